"""The slots for networks of the user's own: masks (of a picture, or prompted), flow, features, tokens.

Masks and features take ImageNet's mean and std on 0..1 by default; flow takes RGB 0..255 as it is, and its last output
counts (the OpenCV zoo's RAFT). A contract beside the file says otherwise: docs/slots.md.
"""

from __future__ import annotations

import zipfile
from pathlib import Path

import cv2
import numpy as np

from pipeline import BadInput, InputFile
from stages.contracts import FLOW, PICTURE, locate, read_contract
from stages.onnx_session import Network, multiple_of

NO_FILE = InputFile("")
BASIS = "basis.npz"
"""Beside a network of tokens: `mean` (C,) and `axes` (C, 16) of a collection."""
BOX_CORNERS = (2.0, 3.0)
"""Labels of a box's corners among the clicks of a prompted network; 1 is a click on the object, 0 one beside it."""


class MaskNetwork(Network):
    """1x3xHxW -> 1x1xHxW: how probably each pixel is the object (u2net, isnet, birefnet and their like)."""

    def __call__(self, image: np.ndarray) -> np.ndarray:
        """(H, W) float32 in 0..1 of an (H, W, 3) uint8 RGB image."""
        size = self.size or multiple_of(image.shape[:2], 32)
        raw = self.run(self.prepare(image, size))
        if raw.ndim == 3:
            raw = raw[:, None]
        if raw.ndim != 4 or raw.shape[:2] != (1, 1):
            raise BadInput(f"{self.path.name} gives shape {raw.shape}, a mask of 1x1xHxW expected")
        values = _activate(raw[0, 0], self.contract.activation)
        return cv2.resize(values, image.shape[1::-1], interpolation=cv2.INTER_LINEAR)


