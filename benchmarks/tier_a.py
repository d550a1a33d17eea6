"""Put what is already known beside the clips: true masks and root poses of an evaluation data set.

``python -m benchmarks.tier_a --data DATA/fox --look clean --out DIR [--without masks|poses] [--copy]``

DATA/fox holds ``<look>/videos/NAME.mp4``, ``<look>/masks/NAME.mp4`` and ``<look>/gt/NAME.json``. In DIR these become
``NAME.mp4``, ``NAME.masks.mp4`` and ``NAME.poses.json``: a folder for ``make reconstruct VIDEOS=DIR`` (the setting of
the paper's Table 1: given masks and root poses). Links by default; the data set is never written to.
"""

from __future__ import annotations

import logging
import shutil
import sys
from pathlib import Path
from typing import Literal

import tyro

log = logging.getLogger(__name__)


def place(
    data: Path,
    look: str,
    out: Path,
    without: Literal["nothing", "masks", "poses", "both"] = "nothing",
    copy: bool = False,
) -> list[Path]:
    """Fill `out`; returns what was put there. Raises FileNotFoundError naming what the data set lacks."""
    videos = sorted((data / look / "videos").glob("*.mp4"))
    if not videos:
        raise FileNotFoundError(f"no clips in {data / look / 'videos'}")
    pairs = []
    for video in videos:
        pairs.append((video, f"{video.stem}.mp4"))
        if without not in ("masks", "both"):
            pairs.append((data / look / "masks" / f"{video.stem}.mp4", f"{video.stem}.masks.mp4"))
        if without not in ("poses", "both"):
            pairs.append((data / look / "gt" / f"{video.stem}.json", f"{video.stem}.poses.json"))
    for source, _ in pairs:
        if not source.is_file():
            raise FileNotFoundError(f"the data set has no {source}")
    out.mkdir(parents=True, exist_ok=True)
    placed = []
    for source, name in pairs:
        target = out / name
        target.unlink(missing_ok=True)
        if copy:
            shutil.copyfile(source, target)
        else:
            target.symlink_to(source.resolve())
        placed.append(target)
    return placed


def main(
    data: Path,
    out: Path,
    look: str = "clean",
    without: Literal["nothing", "masks", "poses", "both"] = "nothing",
    copy: bool = False,
) -> None:
    """Put true masks and root poses beside the clips of an evaluation data set.

    Args:
        data: Folder of one object of the data set.
        out: Folder to fill.
        look: Which look of the object: clean or casual.
        without: Leave out the masks, the poses or both.
        copy: Copy the files rather than link to them.
    """
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    try:
        placed = place(data, look, out, without, copy)
    except (OSError, shutil.SameFileError) as error:
        log.error("%s", error)
        sys.exit(2)
    log.info("%d files in %s; now: make reconstruct VIDEOS=%s", len(placed), out, out)


if __name__ == "__main__":
    tyro.cli(main)
