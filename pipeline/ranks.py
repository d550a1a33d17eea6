"""How the ranks of one action find each other: the first decides and says where to meet, the others wait for it.

The place is a file in the attempt's folder, named by the launch (an attempt that was requeued is launched again), so
no port has to be agreed upon beforehand and a rank never joins the meeting of an earlier launch.
"""

from __future__ import annotations

import contextlib
import os
import socket
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from pipeline.errors import Interrupted, StageError
from pipeline.files import read_json, write_json

_PATIENCE_S = 600.0


@dataclass(frozen=True)
class Ranks:
    """Which rank this process is, of how many, in which launch."""

    rank: int = 0
    world_size: int = 1
    launch: str = "alone"

    @classmethod
    def from_environment(cls) -> Ranks:
        """As whoever started the worker has set RANK, WORLD_SIZE and BANMO_LAUNCH; alone otherwise."""
        try:
            rank, size = int(os.environ["RANK"]), int(os.environ["WORLD_SIZE"])
        except (KeyError, ValueError):
            return cls()
        return cls(rank, size, os.environ.get("BANMO_LAUNCH", "alone")) if 0 <= rank < size else cls()

    def path(self, attempt: Path) -> Path:
        """The file by which this launch meets."""
        return attempt / f"meet-{self.launch}.json"

    def call(self, attempt: Path, *, work: bool) -> None:
        """Rank 0: tell the others to work, and where to meet; or that there is nothing to do."""
        if self.world_size == 1:
            return
        address = {"MASTER_ADDR": _own_address(), "MASTER_PORT": str(_free_port())}
        os.environ.update(address)
        write_json(self.path(attempt), {"work": work, **address})

    def follow(self, attempt: Path, stop_requested: Callable[[], bool]) -> bool:
        """Other ranks: wait for rank 0; whether there is work. Raises Interrupted when asked to stop meanwhile."""
        deadline = time.monotonic() + _PATIENCE_S
        while True:
            found = read_json(self.path(attempt))
            if isinstance(found, dict) and "work" in found:
                os.environ.update({k: str(found[k]) for k in ("MASTER_ADDR", "MASTER_PORT")})
                return bool(found["work"])
            if stop_requested():
                raise Interrupted("stopped while waiting for rank 0")
            if time.monotonic() > deadline:
                raise StageError(f"rank 0 has not called within {_PATIENCE_S / 60:.0f} min")
            time.sleep(0.05)


def _free_port() -> int:
    with socket.socket() as server:
        server.bind(("", 0))
        return int(server.getsockname()[1])


def _own_address() -> str:
    """A name or address under which the other ranks reach this machine."""
    if int(os.environ.get("SLURM_JOB_NUM_NODES", "1")) == 1:
        return "127.0.0.1"
    for name in (os.environ.get("SLURMD_NODENAME", ""), socket.gethostname()):
        with contextlib.suppress(OSError):
            address = socket.gethostbyname(name) if name else ""
            if address and not address.startswith("127."):
                return address
    with contextlib.suppress(OSError), socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.connect(("10.255.255.255", 1))  # sends nothing: it asks which interface leads outside
        return str(probe.getsockname()[0])
    return "127.0.0.1"
