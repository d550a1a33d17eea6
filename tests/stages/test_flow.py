"""flow: DIS with forward-backward confidence, chains, the stage's folder."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from pipeline import BadInput, Given, Run
from stages.flow import FlowSettings, _check, _sheet, flow
from stages.formats import flow_path, read_clip, read_flow, read_json
from stages.perception.optical_flow import (
    Chain,
    Matcher,
    compose,
    confidence,
    isolate,
    make_pair,
    pixel_grid,
    place,
    sample,
    shared_window,
)
from stages.perception.temporal import enlarge
from tests.stages.perception_clips import moving_clip, texture, write_frames_folder, write_masks_folder

IMAGES, TRUTH, SPEED = moving_clip(10, 128)


def test_stage_writes_both_ways_and_is_right(tmp_path: Path) -> None:
    frames = write_frames_folder(tmp_path / "frames", IMAGES)
    clip = read_clip(frames.path)
    masks = write_masks_folder(tmp_path / "masks", TRUTH, clip)
    out = tmp_path / "out"
    out.mkdir()
    flow(frames=frames, masks=masks, given=Given(), settings=FlowSettings(), out=out, run=Run())
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
    far = cv2.dilate(TRUTH[0].astype(np.uint8), np.ones((15, 15))) == 0
    assert (read_flow(flow_path(out, 1, 0))[1][far] == 0).all()
    _sheet(out=out, picture=tmp_path / "sheet.png")
    assert (tmp_path / "sheet.png").stat().st_size > 1000


def test_two_frames_and_wrong_settings(tmp_path: Path) -> None:
    frames = write_frames_folder(tmp_path / "frames", IMAGES[:2])
    masks = write_masks_folder(tmp_path / "masks", TRUTH[:2], read_clip(frames.path))
    out = tmp_path / "out"
    out.mkdir()
    flow(frames=frames, masks=masks, given=Given(), settings=FlowSettings(), out=out, run=Run())
    assert list(read_json(out / "flow.json")["steps"]) == ["1"]
    for settings in (FlowSettings(steps=(0,)), FlowSettings(quality="best")):
        with pytest.raises(BadInput, match=r"flow\."):
            flow(frames=frames, masks=masks, given=Given(), settings=settings, out=out, run=Run())


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
    chain = Chain(grey, np.ones(grey.shape, bool), Matcher(), Matcher("fine"))
    pairs = [p for p in chain.pairs((1, 2, 4, 8)) if p.step == 8]
    stays = pixel_grid(96, 128)[..., 0] > 80  # what is still in sight 72 px further left
    error = np.linalg.norm(pairs[0].forward - np.float32([-72, 0]), axis=-1)[stays]
    direct = Matcher()(grey[0], grey[8])
    assert np.median(error) < 1.0
    assert np.median(error) < np.median(np.linalg.norm(direct - np.float32([-72, 0]), axis=-1)[stays])


def test_enlarged_flow_keeps_its_meaning() -> None:
    small = np.full((8, 10, 2), 1.0, np.float32)
    large = enlarge(small, 40, 16)
    assert large.shape == (16, 40, 2)
    np.testing.assert_allclose(large[5, 5], [4.0, 2.0])
    ramp = np.tile(np.arange(40, dtype=np.float32), (16, 1))
    np.testing.assert_allclose(sample(ramp, large)[8, 10], 14.0, atol=0.05)


def test_isolating_the_object_frees_thin_limbs_from_the_background() -> None:
    rng = np.random.default_rng(4)
    grey = [cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) for image in IMAGES[:2]]
    arm = TRUTH[0].copy()
    arm[: int(TRUTH[0].shape[0] * 0.66)] = False
    error = {}
    for name, frames in (("plain", grey), ("alone", [isolate(g, m) for g, m in zip(grey, TRUTH[:2], strict=True)])):
        found = Matcher("fine")(frames[0], frames[1])
        error[name] = np.linalg.norm(found - SPEED, axis=-1)[arm].mean()
    assert error["alone"] < 0.7 * error["plain"]
    alone = isolate(grey[0], TRUTH[0])
    assert np.abs(alone.astype(int) - grey[0])[cv2.erode(TRUTH[0].astype(np.uint8), np.ones((5, 5))) > 0].max() <= 2
    assert alone[~TRUTH[0]].std() < grey[0][~TRUTH[0]].std()
    noise = rng.integers(0, 255, (32, 32)).astype(np.uint8)
    np.testing.assert_array_equal(isolate(noise, np.zeros((32, 32), bool)), noise)


def test_window_and_placing() -> None:
    masks = np.zeros((3, 200, 300), bool)
    masks[0, 80:90, 100:120] = masks[2, 100:140, 150:160] = True
    rows, columns = shared_window(masks)
    assert (rows.start, rows.stop, columns.start, columns.stop) == (54, 166, 74, 186)
    small = np.ones((112, 112, 2), np.float32)
    pair = place(make_pair(1, 0, small, -small, pixel_grid(112, 112)), rows, columns, (200, 300))
    assert pair.forward.shape == (200, 300, 2) and pair.forward[60, 80, 0] == 1 and not pair.forward[:50].any()
    assert pair.forward_confidence[100, 100] > 0.9 and pair.forward_confidence[10, 10] == 0
