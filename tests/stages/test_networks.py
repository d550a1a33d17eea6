"""networks: ONNX files of every contract and of every fault, made here."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from pipeline import BadInput, Given, InputFile, Run
from stages.features import FeatureSettings, features
from stages.flow import FlowSettings, flow
from stages.formats import flow_path, read_clip, read_features, read_flow, read_json, read_mask_facts, read_masks
from stages.masks import MaskSettings, masks
from stages.networks import FeatureNetwork, FlowNetwork, MaskNetwork, PromptedMaskNetwork, TokenNetwork
from stages.onnx_safety import HUGE, inspect
from stages.perception.principal import principal_axes
from stages.perception.prompts import prompts_of
from stages.perception.segmentation import Hint
from tests.stages.onnx_models import flow_model, mask_model, prompted_model, save, tensor
from tests.stages.perception_clips import moving_clip, overlap, write_frames_folder, write_masks_folder

onnx = pytest.importorskip("onnx")
from onnx import TensorProto, helper  # noqa: E402

IMAGES, TRUTH, _ = moving_clip(3, 96)


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


@pytest.mark.parametrize(("room", "rank"), [(6, 4), ("n", 3)])
def test_prompted_slot(tmp_path: Path, room: int | str, rank: int) -> None:
    contract = tmp_path / "sam.toml"
    contract.write_text('kind = "prompted"\nsize = [64, 64]\nactivation = "none"\n')
    network = PromptedMaskNetwork(prompted_model(tmp_path / "sam.onnx", room, rank), contract)
    found = network(IMAGES[0], box=np.array([24.0, 12.0, 48.0, 36.0]), outside=np.array([[6.0, 6.0]]))
    # at 64/96 of the size: corners (16, 8) and (32, 24), a click at (4, 4); labels 2 + 3 + 0, the rest filled with -1
    filled = -3 if room == 6 else 0
    np.testing.assert_allclose(found, 0.01 * (16 + 8 + 32 + 24 + 4 + 4 + 5 + filled), rtol=1e-5)
    assert found.shape == IMAGES[0].shape[:2]
    with pytest.raises(BadInput, match="wants a box or a click"):
        network(IMAGES[0])


def test_prompts_come_from_hints_first_then_from_the_rough_mask() -> None:
    masks = np.zeros((3, 40, 60), bool)
    masks[:2, 10:21, 20:41] = True
    box = np.array([1.0, 2.0, 30.0, 31.0])
    hints = (
        Hint(1, box),
        Hint(1, None, np.array([[5.0, 6.0]]), np.array([[50.0, 30.0]])),
        Hint(2, None, np.ones((1, 2))),
    )
    plain, told, clicked = prompts_of(masks, hints)
    np.testing.assert_array_equal(plain.box, [20, 10, 41, 21])
    (x, y), *none = plain.inside
    assert y == 15.5 and 25 < x < 36 and not none and not len(plain.outside) and not plain.empty
    np.testing.assert_array_equal(told.box, box)
    np.testing.assert_array_equal(told.inside, [[5, 6]])
    np.testing.assert_array_equal(told.outside, [[50, 30]])
    assert clicked.box is None and len(clicked.inside) == 1 and not clicked.empty
    assert prompts_of(masks[2:], ())[0].empty


def test_prompted_masks_in_the_stage(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The stage asks the rough masks, steered by the hints, where to look; the toy itself goes by colour."""
    heard: list[int] = []

    def rough(images: np.ndarray, hints: tuple[Hint, ...], *_: object, **__: object) -> SimpleNamespace:
        heard.append(len(hints))
        return SimpleNamespace(probability=TRUTH.astype(np.uint8) * 255)

    monkeypatch.setattr("stages.masks.segment", rough)
    contract = tmp_path / "sam.toml"
    contract.write_text('kind = "prompted"\nactivation = "sigmoid"\nmean = [0.0, 0.0, 0.0]\nstd = [1.0, 1.0, 1.0]\n')
    weight = np.float32([40, 0, -40]).reshape(1, 3, 1, 1)  # red minus blue: the object is orange
    nodes = [
        helper.make_node("Conv", ["image", "w", "b"], ["logit"]),
        helper.make_node("Unsqueeze", ["logit", "axis"], ["masks"]),
    ]
    constants = {
        "w": weight,
        "b": np.float32([-8]),
        "axis": np.array([1], np.int64),
        "scores": np.full((1, 1, 1), 0.9, np.float32),
    }
    inputs = [tensor("image", [1, 3, "h", "w"]), tensor("points", [1, 1, "n", 2]), tensor("labels", [1, 1, "n"])]
    outputs = [tensor("masks", [1, 1, 1, "h", "w"]), tensor("scores", [1, 1, 1])]
    path = save(tmp_path / "sam.onnx", nodes, inputs, outputs, constants)
    frames = write_frames_folder(tmp_path / "frames", IMAGES)
    hints = tmp_path / "clip.hints.toml"
    hints.write_text("[[hint]]\nframe = 0\nbox = [30, 30, 75, 90]\n")
    out = tmp_path / "out"
    out.mkdir()
    settings = MaskSettings(network=InputFile(str(path)), network_contract=InputFile(str(contract)))
    masks(frames=frames, given=Given({".hints.toml": hints}), settings=settings, out=out, run=Run())
    assert heard == [1]
    assert overlap(read_masks(out, read_clip(frames.path)) > 127, TRUTH) > 0.75


