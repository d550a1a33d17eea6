"""The skeletons of our categories' canonical surfaces, as files of ours (see synthetic.skeletons, docs/networks.md)."""

from __future__ import annotations

import hashlib

import numpy as np

from stages.geometry.raster import vertex_normals
from stages.own_networks import WEIGHTS, WeightsDamaged, canonical_surface
from stages.retargeting.puppet import Puppet

DIGESTS = {
    "quadruped": "aabfb977e9d3dab9fc71b28930737a8da2837fa47dfe0ac5b703ca83574b950a",
    "human": "a2f5140035bcfba243a3ac916b55fa8c415e76c00904a8233e49cd5872d2d111",
}
"""sha256 of the files this code was written with."""


def own_puppet(category: str) -> Puppet:
    """The puppet of a category: ``quadruped`` or ``human``.

    Raises:
        WeightsDamaged: a file of ours is missing or not what it should be.
    """
    path = WEIGHTS / f"{category}-skeleton.npz"
    try:
        digest = hashlib.sha256(path.read_bytes()).hexdigest()
    except OSError as error:
        raise WeightsDamaged(f"stages/weights/{path.name} cannot be read ({error.strerror}); install again") from error
    if digest != DIGESTS[category]:
        raise WeightsDamaged(f"stages/weights/{path.name} is not the file that was shipped; install again")
    surface = canonical_surface(category)
    normals = vertex_normals(surface["vertices"], surface["faces"])
    with np.load(path, allow_pickle=False) as file:
        return Puppet.of({**surface, "normals": normals}, dict(file))
