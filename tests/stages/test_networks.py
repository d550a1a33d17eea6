"""networks: ONNX files of every contract and of every fault, made here."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from pipeline import BadInput, Given, InputFile, Run
from stages.features import FeatureSettings, features
from stages.flow import FlowSettings, flow
from stages.formats import flow_path, read_clip, read_features, read_flow, read_json, read_mask_facts, read_masks
from stages.masks import MaskSettings, masks
from stages.networks import FeatureNetwork, FlowNetwork, MaskNetwork
from tests.stages.perception_clips import moving_clip, overlap, write_frames_folder, write_masks_folder

onnx = pytest.importorskip("onnx")
from onnx import TensorProto, helper, numpy_helper  # noqa: E402

IMAGES, TRUTH, _ = moving_clip(3, 96)


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


@pytest.mark.parametrize("size", [None, 64])
def test_mask_slot(tmp_path: Path, size: int | None) -> None:
    path = mask_model(tmp_path / "mask.onnx", size)
    frames = write_frames_folder(tmp_path / "frames", IMAGES)
    out = tmp_path / "out"
    out.mkdir()
    settings = MaskSettings(network=InputFile(str(path)))
    masks(frames=frames, given=Given(), settings=settings, out=out, run=Run())
    found = read_masks(out, read_clip(frames.path)) > 127
    assert overlap(found, TRUTH) > 0.75
    assert read_mask_facts(out).provider == "network"


def test_mask_contract_file(tmp_path: Path) -> None:
    nodes = [helper.make_node("ReduceMean", ["x"], ["y"], axes=[1], keepdims=1)]
    path = save(tmp_path / "m.onnx", nodes, [tensor("x", [1, 3, "h", "w"])], [tensor("y", [1, 1, "h", "w"])], {})
    contract = tmp_path / "m.toml"
    contract.write_text(
        'size = [32, 48]\nscale = "own-max"\nmean = [0.0, 0.0, 0.0]\nstd = [1.0, 1.0, 1.0]\nactivation = "minmax"\n'
    )
    image = np.zeros((64, 96, 3), np.uint8)
    image[:, 48:] = 100
    network = MaskNetwork(path, contract)
    assert network.size == (32, 48) and network.on == "cpu" and network.providers == ["CPUExecutionProvider"]
    found = network(image)
    assert found.shape == (64, 96) and found[:, :40].max() < 0.01 and found[:, 56:].min() > 0.99


@pytest.mark.parametrize(
    ("text", "word"),
    [
        ("size = [1]", "size"),
        ("size = [8, 8]", "between 16 and 4096"),
        ('scale = "huge"', "scale"),
        ('colour = "xyz"', "colour"),
        ("std = [0.0, 1.0, 1.0]", "std"),
        ("mean = 'grey'", "mean"),
        ("output = 1.5", "output"),
        ("scael = 'unit'", "scael"),
        ("size = [", "TOML"),
    ],
)
def test_contract_faults(tmp_path: Path, text: str, word: str) -> None:
    path = mask_model(tmp_path / "mask.onnx")
    contract = tmp_path / "mask.toml"
    contract.write_text(text)
    with pytest.raises(BadInput, match=r"mask\.toml") as caught:
        MaskNetwork(path, contract)
    assert word in str(caught.value)


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


def test_flow_slot_scales_to_the_frames(tmp_path: Path) -> None:
    path = flow_model(tmp_path / "raft.onnx")
    found = FlowNetwork(path)(IMAGES[0], IMAGES[1])  # 96x96 frames, 72x96 network
    np.testing.assert_allclose(found[50, 50], [3.0, -1.5 * 96 / 72], rtol=1e-5)
    frames = write_frames_folder(tmp_path / "frames", IMAGES)
    out = tmp_path / "out"
    out.mkdir()
    flow(
        frames=frames,
        given=Given(),
        settings=FlowSettings(network=InputFile(str(path))),
        out=out,
        run=Run(),
    )
    assert read_json(out / "flow.json")["provider"] == "raft.onnx"
    values, sure = read_flow(flow_path(out, 1, 0))
    assert sure.max() < 0.1  # forward and backward say the same thing: the round trip does not close
    assert np.allclose(values[sure > 0][:, 0], 3.0) or not (sure > 0).any()


@pytest.mark.parametrize("channels", [16, 17])
def test_feature_slot(tmp_path: Path, channels: int) -> None:
    rng = np.random.default_rng(0)
    weight = rng.normal(size=(channels, 3, 1, 1)).astype(np.float32)
    nodes = [helper.make_node("Conv", ["x", "w"], ["y"])]
    shape = [1, 3, "h", "w"]
    path = save(
        tmp_path / "cse.onnx", nodes, [tensor("x", shape)], [tensor("y", [1, channels, "h", "w"])], {"w": weight}
    )
    frames = write_frames_folder(tmp_path / "frames", IMAGES)
    truth = write_masks_folder(tmp_path / "masks", TRUTH, read_clip(frames.path))
    out = tmp_path / "out"
    out.mkdir()
    settings = FeatureSettings(network=InputFile(str(path)), category="quadruped")
    features(frames=frames, masks=truth, given=Given(), settings=settings, out=out, run=Run())
    values, _ = read_features(out)
    assert read_json(out / "features.json")["category"] == "quadruped"
    # the mask logit, if any, comes first and is left out
    embedding = FeatureNetwork(path)(np.full((112, 112, 3), 90, np.uint8), 112)[0, 0]
    normal = (np.float32([90 / 255] * 3) - np.float32([0.485, 0.456, 0.406])) / np.float32([0.229, 0.224, 0.225])
    np.testing.assert_allclose(embedding, weight[-16:, :, 0, 0] @ normal, rtol=1e-3, atol=1e-4)
    assert values.shape[-1] == 16


# --------------------------------------------------------------------------------------------- faults


def refused(path: Path, kind: type = MaskNetwork) -> str:
    with pytest.raises(BadInput, match=path.name) as caught:
        network = kind(path)
        network(IMAGES[0]) if kind is MaskNetwork else network(IMAGES[0], IMAGES[1])
    return str(caught.value)


def test_files_that_are_no_networks(tmp_path: Path) -> None:
    assert "cannot be read" in refused(tmp_path / "absent.onnx")
    (tmp_path / "empty.onnx").write_bytes(b"")
    assert "not an ONNX file" in refused(tmp_path / "empty.onnx")
    (tmp_path / "noise.onnx").write_bytes(np.random.default_rng(0).bytes(4000))
    assert "noise.onnx" in refused(tmp_path / "noise.onnx")
    whole = mask_model(tmp_path / "whole.onnx").read_bytes()
    (tmp_path / "cut.onnx").write_bytes(whole[: len(whole) // 2])
    assert "cut.onnx" in refused(tmp_path / "cut.onnx")
    (tmp_path / "folder.onnx").mkdir()
    assert "not a file" in refused(tmp_path / "folder.onnx")


def test_weights_outside_the_file_are_refused(tmp_path: Path) -> None:
    path = mask_model(tmp_path / "mask.onnx")
    model = onnx.load(str(path))
    model.graph.initializer[0].ClearField("raw_data")
    model.graph.initializer[0].data_location = TensorProto.EXTERNAL
    entry = model.graph.initializer[0].external_data.add()
    entry.key, entry.value = "location", "../../etc/passwd"
    path.write_bytes(model.SerializeToString())
    assert "../../etc/passwd" in refused(path)


def test_operators_of_its_own_are_refused(tmp_path: Path) -> None:
    nodes = [helper.make_node("Steal", ["x"], ["y"], domain="evil")]
    path = save(
        tmp_path / "evil.onnx", nodes, [tensor("x", [1, 3, 32, 32])], [tensor("y", [1, 1, 32, 32])], {}, domain="evil"
    )
    assert "operators of 'evil'" in refused(path)


def test_wrong_shapes(tmp_path: Path) -> None:
    flow_path_ = flow_model(tmp_path / "raft.onnx")
    assert "takes 2 inputs, 1 expected" in refused(flow_path_)
    assert "takes 1 inputs, 2 expected" in refused(mask_model(tmp_path / "mask.onnx"), FlowNetwork)
    nodes = [helper.make_node("Identity", ["x"], ["y"])]
    three = save(tmp_path / "three.onnx", nodes, [tensor("x", [1, 3, "h", "w"])], [tensor("y", [1, 3, "h", "w"])], {})
    assert "1x1xHxW expected" in refused(three)
    four = save(tmp_path / "four.onnx", nodes, [tensor("x", [1, 4, "h", "w"])], [tensor("y", [1, 4, "h", "w"])], {})
    assert "1x3xHxW expected" in refused(four)
    batch = save(tmp_path / "batch.onnx", nodes, [tensor("x", [8, 3, 32, 32])], [tensor("y", [8, 3, 32, 32])], {})
    assert "8 pictures at once" in refused(batch)


def test_values_that_are_not_finite(tmp_path: Path) -> None:
    nodes = [
        helper.make_node("ReduceMean", ["x"], ["m"], axes=[1], keepdims=1),
        helper.make_node("Sub", ["m", "m"], ["z"]),
        helper.make_node("Div", ["z", "z"], ["y"]),
    ]
    path = save(tmp_path / "nan.onnx", nodes, [tensor("x", [1, 3, "h", "w"])], [tensor("y", [1, 1, "h", "w"])], {})
    assert "not finite" in refused(path)
