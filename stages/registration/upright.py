"""The plainest provider: an upright object, filmed from slightly above, turned as the flow says. Never fails."""

from __future__ import annotations

import numpy as np

from stages.registration.answer import Answer, Subject, Tell
from stages.registration.placing import OBJECT_SIZE, view_rotation
from stages.registration.turning import expected_turns

ELEVATION = np.radians(15.0)
"""People film what stands on the ground from a little above."""


def upright(subjects: list[Subject], seed: int, tell: Tell) -> dict[str, Answer]:
    """Each clip begins as seen from the front and turns about the vertical axis as its flow says (no search)."""
    del seed
    answers = {}
    for done, subject in enumerate(subjects):
        tell(done, len(subjects), "upright poses")
        cues = subject.cues
        # a turn of the object by +w about the camera's y (down) moves the camera's azimuth by +w
        azimuth = np.concatenate([[0.0], np.cumsum(expected_turns(cues)[:-1])])
        rotation = view_rotation(azimuth, np.full(len(cues), ELEVATION))
        extent = np.full(len(cues), OBJECT_SIZE)
        answers[subject.name] = Answer("upright", rotation, extent, cues.centre_px, 0.1 * cues.known, 0.05)
    return answers
