"""The plainest provider: an upright object, filmed from slightly above, turned as the flow says. Never fails."""

from __future__ import annotations

import numpy as np

from stages.registration.answer import Answer, Subject, Tell
from stages.registration.cues import inflate
from stages.registration.placing import OBJECT_SIZE, smooth, view_rotation
from stages.registration.turning import turn_rates

ELEVATION = np.radians(15.0)
"""People film what stands on the ground from a little above."""


def upright(subjects: list[Subject], seed: int, tell: Tell) -> dict[str, Answer]:
    """Each clip begins as seen from the front and turns about the vertical axis as its flow says (no search)."""
    del seed
    answers = {}
    for done, subject in enumerate(subjects):
        tell(done, len(subjects), "upright poses")
        cues = subject.cues
        relief = inflate(cues.mask) * 2 / cues.mask.shape[1]
        rates, trust = turn_rates(cues, relief)
        # a turn of the object by +w about the camera's y (down) moves the camera's azimuth by +w
        azimuth = np.concatenate([[0.0], np.cumsum(smooth(rates[:, 1], 2.0)[:-1])])
        rotation = view_rotation(azimuth, np.full(len(cues), ELEVATION))
        extent = np.full(len(cues), OBJECT_SIZE)
        answers[subject.name] = Answer("upright", rotation, extent, 0.1 * trust * cues.known, 0.05)
    return answers
