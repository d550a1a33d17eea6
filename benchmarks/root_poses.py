"""What each way to root poses gives alone: the network a frame at a time, with flow and time, PnP, search, COLMAP.

``python -m benchmarks.root_poses --workspace WORKSPACE --truth DATA/fox/casual/gt [--rungs frame seen pnp search]``

Takes frames, masks, flow and features from a finished workspace (which it only reads) and `NAME.json` with
`object_to_camera` from the truth. Rungs: frame, seen, pnp, search, colmap. Prints, a rung, the geodesic error in
degrees after one global rotation: mean, median, share of frames over 90, mean of each clip. Clips that a rung cannot
answer are left out and counted.
"""

from __future__ import annotations

import json
import logging
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import tyro

from pipeline import Folder, Run
from stages import poses as stage
from stages.formats import Clip, read_clip, read_features
from stages.own_networks import OwnNetwork, canonical_surface
from stages.registration.answer import Subject
from stages.registration.combine import common_rotation
from stages.registration.placing import default_intrinsics, ray_rotation, view_rotation

log = logging.getLogger(__name__)
RUNGS = {
    "frame": "network, each frame alone",
    "seen": "network, flow, time and ground (the stage)",
    "pnp": "PnP + RANSAC on the embedding",
    "search": "search by silhouettes and colours",
    "colmap": "COLMAP on the masked frames",
}
PNP_POINTS, PNP_ERROR_SHARE = 400, 0.05


def read_workspace(root: Path) -> tuple[list[Subject], dict[str, Clip], dict[str, Folder], str]:
    """Subjects with the network's views, clips, features folders, and the collection's category."""
    found = {v.name: {s: Folder((v / s).resolve()) for s in ("frames", "masks", "flow", "features")}
             for v in sorted((root / "latest" / "videos").iterdir())}  # fmt: skip
    features = {name: parts["features"] for name, parts in found.items()}
    run, settings = Run(), stage.PosesSettings()
    network, basis = stage._network(features, run), stage._embedding_basis(features)
    subjects, clips = [], {}
    for name, parts in found.items():
        clips[name] = read_clip(parts["frames"].path)
        subject = stage._subject(
            name, clips[name], parts["masks"], parts["flow"], parts["features"], basis, settings, None, run
        )
        if network is not None:
            subject = replace(subject, view=stage._view(clips[name], parts["masks"], network))
        subjects.append(subject)
    if network is not None:
        subjects = stage._on_ground(subjects, clips, settings, run)
    return subjects, clips, features, network.category if isinstance(network, OwnNetwork) else "other"


def each_frame_alone(subjects: list[Subject]) -> dict[str, np.ndarray]:
    """Rotations (T, 3, 3) at the likeliest azimuth, elevation and roll of each frame."""
    out = {}
    for s in subjects:
        if s.view is None:
            continue
        angles = ((s.view.azimuth, s.view.azimuth_bins), (s.view.elevation, s.view.elevation_bins),
                  (s.view.roll, s.view.roll_bins))  # fmt: skip
        likeliest = [bins[said.argmax(axis=1)] for said, bins in angles]
        out[s.name] = ray_rotation(s.cues.centre_px, s.intrinsics) @ view_rotation(*likeliest)
    return out


