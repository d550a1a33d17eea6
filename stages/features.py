"""features: a 16-D vector a pixel, alike where the same surface is seen, on a square crop round the object.

Who answers, first to last: `clip.features.npy` beside the video, the ONNX network that the settings name, our own
network of the object's category (found by itself unless the settings say), the built-in appearance descriptor.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from pipeline import BadInput, Folder, Given, InputFile, Resources, Run, Video, stage
from stages.formats import (
    FEATURE_CHANNELS,
    FEATURE_SIZE,
    Clip,
    FormatError,
    read_clip,
    read_features,
    read_grey,
    read_mask_facts,
    write_image,
    write_json,
)
from stages.networks import NO_FILE, FeatureNetwork
from stages.own_networks import CATEGORIES, OwnNetwork
from stages.perception.category import OTHER, Verdict, choose_category
from stages.perception.descriptors import crop_box, crop_resize, describe_appearance, match_trust, normalise
from stages.perception.sheets import feature_sheet
from stages.perception.viewpoint import PoseNetwork, prompted_input

Describe = Callable[[np.ndarray, np.ndarray, np.ndarray, np.ndarray], np.ndarray]
"""Image (H, W, 3) uint8, mask (H, W) uint8, mask on the crop (112, 112) in 0..1, crop (4,) px -> (112, 112, 16)."""


@dataclass(frozen=True)
class FeatureSettings:
    """Settings of the `features` stage."""

    network: InputFile = NO_FILE
    """An ONNX file that turns a 1x3xHxW crop into 1x16xhxw (or 1x17xhxw, mask logit first); empty for none."""
    network_contract: InputFile = NO_FILE
    """A small TOML file that says what that network expects; empty for sane defaults."""
    category: str = "auto"
    """quadruped, human or other (no network of ours knows it); auto finds out."""
    seed: int = 0
    """Seed of the sampling behind the trust figure."""


@stage(per=Video, version=2, given=(".features.npy",), needs=Resources(cpus=1))
def features(frames: Folder, masks: Folder, given: Given, settings: FeatureSettings, out: Path, run: Run) -> None:
    """Embeddings (T, 112, 112, 16) float16, unit length on the object and zero off it, and the crop of each frame."""
    if settings.category not in ("auto", OTHER, *CATEGORIES):
        known = ", ".join(("auto", *CATEGORIES, OTHER))
        raise BadInput(f"features.category is {settings.category!r}", hint=f"known: {known}")
    cv2.setNumThreads(1)
    clip = read_clip(frames.path)
    boxes = read_mask_facts(masks.path).box
    crops = np.stack([crop_box(box, clip.width, clip.height) for box in boxes])
    own = {name: OwnNetwork(name, device=run.device, threads=run.threads) for name in CATEGORIES}
    verdict = _verdict(clip, masks, settings.category, own)
    path = given.get(".features.npy")
    if path is not None:
        provider = "given"
        values = _given(path, clip, crops)
    elif settings.network:
        network = FeatureNetwork(
            Path(settings.network), settings.network_contract, device=run.device, threads=run.threads
        )
        run.log.info("%s on %s", network.name, network.on)
        provider, values = network.name, _described(clip, masks, crops, _by_slot(network), run)
    elif verdict.category in own:
        ours = own[verdict.category]
        run.log.info("%s on %s", ours.name, ", ".join(ours.providers))
        provider, values = ours.name, _described(clip, masks, crops, _by_own(ours), run)
    else:
        provider, values = "builtin-appearance", _described(clip, masks, crops, _by_appearance, run)
    np.save(out / "features.npy", values, allow_pickle=False)
    trust = match_trust(values, np.random.default_rng(settings.seed))
    rows = [{"name": n, "crop": [round(float(v), 3) for v in c]} for n, c in zip(clip.names, crops, strict=True)]
    write_json(
        out / "features.json",
        {
            "network": provider,
            "category": verdict.category,
            "margin": round(verdict.margin, 4),
            "category_named": {name: round(value, 4) for name, value in verdict.named.items()},
            "category_explained": {name: round(value, 4) for name, value in verdict.explained.items()},
            "trust": round(trust, 4),
            "frames": rows,
        },
    )
    run.metric("network", provider)
    run.metric("category", verdict.category)
    run.metric("match_trust", round(trust, 3))


def embed(image: np.ndarray, grey: np.ndarray, mask: np.ndarray, crop: np.ndarray, network: PoseNetwork) -> np.ndarray:
    """(112, 112, 16) embedding by a category's network, unit length where `mask` (112, 112) says the object is.

    `image` (H, W, 3) uint8 RGB and `grey` (H, W) uint8 mask are the whole frame's; `crop` is square, in pixels.
    """
    if not (mask > 0.5).any():
        return np.zeros((FEATURE_SIZE, FEATURE_SIZE, FEATURE_CHANNELS), np.float32)
    dense = network(prompted_input(image, grey, crop)[None])["dense"][0, 1:]
    larger = cv2.resize(dense.transpose(1, 2, 0), (FEATURE_SIZE, FEATURE_SIZE), interpolation=cv2.INTER_LINEAR)
    return normalise(larger, mask > 0.5)


def _verdict(clip: Clip, masks: Folder, category: str, own: dict[str, OwnNetwork]) -> Verdict:
    """What the object is: as the settings say, or by what our networks make of some of the frames."""
    if category != "auto":
        return Verdict(category, 1.0, {}, {})
    some = np.unique(np.linspace(0, len(clip) - 1, min(len(clip), 24)).astype(int))
    images = np.stack([clip.image(int(i)) for i in some])
    greys = np.stack([read_grey(masks / clip.names[int(i)]) for i in some])
    return choose_category(images, greys, own)


def _by_slot(network: FeatureNetwork) -> Describe:
    def describe(image: np.ndarray, _: np.ndarray, mask: np.ndarray, crop: np.ndarray) -> np.ndarray:
        return normalise(network(crop_resize(image, crop, 2 * FEATURE_SIZE), FEATURE_SIZE), mask > 0.5)

    return describe


def _by_own(network: PoseNetwork) -> Describe:
    return lambda image, grey, mask, crop: embed(image, grey, mask, crop, network)


def _by_appearance(image: np.ndarray, _: np.ndarray, mask: np.ndarray, crop: np.ndarray) -> np.ndarray:
    return describe_appearance(crop_resize(image, crop), mask)


def _described(clip: Clip, masks: Folder, crops: np.ndarray, describe: Describe, run: Run) -> np.ndarray:
    """(T, 112, 112, 16) float16: `describe` of every frame."""
    values = np.zeros((len(clip), FEATURE_SIZE, FEATURE_SIZE, FEATURE_CHANNELS), np.float16)
    for i in run.progress(range(len(clip)), label="features"):
        grey = read_grey(masks / clip.names[i])
        mask = crop_resize(grey.astype(np.float32) / 255.0, crops[i])
        values[i] = describe(clip.image(i), grey, mask, crops[i])
    return values


def _given(path: Path, clip: Clip, crops: np.ndarray) -> np.ndarray:
    """The user's array: (N or T, H, W, 16) over the whole picture, or (N or T, 112, 112, 16) on our crops."""
    try:
        array = np.load(path, mmap_mode="r", allow_pickle=False)
    except (OSError, ValueError, EOFError) as error:
        raise BadInput(f"{path.name} cannot be read as a NumPy array ({error})") from error
    source = len(clip.source_time_s)
    shape = "x".join(str(n) for n in array.shape)
    if array.ndim != 4 or array.shape[3] != FEATURE_CHANNELS or array.dtype.kind != "f":
        raise BadInput(f"{path.name} holds {array.dtype} {shape}, floats of frames x height x width x 16 expected")
    if len(array) not in (source, len(clip)):
        raise BadInput(f"{path.name} holds {len(array)} frames, the video has {source}")
    rows = clip.source_idx if len(array) == source else np.arange(len(clip))
    height, width = array.shape[1:3]
    on_crop = height == width == FEATURE_SIZE
    if not on_crop and abs(width / height / (clip.width / clip.height) - 1) > 0.02:
        raise BadInput(f"{path.name} is {width}x{height}, neither 112x112 nor the shape of the frames")
    out = np.zeros((len(clip), FEATURE_SIZE, FEATURE_SIZE, FEATURE_CHANNELS), np.float16)
    for i, row in enumerate(rows):
        values = np.asarray(array[row], np.float32)
        if not np.isfinite(values).all():
            raise BadInput(f"{path.name}: frame {int(row)} holds values that are not finite")
        if not on_crop:
            # Pixels of the array against pixels of the frames.
            scale = np.array([width / clip.width, height / clip.height] * 2)
            halves = [
                crop_resize(np.ascontiguousarray(values[..., c : c + 4]), crops[i] * scale) for c in range(0, 16, 4)
            ]
            values = np.concatenate(halves, axis=-1)
        out[i] = normalise(values, np.abs(values).max(axis=-1) > 1e-6)
    if not out.any():
        raise BadInput(f"{path.name} holds nothing but zeros")
    return out


@features.check
def _check(out: Path, frames: Folder) -> None:
    values, crops = read_features(out)
    clip = read_clip(frames.path)
    if len(values) != len(clip):
        raise FormatError(f"features.npy holds {len(values)} frames, frames.json {len(clip)}")
    side = crops[:, 2:] - crops[:, :2]
    if not np.isfinite(crops).all() or (np.abs(side[:, 0] - side[:, 1]) > 0.01).any() or (side <= 0).any():
        raise FormatError("features.json: crops must be squares")
    for i, frame in enumerate(values):
        length = np.linalg.norm(frame.astype(np.float32), axis=-1)
        if not np.isfinite(length).all() or (np.abs(length[length > 0] - 1) > 0.02).any():
            raise FormatError(f"features.npy: frame {i} is neither of unit length nor zero")


@features.sheet
def _sheet(out: Path, picture: Path) -> None:
    write_image(picture, feature_sheet(read_features(out)[0]))
