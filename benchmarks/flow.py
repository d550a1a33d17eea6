"""How wrong flow is on an object, one and eight frames on: generated clips with exact truth, and evaluation data.

``python -m benchmarks.flow [--frames 20 --size 256 --seed 0 --kinds cat horse] [--data DATA/fox/casual ...]``

Prints, a clip and step, the mean error in pixels on visible object pixels of what the stage writes, of one direct
match without chains, and of no flow at all. ``--data`` takes folders with ``videos/NAME.mp4`` and
``gt/NAME-flow.npz`` (frames, flow, visible).
"""

from __future__ import annotations

import logging
from collections.abc import Iterator
from pathlib import Path

import av
import cv2
import numpy as np
import tyro

from stages.perception.optical_flow import Chain, FlowPair, Matcher
from synthetic.clips import film, make_subject

log = logging.getLogger(__name__)
STEPS = (1, 2, 4, 8)


def grey_of(images: np.ndarray) -> np.ndarray:
    """(T, H, W) uint8 of (T, H, W, 3) RGB."""
    return np.stack([cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) for image in images])


def pairs_of(images: np.ndarray, steps: tuple[int, ...] = STEPS) -> Iterator[FlowPair]:
    """Every pair as the flow stage computes it with its default quality."""
    return Chain(grey_of(images), Matcher("medium"), Matcher("fine")).pairs(steps)


def error_px(found: np.ndarray, truth: np.ndarray, visible: np.ndarray) -> float:
    """Mean end-point error of flow (H, W, 2) on visible pixels."""
    return float(np.linalg.norm(found - truth, axis=-1)[visible].mean())


def on_generated(kind: str, frames: int, size: int, seed: int) -> dict[int, tuple[float, float, float]]:
    """Step -> mean error of the stage's flow, of a direct match, and of none, on one generated clip."""
    made = film(make_subject(seed, kind), 0, 3, frames, size, seed)
    grey, direct = grey_of(made.images), Matcher("medium")
    rows: dict[int, list[tuple[float, float, float]]] = {}
    for pair in pairs_of(made.images):
        if pair.step not in (1, 8) or pair.first_idx % 2:
            continue
        truth, visible = made.flow(pair.first_idx, pair.second_idx)
        if visible.sum() < 50:
            continue
        plain = direct(grey[pair.first_idx], grey[pair.second_idx])
        errors = (error_px(flow, truth, visible) for flow in (pair.forward, plain, np.zeros_like(truth)))
        rows.setdefault(pair.step, []).append((*errors,))  # type: ignore[arg-type]
    return {step: tuple(np.mean(values, axis=0)) for step, values in rows.items()}  # type: ignore[misc]


def on_data(folder: Path) -> dict[str, tuple[float, float]]:
    """Clip -> mean error at step 1 over the frames with truth, and of no flow, of a folder of evaluation data."""
    found = {}
    for truth_path in sorted((folder / "gt").glob("*-flow.npz")):
        name = truth_path.stem.removesuffix("-flow")
        with np.load(truth_path) as held:
            chosen, truth, visible = held["frames"], held["flow"].astype(np.float32), held["visible"]
        with av.open(str(folder / "videos" / f"{name}.mp4")) as container:
            images = [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
        errors = []
        for k, i in enumerate(chosen):
            pair = next(pairs_of(np.stack(images[i : i + 2]), (1,)))
            errors.append([np.linalg.norm(f - truth[k], axis=-1)[visible[k]] for f in (pair.forward, 0 * truth[k])])
        found[name] = tuple(float(np.concatenate([e[w] for e in errors]).mean()) for w in (0, 1))
    return found  # type: ignore[return-value]


def main(
    data: tuple[Path, ...] = (),
    kinds: tuple[str, ...] = ("cat", "horse"),
    frames: int = 20,
    size: int = 256,
    seed: int = 0,
) -> None:
    """Print the table."""
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    cv2.setNumThreads(1)
    log.info("%-22s %5s %10s %10s %10s", "clip", "step", "stage px", "direct px", "none px")
    for kind in kinds:
        for step, (ours, plain, none) in on_generated(kind, frames, size, seed).items():
            log.info("%-22s %5d %10.3f %10.3f %10.3f", f"generated {kind}", step, ours, plain, none)
    for folder in data:
        rows = on_data(folder)
        for name, (ours, none) in rows.items():
            log.info("%-22s %5d %10.3f %10s %10.3f", name, 1, ours, "", none)
        log.info("%-22s %5d %10.3f", f"mean of {folder}", 1, float(np.mean([r[0] for r in rows.values()])))


if __name__ == "__main__":
    tyro.cli(main)
