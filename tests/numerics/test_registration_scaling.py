"""Distance where rotations are known: a long body does not come closer when it turns its flank."""

import numpy as np
import pytest

from stages.registration.answer import Subject
from stages.registration.placing import OBJECT_SIZE, depth_from_size, ray_rotation
from stages.registration.scaling import scalings
from tests.numerics.turning_scene import clip_of


def _subject(name: str, degrees: np.ndarray, distance: float, side: int = 96) -> tuple[Subject, np.ndarray, np.ndarray]:
    cues, poses = clip_of(np.radians(degrees), distance=distance, side=side)
    intrinsics = np.array([[1.3 * side, 0, side / 2], [0, 1.3 * side, side / 2], [0, 0, 1]])
    turned = ray_rotation(cues.centre_px, intrinsics).transpose(0, 2, 1)
    return Subject(name, cues, intrinsics), turned @ poses[:, :3, :3], poses


def test_distance_is_steady_and_common_to_clips_that_see_other_sides() -> None:
    views = [(np.linspace(-90, 30, 24), 3.2), (np.linspace(0, 170, 30), 3.2), (np.linspace(20, 100, 20), 4.8)]
    made = [_subject(f"c{i}", degrees, distance) for i, (degrees, distance) in enumerate(views)]
    found = scalings([m[0] for m in made], [m[1] for m in made], seed=0)
    ratios, naive = [], []
    for (subject, _, poses), (extent, _) in zip(made, found, strict=True):
        box = subject.cues.box_px
        ratios.append(depth_from_size(box, subject.intrinsics, extent) / poses[:, 2, 3])
        naive.append(depth_from_size(box, subject.intrinsics, OBJECT_SIZE) / poses[:, 2, 3])
        assert extent.shape == (len(poses),)
    spread = np.log(np.concatenate(ratios)).std()
    assert spread < 0.07 and spread < 0.5 * np.log(np.concatenate(naive)).std()
    assert ratios[2].mean() / ratios[0].mean() == pytest.approx(1, abs=0.1)


def test_the_origin_is_one_point_of_the_body() -> None:
    subject, rotation, poses = _subject("c", np.linspace(-120, 120, 40), 3.2)
    _, origin_px = scalings([subject], [rotation], seed=0)[0]
    # where the origin would lie in object space, given true poses: the same everywhere but for a little
    ray = np.concatenate([origin_px, np.ones((40, 1))], 1) @ np.linalg.inv(subject.intrinsics).T
    at = np.einsum("tji,tj->ti", poses[:, :3, :3], ray * poses[:, 2, 3:] - poses[:, :3, 3])
    box_ray = np.concatenate([subject.cues.centre_px, np.ones((40, 1))], 1) @ np.linalg.inv(subject.intrinsics).T
    box_at = np.einsum("tji,tj->ti", poses[:, :3, :3], box_ray * poses[:, 2, 3:] - poses[:, :3, 3])
    assert at.std(axis=0).max() < 0.07
    assert np.linalg.norm(at.std(axis=0)) < np.linalg.norm(box_at.std(axis=0))