@pytest.mark.parametrize("leading", [0, 1, 5])
def test_token_slot(tmp_path: Path, leading: int) -> None:
    """DINOv2's contract: tokens of 14 px in rows, a few for the whole picture first."""
    nodes = [
        helper.make_node("AveragePool", ["x"], ["pooled"], kernel_shape=[14, 14], strides=[14, 14]),
        helper.make_node("Reshape", ["pooled", "flat"], ["rows"]),
        helper.make_node("Transpose", ["rows"], ["tokens"], perm=[0, 2, 1]),
        helper.make_node("Concat", ["first", "tokens"], ["y"], axis=1),
    ]
    constants = {"flat": np.array([1, 3, -1], np.int64), "first": np.full((1, leading, 3), 99, np.float32)}
    shape = [1, 3, 56, 42]
    path = save(tmp_path / "dino.onnx", nodes, [tensor("x", shape)], [tensor("y", [1, None, 3])], constants)
    contract = tmp_path / "dino.toml"
    contract.write_text('kind = "tokens"\nmean = [0.0, 0.0, 0.0]\nstd = [1.0, 1.0, 1.0]\n')
    crop = np.zeros((56, 42, 3), np.uint8)
    crop[14:28, 28:] = (255, 51, 0)
    tokens = TokenNetwork(path, contract)(crop)
    assert tokens.shape == (4, 3, 3)
    np.testing.assert_allclose(tokens[1, 2], [1.0, 0.2, 0.0], atol=1e-5)
    assert np.abs(tokens).sum() == pytest.approx(1.2, abs=1e-4)
    contract.write_text('kind = "tokens"\npatch = 7\n')
    with pytest.raises(BadInput, match="48xC tokens expected"):
        TokenNetwork(path, contract)(crop)
    with pytest.raises(BadInput, match="kind 'picture', 'tokens' expected"):
        TokenNetwork(path)
    contract.write_text('kind = "tokens"\n')
    with pytest.raises(BadInput, match="banmo weights fit"):
        FeatureNetwork(path, contract)


def test_tokens_are_reduced_to_sixteen_channels_by_axes_beside_them(tmp_path: Path) -> None:
    """Channels of the toy are 20 copies of the picture's, so that the axes bring back what was mixed in."""
    rng = np.random.default_rng(0)
    weight = rng.normal(size=(20, 3, 1, 1)).astype(np.float32)
    nodes = [helper.make_node("Conv", ["x", "w"], ["y"], strides=[14, 14], kernel_shape=[1, 1])]
    shape = [1, 3, 112, 112]
    save(tmp_path / "network.onnx", nodes, [tensor("x", shape)], [tensor("y", [1, 20, 8, 8])], {"w": weight})
    (tmp_path / "network.toml").write_text('kind = "tokens"\n')
    tokens = TokenNetwork(tmp_path)(IMAGES[0])
    assert tokens.shape == (8, 8, 20)
    mean, axes = principal_axes(tokens.reshape(-1, 20), 16)
    np.testing.assert_allclose(axes.T @ axes, np.eye(16), atol=1e-4)
    centred = tokens.reshape(-1, 20) - mean
    np.testing.assert_allclose((centred @ axes[:, :3]) @ axes[:, :3].T, centred, atol=1e-2)  # colours have three
    assert (np.diff((centred @ axes).var(axis=0)) <= 1e-4).all(), "largest variance first"
    np.savez(tmp_path / "basis.npz", mean=mean, axes=axes)
    network = FeatureNetwork(tmp_path)
    np.testing.assert_allclose(network(IMAGES[0], 8), (tokens - mean) @ axes, atol=1e-3)
    assert network(IMAGES[0], 112).shape == (112, 112, 16)
    with pytest.raises(ValueError, match="16 axes"):
        principal_axes(tokens.reshape(-1, 20)[:10], 16)
    for broken in (b"", b"PK nonsense"):
        (tmp_path / "basis.npz").write_bytes(broken)
        with pytest.raises(BadInput, match=r"basis\.npz"):
            FeatureNetwork(tmp_path)
    np.savez(tmp_path / "basis.npz", mean=mean, axes=axes[:, :8])
    with pytest.raises(BadInput, match=r"\(C, 16\) expected"):
        FeatureNetwork(tmp_path)


