"""Score a workspace's exports with an evaluation script given by its path.

``python -m benchmarks.score --evaluate evaluate.py --data DATA/fox --look clean --workspace WORKSPACE [--only mesh]``

Runs ``evaluate.py mesh`` on ``exports/meshes``, ``pose`` on ``exports/cameras``, and a clip ``mask`` and ``flow`` on
the last run's folders, as far as they exist. Prints what the script prints; exit 1 if one of them failed.
"""

from __future__ import annotations

import logging
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Literal

import numpy as np
import tyro

from stages.formats import read_flow

log = logging.getLogger(__name__)

Part = Literal["all", "mesh", "pose", "mask", "flow"]


def flow_as_arrays(folder: Path, target: Path) -> Path:
    """The one-step forward flow of a `flow` folder as ``flow_00004.npy``, which evaluation scripts read."""
    target.mkdir(parents=True, exist_ok=True)
    for picture in sorted((folder / "fw-01").glob("*.png")):
        np.save(target / f"flow_{picture.stem}.npy", read_flow(picture)[0])
    return target


def commands(
    evaluate: Path, data: Path, look: str, workspace: Path, scratch: Path, only: Part = "all"
) -> list[list[str]]:
    """The evaluation commands that make sense for this workspace; `scratch` takes converted flow."""
    truth, exports = data / look / "gt", workspace / "exports"
    run = [sys.executable, str(evaluate)]
    wanted: list[list[str]] = []
    if only in ("all", "mesh") and (exports / "meshes").is_dir():
        wanted.append([*run, "mesh", "--gt", str(data / "gt" / "meshes.npz"), "--pred", str(exports / "meshes")])
    if only in ("all", "pose") and (exports / "cameras").is_dir():
        wanted.append([*run, "pose", "--gt", str(truth), "--pred", str(exports / "cameras")])
    for video in sorted((data / look / "videos").glob("*.mp4")):
        shown = workspace / "latest" / "videos" / video.stem
        for part in ("mask", "flow"):
            folder = shown / ("masks" if part == "mask" else "flow")
            known = truth / f"{video.stem}-{part}.npz"
            if only not in ("all", part) or not folder.is_dir() or not known.is_file():
                continue
            if part == "flow":
                folder = flow_as_arrays(folder, scratch / video.stem)
            wanted.append([*run, part, "--gt", str(known), "--pred", str(folder)])
    return wanted


def main(
    evaluate: Path, data: Path, workspace: Path = Path("workspace"), look: str = "clean", only: Part = "all"
) -> None:
    """Score a workspace's exports against an evaluation data set.

    Args:
        evaluate: Path of the evaluation script.
        data: Folder of one object of the data set.
        workspace: The workspace whose exports are scored.
        look: Which look was reconstructed: clean or casual.
        only: One kind of score.
    """
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    failed = 0
    with tempfile.TemporaryDirectory(prefix="banmo-score-") as scratch:
        wanted = commands(evaluate, data, look, workspace, Path(scratch), only)
        if not wanted:
            log.error("nothing to score in %s", workspace)
            sys.exit(2)
        for command in wanted:
            log.info("$ %s", " ".join(command[1:]))
            failed += subprocess.run(command, check=False).returncode != 0
    sys.exit(1 if failed else 0)


if __name__ == "__main__":
    tyro.cli(main)
