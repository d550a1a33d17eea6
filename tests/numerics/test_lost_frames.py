"""Frames that lost the object: found again by features that tell it, left alone where none do or none is lost."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from stages.own_networks import OwnTrunk
from stages.perception import lost_frames
from stages.perception.lost_frames import find_again, largest_piece, look_again, steadiness, trunk_features
from stages.perception.temporal import intersection_over_union

COUNT, HEIGHT, WIDTH = 24, 64, 96
LOST = range(9, 13)


class _Knowing:
    """Features that show the object (plus noise), whatever the picture looks like; with `blind` they show nothing."""

    def __init__(self, truth: np.ndarray, blind: bool = False) -> None:
        self.truth, self.blind, self.at = truth, blind, 0
        self.rng = np.random.default_rng(5)

    def __call__(self, inputs: np.ndarray) -> np.ndarray:
        out = self.rng.normal(0, 0.2, (len(inputs), 4, HEIGHT // 8, WIDTH // 8)).astype(np.float32)
        for k in range(len(inputs)):
            small = cv2.resize(self.truth[self.at % COUNT], (WIDTH // 8, HEIGHT // 8), interpolation=cv2.INTER_AREA)
            out[k, 1] += 0.0 if self.blind else 2 * small
            self.at += 1
        return out


def _clip() -> tuple[list[np.ndarray], np.ndarray, np.ndarray]:
    """Frames, true and rough masks: a block on grey, as grey itself in every other frame; four rough masks lost it."""
    rng = np.random.default_rng(0)
    truth = np.zeros((COUNT, HEIGHT, WIDTH), np.float32)
    frames = []
    for t in range(COUNT):
        truth[t, 16:48, 10 + 2 * t : 42 + 2 * t] = 1
        bright = 90 if t in LOST or t % 2 else 180
        frame = 90 + (bright - 90) * truth[t][..., None] + rng.normal(0, 6, (HEIGHT, WIDTH, 3))
        frames.append(np.clip(frame, 0, 255).astype(np.uint8))
    rough = 0.05 + 0.9 * truth
    for t in LOST:
        rough[t, :, 18 + 2 * t :] = 0.05
    return frames, truth, rough.astype(np.float32)


def _found(
    frames: list[np.ndarray], rough: np.ndarray, network: _Knowing, told: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    found = find_again(frames, rough, np.zeros_like(rough) if told is None else told, network, seed=0)
    return found.probability, found.lost


def _overlap(a: np.ndarray, b: np.ndarray) -> float:
    return intersection_over_union(a > 0.5, b > 0.5)


def test_what_features_tell_is_found_again_and_the_rest_stays() -> None:
    frames, truth, rough = _clip()
    mended, lost = _found(frames, rough, _Knowing(truth))
    assert np.flatnonzero(lost).tolist() == list(LOST)
    assert max(_overlap(rough[t], truth[t]) for t in LOST) < 0.4
    assert min(_overlap(mended[t], truth[t]) for t in LOST) > 0.8
    np.testing.assert_array_equal(mended[~lost], rough[~lost])


def test_features_that_tell_nothing_find_nothing() -> None:
    frames, truth, rough = _clip()
    mended, _ = _found(frames, rough, _Knowing(truth, blind=True))
    assert max(_overlap(mended[t], truth[t]) for t in LOST) < 0.5
    grey = [np.full((HEIGHT, WIDTH, 3), 90, np.uint8)] * COUNT  # nor do colours here: the classifier learns nothing
    untouched, lost = _found(grey, rough, _Knowing(truth, blind=True))
    assert not lost.any()
    np.testing.assert_array_equal(untouched, rough)


def test_a_clip_that_lost_nothing_comes_back_as_it_was() -> None:
    frames, truth, _ = _clip()
    rough = (0.05 + 0.9 * truth).astype(np.float32)
    mended, lost = _found(frames, rough, _Knowing(truth))
    assert not lost.any()
    np.testing.assert_array_equal(mended, rough)


def test_a_hint_counts_where_features_say_otherwise() -> None:
    frames, truth, rough = _clip()
    told = np.zeros_like(rough)
    told[LOST, :, :30] = -20.0
    mended, _ = _found(frames, rough, _Knowing(truth), told)
    beyond = mended - rough
    assert not (beyond[LOST, :, :26] > 0.01).any() and (beyond[LOST, :, 34:] > 0.5).any()


def test_a_clip_without_any_mask_stays_without() -> None:
    frames, truth, _ = _clip()
    nothing = np.zeros_like(truth)
    mended, lost = _found(frames, nothing, _Knowing(truth))
    assert not lost.any() and not mended.any()


def test_what_is_left_of_an_object_that_has_gone_is_not_the_object() -> None:
    frames, truth, rough = _clip()
    for t in LOST:  # gone, but for something small that looks like it
        truth[t] = 0
        truth[t, 20:36, 40:56] = 1
        rough[t] = 0.05
    first = find_again(frames, rough, np.zeros_like(rough), _Knowing(truth), seed=0)
    assert not first.lost.any() and first.said is not None
    np.testing.assert_array_equal(first.probability, rough)
    assert not first.said[list(LOST)].any() and first.said[0].any()
    refined = _twice_as_large(truth)
    for t in LOST:
        refined[t] = 0
    refined[2, :, : 2 * (26 + 2 * 2)] = 0  # something else is in doubt
    out, changed = look_again(refined, np.zeros_like(rough), 0, first)
    assert np.flatnonzero(changed).tolist() == [2]
    assert not out[list(LOST)].any()


def _twice_as_large(masks: np.ndarray) -> np.ndarray:
    return np.stack([cv2.resize(m, (2 * WIDTH, 2 * HEIGHT), interpolation=cv2.INTER_NEAREST) for m in masks])


def test_a_part_that_refining_dropped_comes_back() -> None:
    """At twice the size, as refined masks may be; what was right before stays right."""
    frames, truth, _ = _clip()
    rough = (0.05 + 0.9 * truth).astype(np.float32)
    zeros = np.zeros_like(rough)
    first = find_again(frames, rough, zeros, _Knowing(truth), seed=0)
    assert not first.lost.any() and first.said is not None
    large = _twice_as_large(truth)
    refined = large.copy()
    dropped = range(6, 14)
    for t in dropped:
        refined[t, :, : 2 * (26 + 2 * t)] = 0
    out, changed = look_again(refined, zeros, 0, first)
    assert np.flatnonzero(changed).tolist() == list(dropped)
    assert max(_overlap(refined[t], large[t]) for t in dropped) < 0.6
    assert min(_overlap(a, b) for a, b in zip(out, large, strict=True)) > 0.8


def test_what_the_classifier_contradicts_does_not_teach_it_again() -> None:
    """A fifth of what is called object is background in every frame, and looks like it."""
    frames, truth, _ = _clip()
    first = find_again(frames, (0.05 + 0.9 * truth).astype(np.float32), np.zeros_like(truth), _Knowing(truth), seed=0)
    block = np.stack([cv2.resize(m, (WIDTH // 2, HEIGHT // 2), interpolation=cv2.INTER_AREA) for m in truth]) > 0.5
    wrong = np.zeros_like(block)
    wrong[:, 26:31, 2:14] = True
    said = []
    for again in (False, True):
        classifier = lost_frames._fitted(first.seen, (block | wrong).astype(np.float32), 3, again=again)
        assert classifier is not None
        logit = np.stack([classifier.logit(first.seen.of(t)) for t in range(COUNT)])
        assert logit[block].mean() > 2
        said.append(float(logit[wrong].mean()))
    assert said[1] < said[0] - 0.5


def test_a_hint_counts_in_the_second_look() -> None:
    frames, truth, _ = _clip()
    told = np.zeros_like(truth)
    first = find_again(frames, (0.05 + 0.9 * truth).astype(np.float32), told, _Knowing(truth), seed=0)
    large, half = _twice_as_large(truth), 2 * (26 + 2 * 11)
    refined = large.copy()
    refined[11, :, :half] = 0
    assert (look_again(refined, told, 0, first)[0][11, :, : half - 8] > 0.5).any()
    told[11, :, : half // 2] = -20.0
    out, _ = look_again(refined, told, 0, first)
    assert not (out[11, :, : half - 8] > 0.5).any() and _overlap(out[11], refined[11]) > 0.8
    assert _overlap(out[12], large[12]) > 0.8


def test_masks_that_lost_nothing_are_not_looked_at_again() -> None:
    frames, truth, rough = _clip()
    zeros = np.zeros_like(rough)
    first = find_again(frames, rough, zeros, _Knowing(truth), seed=0)
    same, changed = look_again(truth, zeros, 0, first)
    assert same is truth and not changed.any()
    unknown = replace(first, said=None)  # the first look told nothing, so there is none to compare
    same, _ = look_again(rough, zeros, 0, unknown)
    assert same is rough


def test_the_largest_piece_in_which_masks_differ() -> None:
    mask = np.zeros((1, 40, 40), bool)
    mask[0, 10:30, 10:30] = True
    other = mask.copy()
    other[0, 10:30, 28:30] = False  # a rim, not a piece
    assert largest_piece(mask, other, np.zeros(1))[0] == 0
    other[0, 10:20, 10:20] = False
    assert 0.2 < largest_piece(mask, other, np.zeros(1))[0] <= 0.25
    assert largest_piece(np.zeros_like(mask), np.zeros_like(mask), np.zeros(1))[0] == 0
    assert largest_piece(np.zeros_like(mask), mask, np.array([0.5]))[0] == pytest.approx(0.5, rel=0.05)


def test_steadiness_sees_a_mask_that_shrank() -> None:
    _, _, rough = _clip()
    trust = steadiness(rough)
    assert trust[list(LOST)].max() == 0 and np.delete(trust, list(LOST)).min() == 1


def test_the_shipped_trunk_gives_features_of_any_size() -> None:
    rng = np.random.default_rng(0)
    frames = [rng.integers(0, 255, (50, 90, 3)).astype(np.uint8) for _ in range(3)]
    features = trunk_features(frames, OwnTrunk())
    assert features.shape == (3, 10, 16, 64) and features.dtype == np.float16
    assert np.isfinite(features).all() and features.std() > 0.01
    np.testing.assert_allclose(trunk_features(frames[1:2], OwnTrunk())[0], features[1], atol=1e-2)
