"""The user's videos: found, named and hashed in place. Nothing here writes to them.

A video is a file with a known extension, or a folder with images. Its name in the workspace is a safe form of its
stem. What lies beside it under the same stem with one of the stages' ``given`` suffixes belongs to it and is never
itself taken for a video.
"""

from __future__ import annotations

import hashlib
import os
import re
import stat
import time
import unicodedata
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pipeline.errors import BadInput, printable
from pipeline.files import read_json, sha256_file, signature, write_memo

VIDEO_EXTENSIONS = (".mp4", ".mov", ".m4v", ".mkv", ".webm", ".avi", ".gif")
IMAGE_EXTENSIONS = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp")
_RACY_S = 2.0


@dataclass(frozen=True)
class VideoFile:
    """One video of the user. `name` is safe for folders; `display` is what the user called it."""

    name: str
    display: str
    path: Path
    is_folder: bool
    given: dict[str, Path] = field(default_factory=dict)


def discover(folder: Path, suffixes: Iterable[str] = ()) -> list[VideoFile]:
    """The videos in `folder` (or the one video that `folder` is), by name. Raises BadInput with one clear sentence."""
    suffixes = tuple(sorted(set(suffixes), key=len, reverse=True))
    kinds = "mp4 mov m4v mkv webm avi gif, or folders of images"
    try:
        status = folder.stat()
        if stat.S_ISREG(status.st_mode):
            if folder.suffix.lower() not in VIDEO_EXTENSIONS:
                raise BadInput("this file is not a video", where=folder, hint=f"known: {kinds}")
            entries, only = sorted(folder.parent.iterdir()), folder.name
        else:
            entries, only = sorted(folder.iterdir()), None
    except FileNotFoundError as error:
        raise BadInput("there is no such folder of videos", where=folder) from error
    except OSError as error:
        raise BadInput(f"this folder cannot be read ({error.strerror})", where=folder) from error

    names = {entry.name for entry in entries}
    chosen: list[tuple[str, Path, bool]] = []
    for entry in entries:
        if entry.name.startswith(".") or _is_given(entry.name, suffixes) or (only and entry.name != only):
            continue
        found = _classify(entry)
        if found is not None:
            chosen.append(found)
    if not chosen:
        hint = f"put clips there: {kinds}"
        if any(Path(n).suffix.lower() in IMAGE_EXTENSIONS for n in names):
            hint = "images of one clip go into a folder of their own inside it"
        raise BadInput("no videos in this folder" if entries else "this folder is empty", where=folder, hint=hint)

    by_stem: dict[str, Path] = {}
    for stem, path, _ in chosen:
        if stem in by_stem:
            raise BadInput(
                f"{by_stem[stem].name} and {path.name} have the same name before the extension",
                where=folder,
                hint="rename one of them",
            )
        by_stem[stem] = path
    safe = _safe_names([stem for stem, _, _ in chosen])
    videos = []
    for stem, path, is_folder in chosen:
        given = {s: path.parent / (stem + s) for s in suffixes if stem + s in names}
        videos.append(VideoFile(safe[stem], path.name, path.absolute(), is_folder, given))
    return sorted(videos, key=lambda v: v.name)


def orphans(folder: Path, suffixes: Iterable[str], videos: Iterable[VideoFile]) -> list[str]:
    """Names of files that look like what lies beside a video, but whose video is not there."""
    if not folder.is_dir():
        return []
    used = {path.name for video in videos for path in video.given.values()}
    found = [e.name for e in folder.iterdir() if not e.name.startswith(".")]
    return sorted(n for n in found if _is_given(n, tuple(suffixes)) and n not in used)


def _is_given(name: str, suffixes: tuple[str, ...]) -> bool:
    return any(name.endswith(s) and len(name) > len(s) for s in suffixes)


def _classify(entry: Path) -> tuple[str, Path, bool] | None:
    """(stem, path, is_folder) of a video, None for anything else."""
    looks_like_video = entry.suffix.lower() in VIDEO_EXTENSIONS
    try:
        mode = entry.stat().st_mode
    except OSError as error:
        if looks_like_video:
            reason = "it is a link to nothing" if entry.is_symlink() else f"it cannot be read ({error.strerror})"
            raise BadInput(reason, where=entry, hint="mend or remove it") from error
        return None
    if stat.S_ISDIR(mode):
        try:
            has_images = any(_is_image(name) for name in os.listdir(entry))
        except OSError as error:
            raise BadInput(f"this folder cannot be read ({error.strerror})", where=entry) from error
        return (entry.name, entry, True) if has_images else None
    if not looks_like_video:
        return None
    if not stat.S_ISREG(mode):
        raise BadInput("it is not an ordinary file", where=entry, hint="remove it")
    return entry.name[: -len(entry.suffix)], entry, False