def test_a_folder_with_its_contract_is_a_network(tmp_path: Path) -> None:
    folder = tmp_path / "mine"
    folder.mkdir()
    mask_model(folder / "network.onnx")
    (folder / "network.toml").write_text('size = [48, 32]\n[about]\nlicence = "mine"\n')
    network = MaskNetwork(folder)
    assert (network.name, network.size) == ("mine", (48, 32))
    assert overlap((network(IMAGES[0]) > 0.5)[None], TRUTH[:1]) > 0.6
    mask_model(folder / "second.onnx")
    with pytest.raises(BadInput, match="holds 2 ONNX files"):
        MaskNetwork(folder)


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
    assert "holds 0 ONNX files" in refused(tmp_path / "folder.onnx")


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


def test_functions_of_its_own_are_fine(tmp_path: Path) -> None:
    """A model may define an operator out of known ones; onnxruntime puts those in its place."""
    path = mask_model(tmp_path / "mask.onnx")
    model = onnx.load(str(path))
    opset = [helper.make_opsetid("", 17)]
    twice = helper.make_function("mine", "Twice", ["a"], ["b"], [helper.make_node("Add", ["a", "a"], ["b"])], opset)
    model.functions.append(twice)
    model.opset_import.append(helper.make_opsetid("mine", 1))
    model.graph.node[0].output[0] = "half"
    model.graph.node.append(helper.make_node("Twice", ["half"], ["y"], domain="mine"))
    path.write_bytes(model.SerializeToString())
    assert overlap((MaskNetwork(path)(IMAGES[0]) > 0.5)[None], TRUTH[:1]) > 0.75


@pytest.mark.parametrize("how", ["initializer", "constant", "claimed", "raw"])
def test_tensors_too_large_to_hold_are_refused_before_they_are_made(tmp_path: Path, how: str) -> None:
    side = 1 << 16
    shape = np.array([side, side], np.int64)
    fill = helper.make_node("ConstantOfShape", ["s"], ["big"])
    nodes = [fill, helper.make_node("ReduceMean", ["x"], ["y"], axes=[1], keepdims=1)]
    constants = {}
    if how in ("initializer", "raw"):
        constants["s"] = shape
    elif how == "constant":
        value = helper.make_tensor("v", TensorProto.INT64, [2], shape.tolist())
        nodes.insert(0, helper.make_node("Constant", [], ["s"], value=value))
    else:
        nodes = nodes[1:]
    ends = [tensor("x", [1, 3, "h", "w"])], [tensor("y", [1, 1, "h", "w"])]
    path = save(tmp_path / "big.onnx", nodes, *ends, constants)
    if how in ("claimed", "initializer"):
        model = onnx.load(str(path))
        if how == "claimed":  # a tensor that says it is huge and brings no data
            model.graph.initializer.append(TensorProto(name="z", data_type=TensorProto.FLOAT, dims=[side, side]))
        else:  # the same numbers, written the other way
            model.graph.initializer[0].ClearField("raw_data")
            model.graph.initializer[0].int64_data.extend(shape.tolist())
        path.write_bytes(model.SerializeToString())
    found = inspect(path)
    assert found is not None and found.largest == side * side > HUGE
    assert "too large to be meant" in refused(path)


def test_damaged_bytes_never_crash_the_reader(tmp_path: Path) -> None:
    whole = bytearray(prompted_model(tmp_path / "sam.onnx").read_bytes())
    rng = np.random.default_rng(0)
    path = tmp_path / "damaged.onnx"
    answers = set()
    for _ in range(400):
        damaged = bytearray(whole)
        for at in rng.integers(len(whole), size=rng.integers(1, 6)):
            damaged[at] = rng.integers(256)
        cut = len(damaged) if rng.random() < 0.7 else int(rng.integers(1, len(damaged)))
        path.write_bytes(damaged[:cut])
        answers.add(inspect(path) is None)
    assert answers == {True, False}


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
