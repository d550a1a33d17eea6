"""The skeletons of our categories' canonical surfaces, as files of ours (see synthetic.skeletons, docs/networks.md)."""

from __future__ import annotations

from stages.geometry.raster import vertex_normals
from stages.own_networks import canonical_surface, own_arrays
from stages.retargeting.puppet import Puppet


def own_puppet(category: str) -> Puppet:
    """The puppet of a category: ``quadruped`` or ``human``.

    Raises:
        WeightsDamaged: a file of ours is missing or not what it should be.
    """
    surface = canonical_surface(category)
    normals = vertex_normals(surface["vertices"], surface["faces"])
    return Puppet.of({**surface, "normals": normals}, own_arrays(f"{category}-skeleton.npz"))
