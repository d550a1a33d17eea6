"""Bringing the answers of several providers together: each speaks in an object frame of its own."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from stages.registration.answer import Answer

UNALIGNED = 0.5
"""Factor on the trust of an answer whose object frame could not be brought to the others'."""


def common_rotation(first: np.ndarray, second: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """The object-space rotation Q (3, 3) for which ``second Q`` is nearest to ``first``, both (T, 3, 3).

    Weighted chordal mean (orthogonal Procrustes).
    """
    u, _, vt = np.linalg.svd(np.einsum("t,tji,tjk->ik", weight, second, first))
    return u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt


def combine(answers: list[dict[str, Answer]], asked: list[str]) -> dict[str, Answer]:
    """One answer a clip, in one object frame.

    The provider with the highest total trust over the asked clips gives the frame and its answers. A clip it left out
    is filled in by the next, turned into that frame by the clips both answered (or with halved trust if there are
    none).
    """
    ranked = sorted(answers, key=lambda a: -sum(a[n].trust for n in asked if n in a))
    chosen: dict[str, Answer] = {}
    for candidate in ranked:
        missing = [n for n in asked if n in candidate and n not in chosen]
        both = [n for n in candidate if n in chosen]
        if not missing:
            continue
        turn, doubt, first = np.eye(3), 1.0, not chosen
        if both:
            weight = np.concatenate([np.sqrt(chosen[n].confidence * candidate[n].confidence) for n in both])
            turn = common_rotation(
                np.concatenate([chosen[n].rotation for n in both]),
                np.concatenate([candidate[n].rotation for n in both]),
                weight + 1e-6,
            )
        elif chosen:
            doubt = UNALIGNED
        for n in missing:
            a = candidate[n]
            wave = a.wave_rad if first else None  # about axes of its own frame
            told = replace(a, trust=a.trust * doubt, confidence=a.confidence * doubt, wave_rad=wave)
            chosen[n] = replace(told, rotation=a.rotation @ turn)
    return chosen
