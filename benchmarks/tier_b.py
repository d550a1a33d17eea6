"""Put wrong root poses beside the clips: each frame's true rotation turned by some degrees about an axis drawn evenly.

``python -m benchmarks.tier_b --data DATA/fox --out DIR --degrees 20 [--seed 0] [--look clean]``

Clips and true masks lie in DIR as ``benchmarks.tier_a`` lays them, ``NAME.poses.json`` beside them is wrong. Then
``banmo run DIR --workspace W --poses.refine true`` takes the jitter out and moves the poses, and ``benchmarks.score``
tells how far they are from the truth afterwards (degrees, mean and standard deviation, one global rotation removed)
and how good the meshes are. ``evaluate.py pose --pred W/latest/poses`` tells it of the poses that the fit began with.
"""

from __future__ import annotations

import json
import logging
import sys
from pathlib import Path

import torch
import tyro

from benchmarks.tier_a import place
from benchmarks.trials import shaken

log = logging.getLogger(__name__)


def place_turned(data: Path, look: str, out: Path, degrees: float, seed: int = 0) -> list[Path]:
    """Fill `out`; returns what was put there. Raises FileNotFoundError naming what the data set lacks."""
    placed = place(data, look, out, without="poses")
    paths = [data / look / "gt" / f"{video.stem}.json" for video in sorted((data / look / "videos").glob("*.mp4"))]
    documents = [json.loads(path.read_text(encoding="utf-8")) for path in paths]
    true = [torch.tensor(document["object_to_camera"]) for document in documents]
    turned = shaken(torch.cat(true), degrees, seed).split([len(poses) for poses in true])
    for path, document, poses in zip(paths, documents, turned, strict=True):
        target = out / f"{path.stem}.poses.json"
        target.unlink(missing_ok=True)  # what tier_a laid here is a link into the data set
        target.write_text(json.dumps({**document, "object_to_camera": poses.tolist()}) + "\n", encoding="utf-8")
        placed.append(target)
    return placed


def main(data: Path, out: Path, degrees: float = 20.0, seed: int = 0, look: str = "clean") -> None:
    """Put true masks and wrong root poses beside the clips of an evaluation data set.

    Args:
        data: Folder of one object of the data set.
        out: Folder to fill.
        degrees: How far each frame's rotation is turned.
        seed: Of the axes.
        look: Which look of the object: clean or casual.
    """
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    try:
        placed = place_turned(data, look, out, degrees, seed)
    except OSError as error:
        log.error("%s", error)
        sys.exit(2)
    log.info("%d files in %s; now: banmo run %s --poses.refine true", len(placed), out, out)


if __name__ == "__main__":
    tyro.cli(main)
