"""flow: DIS with forward-backward confidence, chains, the stage's folder."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from pipeline import BadInput, Given, Run
from stages.flow import FlowSettings, _check, _sheet, flow
from stages.formats import flow_path, read_flow, read_json
from stages.perception.optical_flow import (
    Chain,
    Matcher,
    compose,
    confidence,
    pixel_grid,
    sample,
)
from stages.perception.temporal import enlarge
from tests.stages.perception_clips import moving_clip, texture, write_frames_folder

IMAGES, TRUTH, SPEED = moving_clip(10, 128)


def test_stage_writes_both_ways_and_is_right(tmp_path: Path) -> None:
    frames = write_frames_folder(tmp_path / "frames", IMAGES)
    out = tmp_path / "out"
    out.mkdir()
    flow(frames=frames, given=Given(), settings=FlowSettings(), out=out, run=Run())
    _check(out=out, frames=frames)
    info = read_json(out / "flow.json")
    assert list(info["steps"]) == ["1", "2", "4", "8"] and info["steps"]["8"]["pairs"] == 2
    core = np.stack([cv2.erode(m.astype(np.uint8), np.ones((7, 7))) for m in TRUTH]) > 0
    for step, limit in ((1, 0.3), (4, 0.8), (8, 1.5)):
        forward, sure = read_flow(flow_path(out, step, 0))
        on = TRUTH[0] & (sure > 0.5)
        assert on.sum() > 0.6 * TRUTH[0].sum()
        assert np.linalg.norm(forward - SPEED * step, axis=-1)[on & core[0]].mean() < limit
        backward, sure = read_flow(flow_path(out, step, step, backward=True))
        on = TRUTH[step] & (sure > 0.5)
        assert np.linalg.norm(backward + SPEED * step, axis=-1)[on & core[step]].mean() < limit
    assert np.allclose(forward * 16, np.round(forward * 16)), "sixteenths of a pixel"
    _sheet(out=out, picture=tmp_path / "sheet.png")
    assert (tmp_path / "sheet.png").stat().st_size > 1000


def test_two_frames_and_wrong_settings(tmp_path: Path) -> None:
    frames = write_frames_folder(tmp_path / "frames", IMAGES[:2])
    out = tmp_path / "out"
    out.mkdir()
    flow(frames=frames, given=Given(), settings=FlowSettings(), out=out, run=Run())
    assert list(read_json(out / "flow.json")["steps"]) == ["1"]
    for settings in (FlowSettings(steps=(0,)), FlowSettings(quality="best")):
        with pytest.raises(BadInput, match=r"flow\."):
            flow(frames=frames, given=Given(), settings=settings, out=out, run=Run())


def test_sample_and_compose_against_a_slow_loop() -> None:
    rng = np.random.default_rng(0)
    first, second = (rng.uniform(-2, 2, (9, 11, 2)).astype(np.float32) for _ in range(2))
    result = compose(first, second)
    for r in range(3, 6):
        for c in range(3, 8):
            x, y = c + first[r, c, 0], r + first[r, c, 1]
            x0, y0 = int(np.floor(x)), int(np.floor(y))
            fx, fy = x - x0, y - y0
            there = (
                second[y0, x0] * (1 - fx) * (1 - fy)
                + second[y0, x0 + 1] * fx * (1 - fy)
                + second[y0 + 1, x0] * (1 - fx) * fy
                + second[y0 + 1, x0 + 1] * fx * fy
            )
            np.testing.assert_allclose(result[r, c], first[r, c] + there, atol=0.1)  # remap has 1/32 px steps


def test_confidence_where_the_round_trip_closes() -> None:
    there, back = np.full((20, 30, 2), 3.0, np.float32), np.full((20, 30, 2), -3.0, np.float32)
    sure = confidence(there, back)
    assert (sure[:16, :26] > 0.99).all() and (sure[:, 28:] == 0).all()
    tolerance = 0.75 + 0.05 * np.linalg.norm([3, 3])
    off = back + np.float32([tolerance, 0])
    np.testing.assert_allclose(confidence(there, off)[10, 10], 0.5, atol=1e-4)


def test_chains_reach_farther_than_direct_matching() -> None:
    rng = np.random.default_rng(1)
    wide = cv2.cvtColor(texture(rng, 96, 500, (0, 0, 0), (255, 255, 255)), cv2.COLOR_RGB2GRAY)
    grey = np.stack([wide[:, 9 * t : 9 * t + 128] for t in range(9)])
    every = list(Chain(grey, Matcher("fine")).pairs((1, 2, 4, 8)))
    assert [(p.step, p.first_idx) for p in every] == [(s, i) for s in (1, 2, 4, 8) for i in range(9 - s)]
    pairs = [p for p in every if p.step == 8]
    stays = pixel_grid(96, 128)[..., 0] > 80  # what is still in sight 72 px further left
    error = np.linalg.norm(pairs[0].forward - np.float32([-72, 0]), axis=-1)[stays]
    direct = Matcher()(grey[0], grey[8])
    assert np.median(error) < 1.0
    assert np.median(error) < np.median(np.linalg.norm(direct - np.float32([-72, 0]), axis=-1)[stays])


def test_chains_of_odd_lengths_are_the_sum_of_their_links() -> None:
    frames = np.zeros((8, 24, 32), np.uint8)
    steps = iter(range(1, 100))

    class Counting(Matcher):
        def __call__(self, first: np.ndarray, second: np.ndarray) -> np.ndarray:
            return np.full((24, 32, 2), next(steps), np.float32)

    # links of two frames: there 1, 3, 5 ... and back 2, 4, 6 ...
    pairs = {(p.step, p.first_idx): p for p in Chain(frames, Counting()).pairs((2, 6))}
    assert set(pairs) == {(2, i) for i in range(6)} | {(6, i) for i in range(2)}
    assert pairs[6, 0].forward[5, 5, 0] == 1 + 5 + 9 and pairs[6, 1].backward[5, 5, 0] == 4 + 8 + 12


def test_enlarged_flow_keeps_its_meaning() -> None:
    small = np.full((8, 10, 2), 1.0, np.float32)
    large = enlarge(small, 40, 16)
    assert large.shape == (16, 40, 2)
    np.testing.assert_allclose(large[5, 5], [4.0, 2.0])
    ramp = np.tile(np.arange(40, dtype=np.float32), (16, 1))
    np.testing.assert_allclose(sample(ramp, large)[8, 10], 14.0, atol=0.05)


@pytest.mark.parametrize("shape", [(16, 256), (20, 128), (256, 20), (9, 9), (1, 64)])
@pytest.mark.parametrize("preset", ["ultrafast", "fast", "medium"])
def test_narrow_pictures_have_a_flow(shape: tuple[int, int], preset: str) -> None:
    """The library itself crashes on some of these, and takes the process with it."""
    picture = np.random.default_rng(0).integers(0, 255, shape).astype(np.uint8)
    still = Matcher(preset)(picture, picture)
    assert still.shape == (*shape, 2)
    assert np.abs(still).max() < 1.0
