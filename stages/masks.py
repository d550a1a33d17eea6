"""masks: how probably each pixel of each kept frame is the object.

Who answers, first to last: what lies beside the video (`clip.masks/` with PNGs, `clip.masks.mp4`), the ONNX network
that the settings name, the built-in segmentation by motion, place and colour (steered by `clip.hints.toml`).
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from pipeline import BadInput, Folder, Given, InputFile, Resources, Run, Video, stage
from stages.decoding import list_images, read_frames
from stages.formats import (
    Clip,
    FormatError,
    MaskFacts,
    read_clip,
    read_image,
    read_json,
    read_mask_facts,
    read_masks,
    write_image,
    write_mask_facts,
)
from stages.networks import NO_FILE, PromptedMaskNetwork, mask_network
from stages.own_networks import CATEGORIES, OwnFinder, OwnRefiner, OwnTrunk
from stages.perception.background import shrink
from stages.perception.category import OTHER
from stages.perception.optical_flow import Matcher, sample
from stages.perception.prior import object_priors
from stages.perception.prompts import Prompt, prompts_of
from stages.perception.segmentation import Effort, Hint, Segmentation, segment
from stages.perception.sheets import mask_sheet
from stages.perception.temporal import area_steadiness, describe

ASPECT_TOLERANCE = 0.02
HINT_KEYS = {"frame", "time_s", "box", "inside", "outside"}


@dataclass(frozen=True)
class MaskSettings:
    """Settings of the `masks` stage."""

    threshold: float = 0.5
    """Probability above which a pixel counts as the object, for boxes, areas and flags."""
    category: str = "auto"
    """quadruped or human: a network of ours that knows it helps; other: none does; auto: whichever fits what moves."""
    refinements: int = 1
    """How often a network of ours goes over the rough mask of a quadruped or a person (once more where it is in doubt);
    0 leaves it rough."""
    seed: int = 0
    """Seed of the built-in segmentation."""
    network: InputFile = NO_FILE
    """An ONNX file that turns a 1x3xHxW picture into a 1x1xHxW mask (u2net, isnet, birefnet ...); empty for none."""
    network_contract: InputFile = NO_FILE
    """A small TOML file that says what that network expects (see docs/workspace.md); empty for sane defaults."""


@stage(per=Video, version=1, given=(".masks", ".masks.mp4", ".hints.toml"), needs=Resources(cpus=1))
def masks(frames: Folder, given: Given, settings: MaskSettings, out: Path, run: Run) -> None:
    """Foreground probability of every frame, one 8-bit PNG each; `masks.json` says who answered and how sure it is."""
    cv2.setNumThreads(1)  # DIS gives other digits with other thread counts
    clip = read_clip(frames.path)
    folder, video = given.get(".masks"), given.get(".masks.mp4")
    if folder is not None:
        provider, result = "given-folder", _certain(_from_folder(folder, clip))
    elif video is not None:
        provider, result = "given-video", _certain(_from_video(video, clip, run))
    elif settings.network:
        provider, result = "network", _from_network(clip, given, settings, run)
    else:
        hints = read_hints(given.get(".hints.toml"), clip)
        provider = "builtin"
        images = clip.images()
        networks = _own_networks(settings.category, run)
        priors, refiner, trunk = {}, None, None
        if networks is not None:
            finder, refiner, trunk = networks
            priors = _priors(images, settings.category, finder, run)
        result = segment(
            images, hints, _effort(settings), tick=_ticker(run), priors=priors, refiner=refiner, trunk=trunk
        )
        found_again = result.found_again or result.looked_again
        run.metric("category_prior", result.prior or "none")
        run.metric("found_by", OwnFinder.name if result.prior else "none")
        run.metric("refined_by", OwnRefiner.name if result.refined else "none")
        run.metric("frames_found_again", result.found_again)
        run.metric("found_again_by", OwnTrunk.name if found_again else "none")
        run.metric("frames_with_pieces_added", result.with_pieces)
    for name, mask in zip(clip.names, result.probability, strict=True):
        write_image(out / name, mask)
    facts = _facts(provider, result, clip, settings.threshold)
    write_mask_facts(out, facts, clip)
    _report(facts, settings, run, clip)


def _effort(settings: MaskSettings) -> Effort:
    return Effort(refinements=settings.refinements, seed=settings.seed % 2**32)  # numpy takes no negative seeds


def _own_networks(category: str, run: Run) -> tuple[OwnFinder, OwnRefiner, OwnTrunk] | None:
    """Our networks; None where the settings say that the object is of no category."""
    if category not in ("auto", OTHER, *CATEGORIES):
        known = ", ".join(("auto", *CATEGORIES, OTHER))
        raise BadInput(f"masks.category is {category!r}", hint=f"known: {known}")
    if category == OTHER:
        return None
    return OwnFinder(threads=run.threads), OwnRefiner(threads=run.threads), OwnTrunk(threads=run.threads)


def _priors(images: np.ndarray, category: str, finder: OwnFinder, run: Run) -> dict[str, np.ndarray]:
    """What a network of ours takes for the object, (T, H, W) uint8 a category; of the named one alone if one is."""
    wanted = CATEGORIES if category == "auto" else (category,)
    run.tick(0, 1, label=f"looking for a {' or a '.join(wanted)}")
    return object_priors(images, finder, {name: CATEGORIES.index(name) for name in wanted})


def _ticker(run: Run) -> Callable[[int, int, str], None]:
    def tick(done: int, total: int, label: str) -> None:
        run.tick(done, total, label=label)
        if run.stop_requested:
            run.interrupt()

    return tick


def _certain(probability: np.ndarray) -> Segmentation:
    return Segmentation(probability, np.ones(len(probability)))


# --------------------------------------------------------------------------------------------- given masks


def _from_folder(folder: Path, clip: Clip) -> np.ndarray:
    """(T, H, W) uint8 from one PNG a source frame, or one a kept frame."""
    if not folder.is_dir():
        raise BadInput(f"{folder.name} must be a folder of mask images")
    paths = list_images(folder)
    picked = [paths[i] for i in pick_files([p.stem for p in paths], clip, folder.name)]
    return np.stack([_fit(_grey_file(path), clip, f"{folder.name}/{path.name}") for path in picked])


def pick_files(stems: list[str], clip: Clip, what: str) -> list[int]:
    """Which of the given files belongs to each kept frame.

    One file a source frame in natural order, or files whose last number is the source index of a kept frame, or one
    file a kept frame; anything else is refused.
    """
    source, kept = len(clip.source_time_s), len(clip)
    if len(stems) == source:
        return [int(i) for i in clip.source_idx]
    numbers = {}
    for position, stem in enumerate(stems):
        digits = [int(digits) for digits in re.findall(r"\d+", stem)]
        if digits:
            numbers[digits[-1]] = position
    wanted = [int(i) for i in clip.source_idx]
    if all(i in numbers for i in wanted) and len(stems) < source:
        return [numbers[i] for i in wanted]
    if len(stems) == kept:
        return list(range(kept))
    either = f"{source}" if source == kept else f"{source} (one a frame) or {kept} (one a kept frame)"
    raise BadInput(f"{what} holds {len(stems)} masks, but the video has {either}")


def _grey_file(path: Path) -> np.ndarray:
    """Largest channel of an image file as (H, W) uint8: palettes and coloured masks count as object where not black."""
    try:
        return read_image(path).max(axis=2)
    except FormatError as error:
        raise BadInput(f"{path.parent.name}/{path.name} cannot be read as an image") from error


def _from_video(path: Path, clip: Clip, run: Run) -> np.ndarray:
    """(T, H, W) uint8 from a video of masks with one frame a source frame, or one a kept frame."""
    source, kept = len(clip.source_time_s), len(clip)
    found = [_fit(f.image.max(axis=2), clip, path.name) for f in read_frames(path)]
    run.log.info("%s: %d frames", path.name, len(found))
    if len(found) == source:
        return np.stack([found[int(i)] for i in clip.source_idx])
    if len(found) == kept:
        return np.stack(found)
    raise BadInput(f"{path.name} holds {len(found)} masks, but the video has {source} frames")


def _fit(mask: np.ndarray, clip: Clip, what: str) -> np.ndarray:
    """A mask at the size of the kept frames; another shape of picture is refused."""
    height, width = mask.shape
    if (width, height) == (clip.width, clip.height):
        return mask
    if abs(width / height / (clip.width / clip.height) - 1) > ASPECT_TOLERANCE:
        frame = f"{clip.width}x{clip.height}"
        raise BadInput(f"{what} is {width}x{height}, which has another shape than the frames ({frame})")
    shrinking = width > clip.width
    return cv2.resize(mask, (clip.width, clip.height), interpolation=cv2.INTER_AREA if shrinking else cv2.INTER_LINEAR)


# --------------------------------------------------------------------------------------------- network and hints


def _from_network(clip: Clip, given: Given, settings: MaskSettings, run: Run) -> Segmentation:
    network = mask_network(settings.network, settings.network_contract, device=run.device, threads=run.threads)
    run.log.info("%s on %s", network.name, network.on)
    run.metric("network", f"{network.name} on {network.on}")
    prompts = _prompts(clip, given, settings, run) if isinstance(network, PromptedMaskNetwork) else []
    found = []
    for i in run.progress(range(len(clip)), label="network"):
        image = clip.image(i)
        if not isinstance(network, PromptedMaskNetwork):
            mask = network(image)
        elif prompts[i].empty:
            mask = np.zeros(image.shape[:2], np.float32)
        else:
            mask = network(image, prompts[i].box, prompts[i].inside, prompts[i].outside)
        found.append(np.round(mask * 255).astype(np.uint8))
    probability = np.stack(found)
    # A network that is sure says 0 or 1; the share of undecided pixels on the object's own scale lowers the trust.
    undecided = ((probability > 38) & (probability < 217)).reshape(len(clip), -1).sum(axis=1)
    object_px = (probability > 127).reshape(len(clip), -1).sum(axis=1)
    return Segmentation(probability, np.clip(1 - undecided / np.maximum(object_px, 1), 0, 1))


def _prompts(clip: Clip, given: Given, settings: MaskSettings, run: Run) -> list[Prompt]:
    """Where to look in each frame: the user's hints, and the built-in segmentation that they steer."""
    hints = read_hints(given.get(".hints.toml"), clip)
    rough = segment(clip.images(), hints, _effort(settings), tick=_ticker(run))
    return prompts_of(rough.probability > 127, hints)


