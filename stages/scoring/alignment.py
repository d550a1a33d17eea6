"""The similarity that lays a prediction on the truth: iterative closest points from both sides, many starts."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from stages.scoring.surfaces import Surface

Matcher = Callable[[Surface, np.ndarray], tuple[np.ndarray, np.ndarray]]


@dataclass(frozen=True)
class Similarity:
    """``x -> scale * rotation @ x + translation``."""

    scale: float
    rotation: np.ndarray
    translation: np.ndarray

    def __call__(self, points: np.ndarray) -> np.ndarray:
        """Points (N, 3) moved."""
        return np.asarray(self.scale * points @ self.rotation.T + self.translation)

    def undo(self, points: np.ndarray) -> np.ndarray:
        """Points (N, 3) moved back."""
        return np.asarray((points - self.translation) @ self.rotation / self.scale)


IDENTITY = Similarity(1.0, np.eye(3), np.zeros(3))


def cube_rotations() -> np.ndarray:
    """(24, 3, 3): the turns of a cube."""
    return np.asarray(Rotation.create_group("O").as_matrix())


def fit_similarity(source: np.ndarray, target: np.ndarray) -> Similarity:
    """The similarity with the least squared distances from source (N, 3) to target (N, 3) (Umeyama 1991)."""
    middle_s, middle_t = source.mean(axis=0), target.mean(axis=0)
    centred_s, centred_t = source - middle_s, target - middle_t
    u, stretch, vt = np.linalg.svd(centred_t.T @ centred_s / len(source))
    sign = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    rotation = (u * sign) @ vt
    scale = float((stretch * sign).sum() / max(float((centred_s**2).sum()) / len(source), 1e-30))
    return Similarity(scale, rotation, middle_t - scale * rotation @ middle_s)


def align(predicted: Sequence[Surface], truth: Sequence[Surface], starts: np.ndarray, frames: int = 10) -> Similarity:
    """One similarity for all frames: rough matching from every start, the best four refined, the best made exact.

    Matches are taken from the prediction to the truth and back, so that a part cannot hide in a larger one.

    Args:
        predicted, truth: a surface a frame. starts: (S, 3, 3) rotations. frames: at most so many take part.
    """
    chosen = np.unique(np.linspace(0, len(predicted) - 1, min(frames, len(predicted))).astype(int))
    pairs = [(predicted[i], truth[i]) for i in chosen]
    cloud_p = np.concatenate([p.shuffled[:2000] for p, _ in pairs])
    cloud_t = np.concatenate([t.shuffled[:2000] for _, t in pairs])
    middle_p, middle_t = cloud_p.mean(axis=0), cloud_t.mean(axis=0)
    scale = float(np.sqrt(cloud_t.var(axis=0).sum() / max(cloud_p.var(axis=0).sum(), 1e-12)))
    first = [pairs[i] for i in np.unique(np.linspace(0, len(pairs) - 1, min(5, len(pairs))).astype(int))]
    rough = []
    for rotation in starts:
        start = Similarity(scale, rotation, middle_t - scale * rotation @ middle_p)
        rough.append(_icp(first, start, _sample_matches, 250, 25, 1e-3))
    rough.sort(key=lambda found: found[1])
    refined = [_icp(pairs, found[0], _sample_matches, 500, 20, 1e-4) for found in rough[:4]]
    best = min(refined, key=lambda found: found[1])[0]
    return _icp(pairs, best, _surface_matches, 1000, 120, 1e-5)[0]


def _icp(
    pairs: Sequence[tuple[Surface, Surface]],
    start: Similarity,
    match: Matcher,
    points: int,
    most: int,
    tolerance: float,
) -> tuple[Similarity, float]:
    """Match and fit in turn until the mean distance stops falling; the similarity and that distance."""
    current, before = start, np.inf
    cost = np.inf
    for _ in range(most):
        source, target, distance = [], [], []
        for predicted, truth in pairs:
            forth, back = predicted.shuffled[:points], truth.shuffled[:points]
            spot, gap = match(truth, current(forth))
            source.append(forth)
            target.append(spot)
            distance.append(gap)
            spot, gap = match(predicted, current.undo(back))
            source.append(spot)
            target.append(back)
            distance.append(gap * current.scale)
        cost = float(np.mean(np.concatenate(distance)))
        current = fit_similarity(np.concatenate(source), np.concatenate(target))
        if abs(before - cost) < tolerance * max(cost, 1e-9):
            break
        before = cost
    return current, cost


def _sample_matches(surface: Surface, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    distance, index = surface.few.query(points)
    return surface.shuffled[:2000][index], distance


def _surface_matches(surface: Surface, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return surface.nearest(points, candidates=3)
