"""Locks that save work, and never decide what is right: running an action twice is harmless.

On a disk of this machine the kernel's locks, dropped at the holder's death. On a network disk leases that expire: the
holder renews its mark, and whoever has seen no renewal for a while by its own clock takes over. So a lost machine
blocks nobody for long, and clocks need not agree; but a holder that was frozen may find that another has done its work
as well. Nothing built on these locks may break by that; what ``gc`` took too early is made again.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from filelock import BaseFileLock, FileLock, SoftFileLease, Timeout

KERNEL, EXPIRING = "kernel", "expiring"
_NETWORK_TYPES = (
    "nfs", "nfs4", "cifs", "smb3", "smbfs", "lustre", "gpfs", "beegfs", "ceph", "glusterfs", "afs", "9p", "pvfs2",
    "fuse.sshfs", "fuse.glusterfs", "fuse.ceph", "fuse.juicefs", "fuse.s3fs", "fuse.rclone", "fuse.mount.ceph",
)  # fmt: skip


@dataclass(frozen=True)
class Locks:
    """Which locks a workspace uses. All who use it must agree, so the choice lies in the workspace."""

    kind: str = KERNEL
    expire_s: float = 60.0

    @classmethod
    def of(cls, folder: Path, root: Path) -> Locks:
        """As the file ``kind`` in `folder` says; where there is none, by the file system of the workspace `root`."""
        try:
            kind, _, seconds = (folder / "kind").read_text(encoding="ascii").strip().partition(" ")
            if kind in (KERNEL, EXPIRING):
                return cls(kind, min(3600.0, max(0.5, float(seconds or 60))))
        except (OSError, ValueError):
            pass
        return cls(EXPIRING if on_network(root) else KERNEL)

    @property
    def suffix(self) -> str:
        """Of the files; another for each kind, because one must not take the other's for its own."""
        return ".lock" if self.kind == KERNEL else ".lease"

    def at(self, path: Path) -> BaseFileLock:
        """The lock at ``<path><suffix>``."""
        path.parent.mkdir(parents=True, exist_ok=True)
        name = f"{path}{self.suffix}"
        if self.kind == KERNEL:
            return FileLock(name, fallback_to_soft=False)
        return SoftFileLease(name, lease_duration=self.expire_s)

    def held(self, path: Path, patience_s: float = 0.0) -> bool:
        """Whether somebody living holds it. Of an expiring lease that takes `patience_s` > its duration to know."""
        if not os.path.lexists(f"{path}{self.suffix}"):
            return False
        lock = self.at(path)
        try:
            lock.acquire(timeout=patience_s)
        except Timeout:
            return True
        lock.release()
        return False


def on_network(path: Path) -> bool:
    """Whether a folder lies on a file system that other machines may write to."""
    try:
        lines = Path("/proc/self/mounts").read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        return False
    real = os.path.realpath(path)
    best, kind = -1, ""
    for line in lines:
        words = line.split()
        place = words[1].replace("\\040", " ") if len(words) > 2 else ""
        inside = place == "/" or real == place or real.startswith(place + "/")
        if place and inside and len(place) >= best:  # the last mount on a place is the one seen
            best, kind = len(place), words[2]
    return kind in _NETWORK_TYPES


class Patience:
    """How long files that another machine has written may stay invisible here: so much in one command, all in all."""

    def __init__(self, seconds: float) -> None:
        self._left_s = seconds

    def until(self, look: Callable[[], bool]) -> bool:
        """Look again and again until it is there or patience is used up; whether it is there."""
        pause_s = 0.05
        while True:
            started = time.monotonic()
            if look():
                return True
            if self._left_s <= 0:
                return False
            time.sleep(min(pause_s, self._left_s))
            self._left_s -= time.monotonic() - started
            pause_s = min(1.0, 2 * pause_s)
