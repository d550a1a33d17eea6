"""What the background contradicts: feet that look like the ground are added, shadows and standing things are not."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from stages.perception.backdrop import contradiction, patch_correlation, registered
from stages.perception.missing_pieces import LEAST_FRAMES, with_missing_pieces
from stages.perception.segmentation import Carrier

COUNT, HEIGHT, WIDTH = 26, 144, 176
PAN = 1.0  # pixels a frame that the ground moves to the left
FOOT = (88, 100)  # rows


def _ground(rng: np.random.Generator, pattern: float) -> np.ndarray:
    noise = rng.normal(0, 1, (HEIGHT + 20, WIDTH + 2 * COUNT))
    fine, coarse = (cv2.GaussianBlur(noise, (0, 0), s) for s in (1.2, 3.0))
    return 95 + pattern * (14 * fine / fine.std() + 8 * coarse / coarse.std())


class _Scene:
    """A patterned body with a plain foot of the ground's own grey walks over ground that the camera pans along."""

    def __init__(self, pattern: float = 1.0, foot: bool = True, shadow: bool = False, walks: float = 2.0) -> None:
        rng = np.random.default_rng(3)
        ground = _ground(rng, pattern)
        body = np.clip(rng.normal(170, 30, (48, 40)), 0, 255)
        self.frames: list[np.ndarray] = []
        self.rough = np.full((COUNT, HEIGHT, WIDTH), 0.02, np.float32)
        self.feet = np.zeros((COUNT, HEIGHT, WIDTH), bool)
        for t in range(COUNT):
            picture = ground[10 : 10 + HEIGHT, round(PAN * t) : round(PAN * t) + WIDTH].copy()
            x = round(60 + (walks - PAN) * (t - COUNT / 2))
            self.feet[t, FOOT[0] : FOOT[1], x - 6 : x + 22] = True
            if shadow:
                picture[self.feet[t]] *= 0.6
            if foot:
                picture[self.feet[t]] = 95
            picture[40:88, x : x + 40] = body
            self.rough[t, 40:88, x : x + 40] = 0.98
            noisy = picture[..., None] + rng.normal(0, 1.5, (HEIGHT, WIDTH, 3))
            self.frames.append(np.clip(noisy, 0, 255).astype(np.uint8))
        self.carrier = Carrier(self.frames)

    def mended(self, told: np.ndarray | None = None) -> np.ndarray:
        told = np.zeros_like(self.rough) if told is None else told
        flows = self.carrier.to_next, self.carrier.to_previous
        return with_missing_pieces(self.frames, self.rough, told, *flows, seed=0)[0] > 0.5

    def shares(self, mended: np.ndarray) -> tuple[float, float]:
        """Of the feet that were added; of what was added wrongly, in feet."""
        new = mended & (self.rough < 0.5)
        return (new & self.feet).sum() / self.feet.sum(), (new & ~self.feet).sum() / self.feet.sum()


def test_a_foot_of_the_colour_of_the_ground_is_added() -> None:
    scene = _Scene()
    mended = scene.mended()
    right, wrong = scene.shares(mended)
    assert right > 0.7
    assert wrong < 0.15
    assert mended[scene.rough > 0.5].all()  # nothing is taken away


def test_the_ground_alone_adds_nothing() -> None:
    scene = _Scene(foot=False)
    right, wrong = scene.shares(scene.mended())
    assert right + wrong < 0.02


def test_a_shadow_is_none_of_the_object() -> None:
    scene = _Scene(foot=False, shadow=True)
    right, wrong = scene.shares(scene.mended())
    assert right + wrong < 0.05


def test_ground_without_a_pattern_tells_nothing() -> None:
    scene = _Scene(pattern=0.0)
    np.testing.assert_array_equal(scene.mended(), scene.rough > 0.5)


def test_what_never_leaves_its_place_is_not_known() -> None:
    """It stands on the ground all the time, so no frame shows what is under it."""
    scene = _Scene(walks=0.0)
    right, wrong = scene.shares(scene.mended())
    assert right + wrong < 0.1


def test_a_hint_forbids_a_piece() -> None:
    scene = _Scene()
    told = np.where(scene.feet, -6.0, 0.0).astype(np.float32)
    right, _ = scene.shares(scene.mended(told))
    assert right < 0.05


