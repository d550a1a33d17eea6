"""Root poses of any object without a network: many hypotheses, each a volume and its poses.

From random starts, expectation maximisation between a small coloured volume and the frames' views (as single-particle
microscopy reconstructs molecules from unknown projections), tied in time and led by the flow; the better half goes
on; clips are registered anew to the volume of the others; mirrored hypotheses are tried on purpose.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from stages.registration.answer import Answer, Subject, Tell, ViewBelief
from stages.registration.cues import CROP_MARGIN
from stages.registration.model import Hypothesis, Sequence, Weights
from stages.registration.placing import smooth, upright_frame, view_angles, view_rotation
from stages.registration.tracking import azimuth_steps, elevation_step, forward_backward, posterior_angles
from stages.registration.turning import expected_turns
from stages.registration.volume import EXTENT, ViewBank
from stages.registration.windows import Windows, whiten_together


@dataclass(frozen=True)
class Effort:
    """How hard to search."""

    starts: int = 14
    rounds: int = 14
    fine_rounds: int = 8
    frames: int = 150
    """Most frames looked at, all clips together."""
    coarse_px: int = 24
    fine_px: int = 32


COARSE_ELEVATION = np.radians([18.0])
FINE_ELEVATION = np.radians([8.0, 18.0, 28.0])
AZIMUTHS = 36
LAST_SHARPNESS = 30.0
RIVAL_MARGIN = 0.004
"""Difference of evidence (cost a frame) at which two hypotheses are told apart with some confidence."""
TELLING_MARGIN = 0.09
"""Rise of a clip's evidence, seen from elsewhere, at which its own poses are well supported; see Hypothesis.margin."""


