"""Views, prior masks and categories: what is done with a network's answers, with networks made up for the purpose."""

from __future__ import annotations

import numpy as np
import pytest

from stages.perception.category import OTHER, choose_category
from stages.perception.prior import (
    Candidate,
    best_chain,
    object_priors,
    overlap,
    paste,
    refined_boxes,
    searched_boxes,
    window_logits,
)
from stages.perception.viewpoint import (
    AZIMUTH_DEG,
    ELEVATION_DEG,
    IMAGENET_MEAN,
    IMAGENET_STD,
    INPUT_PX,
    ROLL_DEG,
    angle_log_probabilities,
    mask_box,
    view_rotations,
    viewpoint_log_probabilities,
)
from stages.registration.placing import view_angles

BINS = (len(AZIMUTH_DEG), len(ELEVATION_DEG), len(ROLL_DEG))


class RedFinder:
    """Calls every red pixel the object; sees its centre right of the picture's as azimuth to the right."""

    def __init__(self, category: int = 0) -> None:
        self.category = category

    def __call__(self, inputs: np.ndarray) -> dict[str, np.ndarray]:
        image = inputs[:, :3] * IMAGENET_STD[:, None, None] + IMAGENET_MEAN[:, None, None]
        red = (image[:, 0] > 0.6) & (image[:, 1] < 0.3)
        prompted = inputs[:, 3].any(axis=(1, 2))
        view = np.zeros((len(inputs), sum(BINS)), np.float32)
        for k, mask in enumerate(inputs[:, 3]):
            if mask.any():
                right = np.nonzero(mask)[1].mean() > INPUT_PX / 2
                view[k, int(np.argmin(np.abs(AZIMUTH_DEG - (65 if right else -65))))] = 9.0
                view[k, BINS[0] + 3] = 9.0
                view[k, BINS[0] + BINS[1] + (7 if right else 4)] = 9.0
        dense = np.zeros((len(inputs), 17, INPUT_PX // 2, INPUT_PX // 2), np.float32)
        dense[:, 0] = np.where(red[:, ::2, ::2], 6.0, -6.0)
        kind = np.zeros((len(inputs), 3), np.float32)
        kind[:, 2] = 5.0
        kind[prompted & red.any(axis=(1, 2)), self.category] = 12.0
        return {"view": view, "dense": dense, "category": kind}


def moving_square(count: int = 9, height: int = 90, width: int = 160) -> tuple[np.ndarray, np.ndarray]:
    """Green pictures with a red block that walks to the right, and its masks."""
    frames = np.zeros((count, height, width, 3), np.uint8)
    frames[..., 1] = 120
    masks = np.zeros((count, height, width), np.uint8)
    for i in range(count):
        x = 20 + 8 * i
        frames[i, 30:60, x : x + 40] = (230, 20, 20)
        masks[i, 30:60, x : x + 40] = 255
    return frames, masks


def test_bins_are_the_rotations_they_say() -> None:
    rotations = view_rotations()
    assert rotations.shape == (np.prod(BINS), 3, 3)
    np.testing.assert_allclose(
        rotations @ rotations.transpose(0, 2, 1), np.broadcast_to(np.eye(3), rotations.shape), atol=1e-9
    )
    a, e, r = 20, 4, 9
    one = rotations[(a * BINS[1] + e) * BINS[2] + r]
    bearing, elevation, roll = (float(np.rad2deg(v[0])) for v in view_angles(one[None]))
    assert (-bearing, elevation, roll) == pytest.approx((AZIMUTH_DEG[a], ELEVATION_DEG[e], ROLL_DEG[r]), abs=1e-6)
    facing = view_rotations()[(18 * BINS[1] + 2) * BINS[2] + 5]  # azimuth 5, elevation -5
    assert (facing @ [0, 0, 1])[2] < -0.9 and (facing @ [0, 1, 0])[1] < -0.9, "looks at the camera, stands upright"
    sideways = view_rotations()[(26 * BINS[1] + 2) * BINS[2] + 5]  # azimuth 85
    assert (sideways @ [0, 0, 1])[0] > 0.9, "looks to the picture's right"


def test_log_probabilities_follow_the_network_and_its_mirror_image() -> None:
    frames, masks = moving_square(3)
    masks[0, 30:60, 25:45] = 0  # lopsided: more of it on the right
    masks[1, 30:60, 45:66] = 0
    masks[2] = 0
    found = viewpoint_log_probabilities(frames, masks, RedFinder())
    np.testing.assert_allclose(np.exp(found).sum(1), 1, atol=1e-4)
    assert np.ptp(found[2]) < 1e-9, "no mask, no opinion"
    azimuth, elevation, roll = angle_log_probabilities(frames, masks, RedFinder())
    joint = azimuth[0][:, None, None] + elevation[0][None, :, None] + roll[0][None, None, :]
    np.testing.assert_allclose(joint.ravel(), found[0], atol=1e-4)
    assert ELEVATION_DEG[elevation[0].argmax()] == 5.0

    def answer(inputs: np.ndarray) -> dict[str, np.ndarray]:
        """Azimuth +65 and roll +11 whichever way the picture lies: its mirror image says the opposite."""
        view = np.zeros((len(inputs), sum(BINS)), np.float32)
        view[:, 24], view[:, BINS[0] + BINS[1] + 7] = 8.0, 8.0
        return {"view": view, "dense": np.zeros((len(inputs), 17, 48, 48)), "category": np.zeros((len(inputs), 3))}

    azimuth, _, roll = angle_log_probabilities(frames, masks, answer)
    assert azimuth[0][24] == pytest.approx(azimuth[0][11]) and roll[0][7] == pytest.approx(roll[0][4])


def test_box_leaves_specks_out() -> None:
    mask = np.zeros((200, 300), np.uint8)
    mask[50:150, 100:200] = 255
    mask[3, 3] = 255
    np.testing.assert_allclose(mask_box(mask), [100, 50, 200, 150], atol=1)
    assert not mask_box(np.zeros((20, 20), np.uint8)).any()


def red_and_blue(images: np.ndarray) -> np.ndarray:
    """Logits of two categories: red pixels, and (less surely) blue ones."""
    image = images * IMAGENET_STD[:, None, None] + IMAGENET_MEAN[:, None, None]
    red = (image[:, 0] > 0.6) & (image[:, 1] < 0.3)
    blue = (image[:, 2] > 0.6) & (image[:, 1] < 0.3)
    return np.stack([np.where(red, 6.0, -6.0), np.where(blue, 0.3, -1.0)], 1)[:, :, ::2, ::2]


@pytest.mark.parametrize(("height", "width"), [(90, 160), (160, 90), (128, 128), (270, 480)])
def test_windows_cover_the_picture_and_say_where_they_are(height: int, width: int) -> None:
    frame = np.zeros((height, width, 3), np.uint8)
    frame[height // 2 : height // 2 + 12, width // 3 : width // 3 + 16] = (255, 0, 0)
    seen, sizes = np.zeros((height, width), int), set()
    ends: dict[float, list[tuple[float, float]]] = {}
    for (x0, y0, x1, y1), logits in window_logits(frame, red_and_blue):
        assert logits.shape == (2, 48, 48)
        assert x1 - x0 == pytest.approx(y1 - y0, rel=0.02)
        sizes.add(round(x1 - x0, -1))
        seen[max(0, round(y0)) : round(y1), max(0, round(x0)) : round(x1)] += 1
        scale = (x1 - x0) / 48
        middle = np.array([width // 3 + 8, height // 2 + 6])
        column, row = ((middle - (x0, y0)) / scale).astype(int)
        if 0 <= row < 48 and 0 <= column < 48:
            assert logits[0, row, column] > 0, "the square is where the window says"
        ends.setdefault(round(x1 - x0, -1), []).append((x1, y1))
    assert seen.min() >= 2 and len(sizes) == (2 if height == width else 3)
    for size in sorted(sizes)[:-1]:
        np.testing.assert_allclose(np.max(ends[size], 0), [width, height])


def test_chain_prefers_what_stays() -> None:
    def at(x: float, score: float) -> Candidate:
        return Candidate(np.array([x, 0.0, x + 10, 10]), score)

    found = [[at(0, 0.6), at(50, 0.7)], [at(1, 0.6), at(90, 0.8)], [], [at(2, 0.6), at(20, 0.8)]]
    chain = best_chain(found)
    assert [None if c is None else c.box[0] for c in chain] == [0.0, 1.0, None, 2.0]
    assert best_chain([[], []]) == [None, None]
    assert overlap(np.array([0, 0, 2, 2.0]), np.array([1, 0, 3, 2.0])) == pytest.approx(1 / 3)


def test_prior_finds_what_the_network_sees() -> None:
    frames, masks = moving_square()
    prior = object_priors(frames, red_and_blue, {"red": 0})["red"]
    assert prior.dtype == np.uint8 and prior.shape == masks.shape
    both = ((prior > 127) & (masks > 0)).sum((1, 2)) / ((prior > 127) | (masks > 0)).sum((1, 2))
    assert both.min() > 0.85
    boxes = refined_boxes(frames, searched_boxes(frames, red_and_blue, (0,))[0], red_and_blue, 0)
    for t in range(len(frames)):  # in odd frames between those of its neighbours
        rows, columns = np.nonzero(masks[t])
        whole = [columns.min(), rows.min(), columns.max() + 1, rows.max() + 1]
        np.testing.assert_allclose(boxes[t], whole, atol=4)
    nothing = np.zeros_like(frames)
    assert not searched_boxes(nothing, red_and_blue, (0,))
    assert not object_priors(nothing, red_and_blue, {"red": 0})["red"].any()


def test_a_category_seen_much_worse_is_not_looked_at_again() -> None:
    frames, _ = moving_square()
    frames = frames.copy()
    frames[:, 70:, 8:40] = (0, 0, 255)
    asked = []

    def counting(images: np.ndarray) -> np.ndarray:
        asked.append(len(images))
        return red_and_blue(images)

    assert set(object_priors(frames, counting, {"blue": 1})) == {"blue"}, "alone it is all there is"
    alone = sum(asked)
    asked.clear()
    both = {"red": 0, "blue": 1}
    surest = object_priors(frames, lambda x: counting(x) * np.array([1, 0.9])[:, None, None], both)
    assert set(surest) == {"red"} and surest["red"].any()
    assert sum(asked) < 1.5 * alone


def test_narrow_pictures_are_not_cut_into_hundreds_of_windows() -> None:
    assert len(list(window_logits(np.zeros((20, 1920, 3), np.uint8), red_and_blue))) == 1
    assert 30 < len(list(window_logits(np.zeros((90, 480, 3), np.uint8), red_and_blue))) < 90


def test_what_comes_late_is_looked_at_as_well() -> None:
    frames, _ = moving_square()
    frames = np.concatenate([frames] * 3)
    frames[:, 70:, 8:40] = (0, 0, 255)
    frames[: 2 * len(frames) // 3, :69] = 0  # red is there in the last third alone
    found = object_priors(frames, lambda x: red_and_blue(x) * np.array([1, 8])[:, None, None], {"red": 0, "blue": 1})
    assert set(found) == {"red", "blue"} and found["red"][-1].any()


def test_paste_puts_a_crop_back() -> None:
    whole = paste(np.ones((48, 48), np.float32), np.array([10.0, 20.0, 58.0, 68.0]), 100, 90)
    assert whole[25:63, 15:53].min() == 1 and whole[:18].max() == 0 and whole[:, 62:].max() == 0
    assert whole.sum() == pytest.approx(48 * 48, rel=0.05)


def test_category_needs_a_word_and_a_mask() -> None:
    frames, masks = moving_square()
    networks = {"quadruped": RedFinder(0), "human": RedFinder(0)}
    verdict = choose_category(frames, masks, networks)
    assert verdict.category == "quadruped" and verdict.margin > 0.5
    assert verdict.explained["quadruped"] > 0.7 and verdict.named["quadruped"] > 0.9 > 0.1 > verdict.named["human"]
    elsewhere = np.roll(masks, 40, axis=1)  # the mask shows another thing than the networks find
    assert choose_category(frames, elsewhere, networks).category == OTHER
    assert choose_category(frames, masks, {"quadruped": RedFinder(2), "human": RedFinder(2)}).category == OTHER
    assert choose_category(frames, np.zeros_like(masks), networks).category == OTHER