def test_short_clips_and_empty_masks_come_back_as_they_were() -> None:
    scene = _Scene()
    few = LEAST_FRAMES - 1
    zeros = np.zeros_like(scene.rough)
    flows = scene.carrier.to_next, scene.carrier.to_previous
    short = with_missing_pieces(
        scene.frames[:few], scene.rough[:few], zeros[:few], flows[0][: few - 1], flows[1][: few - 1], seed=0
    )
    np.testing.assert_array_equal(short[0], scene.rough[:few])
    empty, gained = with_missing_pieces(scene.frames, zeros, zeros, *flows, seed=0)
    np.testing.assert_array_equal(empty, zeros)
    assert not gained.any()


def test_masks_larger_than_the_working_size_keep_their_size() -> None:
    scene = _Scene()
    large = np.stack([cv2.resize(m, (2 * WIDTH, 2 * HEIGHT), interpolation=cv2.INTER_NEAREST) for m in scene.rough])
    flows = scene.carrier.to_next, scene.carrier.to_previous
    out, gained = with_missing_pieces(scene.frames, large, np.zeros_like(scene.rough), *flows, seed=0)
    assert out.shape == large.shape
    feet = np.stack([cv2.resize(f.astype(np.uint8), (2 * WIDTH, 2 * HEIGHT), interpolation=0) > 0 for f in scene.feet])
    assert (out[feet] > 0.5).mean() > 0.7
    assert (gained > 0).mean() > 0.9


def test_frames_are_registered_by_the_ground() -> None:
    scene = _Scene()
    masks = (scene.rough > 0.5).astype(np.uint8)
    columns, rows = np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))
    seen = 0
    for t, anchor, at in registered(scene.frames, masks, scene.carrier.to_next, scene.carrier.to_previous):
        inner = np.s_[20:-20, 30:-30]
        error = np.hypot(at[..., 0] - columns - PAN * (t - anchor), at[..., 1] - rows)[inner]
        assert np.median(error) < (0.8 if abs(t - anchor) < 15 else 2.0)
        seen += 1
    assert seen > COUNT


def test_what_enters_the_picture_is_outside_the_anchor() -> None:
    ground = _ground(np.random.default_rng(5), 1.0)
    frames = [
        np.repeat(ground[10 : 10 + HEIGHT, 3 * t : 3 * t + WIDTH, None], 3, 2).clip(0, 255).astype(np.uint8)
        for t in range(12)
    ]
    carrier = Carrier(frames)
    masks = np.zeros((12, HEIGHT, WIDTH), np.uint8)
    for t, anchor, at in registered(frames, masks, carrier.to_next, carrier.to_previous):
        beyond = 3 * (t - anchor)  # columns that the anchor does not show
        entered = at[..., 0][:, -beyond:] if beyond > 0 else at[..., 0][:, :-beyond]
        outside = (entered > WIDTH - 1) | (entered < 0)
        assert outside.mean() > 0.8


def test_evidence_is_for_the_foot_and_against_the_ground() -> None:
    scene = _Scene()
    found = contradiction(scene.frames, scene.rough > 0.5, scene.carrier.to_next, scene.carrier.to_previous)
    middle = slice(8, 18)
    assert np.median(found.evidence[middle][scene.feet[middle]]) > 1.0
    ground = np.zeros_like(scene.feet)
    ground[middle, 106:120, 30:-30] = True
    assert np.median(found.evidence[ground]) < -1.0
    assert (found.evidence[found.weight == 0] == 0).all()


@pytest.mark.parametrize(("factor", "sign"), [(1.0, 1.0), (0.6, 1.0), (-1.0, -1.0)])
def test_correlation_of_patches(factor: float, sign: float) -> None:
    """Of strong patterns it is one, whatever the light, and minus one of the negative."""
    rng = np.random.default_rng(0)
    first = (50 + 60 * rng.normal(0, 1, (40, 50))).astype(np.float32)
    correlation, pattern, share = patch_correlation(first, 20 + factor * first, np.ones_like(first))
    np.testing.assert_allclose(correlation, sign, atol=0.02)
    np.testing.assert_allclose(share, 1.0, atol=1e-5)
    assert (pattern > 100).all()


def test_patches_without_pattern_do_not_correlate_and_hidden_pixels_do_not_count() -> None:
    rng = np.random.default_rng(1)
    first, second = (rng.normal(50, 20, (2, 40, 50))).astype(np.float32)
    flat = np.full_like(first, 50)
    np.testing.assert_allclose(patch_correlation(flat, flat, np.ones_like(flat))[0], 0.0, atol=1e-3)
    weight = (rng.random((40, 50)) < 0.6).astype(np.float32)
    other = np.where(weight > 0, second, 999.0).astype(np.float32)
    np.testing.assert_array_equal(
        patch_correlation(first, second, weight)[0], patch_correlation(first, other, weight)[0]
    )
