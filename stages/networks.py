"""Networks of the user's own, as ONNX files: opened safely, run on the providers the machine has, shapes checked.

What a network expects is said by a contract (:mod:`stages.contracts`). Masks and features take ImageNet's mean and
std on 0..1 by default; flow takes RGB 0..255 as it is, and its last output (the OpenCV zoo's RAFT). Weights kept
outside the file are refused, and so are operators that onnxruntime does not know and tensors too large to hold.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import onnxruntime

from pipeline import BadInput, InputFile
from stages import contracts
from stages.contracts import Contract, locate, read_contract
from stages.onnx_safety import HUGE, inspect

NO_FILE = InputFile("")
MAX_BYTES = 2_000_000_000
BOX_CORNERS = (2.0, 3.0)
"""Labels of a box's corners among the clicks of a prompted network; 1 is a click on the object, 0 one beside it."""


class Network:
    """An open ONNX session with its contract."""

    KIND, INPUTS, PICTURES = "picture", 1, 1

    def __init__(
        self,
        network: str | Path,
        contract: str | Path = "",
        *,
        default: Contract = contracts.PICTURE,
        device: str = "cpu",
        threads: int = 1,
    ) -> None:
        """Open a file, or a folder with an ONNX file and its contract. Raises BadInput when it cannot be trusted."""
        path, beside = locate(network, contract)
        self.path, self.contract = path, read_contract(beside, default)
        if self.contract.kind != self.KIND:
            raise BadInput(f"{path.name} is a network of kind {self.contract.kind!r}, {self.KIND!r} expected here")
        self.session = _session(path, device, threads)
        self.providers: list[str] = self.session.get_providers()
        found = self.session.get_inputs()
        if len(found) != self.INPUTS:
            raise BadInput(f"{path.name} takes {len(found)} inputs, {self.INPUTS} expected")
        self.names = [i.name for i in found]
        self.dtype = _dtype(found[0].type, path)
        self.size = self._input_size(found[: self.PICTURES])
        self.output = self._output_name()

    @property
    def name(self) -> str:
        """What to call it: its file, or its folder where it was added under a name."""
        return self.path.parent.name if self.path.name == "network.onnx" else self.path.name

    @property
    def on(self) -> str:
        """The execution provider that runs it, in a word: cuda, cpu."""
        return self.providers[0].removesuffix("ExecutionProvider").lower()

    def _input_size(self, found: list[Any]) -> tuple[int, int] | None:
        """(height, width) that the file fixes, else the contract's, else None (any size)."""
        for given in found:
            shape = given.shape
            if len(shape) != 4 or (isinstance(shape[1], int) and shape[1] != 3):
                raise BadInput(f"{self.path.name}: input {given.name!r} has shape {shape}, 1x3xHxW expected")
            if isinstance(shape[0], int) and shape[0] != 1:
                raise BadInput(f"{self.path.name}: input {given.name!r} takes {shape[0]} pictures at once, 1 expected")
        height, width = found[0].shape[2:]
        if isinstance(height, int) and isinstance(width, int):
            return height, width
        return self.contract.size

    def _output_name(self) -> str:
        names = [o.name for o in self.session.get_outputs()]
        wanted = self.contract.output
        if isinstance(wanted, str):
            if wanted not in names:
                raise BadInput(f"{self.path.name} has no output {wanted!r}; it has {', '.join(names)}")
            return wanted
        if not -len(names) <= wanted < len(names):
            raise BadInput(f"{self.path.name} has {len(names)} outputs, number {wanted} asked for")
        return str(names[wanted])

    def prepare(self, image: np.ndarray, size: tuple[int, int]) -> np.ndarray:
        """(1, 3, h, w) tensor of an (H, W, 3) uint8 RGB image at `size` (h, w), by the contract."""
        resized = cv2.resize(
            image, (size[1], size[0]), interpolation=cv2.INTER_AREA if size[0] < image.shape[0] else cv2.INTER_LINEAR
        )
        values: np.ndarray = resized.astype(np.float32)
        if self.contract.scale == "unit":
            values /= 255.0
        elif self.contract.scale == "own-max":
            values /= max(float(values.max()), 1.0)
        if self.contract.colour == "bgr":
            values = values[..., ::-1]
        values = (values - np.array(self.contract.mean, np.float32)) / np.array(self.contract.std, np.float32)
        return np.ascontiguousarray(values.transpose(2, 0, 1)[None]).astype(self.dtype)

    def run(self, *tensors: np.ndarray) -> np.ndarray:
        """The output that counts, float32; not finite or failing is the model file's fault (`BadInput`)."""
        return self.run_outputs([self.output], *tensors)[0]

    def run_outputs(self, outputs: Sequence[str], *tensors: np.ndarray) -> list[np.ndarray]:
        """Named outputs as float32, for one tensor an input; raises as `run` does."""
        try:
            found = self.session.run(list(outputs), dict(zip(self.names, tensors, strict=True)))
        except Exception as error:  # onnxruntime raises a family of untyped errors
            raise BadInput(
                f"{self.path.name} fails on a picture of {tensors[0].shape}", hint=_first_line(error)
            ) from error
        results = [np.asarray(value, np.float32) for value in found]
        if not all(np.isfinite(value).all() for value in results):
            raise BadInput(f"{self.path.name} gives values that are not finite")
        return results