class PromptedMaskNetwork(Network):
    """A picture 1x3xHxW, clicks 1x1xNx2 and their labels 1x1xN (or 1x1xNx1) -> masks 1x1xKxHxW and K scores.

    The OpenCV zoo's EfficientSAM as it is. Clicks are in pixels of the picture at the network's size; label 1 is a
    click on the object, 0 one beside it, 2 and 3 the corners of a box, -1 fills up. The mask that scores best counts.
    """

    KINDS, INPUTS = ("prompted",), 3

    def __call__(
        self,
        image: np.ndarray,
        box: np.ndarray | None = None,
        inside: np.ndarray | None = None,
        outside: np.ndarray | None = None,
    ) -> np.ndarray:
        """(H, W) float32 in 0..1 of an (H, W, 3) uint8 RGB image; box (4,) and clicks (N, 2) in its pixels."""
        size = self.size or multiple_of(image.shape[:2], 32)
        clicks, labels = self._prompts(box, inside, outside)
        clicks = clicks * np.array([size[1] / image.shape[1], size[0] / image.shape[0]], np.float32)
        shape = self.session.get_inputs()[2].shape
        given = labels.reshape((1, 1, -1, 1) if len(shape) == 4 else (1, 1, -1))
        outputs = [o.name for o in self.session.get_outputs()]
        tensors = self.prepare(image, size), clicks[None, None].astype(self.dtype), given.astype(self.dtype)
        found = self.run_outputs(outputs, *tensors)
        masks = next((v for v in found if v.ndim == 5), None)
        scores = next((v for v in found if v.ndim == 3), None)
        if masks is None or scores is None or masks.shape[:2] != (1, 1) or scores.shape != masks.shape[:3]:
            shapes = " and ".join(str(v.shape) for v in found)
            raise BadInput(f"{self.path.name} gives {shapes}, masks of 1x1xKxHxW and scores of 1x1xK expected")
        values = _activate(masks[0, 0, int(scores[0, 0].argmax())], self.contract.activation)
        return cv2.resize(values, image.shape[1::-1], interpolation=cv2.INTER_LINEAR)

    def _prompts(
        self, box: np.ndarray | None, inside: np.ndarray | None, outside: np.ndarray | None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Clicks (N, 2) and labels (N,), filled up or cut to as many as the network takes."""
        clicks = [np.zeros((0, 2), np.float32)]
        labels: list[float] = []
        if box is not None:
            clicks.append(np.asarray(box, np.float32).reshape(2, 2))
            labels += BOX_CORNERS
        for points, label in ((inside, 1.0), (outside, 0.0)):
            if points is not None and len(points):
                clicks.append(np.asarray(points, np.float32).reshape(-1, 2))
                labels += [label] * len(points)
        if not labels:
            raise BadInput(f"{self.path.name} wants a box or a click, and there is none")
        places, kinds = np.concatenate(clicks), np.array(labels, np.float32)
        room = self.session.get_inputs()[1].shape[2]
        if isinstance(room, int):
            spare = max(0, room - len(kinds))
            places = np.concatenate([places[:room], np.zeros((spare, 2), np.float32)])
            kinds = np.concatenate([kinds[:room], np.full(spare, -1, np.float32)])
        return places, kinds


class FlowNetwork(Network):
    """Two pictures 1x3xHxW -> 1x2xHxW flow from the first to the second, in pixels of that size."""

    INPUTS = PICTURES = 2

    def __init__(
        self, network: str | Path, contract: str | Path = "", *, device: str = "cpu", threads: int = 1
    ) -> None:
        super().__init__(network, contract, default=FLOW, device=device, threads=threads)

    def __call__(self, first: np.ndarray, second: np.ndarray) -> np.ndarray:
        """(H, W, 2) float32 pixels of the pictures given, (H, W, 3) uint8 RGB."""
        height, width = first.shape[:2]
        size = self.size or multiple_of((height, width), 8)
        raw = self.run(self.prepare(first, size), self.prepare(second, size))
        if raw.ndim != 4 or raw.shape[:2] != (1, 2):
            raise BadInput(f"{self.path.name} gives shape {raw.shape}, a flow of 1x2xHxW expected")
        flow = cv2.resize(raw[0].transpose(1, 2, 0), (width, height), interpolation=cv2.INTER_LINEAR)
        # A coarser output is still in pixels of the input, so the scale is the input's.
        return flow * np.array([width / size[1], height / size[0]], np.float32)


class TokenNetwork(Network):
    """1x3xHxW crop -> 1xNxC tokens of `patch` pixels (DINOv2), a few for the whole picture first; or 1xCxhxw."""

    KINDS = ("tokens",)

    def __call__(self, crop: np.ndarray) -> np.ndarray:
        """(h, w, C) float32 tokens of a square (S, S, 3) uint8 RGB crop."""
        return _tokens(self, crop)


class FeatureNetwork(Network):
    """1x3xHxW crop -> 1x16xhxw embedding, or 1x17xhxw with a mask logit first (DensePose-CSE and its like).

    Or a network of tokens with the axes of a collection beside it (`basis.npz`, by ``banmo weights fit``).
    """

    KINDS = ("picture", "tokens")

    def __init__(
        self, network: str | Path, contract: str | Path = "", *, device: str = "cpu", threads: int = 1
    ) -> None:
        super().__init__(network, contract, device=device, threads=threads)
        self.basis = _read_basis(self.path, self.name) if self.contract.kind == "tokens" else None

    def __call__(self, crop: np.ndarray, side: int) -> np.ndarray:
        """(side, side, 16) float32 embedding of a square (S, S, 3) uint8 RGB crop, not yet normalised."""
        if self.basis is not None:
            tokens = _tokens(self, crop)
            mean, axes = self.basis
            if tokens.shape[2] != len(mean):
                raise BadInput(f"{self.name} gives {tokens.shape[2]} channels, its axes are for {len(mean)}")
            return cv2.resize((tokens - mean) @ axes, (side, side), interpolation=cv2.INTER_LINEAR)
        raw = self.run(self.prepare(crop, self.size or (224, 224)))
        if raw.ndim != 4 or raw.shape[0] != 1 or raw.shape[1] not in (16, 17):
            raise BadInput(f"{self.path.name} gives shape {raw.shape}, 1x16xhxw or 1x17xhxw expected")
        return cv2.resize(raw[0, -16:].transpose(1, 2, 0), (side, side), interpolation=cv2.INTER_LINEAR)


def _tokens(network: Network, crop: np.ndarray) -> np.ndarray:
    patch = network.contract.patch
    size = network.size or (16 * patch, 16 * patch)
    raw = network.run(network.prepare(crop, size))
    if raw.ndim == 4 and raw.shape[0] == 1:
        return np.ascontiguousarray(raw[0].transpose(1, 2, 0))
    rows, columns = size[0] // patch, size[1] // patch
    spare = raw.shape[1] - rows * columns if raw.ndim == 3 else -1
    if raw.ndim != 3 or raw.shape[0] != 1 or not 0 <= spare <= 8:
        raise BadInput(
            f"{network.path.name} gives shape {raw.shape}, 1x{rows * columns}xC tokens expected",
            hint="size and patch in its contract say how many",
        )
    return raw[0, spare:].reshape(rows, columns, -1)


def _read_basis(path: Path, name: str) -> tuple[np.ndarray, np.ndarray]:
    """Mean (C,) and axes (C, 16) that reduce tokens to the 16 channels of the features stage."""
    beside = path.with_name(BASIS)
    if not beside.is_file():
        raise BadInput(
            f"{name} gives tokens, and the axes that reduce them to 16 channels are not there",
            hint=f"banmo weights fit {name}, once the masks of your clips are done",
        )
    try:
        with np.load(beside, allow_pickle=False) as held:
            mean, axes = np.float32(held["mean"]), np.float32(held["axes"])
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
        raise BadInput(f"{beside.name} of {name} cannot be read ({error})") from error
    if mean.ndim != 1 or axes.shape != (len(mean), 16) or not (np.isfinite(mean).all() and np.isfinite(axes).all()):
        raise BadInput(f"{beside.name} of {name} holds {mean.shape} and {axes.shape}, (C,) and (C, 16) expected")
    return mean, axes


def mask_network(
    network: str | Path, contract: str | Path = "", *, device: str = "cpu", threads: int = 1
) -> MaskNetwork | PromptedMaskNetwork:
    """The mask network of a setting, by the kind that its contract names."""
    beside = locate(network, contract)[1]
    kind = PromptedMaskNetwork if read_contract(beside, PICTURE).kind == "prompted" else MaskNetwork
    return kind(network, contract, device=device, threads=threads)


def _activate(values: np.ndarray, kind: str) -> np.ndarray:
    low, high = float(values.min()), float(values.max())
    if kind == "sigmoid" or (kind == "auto" and (low < -0.01 or high > 1.01)):
        return (1.0 / (1.0 + np.exp(-np.clip(values, -30, 30)))).astype(np.float32)
    if kind == "minmax" and high > low:
        return ((values - low) / (high - low)).astype(np.float32)
    return np.clip(values, 0.0, 1.0)