def by_pnp(clips: dict[str, Clip], features: dict[str, Folder], category: str, seed: int) -> dict[str, np.ndarray]:
    """Rotations (T, 3, 3) from each cell's nearest canonical vertex; a frame without an answer repeats the last."""
    surface, rng = canonical_surface(category), np.random.default_rng(seed)
    cv2.setRNGSeed(seed)
    out = {}
    for name, clip in clips.items():
        maps, crops = read_features(features[name].path)
        intrinsics = default_intrinsics(clip.width, clip.height, clip.focal_hint_px)
        rotations = [np.eye(3)]
        for cells, crop in zip(maps, crops, strict=True):
            cells = np.asarray(cells, np.float32)
            rows, columns = np.nonzero(np.abs(cells).sum(-1) > 0)
            if len(rows) >= 12:
                some = rng.choice(len(rows), min(PNP_POINTS, len(rows)), replace=False)
                rows, columns = rows[some], columns[some]
                nearest = (cells[rows, columns] @ surface["embedding"].T).argmax(axis=1)
                step = (crop[2] - crop[0]) / len(cells)
                pixels = crop[:2] + (np.stack([columns, rows], 1) + 0.5) * step
                points = surface["vertices"][nearest].astype(np.float64)
                ok, turn, _, _ = cv2.solvePnPRansac(
                    points, pixels, intrinsics, None, iterationsCount=100, flags=cv2.SOLVEPNP_EPNP,
                    reprojectionError=PNP_ERROR_SHARE * float(crop[2] - crop[0]),
                )  # fmt: skip
                if ok:
                    rotations.append(np.asarray(cv2.Rodrigues(turn)[0], np.float64))
                    continue
            rotations.append(rotations[-1])
        out[name] = np.stack(rotations[1:])
    return out


def by_provider(name: str, subjects: list[Subject], seed: int) -> dict[str, np.ndarray]:
    """Rotations (T, 3, 3) of the clips that a provider of the stage answers."""
    provider = stage.PROVIDERS["network" if name == "seen" else name]
    blind = subjects if name == "seen" else [replace(s, view=None) for s in subjects]
    found = provider(blind, seed, lambda *_: None)
    at = {s.name: s for s in subjects}
    return {n: ray_rotation(a.origin_px, at[n].intrinsics) @ a.rotation for n, a in found.items()}


def errors_deg(found: dict[str, np.ndarray], truth: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """(T,) geodesic errors of each clip after one rotation of the object's frame for all (chordal least squares)."""
    names = sorted(found)
    ours, real = (np.concatenate([side[n] for n in names]) for side in (found, truth))
    turn = common_rotation(real, ours, np.ones(len(ours)))
    return {
        n: np.degrees(np.arccos(np.clip((np.einsum("tij,tij->t", found[n] @ turn, truth[n]) - 1) / 2, -1, 1)))
        for n in names
    }


def main(workspace: Path, truth: Path, rungs: tuple[str, ...] = ("frame", "seen", "pnp"), seed: int = 0) -> None:
    """Print the table."""
    logging.basicConfig(level=logging.WARNING, format="%(message)s")
    log.setLevel(logging.INFO)
    cv2.setNumThreads(1)
    subjects, clips, features, category = read_workspace(workspace)
    known = {}
    for name, clip in clips.items():
        matrices = np.array(json.loads((truth / f"{name}.json").read_text(encoding="utf-8"))["object_to_camera"])
        known[name] = matrices[clip.source_idx, :3, :3]
    log.info("%s, %d clips, category %s", workspace.name, len(clips), category)
    log.info("%-36s %7s %7s %7s   %s", "degrees", "mean", "median", "over 90", "clips")
    for rung in rungs:
        if rung == "frame":
            found = each_frame_alone(subjects)
        elif rung == "pnp":
            found = by_pnp(clips, features, category, seed) if category != "other" else {}
        else:
            found = by_provider(rung, subjects, seed)
        if not found:
            log.info("%-36s no answer", RUNGS[rung])
            continue
        errors = errors_deg(found, known)
        every = np.concatenate(list(errors.values()))
        missing = f", {len(clips) - len(found)} without an answer" if len(found) < len(clips) else ""
        each = " ".join(f"{e.mean():.1f}" for e in errors.values())
        log.info(
            "%-36s %7.1f %7.1f %6.1f%%   %s%s",
            RUNGS[rung], every.mean(), np.median(every), 100 * (every > 90).mean(), each, missing,
        )  # fmt: skip


if __name__ == "__main__":
    tyro.cli(main)