class MaskNetwork(Network):
    """1x3xHxW -> 1x1xHxW: how probably each pixel is the object (u2net, isnet, birefnet and their like)."""

    def __call__(self, image: np.ndarray) -> np.ndarray:
        """(H, W) float32 in 0..1 of an (H, W, 3) uint8 RGB image."""
        size = self.size or _multiple_of(image.shape[:2], 32)
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

    KIND, INPUTS = "prompted", 3

    def __call__(
        self,
        image: np.ndarray,
        box: np.ndarray | None = None,
        inside: np.ndarray | None = None,
        outside: np.ndarray | None = None,
    ) -> np.ndarray:
        """(H, W) float32 in 0..1 of an (H, W, 3) uint8 RGB image; box (4,) and clicks (N, 2) in its pixels."""
        size = self.size or _multiple_of(image.shape[:2], 32)
        clicks, labels = self._prompts(box, inside, outside)
        clicks = clicks * np.float32([size[1] / image.shape[1], size[0] / image.shape[0]])
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
            clicks.append(np.float32(box).reshape(2, 2))
            labels += BOX_CORNERS
        for points, label in ((inside, 1.0), (outside, 0.0)):
            if points is not None and len(points):
                clicks.append(np.float32(points).reshape(-1, 2))
                labels += [label] * len(points)
        if not labels:
            raise BadInput(f"{self.path.name} wants a box or a click, and there is none")
        places, kinds = np.concatenate(clicks), np.float32(labels)
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
        super().__init__(network, contract, default=contracts.FLOW, device=device, threads=threads)

    def __call__(self, first: np.ndarray, second: np.ndarray) -> np.ndarray:
        """(H, W, 2) float32 pixels of the pictures given, (H, W, 3) uint8 RGB."""
        height, width = first.shape[:2]
        size = self.size or _multiple_of((height, width), 8)
        raw = self.run(self.prepare(first, size), self.prepare(second, size))
        if raw.ndim != 4 or raw.shape[:2] != (1, 2):
            raise BadInput(f"{self.path.name} gives shape {raw.shape}, a flow of 1x2xHxW expected")
        flow = cv2.resize(raw[0].transpose(1, 2, 0), (width, height), interpolation=cv2.INTER_LINEAR)
        # A coarser output is still in pixels of the input, so the scale is the input's.
        return flow * np.array([width / size[1], height / size[0]], np.float32)


class FeatureNetwork(Network):
    """1x3xHxW crop -> 1x16xhxw embedding, or 1x17xhxw with a mask logit first (DensePose-CSE and its like)."""

    def __call__(self, crop: np.ndarray, side: int) -> np.ndarray:
        """(side, side, 16) float32 embedding of a square (S, S, 3) uint8 RGB crop, not yet normalised."""
        raw = self.run(self.prepare(crop, self.size or (224, 224)))
        if raw.ndim != 4 or raw.shape[0] != 1 or raw.shape[1] not in (16, 17):
            raise BadInput(f"{self.path.name} gives shape {raw.shape}, 1x16xhxw or 1x17xhxw expected")
        return cv2.resize(raw[0, -16:].transpose(1, 2, 0), (side, side), interpolation=cv2.INTER_LINEAR)


