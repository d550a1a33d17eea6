"""Principal components: many-channel tokens of a collection reduced to the few channels that tell its parts apart."""

from __future__ import annotations

import numpy as np


def principal_axes(samples: np.ndarray, channels: int) -> tuple[np.ndarray, np.ndarray]:
    """Mean (C,) and orthonormal axes (C, channels) of samples (N, C) float, in order of variance, largest first.

    Each axis points to where its largest entry is positive, so that the same samples give the same axes. Raises
    ValueError when there are fewer samples or input channels than `channels`.
    """
    if samples.ndim != 2 or min(samples.shape) < channels:
        raise ValueError(f"{channels} axes cannot be told from samples of shape {samples.shape}")
    mean = samples.mean(axis=0, dtype=np.float64)
    centred = samples - mean
    _, vectors = np.linalg.eigh(centred.T @ centred / len(samples))
    axes = vectors[:, ::-1][:, :channels]
    largest = np.abs(axes).argmax(axis=0)
    axes = axes * np.sign(axes[largest, np.arange(channels)])
    return mean.astype(np.float32), np.ascontiguousarray(axes, np.float32)
