"""What a network expects and gives: a small TOML file beside its ONNX file, or named by a setting.

::

    size = [320, 320]          # height, width, where the file leaves them open
    colour = "rgb"             # or "bgr"
    scale = "unit"             # pixel values: "unit" 0..1, "byte" 0..255, "own-max" divided by the picture's largest
    mean = [0.485, 0.456, 0.406]
    std = [0.229, 0.224, 0.225]
    output = 0                 # index or name of the output that counts
    activation = "auto"        # of a mask: "none", "sigmoid", "minmax", "auto" (sigmoid where values leave 0..1)
    kind = "picture"           # or "prompted" (a picture and clicks, EfficientSAM), "tokens" (DINOv2)
    patch = 14                 # side of a token in pixels

Every key may be left out. A table ``[about]`` (licence, source, digest) may stand below and is not read here.
"""

from __future__ import annotations

import tomllib
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from pipeline import BadInput

IMAGENET_MEAN = (0.485, 0.456, 0.406)
IMAGENET_STD = (0.229, 0.224, 0.225)
CHOICES = {
    "colour": ("rgb", "bgr"),
    "scale": ("unit", "byte", "own-max"),
    "activation": ("auto", "none", "sigmoid", "minmax"),
    "kind": ("picture", "prompted", "tokens"),
}
MAX_CONTRACT_BYTES = 100_000


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
    kind: str = "picture"
    patch: int = 14


PICTURE = Contract()
FLOW = Contract(scale="byte", mean=(0.0, 0.0, 0.0), std=(1.0, 1.0, 1.0), output=-1)
"""Two pictures of RGB 0..255, the last output counts: the contract of the OpenCV zoo's RAFT."""


def locate(network: str | Path, contract: str | Path = "") -> tuple[Path, Path | None]:
    """The ONNX file and the contract file of a setting: a file, or a folder that holds one of each.

    A contract named by itself comes first. Raises BadInput when a folder does not hold just one ONNX file.
    """
    path, named = Path(network), Path(contract) if str(contract) else None
    if not path.is_dir():
        return path, named
    found = sorted(path.glob("*.onnx"))
    if len(found) != 1:
        raise BadInput(f"the folder {path.name} holds {len(found)} ONNX files, one expected")
    beside = found[0].with_suffix(".toml")
    return found[0], named or (beside if beside.is_file() else None)


def read_contract(path: Path | None, default: Contract) -> Contract:
    """A contract file over the defaults; None gives the defaults. Unknown keys and values are refused."""
    if path is None:
        return default
    try:
        if path.stat().st_size > MAX_CONTRACT_BYTES:
            raise BadInput(f"{path.name} is too large to be a contract")
        table = tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise BadInput(f"{path.name} cannot be read as TOML ({error})") from error
    table.pop("about", None)
    return contract_of(table, default, path.name)


def contract_of(table: dict[str, Any], default: Contract, name: str) -> Contract:
    """A contract from a parsed table; `name` is what errors call it."""
    table = dict(table)
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
        height, width = table["size"]
        if not (min(height, width) >= 16 and max(height, width) <= 4096):
            raise BadInput(f"{name}: size must lie between 16 and 4096")
        table["size"] = (int(height), int(width))
    if any(s <= 0 for s in table.get("std", ())):
        raise BadInput(f"{name}: std must be positive")
    if isinstance(table.get("output", 0), bool) or not isinstance(table.get("output", 0), int | str):
        raise BadInput(f"{name}: output is the index or the name of an output")
    patch = table.get("patch", 14)
    if isinstance(patch, bool) or not isinstance(patch, int) or not 1 <= patch <= 64:
        raise BadInput(f"{name}: patch is a number of pixels between 1 and 64")
    return replace(default, **table)


def _numbers(value: Any, count: int, what: str) -> tuple[float, ...]:
    fine = isinstance(value, list) and len(value) == count
    if not fine or not all(isinstance(v, int | float) and not isinstance(v, bool) and abs(v) < 1e6 for v in value):
        raise BadInput(f"{what} must be a list of {count} numbers")
    return tuple(float(v) for v in value)
