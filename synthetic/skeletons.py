"""Write the skeletons of the categories' canonical surfaces: what moves them, for whoever has only the surface.

``python -m synthetic.skeletons OUT`` writes ``OUT/<category>-skeleton.npz``: ``names``, ``parents`` (B,), ``joints``,
``tips`` (B, 3) and ``weights`` (V, B) for the V vertices of ``<category>.npz`` (see docs/networks.md).
"""

from __future__ import annotations

import hashlib
import logging
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro

from synthetic.canonical import CATEGORIES, canonical_body

log = logging.getLogger(__name__)


def skeleton_of(category: str) -> dict[str, np.ndarray]:
    """Names, parents, joints, tips and skinning weights of a category's canonical body."""
    body = canonical_body(category)
    return {
        "names": np.array([bone.name for bone in body.bones]),
        "parents": np.array([bone.parent for bone in body.bones], np.int32),
        "joints": np.stack([bone.joint for bone in body.bones]).astype(np.float32),
        "tips": np.stack([bone.tip for bone in body.bones]).astype(np.float32),
        "weights": body.weights.astype(np.float16),
    }


def main(out: Annotated[Path, tyro.conf.Positional]) -> None:
    """Write both files and say their digests.

    Args:
        out: Folder; made if missing.
    """
    out.mkdir(parents=True, exist_ok=True)
    for category in CATEGORIES:
        path = out / f"{category}-skeleton.npz"
        part = path.with_name(f".{path.name}")
        with part.open("wb") as file:
            np.savez_compressed(file, **skeleton_of(category))  # type: ignore[arg-type]
        part.replace(path)
        log.info('"%s": "%s",', path.name, hashlib.sha256(path.read_bytes()).hexdigest())


if __name__ == "__main__":
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    tyro.cli(main)
