"""An exported network made trainable again: export folds normalisation into convolutions, this unfolds it.

Weights come back in the half precision they were kept in.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import onnx
import torch
from onnx import numpy_helper
from torch import Tensor, nn

from training.network import Network

_ORDER = (
    "stem", "down4", "at4", "down8", "at8", "down16", "at16", "up8", "side8", "join8", "up4", "side4", "join4", "up2",
    "side2", "join2",
)  # fmt: skip
"""The trunk's modules as `training.export` writes them."""


def revive(trunk: Network, head: nn.Conv2d, path: Path) -> None:
    """Give a refiner's parts the weights of an exported one. Normalisation does nothing until it is calibrated.

    Raises:
        ValueError: the file does not hold such a network.
    """
    weights, layers = _weights(path), [*_layers(trunk), (head, None)]
    if len(weights) != 2 * len(layers):
        raise ValueError(f"{path} holds {len(weights)} weights, a refiner {2 * len(layers)}")
    _give(layers, weights)


def revive_trunk(trunk: Network, path: Path) -> None:
    """Give a trunk the weights of an exported network that begins with one; heads stay as they are.

    Raises:
        ValueError: the file does not begin with such a trunk.
    """
    weights, layers = _weights(path), list(_layers(trunk))
    shapes = [tuple(conv.weight.shape) for conv, _ in layers]
    if [w.shape for w in weights[: 2 * len(layers) : 2]] != shapes:
        raise ValueError(f"{path} does not begin with the categories' trunk")
    _give(layers, weights)


def revive_masks(head: nn.Conv2d, path: Path) -> None:
    """Give the head of all categories' masks the weights of an exported PoseNet.

    Raises:
        ValueError: the file holds no such head, or more than one.
    """
    weights = _weights(path)
    found = [k for k, w in enumerate(weights) if w.shape == tuple(head.weight.shape)]
    if len(found) != 1:
        raise ValueError(f"{path} holds {len(found)} heads of masks, one expected")
    _give([(head, None)], weights[found[0] :])


def _weights(path: Path) -> list[np.ndarray]:
    return [numpy_helper.to_array(w) for w in onnx.load(path).graph.initializer if w.name.startswith("w_")]


def _give(layers: Sequence[tuple[nn.Conv2d, nn.BatchNorm2d | None]], weights: list[np.ndarray]) -> None:
    """Kernel and bias of each layer, in order; a normalisation carries the bias and does nothing else."""
    with torch.no_grad():
        for (conv, norm), kernel, bias in zip(layers, weights[::2], weights[1::2], strict=False):
            conv.weight.copy_(torch.from_numpy(kernel.astype(np.float32)))
            shift = torch.from_numpy(bias.astype(np.float32))
            if norm is None:
                assert conv.bias is not None
                conv.bias.copy_(shift)
            else:
                norm.running_mean.zero_()  # type: ignore[union-attr]
                norm.running_var.fill_(1 - norm.eps)  # type: ignore[union-attr]
                norm.weight.fill_(1)
                norm.bias.copy_(shift)


def calibrate(network: nn.Module, batches: list[Tensor]) -> None:
    """Let every normalisation know the mean and variance of what it sees, changing nothing that comes out of it.

    Without that, training would normalise by the batch what was never normalised.
    """
    norms = [m for m in network.modules() if isinstance(m, nn.BatchNorm2d)]
    sums = {m: torch.zeros(3, m.num_features, dtype=torch.float64) for m in norms}

    def watch(norm: nn.Module, inputs: tuple[Tensor, ...]) -> None:
        x = inputs[0].double().transpose(0, 1).flatten(1)
        sums[norm] += torch.stack([torch.full_like(x[:, 0], x.shape[1]), x.sum(1), (x**2).sum(1)])  # type: ignore[index]

    handles = [m.register_forward_pre_hook(watch) for m in norms]
    network.eval()
    with torch.no_grad():
        for batch in batches:
            network(batch)
    for handle in handles:
        handle.remove()
    for norm, (count, total, squares) in sums.items():
        if count[0] == 0:  # not on the way from input to output
            continue
        mean = total / count
        spread = (squares / count - mean**2).clamp_min(0)
        scale = norm.weight.double() / torch.sqrt(norm.running_var.double() + norm.eps)  # type: ignore[union-attr]
        shift = norm.bias.double() - norm.running_mean.double() * scale  # type: ignore[union-attr]
        wanted = scale * torch.sqrt(spread + norm.eps)
        with torch.no_grad():
            norm.weight.copy_(wanted)
            norm.bias.copy_(shift + mean * scale)
            norm.running_mean.copy_(mean)  # type: ignore[union-attr]
            norm.running_var.copy_(spread)  # type: ignore[union-attr]


def _layers(trunk: Network) -> Iterator[tuple[nn.Conv2d, nn.BatchNorm2d]]:
    for name in _ORDER:
        parts = list(getattr(trunk, name).modules())
        convs = [m for m in parts if isinstance(m, nn.Conv2d)]
        norms = [m for m in parts if isinstance(m, nn.BatchNorm2d)]
        yield from zip(convs, norms, strict=True)
