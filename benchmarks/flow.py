"""How wrong flow is on an object, one and eight frames on: generated clips with exact truth, and evaluation data.

``python -m benchmarks.flow [--frames 20 --size 256 --seed 0 --kinds cat horse] [--data DATA/fox/casual ...]``

Prints, a clip and step, the error in pixels on visible object pixels of what the stage writes (mean, median, mean where
it is sure of itself, share of such pixels), of one direct match without chains, and of no flow at all. ``--data`` takes
folders with ``videos/NAME.mp4`` and ``gt/NAME-flow.npz`` (frames, flow, visible).
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
    return Chain(grey_of(images), Matcher("fine")).pairs(steps)


def error_px(found: np.ndarray, truth: np.ndarray, visible: np.ndarray) -> float:
    """Mean end-point error of flow (H, W, 2) on visible pixels."""
    return float(np.linalg.norm(found - truth, axis=-1)[visible].mean())


def on_generated(kind: str, frames: int, size: int, seed: int) -> dict[int, np.ndarray]:
    """Step -> mean, median, mean where sure, share of sure, of the stage's flow; mean of a direct match, of no flow."""
    made = film(make_subject(seed, kind), 0, 3, frames, size, seed)
    grey, direct = grey_of(made.images), Matcher("medium")
    rows: dict[int, list[list[float]]] = {}
    for pair in pairs_of(made.images):
        if pair.first_idx % 2:
            continue
        truth, visible = made.flow(pair.first_idx, pair.second_idx)
        if visible.sum() < 50:
            continue
        plain = direct(grey[pair.first_idx], grey[pair.second_idx])
        ours = np.linalg.norm(pair.forward - truth, axis=-1)[visible]
        sure = pair.forward_confidence[visible] > 0.5
        others = [error_px(flow, truth, visible) for flow in (plain, np.zeros_like(truth))]
        where_sure = float(ours[sure].mean()) if sure.any() else np.nan
        rows.setdefault(pair.step, []).append(
            [float(ours.mean()), float(np.median(ours)), where_sure, float(sure.mean()), *others]
        )
    return {step: np.nanmean(values, axis=0) for step, values in rows.items()}


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
    kinds: tuple[str, ...] = ("cat", "horse", "person"),
    frames: int = 20,
    size: int = 256,
    seed: int = 0,
) -> None:
    """Print the table."""
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    cv2.setNumThreads(1)
    names = ("mean px", "median", "sure px", "share", "direct px", "none px")
    log.info("%-22s %5s" + 6 * "%10s", "clip", "step", *names)
    for kind in kinds:
        for step, row in on_generated(kind, frames, size, seed).items():
            log.info("%-22s %5d" + 6 * "%10.2f", f"generated {kind}", step, *row)
    for folder in data:
        rows = on_data(folder)
        for name, (ours, none) in rows.items():
            log.info("%-22s %5d%10.3f%50.3f", name, 1, ours, none)
        log.info("%-22s %5d%10.3f", f"mean of {folder}", 1, float(np.mean([r[0] for r in rows.values()])))


if __name__ == "__main__":
    tyro.cli(main)