def read_hints(path: Path | None, clip: Clip) -> tuple[Hint, ...]:
    """`clip.hints.toml`: tables `[[hint]]` with `frame` (source index) or `time_s`, and `box`, `inside` or `outside`.

    Coordinates are pixels of the upright source video. Raises `BadInput` on anything else.
    """
    if path is None:
        return ()
    try:
        table = tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise BadInput(f"{path.name} cannot be read as TOML ({error})") from error
    rows = table.get("hint", [])
    if set(table) - {"hint"} or not isinstance(rows, list) or not rows:
        raise BadInput(f"{path.name} must hold tables [[hint]] and nothing else")
    info = read_json(clip.root / "frames.json")
    scale = np.array(
        [clip.width / info.get("source_width", clip.width), clip.height / info.get("source_height", clip.height)]
    )
    return tuple(_hint(row, i, path.name, clip, scale) for i, row in enumerate(rows))


def _hint(row: dict[str, Any], number: int, name: str, clip: Clip, scale: np.ndarray) -> Hint:
    where = f"{name}, hint {number + 1}"
    if set(row) - HINT_KEYS or not ({"frame", "time_s"} & set(row)) or not ({"box", "inside", "outside"} & set(row)):
        raise BadInput(f"{where}: needs frame or time_s, and box, inside or outside; it has {', '.join(sorted(row))}")
    try:
        if "frame" in row:
            frame_idx = int(np.argmin(np.abs(clip.source_idx - int(row["frame"]))))
        else:
            frame_idx = int(np.argmin(np.abs(clip.time_s - float(row["time_s"]))))
        box = np.array(row["box"], float).reshape(4) * np.tile(scale, 2) if "box" in row else None
        points = {k: np.array(row.get(k, []), float).reshape(-1, 2) * scale for k in ("inside", "outside")}
    except (TypeError, ValueError, OverflowError) as error:
        raise BadInput(
            f"{where}: box is [x0, y0, x1, y1], inside and outside are lists of [x, y], in pixels"
        ) from error
    if box is not None and not (box[2] > box[0] and box[3] > box[1]):
        raise BadInput(f"{where}: box must be [x0, y0, x1, y1] with x0 < x1 and y0 < y1")
    limit = np.array([clip.width, clip.height], float)
    corners = np.zeros((0, 2)) if box is None else box.reshape(2, 2)
    everything = np.concatenate([*points.values(), corners])
    if (everything < -0.02 * limit).any() or (everything > 1.02 * limit).any() or not np.isfinite(everything).all():
        raise BadInput(f"{where}: a coordinate lies outside the picture")
    return Hint(frame_idx, box, points["inside"], points["outside"])


