"""Distance and origin of every frame where rotations are known: what the pictures' sizes say of a common shape.

A body seen from its end fills less of the picture than one seen from its side. So a coarse volume is fitted to all
frames at their rotations, and each frame's scale and place follow from comparing it with the volume seen from there.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from stages.registration.answer import Subject
from stages.registration.cues import CROP_MARGIN
from stages.registration.model import Hypothesis, Sequence, Weights
from stages.registration.placing import smooth, view_angles
from stages.registration.search import choose_frames, spread
from stages.registration.turning import expected_turns
from stages.registration.volume import EXTENT, ViewBank
from stages.registration.windows import Windows, whiten_together

AZIMUTHS = 24
ELEVATIONS = np.radians([-5.0, 10.0, 25.0, 40.0, 60.0])
VOXELS = 20
ROUNDS = 8
FRAMES = 200
"""Most frames looked at, all clips together."""


@dataclass(frozen=True)
class Scaling:
    """Of one clip: `extent` (T,), the object's size in the picture in units, and `origin_px` (T, 2)."""

    extent: np.ndarray
    origin_px: np.ndarray


def scalings(subjects: list[Subject], rotations: list[np.ndarray], seed: int) -> list[Scaling]:
    """Scale and place of every clip from its rotations (T, 3, 3), object to the camera turned onto the object."""
    chosen = choose_frames([len(s.cues) for s in subjects], FRAMES)
    bank = ViewBank(np.arange(AZIMUTHS) * 2 * np.pi / AZIMUTHS, ELEVATIONS, VOXELS)
    windows = [Windows(s.cues, idx, bank.size) for s, idx in zip(subjects, chosen, strict=True)]
    whiten_together(windows)
    sequences = []
    for subject, idx, window, rotation in zip(subjects, chosen, windows, rotations, strict=True):
        azimuth, elevation, _ = view_angles(rotation[idx])
        drift = np.concatenate([[0.0], np.cumsum(expected_turns(subject.cues))])
        sequences.append(
            Sequence(window, np.diff(drift[idx]), np.full(len(idx) - 1, 0.1), spread(bank, azimuth, elevation))
        )
    volume = Hypothesis(sequences, bank, VOXELS, Weights(), seed)
    for _ in range(ROUNDS):
        volume.improve(10)
        volume.look(1.0)
    return [_scaling(subject, k, volume, chosen[k]) for k, subject in enumerate(subjects)]


def _scaling(subject: Subject, k: int, volume: Hypothesis, chosen: np.ndarray) -> Scaling:
    every = np.arange(len(subject.cues))
    half = subject.cues.half_px
    known = volume.units[k].numpy()
    units = half * np.interp(every, chosen, known / half[chosen])
    share = volume.posterior[k].reshape(len(chosen), -1)
    shift = (share @ volume.offset.numpy()) * EXTENT / known[:, None]  # of the centroid, half crops
    offset = np.stack([np.interp(every, chosen, s) for s in (volume.sequences[k].windows.centre.numpy() - shift).T], 1)
    return Scaling(2 * units / CROP_MARGIN, subject.cues.centre_px + smooth(offset, 2.0) * half[:, None])