def _is_image(name: str) -> bool:
    return not name.startswith(".") and name.lower().endswith(IMAGE_EXTENSIONS)


def slug(stem: str) -> str:
    """A form of `stem` that is safe as a folder name: letters, digits, ``-``, ``_`` and inner dots; may be empty."""
    text = unicodedata.normalize("NFKC", stem)
    kept = "".join(c if unicodedata.category(c)[0] in "LNM" or c in "-_." else "-" for c in text)
    kept = re.sub(r"\.{2,}", "-", kept)
    kept = re.sub(r"-{2,}", "-", kept).strip("-._")
    while len(kept.encode()) > 80:
        kept = kept[:-1]
    return kept.rstrip("-._")


def _safe_names(stems: list[str]) -> dict[str, str]:
    slugs = {stem: slug(stem) for stem in stems}
    counts: dict[str, int] = {}
    for value in slugs.values():
        counts[value.casefold()] = counts.get(value.casefold(), 0) + 1
    names = {}
    for stem, value in slugs.items():
        if not value or (counts[value.casefold()] > 1 and value != stem) or len(value.encode()) > 80:
            tag = hashlib.sha256(stem.encode("utf-8", "surrogateescape")).hexdigest()[:6]
            value = f"{value or 'video'}-{tag}"
        elif counts[value.casefold()] > 1 and any(
            o != stem and o == slugs[o] and o.casefold() == value.casefold() for o in stems
        ):
            value = f"{value}-{hashlib.sha256(stem.encode('utf-8', 'surrogateescape')).hexdigest()[:6]}"
        names[stem] = value
    return names


class SourceDigests:
    """Digests of the user's files, with a memo by (inode, size, mtime, ctime) so that they are read once."""

    def __init__(self, memo: Path | None) -> None:
        self._path = memo
        stored = read_json(memo) if memo else None
        self._memo: dict[str, Any] = stored if isinstance(stored, dict) else {}
        self._dirty = False

    def of(self, path: Path) -> str:
        """SHA-256 of a file; for a folder, the SHA-256 of its listing in sha256sum format (hidden files left out)."""
        try:
            if path.is_dir():
                lines = [f"{self._file(p)}  {name}\n" for name, p in _listing(path)]
                return hashlib.sha256("".join(lines).encode("utf-8", "surrogateescape")).hexdigest()
            return self._file(path)
        except OSError as error:
            reason = "no such file" if isinstance(error, FileNotFoundError) else error.strerror
            raise BadInput(
                f"it cannot be read ({reason})", where=error.filename or path, hint="check its permissions"
            ) from error

    def save(self) -> None:
        """Keep the memo for the next command."""
        if self._path is not None and self._dirty:
            write_memo(self._path, self._memo)
            self._dirty = False

    def _file(self, path: Path) -> str:
        status = path.stat()
        if not stat.S_ISREG(status.st_mode):
            raise BadInput("it is not an ordinary file", where=path, hint="remove it")
        now = signature(status)
        name = os.fsencode(path).decode("utf-8", "backslashreplace")
        known = self._memo.get(name)
        if isinstance(known, list) and len(known) == 2 and known[0] == now:
            return str(known[1])
        started = time.time()
        digest = sha256_file(path)
        after = signature(path.stat())
        if after != now:
            raise BadInput("it changed while it was being read", where=path, hint="wait until it is complete")
        if started - max(status.st_mtime, status.st_ctime) > _RACY_S:
            self._memo[name] = [now, digest]
            self._dirty = True
        return digest


def _listing(folder: Path) -> list[tuple[str, Path]]:
    found: list[tuple[str, Path]] = []
    for current, folders, names in os.walk(folder):
        folders[:] = [f for f in folders if not f.startswith(".")]
        for name in names:
            if not name.startswith("."):
                path = Path(current) / name
                found.append((path.relative_to(folder).as_posix(), path))
    return sorted(found, key=lambda f: os.fsencode(f[0]))


def state_of(path: Path) -> list[Any]:
    """What changes when a source changes; compared before and after a stage has read it. Empty when it is gone."""
    try:
        if path.is_dir():
            return [[printable(name), *signature(p.stat())] for name, p in _listing(path)]
        return signature(path.stat())
    except OSError:
        return []
