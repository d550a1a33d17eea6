"""A trial of a network for a slot: opened as its stage would, shown a picture, its answer looked at."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from stages.contracts import PICTURE, locate, read_contract
from stages.networks import FeatureNetwork, FlowNetwork, PromptedMaskNetwork, TokenNetwork, mask_network
from stages.onnx_session import Network

_SIDE_PX = 192
_BOX = (50, 60, 140, 130)


def trial(network: Path, slot: str, contract: str | Path = "", device: str = "cpu") -> str:
    """Open a network as the stage `slot` would and show it one picture; a line on what it is and how long it took.

    Raises BadInput when the file cannot be trusted or does not do what the slot wants.
    """
    started = time.monotonic()
    opened, show = _open(network, slot, contract, device)
    opened_s = time.monotonic()
    found = show()
    ended = time.monotonic()
    size = "any size" if opened.size is None else f"{opened.size[1]}x{opened.size[0]}"
    return (
        f"{opened.path.stat().st_size / 1e6:.1f} MB, {slot}, takes {size}, gives {'x'.join(map(str, found.shape))}, "
        f"on {opened.on}; opened in {opened_s - started:.1f} s, a picture in {ended - opened_s:.2f} s"
    )


def _open(network: Path, slot: str, contract: str | Path, device: str) -> tuple[Network, Callable[[], np.ndarray]]:
    """The network of a slot, and how to show it the test picture."""
    rows, columns = np.mgrid[0:_SIDE_PX, 0:_SIDE_PX]
    picture = np.stack([rows, columns, (rows + columns) // 2], axis=-1).astype(np.uint8)
    picture[_BOX[1] : _BOX[3], _BOX[0] : _BOX[2]] = (210, 120, 40)
    if slot == "masks":
        mask = mask_network(network, contract, device=device)
        if isinstance(mask, PromptedMaskNetwork):
            return mask, lambda: mask(picture, np.array(_BOX, float))
        return mask, lambda: mask(picture)
    if slot == "flow":
        flow = FlowNetwork(network, contract, device=device)
        return flow, lambda: flow(picture, picture)
    if read_contract(locate(network, contract)[1], PICTURE).kind == "tokens":
        tokens = TokenNetwork(network, contract, device=device)
        return tokens, lambda: tokens(picture)
    features = FeatureNetwork(network, contract, device=device)
    return features, lambda: features(picture, 112)
