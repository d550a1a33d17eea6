"""Root poses of rigid-looking clips by structure from motion (pycolmap) on the object's own pixels."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from stages.registration.answer import Answer, Subject, Tell
from stages.registration.placing import depth_from_size, ray_rotation, upright_frame

MOST_FRAMES = 96
"""Frames of all clips together: every pair is matched."""
LEAST_SHARE = 0.3
"""A clip with a smaller share of its frames registered gets no answer."""
_LONG_SIDE_PX = 640


def structure_from_motion(subjects: list[Subject], seed: int, tell: Tell) -> dict[str, Answer]:
    """Answers for the clips that the largest model registers well; all of them in that model's one frame.

    Features are found on the object alone, so that what moves is the camera round it. Frames in between are
    interpolated, with the less confidence the further the next registered frame is. "Up" is the cameras' mean up.
    """
    usable = [s for s in subjects if s.frame is not None]
    most = max(8, MOST_FRAMES // max(len(usable), 1))
    if not usable:
        return {}
    with tempfile.TemporaryDirectory(prefix="structure-") as scratch:
        model = _reconstruct(usable, most, Path(scratch), seed, tell)
    if model is None:
        return {}
    poses, centre, size, error_px = model
    up = -np.mean([r[1] for clip in poses.values() for r, _ in clip.values()], axis=0)
    world = upright_frame(up)
    answers = {}
    for subject in usable:
        found = poses.get(subject.name, {})
        chosen = len(_chosen(subject, most))
        if subject.rotation is None and len(found) >= max(2, LEAST_SHARE * chosen):
            answers[subject.name] = _answer(subject, found, chosen, centre, size, world, error_px)
    return answers


def _chosen(subject: Subject, most: int) -> np.ndarray:
    count = len(subject.cues)
    return np.unique(np.round(np.linspace(0, count - 1, min(count, most))).astype(int))


def _reconstruct(
    subjects: list[Subject], most: int, scratch: Path, seed: int, tell: Tell
) -> tuple[dict[str, dict[int, tuple[np.ndarray, np.ndarray]]], np.ndarray, float, float] | None:
    """Camera-from-world of the largest model by clip and frame, its points' centre and half length, pixel error."""
    import pycolmap  # heavy, and only this provider needs it

    pycolmap.logging.minloglevel = 3
    pycolmap.set_random_seed(seed)
    pictures, database = scratch / "pictures", scratch / "database.db"
    for done, (label, subject) in enumerate((f"clip{k:04d}", s) for k, s in enumerate(subjects)):
        tell(done, len(subjects) + 2, "finding features")
        names, camera = _write(subject, most, label, pictures)
        options: dict[str, Any] = {"camera_model": "PINHOLE", "camera_params": camera, "mask_path": scratch / "masks"}
        extraction = pycolmap.FeatureExtractionOptions(num_threads=1)
        extraction.sift.peak_threshold = 0.003  # fur and cloth are faint
        pycolmap.extract_features(
            database,
            pictures,
            image_names=names,
            camera_mode=pycolmap.CameraMode.SINGLE,
            reader_options=pycolmap.ImageReaderOptions(**options),
            extraction_options=extraction,
        )
    tell(len(subjects), len(subjects) + 2, "matching features")
    pycolmap.match_exhaustive(database, matching_options=pycolmap.FeatureMatchingOptions(num_threads=1))
    tell(len(subjects) + 1, len(subjects) + 2, "structure from motion")
    mapping = pycolmap.IncrementalPipelineOptions(
        num_threads=1, random_seed=seed, ba_refine_focal_length=False, ba_refine_extra_params=False, min_model_size=5
    )
    mapping.mapper.init_min_num_inliers = 30
    mapping.mapper.init_min_tri_angle = 6.0
    mapping.mapper.abs_pose_min_num_inliers = 15
    (scratch / "models").mkdir()
    models = pycolmap.incremental_mapping(database, pictures, scratch / "models", mapping)
    if not models:
        return None
    best = max(models.values(), key=lambda m: (m.num_reg_images(), m.num_points3D()))
    poses: dict[str, dict[int, tuple[np.ndarray, np.ndarray]]] = {}
    for image in best.images.values():
        if image.has_pose:
            label, stem = image.name.split("/")
            matrix = image.cam_from_world().matrix()
            poses.setdefault(subjects[int(label[4:])].name, {})[int(stem[:-4])] = (matrix[:, :3], matrix[:, 3])
    points = np.array([p.xyz for p in best.points3D.values()])
    centre = np.median(points, axis=0)
    size = float(np.quantile(np.linalg.norm(points - centre, axis=1), 0.9))
    return poses, centre, max(size, 1e-9), float(best.compute_mean_reprojection_error())


def _write(subject: Subject, most: int, label: str, pictures: Path) -> tuple[list[str], str]:
    """Frames and masks of one clip as PNG for the extractor; their names, and the camera's parameters as text."""
    assert subject.frame is not None
    masks = pictures.parent / "masks"
    (pictures / label).mkdir(parents=True)
    (masks / label).mkdir(parents=True)
    names, factor = [], 1.0
    for i in _chosen(subject, most):
        image, mask = subject.frame(int(i))
        factor = max(1.0, _LONG_SIDE_PX / max(image.shape[:2]))
        size = (round(image.shape[1] * factor), round(image.shape[0] * factor))
        name = f"{label}/{i:05d}.png"
        cv2.imwrite(str(pictures / name), cv2.resize(image, size, interpolation=cv2.INTER_CUBIC)[:, :, ::-1])
        inside = cv2.erode((mask >= 128).astype(np.uint8) * 255, np.ones((3, 3), np.uint8))  # the outline is not matter
        cv2.imwrite(str(masks / f"{name}.png"), cv2.resize(inside, size, interpolation=cv2.INTER_NEAREST))
        names.append(name)
    k = subject.intrinsics * factor
    return names, f"{k[0, 0]},{k[1, 1]},{k[0, 2]},{k[1, 2]}"


def _answer(
    subject: Subject,
    found: dict[int, tuple[np.ndarray, np.ndarray]],
    chosen: int,
    centre: np.ndarray,
    size: float,
    world: np.ndarray,
    error_px: float,
) -> Answer:
    frames = np.array(sorted(found))
    rotation = np.stack([found[i][0] @ world.T for i in frames])
    place = np.stack([found[i][0] @ centre + found[i][1] for i in frames])
    flat = place @ subject.intrinsics.T
    every = np.arange(len(subject.cues))
    clamped = np.clip(every, frames[0], frames[-1])
    full = Slerp(frames, Rotation.from_matrix(rotation))(clamped).as_matrix()
    relative = flat[:, :2] / np.maximum(flat[:, 2:], 1e-6) - subject.cues.centre_px[frames]
    origin = subject.cues.centre_px + np.stack([np.interp(every, frames, r) for r in relative.T], 1)
    # one unit is the half length of the object
    depth = np.interp(every, frames, place[:, 2] / size)
    extent = depth / depth_from_size(subject.cues.box_px, subject.intrinsics, 1.0)
    gap = np.abs(every[:, None] - frames[None]).min(axis=1)
    share = len(frames) / chosen
    trust = 0.9 * share * float(np.exp(-0.5 * max(error_px - 1.0, 0.0)))
    return Answer(
        "colmap",
        ray_rotation(origin, subject.intrinsics).transpose(0, 2, 1) @ full,
        extent,
        origin,
        trust * np.exp(-gap / 5.0),
        trust,
        {"registered": round(share, 3), "reprojection_error_px": round(error_px, 3)},
    )
