"""Root poses by a network that knows the category: its views of single frames, tied together in time.

A frame alone is often mistaken for its mirror image or its back; a clip seldom is. The network's probabilities, the
turn that the flow suggests and a smooth path are one hidden Markov model. How far from above the object is seen, the
network hardly knows; where the ground tells (`ground`), it is asked instead.
"""

from __future__ import annotations

import numpy as np

from stages.registration.answer import Answer, Subject, Tell, ViewBelief
from stages.registration.placing import smooth, view_rotation
from stages.registration.scaling import scalings
from stages.registration.tracking import elevation_step, forward_backward, turning_posterior
from stages.registration.turning import expected_turns

FRAME_WEIGHT = 0.12
"""What one frame counts: neighbours look alike, so a mistake lasts for a second rather than for a frame."""
DOUBT = 0.1
"""How likely a frame's opinion is to be worth nothing."""
TURN_SHARE = 0.9
TURN_SIGMA = 0.1
"""A turn from frame to frame is this share of what the flow suggests, give or take the latter, radians."""
LEAST_MATCHED = 0.1
"""Mean confidence of the flow on the object below which it says nothing of a turn."""
TILT_ERROR = np.radians(10.0)
USUAL_ELEVATION, USUAL_ELEVATION_SPREAD = np.radians(18.0), np.radians(10.0)
USUAL_ROLL_SPREAD = np.radians(5.0)
"""People hold a camera level and a little above what stands on the ground, mostly."""
TILT_SIGMA = np.radians(1.0)
"""Change of elevation and roll from frame to frame, radians."""
WAVE_AROUND, WAVE_ON_GROUND, WAVE_ASKEW = np.radians(5.0), np.radians(2.0), np.radians(8.0)
"""How far a path is off once it is smooth, radians: around the object; askew where the ground tells the elevation, and
where it does not."""
AGREEMENT = np.pi / 4
CHANCE = 0.25
"""What single frames say, on average, for views within AGREEMENT of a path that has nothing to do with them."""
TELLING = 0.2
"""Excess over chance at which a clip as a whole is well supported; its frames are many."""


def seen(subjects: list[Subject], seed: int, tell: Tell) -> dict[str, Answer]:
    """Answers for the clips that a network has looked at, in the category's own object frame (y up, z front)."""
    looked, paths = [], []
    for done, subject in enumerate(subjects):
        tell(done, len(subjects), "views by network")
        if subject.view is not None and subject.rotation is None:
            looked.append((subject, subject.view))
            paths.append(view_path(subject, subject.view))
    if not looked:
        return {}
    rotations = [view_rotation(azimuth, elevation, roll) for azimuth, elevation, roll, _ in paths]
    placed = scalings([subject for subject, _ in looked], rotations, seed)
    answers = {}
    for (subject, view), path, rotation, (extent, origin_px) in zip(looked, paths, rotations, placed, strict=True):
        trust, agreed = _trust(subject, view, path[0])
        confidence = trust * path[3] * np.where(subject.cues.cut, 0.5, 1.0)
        figures = {"agreed": round(agreed, 3)}
        askew = float(WAVE_ASKEW if view.ground_elevation is None else WAVE_ON_GROUND)
        wave = askew, float(WAVE_AROUND), askew
        answers[subject.name] = Answer("network", rotation, extent, origin_px, confidence, trust, figures, wave)
    return answers


def view_path(subject: Subject, view: ViewBelief) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Azimuth, elevation and roll (T,) of a clip in radians, and how sharply the azimuth is known (T,) in 0..1."""
    cues = subject.cues
    say = FRAME_WEIGHT * np.where(cues.known, np.where(cues.cut, 0.5, 1.0), 0.0)[:, None]
    azimuth = say * np.logaddexp(view.azimuth, np.log(DOUBT / view.azimuth.shape[1]))
    turn = TURN_SHARE * expected_turns(cues)[:-1]
    object_px = cues.mask > 0.5
    matched = (cues.flow_confidence * object_px).sum(axis=(1, 2)) / np.maximum(object_px.sum(axis=(1, 2)), 1)
    sigma = np.where(matched[:-1] > LEAST_MATCHED, TURN_SIGMA, np.pi)
    posterior, bins = turning_posterior(azimuth, view.azimuth_bins, turn, sigma)
    mean = posterior @ np.exp(1j * bins)
    raised = with_habit(view.elevation, view.elevation_bins, USUAL_ELEVATION, USUAL_ELEVATION_SPREAD)
    turned = with_habit(view.roll, view.roll_bins, 0.0, USUAL_ROLL_SPREAD)
    tilt = [_steady(say * p, b) for p, b in ((raised, view.elevation_bins), (turned, view.roll_bins))]
    if view.ground_elevation is not None:  # known to a degree or two; the network's error is ten
        tilt[0] = view.ground_elevation
    return smooth(np.unwrap(np.angle(mean)), 2.0), smooth(tilt[0], 2.0), smooth(tilt[1], 2.0), np.abs(mean)


def with_habit(tilt: np.ndarray, bins: np.ndarray, usual: float, spread: float) -> np.ndarray:
    """Log-probability (T, B) of tilts after the network's own uncertainty and how people film are added to it.

    The network's error is alike in a whole clip, so however sure of each frame it is, its opinion is widened by
    TILT_ERROR first. Four clips in five are filmed at the `usual` tilt, give or take `spread` (radians).
    """
    away = np.exp(-0.5 * ((bins[:, None] - bins[None]) / TILT_ERROR) ** 2)
    habit = np.exp(-0.5 * ((bins - usual) / spread) ** 2)
    habit = 0.8 * habit / habit.sum() + 0.2 / len(bins)
    wide = np.exp(tilt) @ (away / away.sum(axis=0)).T * habit
    return np.asarray(np.log(wide / wide.sum(axis=1, keepdims=True)))


def _steady(log_likelihood: np.ndarray, bins: np.ndarray) -> np.ndarray:
    """Posterior mean (T,) of an angle that changes slowly, from (T, B) log-likelihoods at `bins` (B,)."""
    start = np.full((1, len(bins)), 1 / len(bins))
    still = np.ones((len(log_likelihood) - 1, 1, 1))
    posterior, _ = forward_backward(log_likelihood[:, None], start, still, elevation_step(bins, TILT_SIGMA))
    return np.asarray(posterior[:, 0] @ bins)


def _trust(subject: Subject, view: ViewBelief, azimuth: np.ndarray) -> tuple[float, float]:
    """How far to trust a path of azimuths (T,), and what single frames, on average, say of it."""
    away = np.angle(np.exp(1j * (view.azimuth_bins[None] - azimuth[:, None])))
    near = (np.exp(view.azimuth) * (np.abs(away) < AGREEMENT)).sum(axis=1)  # what the frame alone says of the path
    agreed = float(near[subject.cues.known].mean()) if subject.cues.known.any() else 0.0
    return 1.0 - float(np.exp(-max(agreed - CHANCE, 0.0) / TELLING)), agreed
