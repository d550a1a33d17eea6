"""Where on the sphere of views each frame of a clip is: a hidden Markov model in time, solved forward and backward."""

from __future__ import annotations

import numpy as np


def azimuth_steps(azimuth: np.ndarray, drift: np.ndarray, sigma: np.ndarray | float) -> np.ndarray:
    """Transition matrices (T - 1, A, A) between azimuths on a circle: row = from, column = to, rows sum to 1.

    `drift` (T - 1,) is the expected turn and `sigma` (T - 1,) its standard deviation, radians; a thousandth goes
    anywhere, so that one bad stretch cannot hold a clip in the wrong place.
    """
    turn = azimuth[None, None, :] - azimuth[None, :, None] - np.asarray(drift)[:, None, None]
    turn = np.angle(np.exp(1j * turn))
    density = np.exp(-0.5 * (turn / np.broadcast_to(sigma, np.shape(drift))[:, None, None]) ** 2)
    density /= np.maximum(density.sum(-1, keepdims=True), 1e-300)
    return 0.999 * density + 0.001 / len(azimuth)


def elevation_step(elevation: np.ndarray, sigma: float) -> np.ndarray:
    """Transition matrix (E, E) between elevations, rows sum to 1."""
    density = np.exp(-0.5 * ((elevation[None] - elevation[:, None]) / sigma) ** 2)
    return density / density.sum(1, keepdims=True)


def forward_backward(
    log_likelihood: np.ndarray, start: np.ndarray, steps: np.ndarray, step_elevation: np.ndarray
) -> tuple[np.ndarray, float]:
    """Posterior (T, A, E) of each frame's view and the log evidence of the clip.

    Args:
        log_likelihood: (T, A, E).
        start: (A, E), prior of the first frame's view.
        steps: (T - 1, A, A) transition of the azimuth, see :func:`azimuth_steps`.
        step_elevation: (E, E).
    """
    count = len(log_likelihood)
    peak = log_likelihood.max(axis=(1, 2), keepdims=True)
    likelihood = np.exp(log_likelihood - peak)
    forward = np.empty_like(likelihood)
    evidence = float(peak.sum())
    state = start
    for t in range(count):
        if t:
            state = steps[t - 1].T @ forward[t - 1] @ step_elevation
        state = state * likelihood[t]
        total = state.sum()
        evidence += float(np.log(total))
        forward[t] = state / total
    posterior = forward.copy()
    ahead = np.ones_like(start)
    for t in range(count - 2, -1, -1):
        ahead = steps[t] @ (ahead * likelihood[t + 1]) @ step_elevation.T
        ahead /= ahead.sum()
        posterior[t] *= ahead
    return posterior / posterior.sum(axis=(1, 2), keepdims=True), evidence


def posterior_angles(
    posterior: np.ndarray, azimuth: np.ndarray, elevation: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Circular mean of the azimuth (T,), mean elevation (T,), and sharpness (T,) in 0..1 of a posterior (T, A, E)."""
    mean = (posterior.sum(2) * np.exp(1j * azimuth)).sum(1)
    return np.angle(mean), (posterior.sum(1) * elevation).sum(1), np.abs(mean)


AZIMUTHS = 90
RATES = np.radians(np.linspace(-6.0, 6.0, 25))
RATE_MEMORY = np.radians(0.2)
"""Change of the turn rate from frame to frame, radians: bodies and cameras have inertia."""
NO_JUMP = 1e-60
"""Keeps products of probabilities above zero; far too small to let a clip jump from one side to the other."""
RATE_REST = np.radians(18.0)
"""Turn rates above this, radians a frame, become unlikely."""


def turning_posterior(
    log_likelihood: np.ndarray, azimuth: np.ndarray, turn: np.ndarray, turn_sigma: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Posterior (T, 90) of the azimuth of an object that turns with inertia, and the angles of its bins (90,).

    The hidden state is azimuth and turn rate. Its rate changes slowly, so a stretch of frames that are mistaken for
    their back or mirror image cannot turn the path round.

    Args:
        log_likelihood: (T, A) at `azimuth` (A,), equal bins once round, radians.
        turn: (T - 1,) observed turn to the next frame, radians, with standard deviations `turn_sigma` (T - 1,).
    """
    bins = np.arange(AZIMUTHS) * 2 * np.pi / AZIMUTHS
    order = np.argsort(azimuth % (2 * np.pi))
    known = (azimuth % (2 * np.pi))[order]
    read = np.stack([np.interp(bins, known, row[order], period=2 * np.pi) for row in log_likelihood])
    likelihood = np.exp(read - read.max(axis=1, keepdims=True))[:, :, None]
    change = np.exp(-0.5 * ((RATES[None] - RATES[:, None]) / RATE_MEMORY) ** 2 - 0.5 * (RATES[None] / RATE_REST) ** 2)
    change /= change.sum(axis=1, keepdims=True)
    seen = np.exp(-0.5 * ((RATES[None] - turn[:, None]) / turn_sigma[:, None]) ** 2) + 1e-6
    wave = np.fft.rfftfreq(AZIMUTHS, 1 / AZIMUTHS)
    shift = np.exp(-1j * wave[:, None] * RATES[None])  # turning by a rate, bins or not, is a phase

    def move(state: np.ndarray, phase: np.ndarray) -> np.ndarray:
        return np.maximum(np.fft.irfft(np.fft.rfft(state, axis=0) * phase, AZIMUTHS, axis=0), 0.0)

    count = len(likelihood)
    forward = np.empty((count, AZIMUTHS, len(RATES)))
    state = np.exp(-0.5 * (RATES / RATE_REST) ** 2)[None].repeat(AZIMUTHS, 0)
    for t in range(count):
        if t:
            state = move(forward[t - 1] * seen[t - 1], shift) @ change
        state = state * likelihood[t]
        forward[t] = state / state.sum() + NO_JUMP
    posterior = forward.copy()
    ahead = np.ones_like(state)
    for t in range(count - 2, -1, -1):
        ahead = move((ahead * likelihood[t + 1]) @ change.T, shift.conj()) * seen[t]
        ahead = ahead / ahead.sum() + NO_JUMP
        posterior[t] *= ahead
    share = posterior.sum(axis=2)
    return share / share.sum(axis=1, keepdims=True), bins
