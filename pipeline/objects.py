"""Immutable folders, named by the hash of their manifest.

``objects/<kind>/<digest>/`` holds the files, ``objects/<kind>/<digest>.sha256`` its manifest in the format of
``sha256sum``: ``sha256sum <digest>.sha256`` prints the folder's own name, ``sha256sum -c`` inside the folder checks it.

Publishing: manifest, seal (the manifest file), one ``syncfs``, ``rename``, read-only. A folder that is there
without its seal, or with other content, is damaged and is moved aside, never deleted, when its content is wanted.
A small memo of file times (``cache/seen``) tells when a folder must be hashed again; it may be removed at any time.
"""

from __future__ import annotations

import contextlib
import errno
import hashlib
import os
import stat
from dataclasses import dataclass
from pathlib import Path

from pipeline.errors import StageError, printable
from pipeline.files import (
    failpoint,
    flush,
    read_json,
    remove_tree,
    sha256_file,
    sync_folder,
    unique,
    write_atomic,
    write_memo,
)


@dataclass(frozen=True)
class Stored:
    """A published folder."""

    kind: str
    digest: str
    path: Path
    files: int
    bytes: int


def build_manifest(folder: Path) -> tuple[str, int, int]:
    """Manifest text, file count and total bytes of a folder. Refuses links, special files and unprintable names."""
    lines: list[tuple[bytes, str]] = []
    total = 0
    for name, path, status in walk(folder):
        if not stat.S_ISREG(status.st_mode):
            raise StageError(f"{printable(name)} is not an ordinary file; a stage's folder holds files only")
        if "\\" in name or not name.isprintable():
            raise StageError(f"{printable(name)}: file names must be printable and without a backslash")
        lines.append((name.encode(), f"{sha256_file(path)}  {name}\n"))
        total += status.st_size
    return "".join(text for _, text in sorted(lines)), len(lines), total


def walk(folder: Path) -> list[tuple[str, Path, os.stat_result]]:
    """Every file below `folder` as (relative POSIX name, path, lstat); links are not followed; any order."""
    found: list[tuple[str, Path, os.stat_result]] = []
    waiting = [("", os.fspath(folder))]
    while waiting:
        prefix, current = waiting.pop()
        with os.scandir(current) as entries:
            for entry in entries:
                name = f"{prefix}{entry.name}"
                if entry.is_dir(follow_symlinks=False):
                    waiting.append((name + "/", entry.path))
                else:
                    found.append((name, Path(entry.path), entry.stat(follow_symlinks=False)))
    return found


def digest_of(manifest: str) -> str:
    """Name of the folder with this manifest."""
    return hashlib.sha256(manifest.encode()).hexdigest()


def parse_manifest(text: str) -> dict[str, str] | None:
    """File name -> digest, or None when the text is no manifest."""
    entries: dict[str, str] = {}
    for line in text.splitlines():
        digest, gap, name = line[:64], line[64:66], line[66:]
        if gap != "  " or not name or len(digest) != 64 or set(digest) - set("0123456789abcdef"):
            return None
        entries[name] = digest
    return entries