# --------------------------------------------------------------------------------------------- judging


def _facts(provider: str, result: Segmentation, clip: Clip, threshold: float) -> MaskFacts:
    binary = result.probability > threshold * 255
    track = describe(binary, _carried(binary, clip))
    confidence = np.clip(result.agreement, 0, 1)
    if not provider.startswith("given"):
        confidence = confidence * np.clip(track.overlap / 0.8, 0, 1) * np.clip(area_steadiness(track.area) / 0.7, 0, 1)
    confidence = np.where(track.area > 0, confidence, 0.0)
    return MaskFacts(provider, track.box, track.area, confidence, track.flags)


def _carried(binary: np.ndarray, clip: Clip, side_px: int = 160) -> list[np.ndarray | None]:
    """The mask before, brought to each frame by flow, at the masks' own size; None for the first frame."""
    matcher = Matcher("fast")
    out: list[np.ndarray | None] = [None]
    before = None
    for t in range(len(clip)):
        grey = cv2.cvtColor(shrink(clip.image(t), side_px), cv2.COLOR_RGB2GRAY)
        if before is not None:
            flow = matcher(grey, before)
            small = cv2.resize(binary[t - 1].astype(np.float32), grey.shape[::-1], interpolation=cv2.INTER_AREA)
            moved = sample(small, flow)
            out.append(cv2.resize(moved, (clip.width, clip.height), interpolation=cv2.INTER_LINEAR) > 0.5)
        before = grey
    return out


