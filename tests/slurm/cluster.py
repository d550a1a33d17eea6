"""A real Slurm of two nodes with two pretended GPUs each, on one machine, started and ended by a test.

Needs the programs of a Slurm distribution (Debian: ``slurm-wlm munge``) and the rights of the superuser, because
``slurmd`` starts jobs as other users. Nothing outside its own folder is written.
"""

from __future__ import annotations

import ctypes
import os
import shutil
import signal
import socket
import stat
import subprocess
import time
from dataclasses import dataclass, field
from pathlib import Path

PROGRAMS = ("munged", "slurmctld", "slurmd", "sbatch", "srun", "squeue", "scancel", "scontrol")
NODES = ("n1", "n2")

_CONF = """\
ClusterName=banmotest
SlurmctldHost={host}
SlurmUser=root
SlurmdUser=root
AuthType=auth/munge
AuthInfo=socket={root}/munge.socket
CredType=cred/munge
StateSaveLocation={root}/state
SlurmctldPidFile={root}/slurmctld.pid
SlurmctldLogFile={root}/slurmctld.log
SlurmctldPort={port}
SlurmdSpoolDir={root}/spool-%n
SlurmdPidFile={root}/slurmd-%n.pid
SlurmdLogFile={root}/slurmd-%n.log
SlurmdParameters=config_overrides
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
MpiDefault=none
SelectType=select/cons_tres
SelectTypeParameters=CR_Core
SchedulerType=sched/backfill
SchedulerParameters=bf_interval=1,sched_interval=2,requeue_delay=0
PreemptType=preempt/partition_prio
PreemptMode=REQUEUE
AccountingStorageType=accounting_storage/none
JobAcctGatherType=jobacct_gather/none
GresTypes=gpu
KillWait=10
MinJobAge=60
ReturnToService=2
SlurmdTimeout=300
{nodes}
PartitionName=debug Nodes=n1,n2 Default=YES MaxTime=INFINITE State=UP PriorityTier=1 GraceTime=30
PartitionName=urgent Nodes=n1,n2 MaxTime=INFINITE State=UP PriorityTier=10 PreemptMode=OFF
"""


def missing() -> str:
    """Why no cluster can be started here; "" when one can."""
    absent = [p for p in PROGRAMS if shutil.which(p) is None]
    if absent:
        return f"no {', '.join(absent)} here (Debian: apt-get install slurm-wlm munge)"
    return "" if os.geteuid() == 0 else "slurmd needs the superuser"


def _free_port() -> int:
    with socket.socket() as server:
        server.bind(("127.0.0.1", 0))
        return int(server.getsockname()[1])


def _die_with_parent() -> None:
    """In a daemon about to start: end when the tests are killed (PR_SET_PDEATHSIG)."""
    ctypes.CDLL(None).prctl(1, signal.SIGTERM)


@dataclass
class Cluster:
    """The running daemons. Commands find it by ``environment``."""

    root: Path
    processes: list[subprocess.Popen[bytes]] = field(default_factory=list)

    @property
    def environment(self) -> dict[str, str]:
        """What a process needs to talk to this cluster."""
        return {"SLURM_CONF": str(self.root / "slurm.conf")}

    def start(self) -> None:
        """Start everything and wait until both nodes are idle."""
        self.root.mkdir(parents=True, exist_ok=True)
        host = socket.gethostname()
        key = self.root / "munge.key"
        key.write_bytes(os.urandom(128))
        key.chmod(0o600)
        lines = []
        for node in NODES:
            lines.append(
                f"NodeName={node} NodeHostname={host} NodeAddr=127.0.0.1 Port={_free_port()} CPUs=4 "
                "RealMemory=4000 Gres=gpu:2 State=UNKNOWN"
            )
            for i in range(2):
                device = self.root / f"{node}-gpu{i}"
                device.unlink(missing_ok=True)
                os.mknod(device, stat.S_IFCHR | 0o666, os.makedev(1, 3))  # another /dev/null: Slurm wants a device
            (self.root / f"spool-{node}").mkdir(exist_ok=True)
        (self.root / "state").mkdir(exist_ok=True)
        gres = "".join(f"NodeName={n} Name=gpu File={self.root}/{n}-gpu[0-1]\n" for n in NODES)
        (self.root / "gres.conf").write_text(gres)
        text = _CONF.format(host=host, root=self.root, port=_free_port(), nodes="\n".join(lines))
        (self.root / "slurm.conf").write_text(text)
        (self.root / "cgroup.conf").write_text("CgroupAutomount=no\n")
        self._spawn(
            "munged", "--foreground", "--force", f"--key-file={key}", f"--socket={self.root}/munge.socket",
            f"--pid-file={self.root}/munged.pid", f"--log-file={self.root}/munged.log",
            f"--seed-file={self.root}/munged.seed", "--num-threads=2",
        )  # fmt: skip
        self._wait(lambda: (self.root / "munge.socket").exists(), "munged")
        self._spawn("slurmctld", "-D", "-f", str(self.root / "slurm.conf"))
        for node in NODES:
            self._spawn("slurmd", "-D", "-N", node, "-f", str(self.root / "slurm.conf"))
        self._wait(lambda: self.idle() == 2, "two idle nodes", 60.0)

    def idle(self) -> int:
        """How many nodes are idle now."""
        return self.command("sinfo", "-h", "-N", "-p", "debug", "-o", "%T").split().count("idle")

    def command(self, *words: str) -> str:
        """Standard output of a Slurm command; "" when it fails."""
        done = subprocess.run(words, capture_output=True, text=True, env={**os.environ, **self.environment})
        with (self.root / "commands.txt").open("a") as log:
            log.write(f"{time.strftime('%H:%M:%S')} {' '.join(words)} -> {done.returncode} {done.stderr}\n")
        return done.stdout if done.returncode == 0 else ""

    def stop(self) -> None:
        """End the daemons, and with them every job."""
        self.command("scancel", "--user", "root")
        deadline = time.monotonic() + 20.0  # the daemons' own children end only with their jobs
        while self.command("squeue", "-h").strip() and time.monotonic() < deadline:
            time.sleep(0.5)
        for process in reversed(self.processes):
            process.terminate()
        for process in self.processes:
            try:
                process.wait(timeout=10)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()

    def _spawn(self, *words: str) -> None:
        log = (self.root / f"{words[0]}-{len(self.processes)}.out").open("wb")
        with log:
            process = subprocess.Popen(
                words,
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                env={**os.environ, **self.environment},
                preexec_fn=_die_with_parent,
            )
        self.processes.append(process)

    def _wait(self, condition: object, what: str, timeout_s: float = 30.0) -> None:
        deadline = time.monotonic() + timeout_s
        while not condition():  # type: ignore[operator]
            dead = [p.args for p in self.processes if p.poll() is not None]
            if dead or time.monotonic() > deadline:
                logs = "\n".join(p.read_text(errors="replace")[-1500:] for p in self.root.glob("*.out"))
                logs += "\n".join(p.read_text(errors="replace")[-1500:] for p in self.root.glob("*.log"))
                self.stop()
                raise RuntimeError(f"no {what} (ended: {dead})\n{logs}")
            time.sleep(0.2)
