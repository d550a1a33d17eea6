"""Mending a mesh with pymeshlab, which the user may add (``pip install banmo-pipeline[clean]``); never needed."""

from __future__ import annotations

import numpy as np

from stages.meshing.surface import Mesh


class CleanerMissing(RuntimeError):
    """pymeshlab is not installed."""


def repair_with_pymeshlab(mesh: Mesh) -> Mesh:
    """Remove doubled and folded faces, mend edges and vertices that join more than one sheet, close small holes.

    Raises:
        CleanerMissing: pymeshlab is not installed.
    """
    try:
        import pymeshlab
    except ImportError as error:
        raise CleanerMissing("pymeshlab is not installed") from error
    meshes = pymeshlab.MeshSet()
    meshes.add_mesh(pymeshlab.Mesh(mesh.vertices, mesh.faces.astype(np.int32)))
    for name in (
        "meshing_remove_duplicate_vertices",
        "meshing_remove_duplicate_faces",
        "meshing_remove_null_faces",
        "meshing_remove_folded_faces",
        "meshing_repair_non_manifold_edges",
        "meshing_repair_non_manifold_vertices",
        "meshing_close_holes",
        "meshing_remove_unreferenced_vertices",
    ):
        meshes.apply_filter(name)
    mended = meshes.current_mesh()
    return Mesh(mended.vertex_matrix().astype(np.float64), mended.face_matrix().astype(np.int64))
