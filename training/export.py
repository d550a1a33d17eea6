"""Write trained networks as ONNX files, and the canonical surfaces as .npz.

``python -m training.export STATE.safetensors OUT_DIR``

For every category: ``cse-<category>.onnx`` (picture 1x3xHxW, normalised by ImageNet's mean and deviation, H and W
multiples of 16 -> 17 channels at half the size: mask logit, then a 16-D embedding of unit length),
``posenet-<category>.onnx`` (4x96x96: picture and mask -> `view` 60 logits, `dense` 17x48x48, `category` 3 logits) and
``<category>.npz`` (vertices, faces, embedding of the canonical surface); and, of what the categories share,
``trunk.onnx`` (picture 1x3xHxW -> 64 features at an eighth of the size) and ``finder.onnx`` (picture 1x3xHxW -> mask
logits of every category at half the size). Batch normalisation is folded into the convolutions; weights are kept in
half precision and widened when the file is opened.
"""

from __future__ import annotations

import hashlib
import json
import logging
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import onnx
import torch
import tyro
from onnx import TensorProto, helper, numpy_helper
from torch import Tensor, nn

from synthetic.canonical import canonical_body
from training.losses import Surface
from training.network import CATEGORIES, EMBEDDING, INPUT_PX, VIEW_OUTPUTS, Network
from training.refine import Refiner, averaged_refiner
from training.revive import revive_masks, revive_trunk
from training.train import make_surface, read_state

log = logging.getLogger(__name__)

OPSET = 17


@dataclass
class _Graph:
    """An ONNX graph in the making: nodes in order, weights by name."""

    nodes: list[onnx.NodeProto] = field(default_factory=list)
    weights: list[onnx.TensorProto] = field(default_factory=list)

    def op(self, kind: str, *inputs: str, **attributes: Any) -> str:
        """Add a node; returns the name of its output."""
        name = f"{kind.lower()}_{len(self.nodes)}"
        self.nodes.append(helper.make_node(kind, list(inputs), [name], name=name, **attributes))
        return name

    def weight(self, value: Tensor) -> str:
        """A floating-point weight, kept as float16."""
        name = f"w_{len(self.weights)}"
        self.weights.append(numpy_helper.from_array(value.detach().cpu().numpy().astype(np.float16), name))
        return self.op("Cast", name, to=TensorProto.FLOAT)

    def constant(self, value: np.ndarray) -> str:
        name = f"c_{len(self.weights)}"
        self.weights.append(numpy_helper.from_array(value, name))
        return name

    def convolve(self, x: str, conv: nn.Conv2d, norm: nn.BatchNorm2d | None = None) -> str:
        """A convolution with the normalisation that follows it folded in."""
        kernel = conv.weight
        bias = torch.zeros(conv.out_channels) if conv.bias is None else conv.bias
        if norm is not None:
            scale = norm.weight / torch.sqrt(norm.running_var + norm.eps)  # type: ignore[operator, arg-type]
            kernel = kernel * scale[:, None, None, None]
            bias = norm.bias + (bias - norm.running_mean) * scale  # type: ignore[operator]
        pad = [conv.padding[0], conv.padding[1]] * 2  # type: ignore[index]
        return self.op("Conv", x, self.weight(kernel), self.weight(bias), strides=list(conv.stride), pads=pad,
                       kernel_shape=list(conv.kernel_size))  # fmt: skip

    def layer(self, x: str, module: nn.Module) -> str:
        """Any of the network's building blocks, by what it is made of."""
        if isinstance(module, nn.Sequential):
            parts = list(module)
            while parts:
                part = parts.pop(0)
                if isinstance(part, nn.Conv2d):
                    norm = parts[0] if parts and isinstance(parts[0], nn.BatchNorm2d) else None
                    parts = parts[1:] if norm is not None else parts
                    x = self.convolve(x, part, norm)
                else:
                    x = self.layer(x, part)
            return x
        if isinstance(module, nn.ReLU):
            return self.op("Relu", x)
        if isinstance(module, nn.Conv2d):
            return self.convolve(x, module)
        if isinstance(module, nn.Upsample):
            return self.lift(x, 2)
        if isinstance(module, nn.Linear):
            return self.op("Gemm", x, self.weight(module.weight), self.weight(module.bias), transB=1)
        if hasattr(module, "first") and hasattr(module, "second"):
            return self.op("Relu", self.op("Add", x, self.layer(self.layer(x, module.first), module.second)))  # type: ignore[arg-type]
        raise TypeError(f"no ONNX form for {type(module).__name__}")

    def lift(self, x: str, times: int, mode: str = "nearest") -> str:
        """Enlarge `times` times."""
        scales = self.constant(np.array([1, 1, times, times], np.float32))
        if mode == "nearest":
            return self.op("Resize", x, "", scales, mode=mode, nearest_mode="floor",
                           coordinate_transformation_mode="asymmetric")  # fmt: skip
        return self.op("Resize", x, "", scales, mode=mode, coordinate_transformation_mode="half_pixel")

    def unit(self, x: str) -> str:
        """Vectors along channels, of unit length."""
        floor = self.constant(np.array(1e-6, np.float32))
        length = self.op("ReduceL2", x, axes=[1], keepdims=1)
        return self.op("Div", x, self.op("Max", length, floor))


