"""Skin weights for a rig: a few influences a vertex that reproduce the model's own motion as well as they can."""

from __future__ import annotations

import numpy as np
from scipy import sparse

_CHUNK = 512
_STAY = 1e-7  # pull towards the model's own weights, in squared units of the object's length


def top_influences(weights: np.ndarray, influences: int) -> tuple[np.ndarray, np.ndarray]:
    """The largest weights of each vertex, descending and made to sum to one in float32.

    Args:
        weights: (V, B), rows sum to one.
        influences: how many to keep.

    Returns:
        Column indices (V, K) int64 and weights (V, K) float32 with K = min(influences, B); index 0 where weight is 0.
    """
    kept = min(influences, weights.shape[1])
    index = np.argsort(-weights, axis=1, kind="stable")[:, :kept]
    return _tidy(index, np.take_along_axis(weights, index, axis=1).astype(np.float64))


def fit_influences(
    vertices: np.ndarray,
    weights: np.ndarray,
    transforms: np.ndarray,
    posed: np.ndarray,
    influences: int,
    length: float,
    frame_weight: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """The largest weights of each vertex, adjusted so that fewer influences still follow the full motion.

    For each vertex, ``min_w mean_t |sum_k w_k J_k(t) x - x(t)|^2 + s |w - w_0|^2`` over weights that are not
    negative and sum to one, with w_0 the model's own weights: where the motion does not tell the bones
    apart, the weights stay as they are. Which bones to keep is found from twice as many, by leaving out again and
    again the one whose part in the motion is smallest.

    Args:
        vertices: (V, 3) at rest.
        weights: (V, B) the model's.
        transforms: (T, B, 4, 4) canonical to posed, over all clips.
        posed: (T, V, 3) where the model puts the vertices.
        influences: how many to keep.
        length: of the object.
        frame_weight: (T, V) how much each frame counts for each vertex, mean 1; None for all alike.

    Returns:
        As :func:`top_influences`.
    """
    bones = weights.shape[1]
    kept, wide = min(influences, bones), min(2 * influences, bones)
    index = np.argsort(-weights, axis=1, kind="stable")[:, :wide]
    value = np.take_along_axis(weights, index, axis=1).astype(np.float64)
    value /= value.sum(axis=1, keepdims=True)
    rotation, offset = transforms[..., :3, :3].astype(np.float32), transforms[..., :3, 3].astype(np.float32)
    for start in range(0, len(vertices), _CHUNK):
        part = slice(start, start + _CHUNK)
        points = vertices[part].astype(np.float32)
        moved = (rotation @ points.T + offset[..., None]).transpose(3, 1, 0, 2)  # (v, B, T, 3)
        chosen = np.take_along_axis(moved, index[part][:, :, None, None], axis=1)
        gap = chosen - posed[:, part].transpose(1, 0, 2)[:, None]
        if frame_weight is not None:
            gap *= np.sqrt(frame_weight[:, part]).T[:, None, :, None]
        gap = gap.reshape(len(points), wide, -1)
        gram = (gap @ gap.swapaxes(1, 2)).astype(np.float64) / (len(transforms) * length**2)
        value[part] = _sparse_least_squares(gram, value[part], kept)
    order = np.argsort(-value, axis=1, kind="stable")[:, :kept]
    return _tidy(np.take_along_axis(index, order, axis=1), np.take_along_axis(value, order, axis=1))


def refit_worst(
    vertices: np.ndarray,
    weights: np.ndarray,
    transforms: np.ndarray,
    posed: np.ndarray,
    skin: tuple[np.ndarray, np.ndarray],
    length: float,
    tolerance: float,
    rounds: int = 6,
) -> tuple[np.ndarray, np.ndarray]:
    """A skin whose largest error is smaller: vertices that miss `tolerance` somewhere are fitted to their worst frames.

    Least squares spread the error evenly over time; what people see is the one frame that breaks. So frames are
    reweighted by their error, again and again, and what lowers a vertex's largest error is kept.

    Args:
        vertices, weights, transforms, posed, length: as for :func:`fit_influences`.
        skin: bone indices and weights (V, K), as :func:`fit_influences` gives them.
        tolerance: in units of the length.
    """
    index, weight = (part.copy() for part in skin)
    error = _errors(vertices, transforms, posed, index, weight) / length
    bad = np.flatnonzero(error.max(axis=0) > tolerance)
    if not len(bad):
        return index, weight
    part, target, error = vertices[bad], posed[:, bad], error[:, bad]
    best, emphasis = error.max(axis=0), np.ones_like(error)
    for _ in range(rounds):
        emphasis *= 0.05 + error / np.maximum(error.max(axis=0), 1e-12)
        emphasis /= emphasis.mean(axis=0)
        tried = fit_influences(part, weights[bad], transforms, target, index.shape[1], length, emphasis)
        error = _errors(part, transforms, target, *tried) / length
        better = error.max(axis=0) < best
        best = np.minimum(best, error.max(axis=0))
        index[bad[better]], weight[bad[better]] = tried[0][better], tried[1][better]
    return index, weight


def _errors(
    vertices: np.ndarray, transforms: np.ndarray, posed: np.ndarray, index: np.ndarray, weight: np.ndarray
) -> np.ndarray:
    """(T, V) distances between linear blend skinning and where the vertices should be."""
    moved = blend(vertices, transforms, index, weight)
    moved -= posed
    return np.asarray(np.sqrt(np.einsum("tvc,tvc->tv", moved, moved)))


def _sparse_least_squares(gram: np.ndarray, start: np.ndarray, kept: int) -> np.ndarray:
    """Minimise ``w G w + s |w - w_0|^2`` over w >= 0 that sum to one and have at most `kept` positive entries.

    G (V, K, K), w_0 (V, K). Backward elimination: good, not proven best.
    """
    count = start.shape[1]
    active = start > 0
    weight = start
    own = np.sqrt(np.maximum(np.einsum("vkk->vk", gram), 0)) + np.sqrt(_STAY)
    for _ in range(2 * count):
        both = active[:, :, None] & active[:, None, :]
        matrix = np.where(both, gram, 0) + _STAY * np.eye(count)
        right = np.stack([np.where(active, _STAY * start, 0), active.astype(np.float64)], axis=-1)
        solved = np.linalg.solve(matrix, right)  # w = a + mu b with mu from the sum
        mu = (1 - solved[..., 0].sum(axis=1)) / solved[..., 1].sum(axis=1)
        weight = np.where(active, solved[..., 0] + mu[:, None] * solved[..., 1], 0)
        negative = weight < 0
        too_many = ~negative.any(axis=1) & (active.sum(axis=1) > kept)
        if not negative.any() and not too_many.any():
            break
        least = np.where(active, weight * own, np.inf).argmin(axis=1)
        negative[too_many, least[too_many]] = True
        active &= ~negative
    weight = np.maximum(weight, 0)
    return np.asarray(weight / weight.sum(axis=1, keepdims=True))


def _tidy(index: np.ndarray, value: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    value = np.where(value < 1e-4 * value[:, :1], 0.0, value)
    result = (value / value.sum(axis=1, keepdims=True)).astype(np.float32)
    result[:, 0] += (1.0 - result.astype(np.float64).sum(axis=1)).astype(np.float32)
    return np.where(result > 0, index, 0), result


def blend(vertices: np.ndarray, transforms: np.ndarray, index: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Linear blend skinning (T, V, 3): ``sum_k weight_k J_index_k x``.

    Args:
        vertices: (V, 3); transforms: (T, B, 4, 4) canonical to posed; index, weight: (V, K).
    """
    rows = np.repeat(np.arange(len(vertices)), index.shape[1])
    matrix = sparse.csr_matrix((weight.ravel(), (rows, index.ravel())), shape=(len(vertices), transforms.shape[1]))
    homogeneous = np.concatenate([vertices, np.ones((len(vertices), 1))], axis=1)
    result = np.empty((len(transforms), len(vertices), 3))
    for t, transform in enumerate(transforms):
        blended = (matrix @ transform[:, :3].reshape(len(transform), 12)).reshape(-1, 3, 4)
        result[t] = np.einsum("vij,vj->vi", blended, homogeneous)
    return result
