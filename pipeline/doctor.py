"""What this machine and workspace can do: cores, memory, GPUs, disk, links, locks, clock, stages."""

from __future__ import annotations

import os
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

from pipeline.console import size
from pipeline.definition import load
from pipeline.errors import PipelineError
from pipeline.local import machine_cpus, machine_gpus
from pipeline.locks import EXPIRING, KERNEL, Locks, on_network
from pipeline.project import Options
from pipeline.workspace import Workspace

_LOW_DISK = 5_000_000_000


@dataclass(frozen=True)
class Row:
    """One thing looked at."""

    name: str
    ok: bool
    text: str


def examine(options: Options) -> list[Row]:
    """Look at everything; a row each."""
    rows = [
        Row("python", sys.version_info >= (3, 11), sys.version.split()[0]),
        Row("cores", True, str(machine_cpus())),
        Row("memory", True, size(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"))),
    ]
    gpus = machine_gpus()
    rows.append(Row("gpus", True, ", ".join(gpus) or "none; everything runs on the CPU"))
    root = options.workspace if options.workspace.is_dir() else options.workspace.absolute().parent
    rows += _disk(root)
    rows += _stages(options)
    return rows


def _disk(root: Path) -> list[Row]:
    try:
        status = os.statvfs(root)
        free = status.f_bavail * status.f_frsize
        rows = [Row("disk", free > _LOW_DISK, f"{size(free)} free at {root}")]
        with tempfile.TemporaryDirectory(dir=root, prefix=".doctor-") as scratch:
            folder = Path(scratch)
            probe = folder / "probe"
            probe.write_text("x", encoding="utf-8")
            skew = abs(probe.stat().st_mtime - time.time())
            rows.append(Row("clock", skew < 2, f"the disk's clock is {skew:.1f} s away from the machine's"))
            rows.append(_links(folder))
            locks = Locks(EXPIRING if on_network(folder) else KERNEL)
            with locks.at(folder / "lock").acquire(timeout=5):
                kind = "the kernel's" if locks.kind == KERNEL else "leases that expire, for this is a network disk"
                rows.append(Row("locks", True, f"work here: {kind}"))
        return rows
    except OSError as error:
        return [Row("disk", False, f"{root} cannot be written ({error.strerror})")]


def _links(folder: Path) -> Row:
    try:
        (folder / "link").symlink_to("probe")
        return Row("links", True, "work here")
    except OSError:
        return Row("links", True, "do not work here; views become small .path files")


def _stages(options: Options) -> list[Row]:
    try:
        known = (options.workspace / "FORMAT").is_file()
        workspace = Workspace.open(options.workspace) if known else None
        memory = workspace.remembered() if workspace else {}
        package = options.definition or str(memory.get("definition") or "stages")
        definition = load(package, workspace.cache if workspace else None)
    except PipelineError as error:
        return [Row("stages", False, str(error))]
    broken = [f"{i.name}: {i.error}" for i in definition.stages.values() if i.error]
    names = ", ".join(definition.stages)
    return [Row("stages", not broken, "; ".join(broken) or names)]