def _trunk(g: _Graph, network: Network, x: str) -> dict[str, str]:
    """As `Network.forward`. `x` holds 16 channels at half the size."""
    at2, at4, at8, at16 = _down(g, network, x)
    fine8 = _up8(g, network, at8, at16)
    fine4 = g.layer(g.op("Add", g.layer(fine8, network.up4), g.layer(at4, network.side4)), network.join4)
    fine2 = g.layer(g.op("Add", g.layer(fine4, network.up2), g.layer(at2, network.side2)), network.join2)
    return {"at16": at16, "fine4": fine4, "fine2": fine2}


def _down(g: _Graph, network: Network, x: str) -> tuple[str, str, str, str]:
    """Features at a half, a quarter, an eighth and a sixteenth of the size, on the way down."""
    at2 = g.layer(x, network.stem)
    at4 = g.layer(g.layer(at2, network.down4), network.at4)
    at8 = g.layer(g.layer(at4, network.down8), network.at8)
    return at2, at4, at8, g.layer(g.layer(at8, network.down16), network.at16)


def _up8(g: _Graph, network: Network, at8: str, at16: str) -> str:
    """Features at an eighth of the size, on the way up."""
    return g.layer(g.op("Add", g.layer(at16, network.up8), g.layer(at8, network.side8)), network.join8)


def _unmasked(g: _Graph, image: str) -> str:
    """A picture and a fourth channel of zeros: no mask is known."""
    zero = g.constant(np.array(0, np.float32))
    return g.op("Concat", image, g.op("Mul", g.op("ReduceMean", image, axes=[1], keepdims=1), zero), axis=1)


def _halve(g: _Graph, x: str) -> str:
    """Pixel unshuffle by 2, channel order as torch's: channel, row, column."""
    blocks = g.op("SpaceToDepth", x, blocksize=2)  # row, column, channel
    order = np.array([(r * 2 + c) * 4 + k for k in range(4) for r in range(2) for c in range(2)], np.int64)
    return g.op("Gather", blocks, g.constant(order), axis=1)


def _dense(g: _Graph, network: Network, parts: dict[str, str], category: int) -> str:
    """17 channels at half the size: mask logit, unit embedding."""
    every = g.convolve(parts["fine2"], network.mask)
    logit = g.op("Gather", every, g.constant(np.array([category], np.int64)), axis=1)
    embedding = g.lift(g.unit(g.layer(parts["fine4"], network.embedding[category])), 2, "linear")
    return g.op("Concat", logit, g.unit(embedding), axis=1)


def _finish(g: _Graph, inputs: list[onnx.ValueInfoProto], outputs: dict[str, tuple[str, list[Any]]], name: str,
            provenance: dict[str, str]) -> onnx.ModelProto:  # fmt: skip
    infos = []
    for public, (source, shape) in outputs.items():
        g.nodes.append(helper.make_node("Identity", [source], [public], name=f"out_{public}"))
        infos.append(helper.make_tensor_value_info(public, TensorProto.FLOAT, shape))
    graph = helper.make_graph(g.nodes, name, inputs, infos, g.weights)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", OPSET)], ir_version=8)
    helper.set_model_props(model, provenance)
    onnx.checker.check_model(model, full_check=True)
    return model


