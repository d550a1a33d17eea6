"""Exported networks in 8-bit integers, for processors: a third of the time, results as good.

``python -m training.quantise WEIGHTS_DIR``

Beside ``trunk.onnx``, ``finder.onnx`` and ``refine.onnx`` (:mod:`training.export`) it writes ``trunk-int8.onnx`` and so
on: weights of 7 bits, scaled channel by channel, so that no sum of products overflows on processors without the newer
instructions, and activations of 8 bits, whose ranges are measured on generated clips.
"""

from __future__ import annotations

import logging
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated

import cv2
import numpy as np
import onnx
import torch
import tyro
from onnx import ModelProto, numpy_helper
from onnxruntime.quantization import CalibrationDataReader, QuantFormat, QuantType, quantize_static

from stages.perception.viewpoint import normalised
from synthetic.clips import film, make_subject
from training.corruption import corrupted
from training.export import log_digests, write_model
from training.wardrobe import Random

NETWORKS = ("trunk", "finder", "refine")
SUBJECTS = ("cat", "dog", "person")
FRAMES = 8
SIDES_PX = (96, 160, 256)
"""Of the pictures on which ranges are measured: a crop, a picture with windows, a whole frame."""


class _Pictures(CalibrationDataReader):
    """Generated pictures one by one, as the network's input; with rough masks where it takes four channels."""

    def __init__(self, model: ModelProto, seed: int) -> None:
        (given,) = model.graph.input
        self._name, self._masked = given.name, given.type.tensor_type.shape.dim[1].dim_value == 4
        self._inputs = self._all(seed)

    def get_next(self) -> dict[str, np.ndarray] | None:
        found = next(self._inputs, None)
        return None if found is None else {self._name: found}

    def _all(self, seed: int) -> Iterator[np.ndarray]:
        draw = Random(seed)
        for k, kind in enumerate(SUBJECTS):
            made = film(make_subject(seed + k, kind), 0, 1, FRAMES, max(SIDES_PX), seed + k)
            for image, mask in zip(made.images, made.masks, strict=True):
                for side in SIDES_PX[-1:] if self._masked else SIDES_PX:
                    small = cv2.resize(image, (side, side), interpolation=cv2.INTER_AREA)
                    picture = normalised(small)[None]
                    if self._masked:
                        truth = torch.from_numpy(mask.astype(np.float32))[None, None]
                        shown = torch.from_numpy(small.transpose(2, 0, 1)[None].astype(np.float32) / 255)
                        picture = np.concatenate([picture, corrupted(truth, shown, draw).numpy()], 1)
                    yield picture


def quantised(model: ModelProto, seed: int) -> ModelProto:
    """An exported network in 8-bit integers; `seed` draws the pictures on which ranges are measured."""
    whole = _widened(model)
    with tempfile.TemporaryDirectory(prefix="banmo-quantise-") as scratch:
        source, target = Path(scratch) / "float.onnx", Path(scratch) / "int8.onnx"
        onnx.save(whole, source)
        quantize_static(
            source, target, _Pictures(whole, seed), quant_format=QuantFormat.QDQ, per_channel=True, reduce_range=True,
            activation_type=QuantType.QUInt8, weight_type=QuantType.QInt8,
        )  # fmt: skip
        out = onnx.load(target)
    del out.metadata_props[:]
    said = {p.key: p.value for p in model.metadata_props}
    onnx.helper.set_model_props(out, said | {"quantised_by": "python -m training.quantise"})
    return out


def _widened(model: ModelProto) -> ModelProto:
    """A copy whose half-precision weights are kept in single precision, with nothing left that casts them."""
    out = ModelProto()
    out.CopyFrom(model)
    kept = {w.name: w for w in out.graph.initializer}
    nodes = []
    for node in out.graph.node:
        if node.op_type == "Cast" and node.input[0] in kept:
            values = numpy_helper.to_array(kept.pop(node.input[0])).astype(np.float32)
            kept[node.output[0]] = numpy_helper.from_array(values, node.output[0])
        else:
            nodes.append(node)
    del out.graph.node[:], out.graph.initializer[:]
    out.graph.node.extend(nodes)
    out.graph.initializer.extend(kept.values())
    return out


def main(weights: Annotated[Path, tyro.conf.Positional], seed: int = 40) -> None:
    """Write the 8-bit twins of the exported networks.

    Args:
        weights: Folder with trunk.onnx, finder.onnx and refine.onnx, those that are there.
        seed: Seed of the pictures on which ranges are measured.
    """
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    written = {}
    for name in NETWORKS:
        if (weights / f"{name}.onnx").exists():
            model = quantised(onnx.load(weights / f"{name}.onnx"), seed)
            written[f"{name}-int8.onnx"] = write_model(weights / f"{name}-int8.onnx", model)
    if not written:
        raise FileNotFoundError(f"{weights} holds none of {', '.join(f'{name}.onnx' for name in NETWORKS)}")
    log_digests(written)


if __name__ == "__main__":
    tyro.cli(main)