class TokenNetwork(Network):
    """1x3xHxW crop -> 1xNxC tokens of `patch` pixels (DINOv2), a few for the whole picture first; or 1xCxhxw."""

    KIND = "tokens"

    def __call__(self, crop: np.ndarray) -> np.ndarray:
        """(h, w, C) float32 tokens of a square (S, S, 3) uint8 RGB crop."""
        patch = self.contract.patch
        size = self.size or (16 * patch, 16 * patch)
        raw = self.run(self.prepare(crop, size))
        if raw.ndim == 4 and raw.shape[0] == 1:
            return np.ascontiguousarray(raw[0].transpose(1, 2, 0))
        rows, columns = size[0] // patch, size[1] // patch
        spare = raw.shape[1] - rows * columns if raw.ndim == 3 else -1
        if raw.ndim != 3 or raw.shape[0] != 1 or not 0 <= spare <= 8:
            raise BadInput(
                f"{self.path.name} gives shape {raw.shape}, 1x{rows * columns}xC tokens expected",
                hint="size and patch in its contract say how many",
            )
        return raw[0, spare:].reshape(rows, columns, -1)


def _session(path: Path, device: str, threads: int) -> onnxruntime.InferenceSession:
    try:
        size = path.stat().st_size
    except OSError as error:
        raise BadInput(f"the network {path.name} cannot be read ({error.strerror})") from error
    if not path.is_file() or size > MAX_BYTES:
        raise BadInput(f"the network {path.name} is not a file of at most {MAX_BYTES // 10**9} GB")
    found = inspect(path)
    if found is None:
        raise BadInput(f"{path.name} is not an ONNX file, or it is damaged")
    if found.outside:
        raise BadInput(f"{path.name} keeps weights in other files ({found.outside[0]}); save it as one file")
    if found.foreign:
        raise BadInput(f"{path.name} uses operators of {found.foreign[0]!r}, which are not onnxruntime's own")
    if found.largest > HUGE:
        raise BadInput(f"{path.name} holds or makes a tensor of {found.largest:,} elements, too large to be meant")
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = max(1, threads)
    options.inter_op_num_threads = 1
    options.log_severity_level = 3
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    wanted = ["CUDAExecutionProvider"] if device == "cuda" else []
    providers = [p for p in [*wanted, "CPUExecutionProvider"] if p in onnxruntime.get_available_providers()]
    try:
        return onnxruntime.InferenceSession(str(path), options, providers=providers)
    except Exception as error:  # onnxruntime raises a family of untyped errors
        raise BadInput(f"{path.name} cannot be opened as an ONNX network", hint=_first_line(error)) from error


def _dtype(name: str, path: Path) -> type[np.floating[Any]]:
    known: dict[str, type[np.floating[Any]]] = {"tensor(float)": np.float32, "tensor(float16)": np.float16}
    if name not in known:
        raise BadInput(f"{path.name} takes {name}, float pictures expected")
    return known[name]


def _first_line(error: Exception) -> str:
    lines = str(error).strip().splitlines()
    return lines[0][:200] if lines else type(error).__name__


def _multiple_of(size: tuple[int, ...], unit: int) -> tuple[int, int]:
    return max(unit, round(size[0] / unit) * unit), max(unit, round(size[1] / unit) * unit)


def _activate(values: np.ndarray, kind: str) -> np.ndarray:
    low, high = float(values.min()), float(values.max())
    if kind == "sigmoid" or (kind == "auto" and (low < -0.01 or high > 1.01)):
        return (1.0 / (1.0 + np.exp(-np.clip(values, -30, 30)))).astype(np.float32)
    if kind == "minmax" and high > low:
        return ((values - low) / (high - low)).astype(np.float32)
    return np.clip(values, 0.0, 1.0)
