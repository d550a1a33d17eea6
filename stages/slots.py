"""Which network class a slot wants, and a trial of a file: opened, shown a picture, its answer looked at."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np

from stages.contracts import PICTURE, locate, read_contract
from stages.networks import FeatureNetwork, FlowNetwork, MaskNetwork, PromptedMaskNetwork, TokenNetwork

_SIDE_PX = 192


def mask_network(
    network: str | Path, contract: str | Path = "", *, device: str = "cpu", threads: int = 1
) -> MaskNetwork | PromptedMaskNetwork:
    """The mask network of a setting, by the kind that its contract names."""
    beside = locate(network, contract)[1]
    kind = PromptedMaskNetwork if read_contract(beside, PICTURE).kind == "prompted" else MaskNetwork
    return kind(network, contract, device=device, threads=threads)


def trial(network: Path, slot: str, contract: str | Path = "", device: str = "cpu") -> str:
    """Open a network as a stage would and show it one picture; a line on what it is and how long it took.

    Raises BadInput when the file cannot be trusted or does not do what the slot wants.
    """
    rows, columns = np.mgrid[0:_SIDE_PX, 0:_SIDE_PX]
    picture = np.stack([rows, columns, (rows + columns) // 2], axis=-1).astype(np.uint8)
    picture[60:130, 50:140] = (210, 120, 40)
    started = time.monotonic()
    if slot == "masks":
        opened = mask_network(network, contract, device=device)
        opened_s = time.monotonic()
        found = (
            opened(picture, np.array([50, 60, 140, 130]))
            if isinstance(opened, PromptedMaskNetwork)
            else opened(picture)
        )
    elif slot == "flow":
        opened = FlowNetwork(network, contract, device=device)
        opened_s = time.monotonic()
        found = opened(picture, picture)
    elif slot == "tokens":
        opened = TokenNetwork(network, contract, device=device)
        opened_s = time.monotonic()
        found = opened(picture)
    else:
        opened = FeatureNetwork(network, contract, device=device)
        opened_s = time.monotonic()
        found = opened(picture, 112)
    ended = time.monotonic()
    size = "any size" if opened.size is None else f"{opened.size[1]}x{opened.size[0]}"
    return (
        f"{opened.path.stat().st_size / 1e6:.1f} MB, {slot}, takes {size}, gives {'x'.join(map(str, found.shape))}, "
        f"on {opened.on}; opened in {opened_s - started:.1f} s, a picture in {ended - opened_s:.2f} s"
    )
