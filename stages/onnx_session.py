"""An ONNX file opened safely: looked at before it is loaded, run on the providers the machine has, shapes checked.

Weights kept outside the file are refused, and so are operators that onnxruntime does not know and tensors too large
to hold. What a network expects is said by a contract (:mod:`stages.contracts`).
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from onnxruntime import InferenceSession

from pipeline import BadInput
from stages.contracts import PICTURE, Contract, locate, read_contract
from stages.onnx_runtime import open_session
from stages.onnx_safety import HUGE, inspect

MAX_BYTES = 2_000_000_000


class Network:
    """An open ONNX session with its contract."""

    KINDS: tuple[str, ...] = ("picture",)
    INPUTS, PICTURES = 1, 1

    def __init__(
        self,
        network: str | Path,
        contract: str | Path = "",
        *,
        default: Contract = PICTURE,
        device: str = "cpu",
        threads: int = 1,
    ) -> None:
        """Open a file, or a folder with an ONNX file and its contract. Raises BadInput when it cannot be trusted."""
        path, beside = locate(network, contract)
        self.path, self.contract = path, read_contract(beside, default)
        if self.contract.kind not in self.KINDS:
            wanted = " or ".join(repr(kind) for kind in self.KINDS)
            raise BadInput(f"{path.name} is a network of kind {self.contract.kind!r}, {wanted} expected here")
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


def _session(path: Path, device: str, threads: int) -> InferenceSession:
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
    try:
        return open_session(path, device, threads)
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


def multiple_of(size: tuple[int, ...], unit: int) -> tuple[int, int]:
    return max(unit, round(size[0] / unit) * unit), max(unit, round(size[1] / unit) * unit)