def cse_model(network: Network, category: int, provenance: dict[str, str]) -> onnx.ModelProto:
    """Picture N x 3 x H x W -> `dense` N x 17 x H/2 x W/2."""
    g = _Graph()
    image = helper.make_tensor_value_info("image", TensorProto.FLOAT, ["n", 3, "h", "w"])
    parts = _trunk(g, network, _halve(g, _unmasked(g, "image")))
    outputs = {"dense": (_dense(g, network, parts, category), ["n", 1 + EMBEDDING, "h2", "w2"])}
    return _finish(g, [image], outputs, f"cse-{CATEGORIES[category]}", provenance)


def trunk_model(network: Network, provenance: dict[str, str]) -> onnx.ModelProto:
    """Picture N x 3 x H x W -> `features` N x 64 x H/8 x W/8 of the trunk on its way up; nothing beyond them."""
    g = _Graph()
    image = helper.make_tensor_value_info("image", TensorProto.FLOAT, ["n", 3, "h", "w"])
    at8, at16 = _down(g, network, _halve(g, _unmasked(g, "image")))[2:]
    outputs = {"features": (_up8(g, network, at8, at16), ["n", network.join8[0].out_channels, "h8", "w8"])}
    return _finish(g, [image], outputs, "trunk", provenance)


def finder_model(network: Network, provenance: dict[str, str]) -> onnx.ModelProto:
    """Picture N x 3 x H x W -> `masks` N x K x H/2 x W/2: mask logits of all categories, as `cse_model` has them."""
    g = _Graph()
    image = helper.make_tensor_value_info("image", TensorProto.FLOAT, ["n", 3, "h", "w"])
    masks = g.convolve(_trunk(g, network, _halve(g, _unmasked(g, "image")))["fine2"], network.mask)
    return _finish(g, [image], {"masks": (masks, ["n", len(CATEGORIES), "h2", "w2"])}, "finder", provenance)


