"""flow: where each pixel goes, forward and backward, at several distances in time.

Who answers, first to last: `clip.flow/` beside the video (the same layout: `fw-01/00000.png` ... in KITTI's format, or
`.npy`), the ONNX network that the settings name, DIS (OpenCV) on the whole frames, long steps chained from short ones.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from pipeline import BadInput, Folder, Given, InputFile, Resources, Run, Source, Video, stage
from stages.decoding import glance
from stages.formats import (
    FLOW_STEPS,
    Clip,
    FormatError,
    flow_path,
    read_clip,
    read_flow,
    read_json,
    write_flow,
    write_image,
    write_json,
)
from stages.networks import NO_FILE, FlowNetwork
from stages.perception.optical_flow import (
    PRESETS,
    Chain,
    FlowPair,
    Matcher,
    direct_pairs,
    round_trip_error,
)
from stages.perception.sampling import fit_size
from stages.perception.sheets import flow_colours, pick, tile


@dataclass(frozen=True)
class FlowSettings:
    """Settings of the `flow` stage."""

    steps: tuple[int, ...] = FLOW_STEPS
    """Distances in kept frames between which flow is computed."""
    quality: str = "fine"
    """Preset of DIS: ultrafast, fast, medium or fine. Neighbours are matched; longer steps are chained."""
    network: InputFile = NO_FILE
    """An ONNX file of two pictures in, flow out (the OpenCV zoo's RAFT as it is); empty for none."""
    network_contract: InputFile = NO_FILE
    """A small TOML file that says what that network expects; empty for RAFT's contract."""


@stage(per=Video, version=1, given=(".flow",), needs=Resources(cpus=1))
def flow(frames: Folder, given: Given, settings: FlowSettings, out: Path, run: Run) -> None:
    """Flow with forward-backward confidence, KITTI's 16-bit PNG; `flow.json` with consistency figures a step."""
    cv2.setNumThreads(1)  # DIS gives other digits with other thread counts
    clip = read_clip(frames.path)
    steps = _steps(settings, clip)
    folder = given.get(".flow")
    figures: dict[int, list[tuple[float, float]]] = {}
    if folder is not None:
        provider = "given"
        _copy_given(folder, clip, out, figures, run)
    else:
        provider, pairs = _provider(clip, settings, steps, run)
        for done, pair in enumerate(pairs):
            _write_pair(pair, clip, out, figures)
            run.tick(done + 1, sum(len(clip) - s for s in steps), label="flow")
            if run.stop_requested:
                run.interrupt()
    rows = {
        str(step): {
            "pairs": len(values),
            "confidence": round(float(np.mean([v[0] for v in values])), 4),
            "round_trip_px": round(float(np.mean([v[1] for v in values])), 3),
        }
        for step, values in sorted(figures.items())
    }
    write_json(out / "flow.json", {"provider": provider, "steps": rows})
    shortest = rows[str(min(figures))]
    run.metric("provider", provider)
    run.metric("confidence_shortest_step", shortest["confidence"])
    if shortest["confidence"] < 0.4:
        run.warn(f"{run.video or 'this clip'}: flow rarely agrees forward and backward ({shortest['confidence']:.2f})")


def _steps(settings: FlowSettings, clip: Clip) -> tuple[int, ...]:
    if not settings.steps or min(settings.steps) < 1:
        raise BadInput("flow.steps must be distances of one frame or more")
    if settings.quality not in PRESETS:
        raise BadInput(f"flow.quality is {settings.quality!r}, it must be one of {', '.join(PRESETS)}")
    steps = tuple(sorted({s for s in settings.steps if s < len(clip)}))
    return steps or (1,)


def _provider(clip: Clip, settings: FlowSettings, steps: tuple[int, ...], run: Run) -> tuple[str, Iterator[FlowPair]]:
    if settings.network:
        network = FlowNetwork(settings.network, settings.network_contract, device=run.device, threads=run.threads)
        run.log.info("%s on %s", network.name, network.on)
        run.metric("network", f"{network.name} on {network.on}")
        images = clip.images()
        return network.name, direct_pairs(images, steps, network)
    grey = np.stack([cv2.cvtColor(clip.image(i), cv2.COLOR_RGB2GRAY) for i in range(len(clip))])
    return f"dis-{settings.quality}", Chain(grey, Matcher(settings.quality)).pairs(steps)


def _write_pair(pair: FlowPair, clip: Clip, out: Path, figures: dict[int, list[tuple[float, float]]]) -> None:
    """Write both directions; note mean confidence and median round trip.

    Steps of 1/16 px and of 1/15 of confidence are finer than the matching is sure of, and halve the files.
    """
    ways = (
        (pair.first_idx, pair.forward, pair.backward, pair.forward_confidence, False),
        (pair.second_idx, pair.backward, pair.forward, pair.backward_confidence, True),
    )
    for frame_idx, there, back, sure, is_backward in ways:
        path = flow_path(out, pair.step, int(clip.source_idx[frame_idx]), is_backward)
        path.parent.mkdir(exist_ok=True)
        coarse = np.where(sure < 0.1, 0.0, np.ceil(sure * 15) / 15)
        write_flow(path, np.round(there * 16) / 16, coarse)
        if not is_backward:
            trip = round_trip_error(there, back)
            figures.setdefault(pair.step, []).append((float(sure.mean()), float(np.median(trip))))
    figures.setdefault(pair.step, [])


# --------------------------------------------------------------------------------------------- given flow


def _copy_given(
    folder: Path,
    clip: Clip,
    out: Path,
    figures: dict[int, list[tuple[float, float]]],
    run: Run,
) -> None:
    """Check the user's flow against the kept frames and write it as ours; every step there must be whole."""
    if not folder.is_dir():
        raise BadInput(f"{folder.name} must be a folder with fw-01, bw-01 and so on")
    found = 0
    for step in FLOW_STEPS:
        for backward in (False, True):
            given = folder / f"{'bw' if backward else 'fw'}-{step:02d}"
            if not given.is_dir() or step >= len(clip):
                continue
            wanted = clip.source_idx[step:] if backward else clip.source_idx[: len(clip) - step]
            files = {p.stem: p for p in given.iterdir() if p.suffix in (".png", ".npy")}
            lacking = [int(i) for i in wanted if f"{int(i):05d}" not in files]
            surplus = set(files) - {f"{int(i):05d}" for i in wanted}
            if lacking or surplus:
                problem = f"frame {lacking[0]:05d} is missing" if lacking else f"{min(surplus)} fits no kept frame"
                raise BadInput(
                    f"{folder.name}/{given.name} does not match the {len(clip)} frames kept: {problem}",
                    hint="steps count kept frames; frames.max_frames = 0 and frames.least_change = 0 keep them all",
                )
            for i in wanted:
                values, sure = _given_file(files[f"{int(i):05d}"], clip, f"{folder.name}/{given.name}")
                path = flow_path(out, step, int(i), backward)
                path.parent.mkdir(exist_ok=True)
                write_flow(path, values, sure)
                figures.setdefault(step, []).append((float(sure.mean()), 0.0))
            figures.setdefault(step, [])
            found += 1
    if not (out / "fw-01").is_dir() or not (out / "bw-01").is_dir():
        raise BadInput(
            f"{folder.name} must hold at least fw-01 and bw-01", hint="one file a frame, such as fw-01/00000.png"
        )
    run.log.info("%s: %d folders of flow", folder.name, found)


def _given_file(path: Path, clip: Clip, where: str) -> tuple[np.ndarray, np.ndarray]:
    """Flow (H, W, 2) and confidence (H, W) of one given file; `.npy` may hold a third channel, the confidence."""
    name = f"{where}/{path.name}"
    try:
        if path.suffix == ".png":
            values, sure = read_flow(path)
        else:
            array = np.load(path, allow_pickle=False)
            if array.ndim != 3 or array.shape[2] not in (2, 3):
                raise FormatError(f"holds {array.shape}, HxWx2 or HxWx3 expected")
            values = array[..., :2].astype(np.float32)
            sure = array[..., 2].astype(np.float32) if array.shape[2] == 3 else np.ones(array.shape[:2], np.float32)
    except (OSError, ValueError, EOFError) as error:
        raise BadInput(f"{name} cannot be read as flow ({error})") from error
    if values.shape[:2] != (clip.height, clip.width):
        raise BadInput(f"{name} is {values.shape[1]}x{values.shape[0]}, the frames are {clip.width}x{clip.height}")
    if not (np.isfinite(values).all() and np.isfinite(sure).all()):
        raise BadInput(f"{name} holds values that are not finite")
    return values, np.clip(sure, 0.0, 1.0)


@flow.check
def _check(out: Path, frames: Folder) -> None:
    clip = read_clip(frames.path)
    for step in read_json(out / "flow.json")["steps"]:
        count = len(clip) - int(step)
        for way in ("fw", "bw"):
            files = sorted((out / f"{way}-{int(step):02d}").glob("*.png"))
            if files and len(files) != count:
                raise FormatError(f"{way}-{int(step):02d} holds {len(files)} files, {count} expected")
    values, _ = read_flow(
        flow_path(out, 1, int(clip.source_idx[0])) if (out / "fw-01").is_dir() else next(out.glob("fw-*/*.png"))
    )
    if values.shape[:2] != (clip.height, clip.width):
        raise FormatError(f"flow is {values.shape[1]}x{values.shape[0]}, frames {clip.width}x{clip.height}")


@flow.estimate
def _bytes(video: Source, settings: FlowSettings) -> int:
    """About a byte a pixel, pair and direction; how many frames are kept is a guess from the defaults of `frames`."""
    seen = glance(video.path)
    if seen is None:
        return 0
    width, height = fit_size(seen.width, seen.height, 480)
    kept = min(seen.frames, 150)
    return 2 * width * height * sum(max(0, kept - step) for step in settings.steps)


@flow.sheet
def _sheet(out: Path, picture: Path) -> None:
    files = sorted(out.glob("fw-01/*.png")) or sorted(out.glob("fw-*/*.png"))
    write_image(picture, tile([flow_colours(*read_flow(files[i])) for i in pick(len(files))]))