def search(subjects: list[Subject], seed: int, tell: Tell, effort: Effort = Effort()) -> dict[str, Answer]:
    """Answers for every clip whose poses are not given."""
    world = given_upright(subjects)
    subjects = [s if s.rotation is None else replace(s, rotation=s.rotation @ world.T) for s in subjects]
    chosen = choose_frames([len(s.cues) for s in subjects], effort.frames)
    drifts = [expected_turns(s.cues) for s in subjects]
    bank = ViewBank(np.arange(AZIMUTHS) * 2 * np.pi / AZIMUTHS, COARSE_ELEVATION, effort.coarse_px)
    sequences = make_sequences(subjects, chosen, drifts, bank)
    kept_count = max(2, effort.starts // 3)
    total = effort.starts * 6 + kept_count * (effort.rounds - 6) + len(subjects) + 10 + effort.fine_rounds
    clock = _Clock(tell, total)
    starts = [Hypothesis(sequences, bank, effort.coarse_px, Weights(), seed * 1000 + i) for i in range(effort.starts)]
    for i, hypothesis in enumerate(starts):
        scatter(hypothesis, np.random.default_rng([seed, i]))
        anneal(hypothesis, 8.0, 12.0, 6, clock)
    kept = sorted(starts, key=lambda h: h.evidence)[:kept_count]
    for hypothesis in kept:
        anneal(hypothesis, 12.0, LAST_SHARPNESS, effort.rounds - 6, clock)
    kept.sort(key=lambda h: h.evidence)
    rivals = [*kept, reregister(kept[0], clock), mirrored(kept[0], clock)]
    rivals.sort(key=lambda h: h.evidence)
    best = finer(rivals[0], subjects, chosen, drifts, effort, clock)
    scale = given_scale(subjects, best, chosen)
    answers = {}
    for k, s in enumerate(subjects):
        if s.rotation is None:
            answer = _answer(s, k, best, rivals, chosen[k])
            answers[s.name] = replace(answer, rotation=answer.rotation @ world, extent=answer.extent * scale)
    return answers


def given_upright(subjects: list[Subject]) -> np.ndarray:
    """Rotation (3, 3) from the object space of the given poses to an upright one; nothing if it is nearly upright."""
    given = [s.rotation for s in subjects if s.rotation is not None]
    if not given:
        return np.eye(3)
    up = -np.concatenate(given)[:, 1].mean(axis=0)
    upright = up[1] > np.cos(np.radians(35.0)) * np.linalg.norm(up)
    return np.eye(3) if upright or np.linalg.norm(up) < 0.1 else upright_frame(up)


def given_scale(subjects: list[Subject], best: Hypothesis, chosen: list[np.ndarray]) -> float:
    """The user's units over the search's (object about 2 long), from the clips whose poses are given; else 1."""
    ratios = []
    for k, s in enumerate(subjects):
        if s.depth is not None:
            focal = np.sqrt(s.intrinsics[0, 0] * s.intrinsics[1, 1])
            units = s.depth[chosen[k]] * s.cues.half_px[chosen[k]] / focal  # the user's, in half a crop
            ratios.append(units / best.units[k].numpy())
    return float(np.median(np.concatenate(ratios))) if ratios else 1.0


class _Clock:
    def __init__(self, tell: Tell, total: int) -> None:
        self.tell, self.total, self.done = tell, total, 0

    def tick(self) -> None:
        self.done += 1
        self.tell(min(self.done, self.total), self.total, "searching root poses")


def choose_frames(lengths: list[int], most: int) -> list[np.ndarray]:
    """Frames to look at in each clip: evenly spread, every third at most, `most` in all, at least 8 a clip."""
    wanted = np.array([max(8, n // 3) for n in lengths], np.float64)
    wanted *= min(1.0, most / wanted.sum())
    return [
        np.unique(np.round(np.linspace(0, n - 1, min(n, max(8, int(w))))).astype(np.int64))
        for n, w in zip(lengths, wanted, strict=True)
    ]


def make_sequences(
    subjects: list[Subject], chosen: list[np.ndarray], drifts: list[np.ndarray], bank: ViewBank
) -> list[Sequence]:
    """The clips at their chosen frames, colours brought together, given poses turned into posteriors."""
    windows = [Windows(s.cues, idx, bank.size) for s, idx in zip(subjects, chosen, strict=True)]
    whiten_together(windows)
    sequences = []
    for subject, idx, drift, window in zip(subjects, chosen, drifts, windows, strict=True):
        total = np.concatenate([[0.0], np.cumsum(drift)])
        gap = np.diff(idx)
        fixed = None
        if subject.rotation is not None:
            azimuth, elevation, _ = view_angles(subject.rotation[idx])
            fixed = spread(bank, azimuth, elevation)
        bearing = None if subject.view is None else resample_bearing(subject.view, idx, bank.azimuth)
        sequences.append(Sequence(window, np.diff(total[idx]), 0.07 * np.sqrt(gap), fixed, bearing))
    return sequences


def resample_bearing(view: ViewBelief, frame_idx: np.ndarray, azimuth: np.ndarray) -> np.ndarray:
    """Log-probability of azimuths (K,) at some frames: (T, K), the peak of each row at 0."""
    order = np.argsort(view.azimuth_bins % (2 * np.pi))
    bins = view.azimuth_bins[order] % (2 * np.pi)
    rows = view.azimuth[frame_idx][:, order]
    read = np.stack([np.interp(azimuth % (2 * np.pi), bins, row, period=2 * np.pi) for row in rows])
    return read - read.max(axis=1, keepdims=True)


def spread(bank: ViewBank, azimuth: np.ndarray, elevation: np.ndarray | None, width: float = 0.12) -> np.ndarray:
    """Posterior (T, A, E) about known angles; all elevations alike when they are not known."""
    turn = np.angle(np.exp(1j * (azimuth[:, None] - bank.azimuth[None])))
    out = np.exp(-0.5 * (turn / width) ** 2)[:, :, None] * np.ones((1, 1, len(bank.elevation)))
    if elevation is not None:
        out = out * (np.exp(-0.5 * ((elevation[:, None] - bank.elevation[None]) / 0.15) ** 2)[:, None] + 1e-9)
    return out / out.sum(axis=(1, 2), keepdims=True)


def scatter(hypothesis: Hypothesis, random: np.random.Generator) -> None:
    """A random start: every clip at a random bearing, turning as its flow says or faster, slower, or backwards."""
    for k, s in enumerate(hypothesis.sequences):
        if s.bearing is not None and s.fixed is None:
            hypothesis.posterior[k] = told(hypothesis, s, s.bearing, random.uniform(0.1, 1.0))
            continue
        path = np.concatenate([[0.0], np.cumsum(s.drift)]) * random.uniform(0.5, 1.5)
        path = path + np.linspace(-0.5, 0.5, len(path)) * random.normal(0.0, 1.2)
        start = random.uniform(0, 2 * np.pi)
        hypothesis.posterior[k] = spread(hypothesis.bank, path + start, None, 0.25) if s.fixed is None else s.fixed


def told(hypothesis: Hypothesis, sequence: Sequence, bearing: np.ndarray, weight: float) -> np.ndarray:
    """Posterior (T, A, E) of a clip by its network's `bearing` (T, A) and its flow alone."""
    bank = hypothesis.bank
    likelihood = np.repeat(weight * bearing[:, :, None], len(bank.elevation), axis=2)
    start = np.full(bank.shape, 1 / len(bank))
    steps = azimuth_steps(bank.azimuth, sequence.drift, sequence.step_sigma)
    return forward_backward(likelihood, start, steps, elevation_step(bank.elevation, np.radians(5.0)))[0]


def anneal(hypothesis: Hypothesis, first: float, last: float, rounds: int, clock: _Clock) -> None:
    """Rounds of improve and look, the likelihood sharpening from `first` to `last`."""
    hypothesis.restart()
    for i in range(rounds):
        hypothesis.improve(12 if not np.isfinite(hypothesis.evidence) else 6)
        hypothesis.look(first * (last / first) ** (i / max(rounds - 1, 1)))
        clock.tick()


def reregister(hypothesis: Hypothesis, clock: _Clock) -> Hypothesis:
    """Each clip in turn looked up anew in a volume made without it; then all together."""
    trial = hypothesis.copy()
    clips = range(len(trial.sequences))
    for k in clips:
        if trial.sequences[k].fixed is None and len(clips) > 1:
            without = trial.copy()
            without.improve(8, [j for j in clips if j != k])
            without.look(15.0, [k])
            trial.posterior[k] = without.posterior[k]
        clock.tick()
    anneal(trial, 20.0, LAST_SHARPNESS, 4, clock)
    return trial


def mirrored(hypothesis: Hypothesis, clock: _Clock) -> Hypothesis:
    """The same clips turning the other way: outlines alone cannot tell the two apart, surfaces and flow can."""
    other = Hypothesis(
        hypothesis.sequences, hypothesis.bank, hypothesis.voxels, hypothesis.weights, hypothesis.random.initial_seed()
    )
    for k, s in enumerate(other.sequences):
        backwards = np.roll(hypothesis.posterior[k][:, ::-1], 1, axis=1)  # azimuth a becomes -a
        other.posterior[k] = backwards if s.fixed is None else s.fixed
    anneal(other, 15.0, LAST_SHARPNESS, 6, clock)
    return other


def finer(
    hypothesis: Hypothesis,
    subjects: list[Subject],
    chosen: list[np.ndarray],
    drifts: list[np.ndarray],
    effort: Effort,
    clock: _Clock,
) -> Hypothesis:
    """The same hypothesis with more pixels, voxels and elevations, a few rounds on."""
    bank = ViewBank(hypothesis.bank.azimuth, FINE_ELEVATION, effort.fine_px)
    sequences = make_sequences(subjects, chosen, drifts, bank)
    fine = Hypothesis(sequences, bank, effort.fine_px, hypothesis.weights, 0)
    fine.start_from(hypothesis)
    for k, s in enumerate(sequences):
        azimuth, elevation, _ = posterior_angles(hypothesis.posterior[k], bank.azimuth, hypothesis.bank.elevation)
        fine.posterior[k] = spread(bank, azimuth, elevation) if s.fixed is None else s.fixed
    anneal(fine, 20.0, LAST_SHARPNESS, effort.fine_rounds, clock)
    return fine


def _answer(subject: Subject, k: int, best: Hypothesis, rivals: list[Hypothesis], chosen: np.ndarray) -> Answer:
    azimuth, elevation, sharp = posterior_angles(best.posterior[k], best.bank.azimuth, best.bank.elevation)
    every = np.arange(len(subject.cues))
    azimuth = smooth(np.interp(every, chosen, np.unwrap(azimuth)), 2.0)
    elevation = smooth(np.interp(every, chosen, elevation), 3.0)
    extent, origin_px = extent_and_origin(subject, k, best, chosen)
    margin = best.margin(k, LAST_SHARPNESS)
    agreed = agreement(best, rivals, k)
    trust = 0.95 * agreed * (1 - np.exp(-max(margin, 0.0) / TELLING_MARGIN))
    confidence = trust * np.interp(every, chosen, sharp) * np.where(subject.cues.cut, 0.5, 1.0)
    figures = {"cost": round(best.cost[k], 4), "margin": round(margin, 4), "agreement": round(agreed, 4)}
    return Answer(
        "search",
        view_rotation(azimuth, elevation),
        extent,
        origin_px,
        confidence,
        float(trust),
        figures,
    )


def extent_and_origin(
    subject: Subject, k: int, volume: Hypothesis, chosen: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The object's size in the picture (T,), units, and its origin's place (T, 2), pixels, in every frame of clip `k`.

    The volume knows both at the frames `chosen`.
    """
    every, half = np.arange(len(subject.cues)), subject.cues.half_px
    known = volume.units[k].numpy()
    units = half * np.interp(every, chosen, known / half[chosen])
    share = volume.posterior[k].reshape(len(chosen), -1)
    shift = (share @ volume.offset.numpy()) * EXTENT / known[:, None]  # of the centroid, half crops
    offset = np.stack([np.interp(every, chosen, s) for s in (volume.sequences[k].windows.centre.numpy() - shift).T], 1)
    return 2 * units / CROP_MARGIN, subject.cues.centre_px + smooth(offset, 2.0) * half[:, None]


def agreement(best: Hypothesis, rivals: list[Hypothesis], k: int) -> float:
    """How far the rivals, weighted by their evidence, agree with the best about clip `k` relative to the others."""

    def bearings(h: Hypothesis, j: int) -> np.ndarray:
        return np.exp(1j * posterior_angles(h.posterior[j], h.bank.azimuth, h.bank.elevation)[0])

    clips = range(len(best.sequences))
    say = np.array([np.exp(-(h.evidence - rivals[0].evidence) / RIVAL_MARGIN) for h in rivals])
    agrees = []
    for h in rivals:
        own = bearings(best, k) / bearings(h, k)
        others = [bearings(best, j) / bearings(h, j) for j in clips if j != k] or [own]
        turn = np.concatenate(others).mean()
        agrees.append(float(np.mean(np.abs(np.angle(own / (turn / max(abs(turn), 1e-9)))) < np.pi / 4)))
    return float(np.dot(say, agrees) / say.sum())
