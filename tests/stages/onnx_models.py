"""Small ONNX files of every contract, made for the tests."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

onnx = pytest.importorskip("onnx")
from onnx import TensorProto, helper, numpy_helper  # noqa: E402


def save(
    path: Path, nodes: list, inputs: list, outputs: list, constants: dict[str, np.ndarray], domain: str = ""
) -> Path:
    values = [numpy_helper.from_array(v, name) for name, v in constants.items()]
    graph = helper.make_graph(nodes, "test", inputs, outputs, values)
    opsets = [helper.make_opsetid("", 17)] + ([helper.make_opsetid(domain, 1)] if domain else [])
    model = helper.make_model(graph, opset_imports=opsets)
    model.ir_version = 8
    path.write_bytes(model.SerializeToString())
    return path


def tensor(name: str, shape: list[int | str | None]):
    return helper.make_tensor_value_info(name, TensorProto.FLOAT, shape)


def mask_model(path: Path, size: int | None = None, scale: float = 8.0) -> Path:
    """Logit = scale (red - blue - 0.6), on normalised ImageNet colours; the test's object is orange."""
    weight = np.zeros((1, 3, 1, 1), np.float32)
    weight[0, 0], weight[0, 2] = scale, -scale
    shape = [1, 3, size or "h", size or "w"]
    nodes = [helper.make_node("Conv", ["x", "w", "b"], ["y"])]
    constants = {"w": weight, "b": np.array([-scale * 1.2], np.float32)}
    return save(path, nodes, [tensor("x", shape)], [tensor("y", [1, 1, size or "h", size or "w"])], constants)


def flow_model(path: Path, size: tuple[int, int] = (72, 96)) -> Path:
    """The zoo's RAFT contract: inputs 0 and 1, two outputs, the second 1x2xHxW; always answers (3, -1.5) px."""
    height, width = size
    weight = np.zeros((2, 3, 1, 1), np.float32)
    nodes = [
        helper.make_node("Conv", ["0", "w", "b"], ["flow"]),
        helper.make_node("Sub", ["0", "1"], ["coarse"]),
    ]
    shape = [1, 3, height, width]
    outputs = [tensor("coarse", shape), tensor("flow", [1, 2, height, width])]
    constants = {"w": weight, "b": np.array([3.0, -1.5], np.float32)}
    return save(path, nodes, [tensor("0", shape), tensor("1", shape)], outputs, constants)


def prompted_model(path: Path, room: int | str = 6, rank: int = 4) -> Path:
    """EfficientSAM's contract: three masks, the second scores best; it is the sum of all clicks and labels."""
    label_shape = [1, 1, room, 1] if rank == 4 else [1, 1, room]
    nodes = [
        helper.make_node("ReduceMean", ["image"], ["grey"], axes=[1], keepdims=1),
        helper.make_node("Mul", ["grey", "zero"], ["nothing"]),
        helper.make_node("Unsqueeze", ["nothing", "axis"], ["one"]),
        helper.make_node("Concat", ["one", "one", "one"], ["three"], axis=2),
        helper.make_node("ReduceSum", ["points"], ["sum"], keepdims=0),
        helper.make_node("ReduceSum", ["labels"], ["labelled"], keepdims=0),
        helper.make_node("Add", ["sum", "labelled"], ["both"]),
        helper.make_node("Mul", ["both", "weights"], ["level"]),
        helper.make_node("Add", ["three", "level"], ["output_masks"]),
    ]
    inputs = [
        tensor("image", [1, 3, "h", "w"]),
        tensor("points", [1, 1, room, 2]),
        tensor("labels", label_shape),
    ]
    constants = {
        "zero": np.zeros(1, np.float32),
        "axis": np.array([1], np.int64),
        "weights": np.array([-1, 0.01, -1], np.float32).reshape(1, 1, 3, 1, 1),
        "iou_predictions": np.array([[[0.1, 0.9, 0.3]]], np.float32),
    }
    outputs = [tensor("output_masks", [1, 1, 3, "h", "w"]), tensor("iou_predictions", [1, 1, 3])]
    return save(path, nodes, inputs, outputs, constants)
