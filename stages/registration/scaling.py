"""Distance and origin of every frame where rotations are known: what the pictures' sizes say of a common shape.

A body seen from its end fills less of the picture than one seen from its side. So a coarse volume is fitted to all
frames at their rotations, and each frame's scale and place follow from comparing it with the volume seen from there.
"""

from __future__ import annotations

import numpy as np

from stages.registration.answer import Subject
from stages.registration.model import Hypothesis, Sequence, Weights
from stages.registration.placing import view_angles
from stages.registration.search import choose_frames, extent_and_origin, spread
from stages.registration.volume import ViewBank
from stages.registration.windows import Windows, whiten_together

AZIMUTHS = 24
ELEVATIONS = np.radians([-5.0, 10.0, 25.0, 40.0, 60.0])
VOXELS = 20
ROUNDS = 8
FRAMES = 200
"""Most frames looked at, all clips together."""


def scalings(subjects: list[Subject], rotations: list[np.ndarray], seed: int) -> list[tuple[np.ndarray, np.ndarray]]:
    """Of every clip the object's size in the picture (T,), units, and its origin's place (T, 2), pixels.

    `rotations` (T, 3, 3) each: object to the camera turned onto the object.
    """
    chosen = choose_frames([len(s.cues) for s in subjects], FRAMES)
    bank = ViewBank(np.arange(AZIMUTHS) * 2 * np.pi / AZIMUTHS, ELEVATIONS, VOXELS)
    windows = [Windows(s.cues, idx, bank.size) for s, idx in zip(subjects, chosen, strict=True)]
    whiten_together(windows)
    sequences = []
    for window, idx, rotation in zip(windows, chosen, rotations, strict=True):
        azimuth, elevation, _ = view_angles(rotation[idx])
        untracked = np.zeros(len(idx) - 1)  # what is fixed needs no path in time
        sequences.append(Sequence(window, untracked, untracked, fixed=spread(bank, azimuth, elevation)))
    volume = Hypothesis(sequences, bank, VOXELS, Weights(), seed)
    for _ in range(ROUNDS):
        volume.improve(10)
        volume.look(1.0)
    return [extent_and_origin(subject, k, volume, chosen[k]) for k, subject in enumerate(subjects)]
