"""Small file operations that the store is built from: atomic writes, tree removal, failpoints, file signatures."""

from __future__ import annotations

import contextlib
import ctypes
import functools
import glob
import hashlib
import json
import os
import secrets
import shutil
import signal
import stat
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

CHUNK = 1 << 20
_RETIRED = "-retired-"


def failpoint(name: str) -> None:
    """Die here, as from a power cut, if the environment asks for it (tests only)."""
    if os.environ.get("BANMO_FAILPOINT") == name:
        os.kill(os.getpid(), signal.SIGKILL)


def unique() -> str:
    """A short name that no other attempt has."""
    return time.strftime("%Y%m%dT%H%M%S", time.gmtime()) + "-" + secrets.token_hex(4)


def write_atomic(path: Path, text: str, *, durable: bool = False) -> None:
    """Write a text file so that readers see the old or the new content, never a part of one."""
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name[:80]}.{secrets.token_hex(4)}.tmp")
    try:
        with temporary.open("w", encoding="utf-8") as file:
            file.write(text)
            if durable:
                file.flush()
                os.fsync(file.fileno())
        os.replace(temporary, path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise
    if durable:
        sync_folder(path.parent)


def sync_folder(path: Path) -> None:
    """Make the entries of a folder durable, where the file system allows it."""
    try:
        handle = os.open(path, os.O_RDONLY)
    except OSError:
        return
    try:
        os.fsync(handle)
    except OSError:
        pass
    finally:
        os.close(handle)


def flush(path: Path) -> None:
    """Make everything written so far durable on the file system that holds `path`; other disks are not waited for."""
    syncfs = getattr(_libc(), "syncfs", None)
    handle = os.open(path, os.O_RDONLY)
    try:
        if syncfs is None or syncfs(handle) != 0:
            os.sync()
    finally:
        os.close(handle)


@functools.cache
def _libc() -> ctypes.CDLL:
    return ctypes.CDLL(None)


def read_json(path: Path) -> Any:
    """Parsed JSON, or None when the file is missing, torn or not JSON."""
    try:
        return json.loads(path.read_bytes())
    except (OSError, ValueError, RecursionError):
        return None


def write_json(path: Path, value: Any, *, durable: bool = False) -> None:
    """Write JSON atomically; NaN is refused."""
    text = json.dumps(value, indent=1, ensure_ascii=False, allow_nan=False)
    try:
        text.encode()
    except UnicodeEncodeError:  # names of files that are not UTF-8
        text = json.dumps(value, indent=1, allow_nan=False)
    write_atomic(path, text + "\n", durable=durable)


def write_memo(path: Path, value: Any) -> None:
    """Write JSON that only saves time later; a store that cannot be written to does without."""
    with contextlib.suppress(OSError):
        write_json(path, value)


def sha256_file(path: Path) -> str:
    """SHA-256 of a file's content."""
    digest = hashlib.sha256()
    with path.open("rb", buffering=0) as file:
        while chunk := file.read(CHUNK):
            digest.update(chunk)
    return digest.hexdigest()


def signature(status: os.stat_result) -> list[int]:
    """What changes whenever a file's content does: (inode, size, mtime, ctime)."""
    return [status.st_ino, status.st_size, status.st_mtime_ns, status.st_ctime_ns]


def remove_tree(path: Path) -> None:
    """Remove a file or folder of ours, read-only or not; missing is fine. Links are removed, never followed."""
    try:
        status = path.lstat()
    except FileNotFoundError:
        return
    if not stat.S_ISDIR(status.st_mode):
        path.unlink(missing_ok=True)
        return
    for folder, _, _ in os.walk(path):
        with contextlib.suppress(OSError):
            os.chmod(folder, 0o755)
    shutil.rmtree(path, ignore_errors=True)


def relink(link: Path, target: str) -> None:
    """Point a symbolic link at `target`, atomically; a small ``.path`` file where links are not supported."""
    temporary = link.with_name(f".{link.name}.{secrets.token_hex(4)}.tmp")
    link.parent.mkdir(parents=True, exist_ok=True)
    try:
        os.symlink(target, temporary)
        os.replace(temporary, link)
    except OSError:
        temporary.unlink(missing_ok=True)
        write_atomic(link.with_name(link.name + ".path"), target + "\n")


@contextlib.contextmanager
def replacing(target: Path) -> Iterator[Path]:
    """A fresh empty folder beside `target` that takes its place when the block ends without an error.

    A crash between the two renames leaves the old folder beside its place; the next call puts it back first.
    """
    _put_back(target)
    fresh = target.with_name(f".{target.name}-{unique()}")
    try:
        fresh.mkdir(parents=True)
        yield fresh
        retired = target.with_name(f".{target.name}{_RETIRED}{unique()}")
        if target.exists():
            os.rename(target, retired)
        failpoint("between_renames")
        os.rename(fresh, target)
        remove_tree(retired)
    finally:
        remove_tree(fresh)


def _put_back(target: Path) -> None:
    if target.parent.is_dir() and not os.path.lexists(target):
        retired = sorted(target.parent.glob(f".{glob.escape(target.name)}{_RETIRED}*"))
        if retired:
            with contextlib.suppress(OSError):  # another process has just done it
                os.rename(retired[-1], target)
