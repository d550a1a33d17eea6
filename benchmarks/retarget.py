"""How well a model follows another animal: ``banmo retarget`` by a generated clip whose motion is known.

``python -m benchmarks.retarget --workspace W --out DIR [--kind dog|person --seed 21 --frames 60 --given]``

A clip of a generated quadruped is filmed and given to ``banmo retarget`` raw (with ``--given``: with true masks and
root poses beside it). Scored are directions of limbs before the camera, in degrees against the truth: from shoulder or
hip to foot, from trunk to head, from trunk to the tip of the tail; lengths play no part, as the two animals differ.
``still`` is the same with the model's limbs at rest on the found root poses: what following is worth.

Where a limb begins is a matter of definition, and two animals stand differently: hence a second pair of columns, of
*motion* alone. Each limb's directions in the body's own frame are turned as a whole so that their mean over the clip is
the true one; ``swing`` is what a limb does that never moves, the size of the true motion about its mean.
"""

from __future__ import annotations

import json
import logging
import shutil
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from scipy.spatial.transform import Rotation

from stages.animating.glb import read_glb
from stages.animating.playing import CV_FROM_GL, ROOT_MOTION, Player
from synthetic.clips import film, make_subject, write_motion, write_truth, write_video

log = logging.getLogger(__name__)

# Limb -> joints of the generated body between which it runs.
TRUE_LIMBS = {
    "leg_front_left": ("arm_left", "hand_left"),
    "leg_front_right": ("arm_right", "hand_right"),
    "leg_back_left": ("thigh_left", "foot_left"),
    "leg_back_right": ("thigh_right", "foot_right"),
    "head": ("chest", "head"),
    "tail": ("pelvis", "tail4"),
    "trunk": ("pelvis", "chest"),
}
TRUE_LIMBS_OF_PEOPLE = {
    "leg_left": ("thigh_left", "foot_left"),
    "leg_right": ("thigh_right", "foot_right"),
    "arm_left": ("arm_left", "hand_left"),
    "arm_right": ("arm_right", "hand_right"),
    "head": ("chest", "head"),
    "trunk": ("pelvis", "chest"),
}


def true_directions(truth: Any, camera_from_object: np.ndarray) -> dict[str, np.ndarray]:
    """Unit directions (T, 3) of every limb before the camera."""
    names = [str(n) for n in truth["bone_names"]]
    joints = np.einsum("tij,tbj->tbi", camera_from_object[:, :3, :3], truth["joints"].astype(np.float64))
    limbs = TRUE_LIMBS_OF_PEOPLE if "clavicle_left" in names else TRUE_LIMBS
    return {k: unit(joints[:, names.index(b)] - joints[:, names.index(a)]) for k, (a, b) in limbs.items()}


def regions(vertices: np.ndarray) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Vertices at the root and at the tip of every limb of a standing quadruped: y up, z front, x its left."""
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    unit_place = (vertices - low) / (high - low)
    x, y, z = vertices[:, 0] - np.median(vertices[:, 0]), unit_place[:, 1], unit_place[:, 2]
    feet = y < 0.2
    middle = float(np.median(z[feet]))
    found = {}
    for end, there in (("front", z >= middle), ("back", z < middle)):
        here = feet & there
        along = np.abs(z - float(np.median(z[here]))) < 0.12
        for side, own in (("left", x > 0), ("right", x <= 0)):
            top = along & own & (y > 0.45) & (y < 0.75)
            found[f"leg_{end}_{side}"] = (np.flatnonzero(top), np.flatnonzero(here & own))
    trunk_z = [float(np.median(z[feet & there])) for there in (z < middle, z >= middle)]
    body = y > 0.4
    rear, chest = (np.flatnonzero(body & (np.abs(z - c) < 0.08)) for c in trunk_z)
    found["head"] = (chest, np.flatnonzero(z > 0.9))
    found["tail"] = (rear, np.flatnonzero(z < 0.08))
    found["trunk"] = (rear, chest)
    return {k: v for k, v in found.items() if len(v[0]) and len(v[1])}


def regions_of_people(vertices: np.ndarray) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """The same of a standing person whose arms are away from the trunk."""
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    y = (vertices[:, 1] - low[1]) / (high[1] - low[1])
    x = vertices[:, 0] - np.median(vertices[y < 0.5, 0])
    found = {}
    for side, sign in (("left", 1.0), ("right", -1.0)):
        own = sign * x > 0
        found[f"leg_{side}"] = (np.flatnonzero(own & (y > 0.42) & (y < 0.52)), np.flatnonzero(own & (y < 0.08)))
        reach = np.quantile((sign * x)[own], 0.96)
        shoulder = own & (y > 0.74) & (y < 0.84) & (sign * x < 0.45 * reach)
        found[f"arm_{side}"] = (np.flatnonzero(shoulder), np.flatnonzero(sign * x > reach))
    chest = np.flatnonzero((y > 0.68) & (y < 0.78) & (np.abs(x) < 0.25 * np.abs(x).max()))
    found["head"] = (chest, np.flatnonzero(y > 0.92))
    found["trunk"] = (np.flatnonzero((y > 0.5) & (y < 0.58)), chest)
    return {k: v for k, v in found.items() if len(v[0]) and len(v[1])}


def found_directions(data: bytes, name: str, articulated: bool, person: bool = False) -> dict[str, np.ndarray]:
    """Unit directions (T, 3) of the model's limbs before the clip's camera; at rest if not articulated."""
    player = Player.of(read_glb(data))
    glb = player.glb
    animation = glb.animation(name)
    local = glb.locals_at(animation, animation.time_s)
    if not articulated:
        root = glb.names.index(ROOT_MOTION)
        still = glb.locals_at(None, np.zeros(1)).repeat(len(local), axis=0)
        still[:, root] = local[:, root]
        local = still
    points = player.surface(glb.scene_from_node(local)) @ CV_FROM_GL[:3, :3]
    parts = regions_of_people(player.vertices) if person else regions(player.vertices)
    return {k: unit(points[:, b].mean(axis=1) - points[:, a].mean(axis=1)) for k, (a, b) in parts.items()}


def unit(vectors: np.ndarray) -> np.ndarray:
    """(T, 3) of length one."""
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-12)


def errors_deg(found: dict[str, np.ndarray], truth: dict[str, np.ndarray]) -> dict[str, float]:
    """Mean angle of each limb over the frames."""
    both = [k for k in truth if k in found]
    return {k: float(np.degrees(np.arccos(np.clip((found[k] * truth[k]).sum(-1), -1, 1))).mean()) for k in both}


def motion_errors_deg(
    found: dict[str, np.ndarray], truth: dict[str, np.ndarray], roots: np.ndarray, true_roots: np.ndarray
) -> dict[str, tuple[float, float]]:
    """A limb's error of motion about its mean, and the size of the true motion; roots (T, 3, 3), camera from object."""
    errors = {}
    for limb in (k for k in truth if k in found):
        mine, own = (np.einsum("tji,tj->ti", r, d[limb]) for r, d in ((roots, found), (true_roots, truth)))
        here, there = unit(mine.mean(axis=0)), unit(own.mean(axis=0))
        turn, _ = Rotation.align_vectors(there[None], here[None])
        angles = [np.degrees(np.arccos(np.clip((a * own).sum(-1), -1, 1))) for a in (turn.apply(mine), there[None])]
        errors[limb] = (float(angles[0].mean()), float(angles[1].mean()))
    return errors


