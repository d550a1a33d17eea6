"""What every provider of root poses is asked and what it answers. A new one (a network, say) is one more function."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from stages.registration.cues import Cues


@dataclass(frozen=True)
class ViewBelief:
    """Log-probabilities of azimuth (T, A), elevation (T, E) and roll (T, R), and the angles of their bins, radians.

    The angles are those of :func:`placing.view_rotation`, in the category's own frame: azimuth 0 sees the front. The
    azimuth's bins are equal and go once round.
    """

    azimuth: np.ndarray
    elevation: np.ndarray
    roll: np.ndarray
    azimuth_bins: np.ndarray
    elevation_bins: np.ndarray
    roll_bins: np.ndarray
    ground_elevation: np.ndarray | None = None  # (T,) radians, from which the ground around the object is seen


@dataclass(frozen=True)
class Subject:
    """One clip as a provider sees it. `rotation` is set where the user gave root poses: they anchor the others."""

    name: str
    cues: Cues
    intrinsics: np.ndarray  # (3, 3) pixels
    rotation: np.ndarray | None = None  # (T, 3, 3) object to crop camera, known exactly
    depth: np.ndarray | None = None  # (T,) of the object's origin, in the user's units, where the rotation is known
    view: ViewBelief | None = None
    """What a network that knows the category says of each frame; None for other categories."""
    frame: Callable[[int], tuple[np.ndarray, np.ndarray]] | None = None
    """Full picture (H, W, 3) and mask (H, W) uint8 of one kept frame, for providers that need more than crops."""


@dataclass(frozen=True)
class Answer:
    """Rotations of one clip, and how far to trust them.

    `rotation` (T, 3, 3) takes object space to the camera turned onto the object's origin
    (:func:`placing.ray_rotation` gives the real camera's); `extent` (T,) is the object's size in the picture, units:
    the longer side of the mask's box, from which depth follows.
    """

    provider: str
    rotation: np.ndarray
    extent: np.ndarray
    origin_px: np.ndarray  # (T, 2) where the object's origin appears in the full image
    confidence: np.ndarray  # (T,) in 0..1
    trust: float  # 0..1: how likely the clip as a whole is right within 45 degrees or so
    score: dict[str, Any] = field(default_factory=dict)  # figures for poses.json
    wave_rad: tuple[float, float, float] | None = None
    """How far rotations that are right as a whole are off about each axis of object space, usually; None if unknown."""


Tell = Callable[[int, int, str], None]
"""Progress: done, total, label. It may raise to stop the work."""

Provider = Callable[[list[Subject], int, Tell], dict[str, Answer]]
"""Subjects, seed, progress -> answers by clip name. A clip it can say nothing of is left out."""