def posenet_model(network: Network, category: int, provenance: dict[str, str]) -> onnx.ModelProto:
    """Picture and mask N x 4 x 96 x 96 -> `view` N x 60, `dense` N x 17 x 48 x 48, `category` N x 3."""
    g = _Graph()
    side = INPUT_PX
    image = helper.make_tensor_value_info("input", TensorProto.FLOAT, ["n", 4, side, side])
    parts = _trunk(g, network, _halve(g, "input"))
    pooled = g.op("AveragePool", parts["fine4"], kernel_shape=[4, 4], strides=[4, 4])
    head = network.view[category]
    x = g.layer(g.layer(g.op("Concat", parts["at16"], pooled, axis=1), head.mix), head.spread)  # type: ignore[arg-type]
    x = g.op("Relu", g.layer(g.op("Flatten", x, axis=1), head.hidden))  # type: ignore[arg-type]
    view = g.layer(x, head.logits)  # type: ignore[arg-type]
    kind = g.layer(g.op("Flatten", g.op("GlobalAveragePool", parts["at16"]), axis=1), network.category)
    outputs: dict[str, tuple[str, list[Any]]] = {
        "view": (view, ["n", VIEW_OUTPUTS]),
        "dense": (_dense(g, network, parts, category), ["n", 1 + EMBEDDING, side // 2, side // 2]),
        "category": (kind, ["n", len(CATEGORIES) + 1]),
    }
    return _finish(g, [image], outputs, f"posenet-{CATEGORIES[category]}", provenance)


def refiner_model(refiner: Refiner, provenance: dict[str, str]) -> onnx.ModelProto:
    """Picture and rough mask N x 4 x H x W -> `logit` N x 1 x H x W."""
    g = _Graph()
    image = helper.make_tensor_value_info("input", TensorProto.FLOAT, ["n", 4, "h", "w"])
    fine = _trunk(g, refiner.trunk, _halve(g, "input"))["fine2"]
    logit = g.op("DepthToSpace", g.convolve(fine, refiner.head), blocksize=2, mode="CRD")
    return _finish(g, [image], {"logit": (logit, ["n", 1, "h", "w"])}, "refine", provenance)


def export(state: Path, out: Path, provenance: dict[str, str]) -> dict[str, str]:
    """Write all files; returns their sha256 by name."""
    saved = read_state(state)
    network = Network().eval()
    network.load_state_dict(saved["network"])
    surfaces = nn.ModuleList(make_surface(name, 0) for name in CATEGORIES)
    surfaces.load_state_dict(saved["surfaces"])
    out.mkdir(parents=True, exist_ok=True)
    digests = {}
    for k, name in enumerate(CATEGORIES):
        for kind, model in (
            ("cse", cse_model(network, k, provenance)),
            ("posenet", posenet_model(network, k, provenance)),
        ):
            digests[f"{kind}-{name}.onnx"] = write_model(out / f"{kind}-{name}.onnx", model)
        body, surface = canonical_body(name), surfaces[k]
        assert isinstance(surface, Surface)
        part = out / f".{name}.npz"
        with part.open("wb") as file:
            np.savez_compressed(
                file,
                vertices=body.vertices.astype(np.float32),
                faces=body.faces.astype(np.int32),
                embedding=surface.embedding().detach().numpy().astype(np.float32),
            )
        part.replace(out / f"{name}.npz")
        digests[f"{name}.npz"] = hashlib.sha256((out / f"{name}.npz").read_bytes()).hexdigest()
    return digests | _write_shared(network, out, provenance)


def shared_of(path: Path, out: Path) -> dict[str, str]:
    """Write ``trunk.onnx`` and ``finder.onnx`` of an exported category's PoseNet; returns their sha256 by name."""
    network = Network().eval()
    revive_trunk(network, path)
    revive_masks(network.mask, path)
    provenance = {p.key: p.value for p in onnx.load(path).metadata_props}
    out.mkdir(parents=True, exist_ok=True)
    return _write_shared(network, out, provenance)


def _write_shared(network: Network, out: Path, provenance: dict[str, str]) -> dict[str, str]:
    models = {"trunk.onnx": trunk_model(network, provenance), "finder.onnx": finder_model(network, provenance)}
    return {name: write_model(out / name, model) for name, model in models.items()}


def write_model(path: Path, model: onnx.ModelProto) -> str:
    """Write a model in one piece; returns its sha256."""
    return _write(path, model.SerializeToString(deterministic=True))


def _write(path: Path, data: bytes) -> str:
    part = path.with_suffix(".part")
    part.write_bytes(data)
    part.replace(path)
    return hashlib.sha256(data).hexdigest()


def main(state: Annotated[Path, tyro.conf.Positional], out: Annotated[Path, tyro.conf.Positional]) -> None:
    """Write trained networks as ONNX files.

    Args:
        state: The `state.safetensors` of a training run (`log.jsonl` beside it), or the `refine.safetensors` of a
            refiner's (`refine.jsonl` beside it), or an exported `posenet-<category>.onnx`, for what the
            categories share.
        out: Folder to write to.
    """
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    if state.suffix == ".onnx":
        log_digests(shared_of(state, out))
        return
    refining = state.stem == "refine"
    lines = (state.parent / ("refine.jsonl" if refining else "log.jsonl")).read_text(encoding="utf-8").splitlines()
    last = json.loads(lines[-1])
    provenance = {
        "made_by": f"python -m training.{'refine' if refining else 'train'}, python -m training.export",
        "trained_on": "renderings of generated bodies only (synthetic/)",
        "pictures": str(last["pictures"]),
        "steps": str(last["step"]),
        "licence": "Apache-2.0",
    }
    if refining:
        out.mkdir(parents=True, exist_ok=True)
        model = refiner_model(averaged_refiner(state), provenance)
        written = {"refine.onnx": write_model(out / "refine.onnx", model)}
    else:
        written = export(state, out, provenance)
    log_digests(written)


def log_digests(written: dict[str, str]) -> None:
    """Say what was written: sha256 and name of each file."""
    for name, digest in written.items():
        log.info("%s  %s", digest, name)


if __name__ == "__main__":
    tyro.cli(main)