def main(
    workspace: Path,
    out: Path,
    kind: str = "dog",
    seed: int = 21,
    frames: int = 60,
    size: int = 256,
    given: bool = False,
) -> None:
    """Film, retarget, score.

    Args:
        workspace: a finished reconstruction of a quadruped (or a person) that stands at rest.
        out: folder for the clip and the result; made anew.
        given: lay true masks and root poses beside the clip.
    """
    shutil.rmtree(out, ignore_errors=True)
    (out / "clip").mkdir(parents=True)
    made = film(make_subject(seed, kind), 0, 1, frames, size, seed)
    write_video(out / "clip" / f"{made.name}.mp4", made.images, made.fps)
    write_motion(out / "truth", made)
    if given:
        write_truth(out / "clip", made)
    command = [sys.executable, "-m", "pipeline.cli", "retarget", "--model", str(workspace)]
    command += ["--video", str(out / "clip" / f"{made.name}.mp4"), "--to", str(out / "result")]
    started = time.monotonic()
    subprocess.run(command, check=True)
    seconds = time.monotonic() - started
    data = (out / "result" / "exports" / "model.glb").read_bytes()
    truth = true_directions(np.load(out / "truth" / f"{made.name}.npz"), made.camera_from_object)
    person = kind == "person"
    followed = errors_deg(found_directions(data, made.name, True, person), truth)
    still = errors_deg(found_directions(data, made.name, False, person), truth)
    cameras = json.loads((out / "result" / "exports" / "cameras" / f"{made.name}.json").read_text(encoding="utf-8"))
    roots = np.array(cameras["object_to_camera"])[:, :3, :3]
    true_roots = made.camera_from_object[:, :3, :3]
    moved = motion_errors_deg(found_directions(data, made.name, True, person), truth, roots, true_roots)
    log.info("degrees, mean over %d frames", frames)
    log.info("%-16s %10s %10s %10s %10s", "limb", "followed", "still", "motion", "swing")
    for limb in followed:
        log.info("%-16s %10.1f %10.1f %10.1f %10.1f", limb, followed[limb], still[limb], *moved[limb])
    limbs = [k for k in followed if k != "trunk"]
    means = [np.mean([row[k] for k in limbs]) for row in (followed, still)]
    means += [np.mean([moved[k][i] for k in limbs]) for i in (0, 1)]
    log.info("%-16s %10.1f %10.1f %10.1f %10.1f", "all limbs", *means)
    log.info(
        "root poses %.1f deg", np.degrees(Rotation.from_matrix(roots @ true_roots.swapaxes(1, 2)).magnitude()).mean()
    )
    facts = json.loads((out / "result" / "exports" / "motion.json").read_text(encoding="utf-8"))
    log.info("silhouettes agree %.3f; %.0f s", facts["iou_mean"] or 0.0, seconds)


if __name__ == "__main__":
    logging.basicConfig(level=logging.INFO, format="%(message)s", stream=sys.stdout)
    tyro.cli(main)
