"""Networks of the user's own, as ONNX files: opened safely, run on the providers the machine has, shapes checked.

A contract, a small TOML file named in the settings, says what a network expects; every key has a sane default::

    size = [320, 320]          # height, width, where the file leaves them open
    colour = "rgb"             # or "bgr"
    scale = "unit"             # pixel values: "unit" 0..1, "byte" 0..255, "own-max" divided by the picture's largest
    mean = [0.485, 0.456, 0.406]
    std = [0.229, 0.224, 0.225]
    output = 0                 # index or name of the output that counts
    activation = "auto"        # of a mask: "none", "sigmoid", "minmax", "auto" (sigmoid where values leave 0..1)

Defaults: masks and features take ImageNet's mean and std on 0..1; flow takes RGB 0..255 as it is, and its last output
(the contract of the OpenCV zoo's RAFT). Weights kept outside the file are refused, and so are operators that
onnxruntime does not know.
"""

from __future__ import annotations

import tomllib
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import onnxruntime

from pipeline import BadInput, InputFile
from stages.onnx_safety import external_data

NO_FILE = InputFile("")
MAX_BYTES = 2_000_000_000
IMAGENET_MEAN = (0.485, 0.456, 0.406)
IMAGENET_STD = (0.229, 0.224, 0.225)
CHOICES = {
    "colour": ("rgb", "bgr"),
    "scale": ("unit", "byte", "own-max"),
    "activation": ("auto", "none", "sigmoid", "minmax"),
}


@dataclass(frozen=True)
class Contract:
    """What a network expects and gives; see the module's text."""

    size: tuple[int, int] | None = None
    colour: str = "rgb"
    scale: str = "unit"
    mean: tuple[float, ...] = IMAGENET_MEAN
    std: tuple[float, ...] = IMAGENET_STD
    output: int | str = 0
    activation: str = "auto"


FLOW_CONTRACT = Contract(scale="byte", mean=(0.0, 0.0, 0.0), std=(1.0, 1.0, 1.0), output=-1)


def read_contract(path: str | Path, default: Contract) -> Contract:
    """A contract file over the defaults; an empty path gives the defaults. Unknown keys and values are refused."""
    if not str(path):
        return default
    name = Path(path).name
    try:
        table = tomllib.loads(Path(path).read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise BadInput(f"{name} cannot be read as TOML ({error})") from error
    known = set(Contract.__dataclass_fields__)
    if set(table) - known:
        raise BadInput(f"{name}: unknown key {min(set(table) - known)!r}; known: {', '.join(sorted(known))}")
    for key, allowed in CHOICES.items():
        if key in table and table[key] not in allowed:
            raise BadInput(f"{name}: {key} is {table[key]!r}, it must be one of {', '.join(allowed)}")
    for key, count in (("mean", 3), ("std", 3), ("size", 2)):
        if key in table:
            table[key] = _numbers(table[key], count, f"{name}: {key}")
    if "size" in table:
        table["size"] = (int(table["size"][0]), int(table["size"][1]))
        if min(table["size"]) < 16 or max(table["size"]) > 4096:
            raise BadInput(f"{name}: size must lie between 16 and 4096")
    if any(s <= 0 for s in table.get("std", ())):
        raise BadInput(f"{name}: std must be positive")
    if isinstance(table.get("output", 0), bool) or not isinstance(table.get("output", 0), int | str):
        raise BadInput(f"{name}: output is the index or the name of an output")
    return replace(default, **table)


def _numbers(value: Any, count: int, what: str) -> tuple[float, ...]:
    if not isinstance(value, list) or len(value) != count or not all(isinstance(v, int | float) for v in value):
        raise BadInput(f"{what} must be a list of {count} numbers")
    return tuple(float(v) for v in value)


class Network:
    """An open ONNX session with its contract."""

    def __init__(self, path: Path, contract: Contract, *, inputs: int, device: str = "cpu", threads: int = 1) -> None:
        self.path, self.contract = path, contract
        self.session = _session(path, device, threads)
        self.providers: list[str] = self.session.get_providers()
        found = self.session.get_inputs()
        if len(found) != inputs:
            raise BadInput(f"{path.name} takes {len(found)} inputs, {inputs} expected")
        self.names = [i.name for i in found]
        self.dtype = _dtype(found[0].type, path)
        self.size = self._input_size(found)
        self.output = self._output_name()

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
        try:
            result = self.session.run([self.output], dict(zip(self.names, tensors, strict=True)))[0]
        except Exception as error:  # onnxruntime raises a family of untyped errors
            raise BadInput(
                f"{self.path.name} fails on a picture of {tensors[0].shape}", hint=_first_line(error)
            ) from error
        result = np.asarray(result, np.float32)
        if not np.isfinite(result).all():
            raise BadInput(f"{self.path.name} gives values that are not finite")
        return result


class MaskNetwork(Network):
    """1x3xHxW -> 1x1xHxW: how probably each pixel is the object."""

    def __init__(self, path: Path, contract: str | Path = "", *, device: str = "cpu", threads: int = 1) -> None:
        super().__init__(path, read_contract(contract, Contract()), inputs=1, device=device, threads=threads)

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


class FlowNetwork(Network):
    """Two pictures 1x3xHxW -> 1x2xHxW flow from the first to the second, in pixels of that size."""

    def __init__(self, path: Path, contract: str | Path = "", *, device: str = "cpu", threads: int = 1) -> None:
        super().__init__(path, read_contract(contract, FLOW_CONTRACT), inputs=2, device=device, threads=threads)

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
    """1x3xHxW crop -> 1x16xhxw embedding, or 1x17xhxw with a mask logit first."""

    def __init__(self, path: Path, contract: str | Path = "", *, device: str = "cpu", threads: int = 1) -> None:
        super().__init__(path, read_contract(contract, Contract()), inputs=1, device=device, threads=threads)

    def __call__(self, crop: np.ndarray, side: int) -> np.ndarray:
        """(side, side, 16) float32 embedding of a square (S, S, 3) uint8 RGB crop, not yet normalised."""
        raw = self.run(self.prepare(crop, self.size or (224, 224)))
        if raw.ndim != 4 or raw.shape[0] != 1 or raw.shape[1] not in (16, 17):
            raise BadInput(f"{self.path.name} gives shape {raw.shape}, 1x16xhxw or 1x17xhxw expected")
        return cv2.resize(raw[0, -16:].transpose(1, 2, 0), (side, side), interpolation=cv2.INTER_LINEAR)


def _session(path: Path, device: str, threads: int) -> onnxruntime.InferenceSession:
    try:
        size = path.stat().st_size
    except OSError as error:
        raise BadInput(f"the network {path.name} cannot be read ({error.strerror})") from error
    if not path.is_file() or size > MAX_BYTES:
        raise BadInput(f"the network {path.name} is not a file of at most {MAX_BYTES // 10**9} GB")
    outside = external_data(path)
    if outside is None:
        raise BadInput(f"{path.name} is not an ONNX file, or it is damaged")
    if outside:
        raise BadInput(f"{path.name} keeps weights in other files ({outside[0]}); save it as one file")
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
