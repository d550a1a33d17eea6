"""Does Blender make of a GLB what we meant? Tree of bones, clips and their lengths, and every vertex in its place.

``python -m benchmarks.blender --exports WORKSPACE/exports --python /path/to/python-with-bpy [--moments 10]``

The interpreter is one with Blender's module (``pip install bpy`` into an environment of its own). Prints a line a clip;
exit 1 if a vertex is off by more than 1e-3 of the object's length.
"""

from __future__ import annotations

import json
import logging
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
import tyro
from scipy.spatial import cKDTree

from stages.formats import read_json, read_poses

log = logging.getLogger(__name__)

TOLERANCE = 1e-3  # of the object's length
_GL_FROM_CV = np.array([1.0, -1.0, -1.0])


@dataclass(frozen=True)
class ClipInBlender:
    """seconds: length of the action; expected_s: of the clip; error: largest distance over the object's length."""

    name: str
    seconds: float
    expected_s: float
    moments: int
    error: float


def compare(exports: Path, interpreter: Path, moments: int = 10) -> tuple[dict[str, Any], list[ClipInBlender]]:
    """Import ``model.glb`` in Blender and compare with ``meshes/`` under the root motion of ``cameras/``.

    Returns:
        What Blender says of the scene (bones and their parents, cameras, attributes), and a result a clip.
    """
    names = sorted(p.stem for p in (exports / "cameras").glob("*.json"))
    times = {n: np.array(read_json(exports / "cameras" / f"{n}.json")["time_s"]) for n in names}
    chosen = {n: np.unique(np.linspace(0, len(t) - 1, moments).round().astype(int)) for n, t in times.items()}
    with tempfile.TemporaryDirectory(prefix="banmo-blender-") as scratch:
        asked, out = Path(scratch) / "moments.json", Path(scratch) / "out.npz"
        asked.write_text(json.dumps({n: (times[n][chosen[n]] - times[n][0]).tolist() for n in names}))
        script = Path(__file__).with_name("posed_in_blender.py")
        command = [str(interpreter), str(script), str(exports / "model.glb"), str(out), str(asked)]
        done = subprocess.run(command, capture_output=True, text=True)
        if done.returncode or not out.is_file():
            raise RuntimeError(f"Blender could not import the file:\n{done.stderr[-2000:]}")
        with np.load(out, allow_pickle=False) as arrays:
            facts = json.loads(str(arrays["facts"]))
            posed = {n: arrays[f"clip_{k}"] for k, n in enumerate(facts["order"])}
    length, results = float(read_json(exports / "quality.json")["length"]), []
    for name in names:
        track = read_poses(exports / "cameras" / f"{name}.json")
        worst = 0.0
        for k, i in enumerate(chosen[name].tolist()):
            mesh: Any = trimesh.load(exports / "meshes" / name / f"{i:05d}.ply", process=False)
            ours = np.asarray(mesh.vertices)
            pose = track.object_to_camera[i]
            scene = (ours @ pose[:3, :3].T + pose[:3, 3]) * _GL_FROM_CV
            worst = max(worst, float(cKDTree(posed[name][k]).query(scene)[0].max()) / length)
        span = float(times[name][-1] - times[name][0])
        results.append(ClipInBlender(name, float(facts["clips"][name]), span, len(chosen[name]), worst))
    return facts, results


def main(exports: Path, python: Path, moments: int = 10) -> None:
    """Compare a GLB as Blender poses it with the per-frame meshes beside it.

    Args:
        exports: Folder with model.glb, meshes/ and cameras/.
        python: An interpreter that can import bpy.
        moments: Frames of each clip to compare.
    """
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    facts, results = compare(exports, python, moments)
    roots = sum(parent is None for parent in facts["bones"].values())
    log.info("%d bones, %d of them without a parent; cameras: %d", len(facts["bones"]), roots, len(facts["cameras"]))
    for r in results:
        log.info("%s: %.3f s of %.3f s, %d frames, worst %.2e", r.name, r.seconds, r.expected_s, r.moments, r.error)
    if max(r.error for r in results) > TOLERANCE:
        log.error("a vertex is off by more than %g of the object's length", TOLERANCE)
        sys.exit(1)


if __name__ == "__main__":
    tyro.cli(main)