class Objects:
    """The store below ``objects/``; ``seen`` is the memo folder, ``tmp`` takes damaged folders."""

    def __init__(self, root: Path, *, seen: Path, tmp: Path) -> None:
        self.root, self._seen, self._tmp = root, seen, tmp

    def path(self, kind: str, digest: str) -> Path:
        """Where the folder of this digest lies."""
        return self.root / kind / digest

    def seal_path(self, kind: str, digest: str) -> Path:
        """Where its manifest lies."""
        return self.root / kind / f"{digest}.sha256"

    # ------------------------------------------------------------------ writing

    def publish(self, kind: str, scratch: Path) -> Stored:
        """Move a finished scratch folder into the store. The same content published twice is stored once."""
        _drop_empty_folders(scratch)
        manifest, files, total = build_manifest(scratch)
        if files == 0:
            raise StageError("it wrote no files")
        digest = digest_of(manifest)
        target = self.path(kind, digest)
        target.parent.mkdir(parents=True, exist_ok=True)
        failpoint("after_manifest")
        if os.path.lexists(target) and self.deep_check(kind, digest):
            self.set_aside(kind, digest)
        if os.path.lexists(target):
            remove_tree(scratch)  # the same bytes are there already
        else:
            self._move_in(scratch, target, manifest)
        os.chmod(target, 0o555)
        sync_folder(target.parent)
        self._remember(kind, digest)
        return Stored(kind, digest, target, files, total)

    def _move_in(self, scratch: Path, target: Path, manifest: str) -> None:
        _make_read_only(scratch)
        write_atomic(target.with_name(f"{target.name}.sha256"), manifest)
        failpoint("after_seal")
        flush(target.parent)  # the files and the seal are durable before the folder gets its name
        failpoint("after_sync")
        try:
            os.rename(scratch, target)
        except OSError as error:
            if error.errno not in (errno.ENOTEMPTY, errno.EEXIST):
                raise
            remove_tree(scratch)  # another process published the same bytes meanwhile
        failpoint("after_rename")

    def set_aside(self, kind: str, digest: str) -> Path | None:
        """Move a damaged folder and its seal out of the way, into ``tmp/damaged-…``; None if nothing was there."""
        refuge = self._tmp / f"damaged-{kind}-{digest[:12]}-{unique()}"
        moved = False
        for path in (self.path(kind, digest), self.seal_path(kind, digest)):
            if not os.path.lexists(path):
                continue
            refuge.mkdir(parents=True, exist_ok=True)
            try:
                if path.is_dir() and not path.is_symlink():
                    os.chmod(path, 0o755)  # moving a read-only folder is refused for ordinary users
                os.rename(path, refuge / path.name)
                moved = True
            except FileNotFoundError:
                pass
        self.forget(kind, digest)
        return refuge if moved else None

    def remove(self, kind: str, digest: str) -> None:
        """Delete a folder and its seal (gc only). The folder leaves its name first, so no half is ever visible."""
        aside = self.set_aside(kind, digest)
        if aside is not None:
            remove_tree(aside)

    # ------------------------------------------------------------------ reading

    def sound(self, kind: str, digest: str) -> bool:
        """Whether the folder is complete and, as far as file times tell, unchanged; hashes it when they moved."""
        if not self.seal_path(kind, digest).is_file():
            return False
        signature = self._signature(kind, digest)
        if signature is None:
            return False
        seen = read_json(self._memo(kind, digest))
        if isinstance(seen, dict) and seen.get("signature") == signature:
            return True
        if self.deep_check(kind, digest):
            return False
        self._remember(kind, digest)
        return True

    def deep_check(self, kind: str, digest: str) -> list[str]:
        """Hash everything; one line for each thing that is wrong, none when sound."""
        folder, seal = self.path(kind, digest), self.seal_path(kind, digest)
        label = f"objects/{kind}/{digest}"
        try:
            text = seal.read_text(encoding="utf-8")
        except (OSError, UnicodeDecodeError):
            return [f"{label}.sha256: missing or unreadable"]
        entries = parse_manifest(text)
        if digest_of(text) != digest or entries is None:
            return [f"{label}.sha256: its content was changed"]
        if folder.is_symlink() or not folder.is_dir():
            return [f"{label}: missing"]
        faults: list[str] = []
        present = {name: (path, status) for name, path, status in walk(folder)}
        for name in sorted(entries.keys() - present.keys()):
            faults.append(f"{label}/{name}: missing")
        for name in sorted(present.keys() - entries.keys()):
            faults.append(f"{label}/{printable(name)}: does not belong here")
        for name in sorted(entries.keys() & present.keys()):
            path, status = present[name]
            try:
                same = stat.S_ISREG(status.st_mode) and sha256_file(path) == entries[name]
            except OSError as error:
                faults.append(f"{label}/{name}: cannot be read ({error.strerror})")
                continue
            if not same:
                faults.append(f"{label}/{name}: its content was changed")
        return faults

    def quick_check(self, kind: str, digest: str, files: int, size: int) -> list[str]:
        """Compare file count and total size, without hashing."""
        label = f"objects/{kind}/{digest}"
        if not self.seal_path(kind, digest).is_file():
            return [f"{label}.sha256: missing"]
        try:
            found = walk(self.path(kind, digest))
        except OSError:
            return [f"{label}: missing"]
        total = sum(status.st_size for _, _, status in found)
        if (len(found), total) != (files, size):
            return [f"{label}: {len(found)} files of {total} bytes, recorded {files} of {size}"]
        return []

    def everything(self) -> list[tuple[str, str]]:
        """(kind, digest) of every folder or seal in the store."""
        found: set[tuple[str, str]] = set()
        if self.root.is_dir():
            for kind in self.root.iterdir():
                if kind.is_dir() and not kind.is_symlink():
                    for entry in kind.iterdir():
                        name = entry.name.removesuffix(".sha256")
                        if len(name) == 64 and not name.startswith("."):
                            found.add((kind.name, name))
        return sorted(found)

    def forget(self, kind: str, digest: str) -> None:
        """Drop the memo, so that the next look hashes the folder."""
        self._memo(kind, digest).unlink(missing_ok=True)

    def _memo(self, kind: str, digest: str) -> Path:
        return self._seen / f"{kind}-{digest}.json"

    def _remember(self, kind: str, digest: str) -> None:
        signature = self._signature(kind, digest)
        if signature is not None:
            write_memo(self._memo(kind, digest), {"signature": signature})

    def _signature(self, kind: str, digest: str) -> str | None:
        """Names, sizes and times of everything in a folder, hashed; asked of every result by every command."""
        root = os.fspath(self.path(kind, digest))
        lines: list[str] = []
        waiting = [("", root)]
        try:
            if os.path.islink(root):
                return None
            while waiting:
                prefix, current = waiting.pop()
                with os.scandir(current) as entries:
                    for entry in entries:
                        s = entry.stat(follow_symlinks=False)
                        if stat.S_ISDIR(s.st_mode):
                            waiting.append((f"{prefix}{entry.name}/", entry.path))
                        else:
                            kept = f"{s.st_mode & 0o170000}\0{s.st_size}\0{s.st_mtime_ns}\0{s.st_ctime_ns}"
                            lines.append(f"{prefix}{entry.name}\0{kept}")
        except OSError:
            return None
        lines.sort()
        return hashlib.sha256("\n".join(lines).encode("utf-8", "surrogateescape")).hexdigest()


def _drop_empty_folders(folder: Path) -> None:
    for current, _, _ in os.walk(folder, topdown=False):
        if Path(current) != folder:
            with contextlib.suppress(OSError):  # not empty
                os.rmdir(current)


def _make_read_only(folder: Path) -> None:
    """Files and inner folders become read-only; the folder itself only after the rename."""
    waiting = [os.fspath(folder)]
    while waiting:
        with os.scandir(waiting.pop()) as entries:
            for entry in entries:
                if entry.is_dir(follow_symlinks=False):
                    waiting.append(entry.path)
                os.chmod(entry.path, 0o555 if entry.is_dir(follow_symlinks=False) else 0o444)