def _report(facts: MaskFacts, settings: MaskSettings, run: Run, clip: Clip) -> None:
    """Metrics, and an honest word when the masks are missing or doubtful."""
    missing = [n for n, f in zip(clip.names, facts.flags, strict=True) if "missing" in f]
    jumped = sum("jumped" in f for f in facts.flags)
    border = sum("border" in f for f in facts.flags)
    mean = float(facts.confidence.mean())
    run.metric("provider", facts.provider)
    run.metric("mask_confidence", round(mean, 3))
    run.metric("frames_missing", len(missing))
    name = run.video or "this clip"
    if len(missing) == len(clip):
        if facts.provider == "builtin":
            hint = f"draw a box round the object in {name}.hints.toml, or put masks into {name}.masks/"
        else:
            hint = f"look at the masks given, and at masks.threshold ({settings.threshold})"
        raise BadInput(f"{name}: no frame's mask covers anything", hint=hint)
    if missing:
        run.warn(f"{name}: no object found in {len(missing)} of {len(clip)} frames")
    if jumped > 0.1 * len(clip):
        run.warn(f"{name}: the mask jumps in {jumped} of {len(clip)} frames")
    if border > 0.5 * len(clip):
        run.warn(f"{name}: the object is cut off by the picture's edge in {border} of {len(clip)} frames")
    if mean < 0.5:
        run.warn(f"{name}: masks look unreliable (confidence {mean:.2f}); a box in {name}.hints.toml may help")


@masks.check
def _check(out: Path, frames: Folder) -> None:
    clip = read_clip(frames.path)
    covered = read_masks(out, clip).reshape(len(clip), -1).max(axis=1)
    facts = read_mask_facts(out)
    if len(facts.box) != len(clip):
        raise FormatError(f"masks.json speaks of {len(facts.box)} frames, frames.json of {len(clip)}")
    if covered.max() == 0:
        raise FormatError("no mask covers anything")


@masks.sheet
def _sheet(out: Path, frames: Folder, picture: Path) -> None:
    clip = read_clip(frames.path)
    write_image(picture, mask_sheet(clip.images(), read_masks(out, clip)))
