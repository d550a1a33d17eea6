"""features: the square crop, the built-in descriptor, its trust, the stage's folder."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from pipeline import BadInput, Given, Run
from stages.features import FeatureSettings, _check, _sheet, features
from stages.formats import read_clip, read_features, read_json
from stages.perception.descriptors import crop_box, crop_resize, describe_appearance, match_trust
from stages.perception.sheets import feature_colours, flow_colours, frame_sheet, mask_sheet, tile
from synthetic.clips import film, make_subject
from tests.stages.perception_clips import moving_clip, write_frames_folder, write_masks_folder

IMAGES, TRUTH, _ = moving_clip(6, 128)


def test_stage(tmp_path: Path) -> None:
    truth = TRUTH.copy()
    truth[3] = False
    frames = write_frames_folder(tmp_path / "frames", IMAGES)
    masks = write_masks_folder(tmp_path / "masks", truth, read_clip(frames.path))
    out = tmp_path / "out"
    out.mkdir()
    settings = FeatureSettings(category="other")
    features(frames=frames, masks=masks, given=Given(), settings=settings, out=out, run=Run())
    _check(out=out, frames=frames)
    values, crops = read_features(out)
    assert values.dtype == np.float16 and values.shape == (6, 112, 112, 16)
    length = np.linalg.norm(np.asarray(values, np.float32), axis=-1)
    share = (length > 0).reshape(6, -1).mean(axis=1)
    box = np.array([crops[0, 2] - crops[0, 0]]) ** 2
    np.testing.assert_allclose(share[0], TRUTH[0].sum() / box, rtol=0.1)
    assert share[3] == 0
    info = read_json(out / "features.json")
    assert info["network"] == "builtin-appearance" and info["category"] == "other" and 0 <= info["trust"] <= 1
    _sheet(out=out, picture=tmp_path / "sheet.png")
    assert (tmp_path / "sheet.png").stat().st_size > 1000


def test_an_animal_is_known_and_embedded_by_our_network(tmp_path: Path) -> None:
    clip = film(make_subject(41, "dog"), clip=0, clips=3, frames=4, size=96, seed=3, fps=4)
    frames = write_frames_folder(tmp_path / "frames", clip.images)
    masks = write_masks_folder(tmp_path / "masks", clip.masks, read_clip(frames.path))
    out = tmp_path / "out"
    out.mkdir()
    features(frames=frames, masks=masks, given=Given(), settings=FeatureSettings(), out=out, run=Run())
    _check(out=out, frames=frames)
    info = read_json(out / "features.json")
    assert info["category"] == "quadruped" and info["network"] == "posenet-quadruped.onnx" and 0 < info["margin"] <= 1
    assert info["category_named"]["quadruped"] > info["category_named"]["human"]
    values, crops = read_features(out)
    # The same points of the surface are nearer to each other, from frame to frame, than others are.
    places = {}
    for i in (0, 1):
        pixel = (
            clip.intrinsics
            @ (clip.camera_from_object[i] @ np.append(clip.joints[i], np.ones((len(clip.joints[i]), 1)), 1).T)[:3]
        )
        cell = (pixel[:2] / pixel[2] - crops[i][:2, None]) * 112 / (crops[i][2] - crops[i][0])
        places[i] = np.clip(cell.T.astype(int), 0, 111)
    a, b = (np.asarray(values[i], np.float32)[places[i][:, 1], places[i][:, 0]] for i in (0, 1))
    on = (np.abs(a).sum(1) > 0) & (np.abs(b).sum(1) > 0)
    alike = a[on] @ b[on].T
    assert on.sum() >= 10 and np.diag(alike).mean() > alike.mean() + 0.1


def test_unknown_category_is_refused(tmp_path: Path) -> None:
    frames = write_frames_folder(tmp_path / "frames", IMAGES)
    masks = write_masks_folder(tmp_path / "masks", TRUTH, read_clip(frames.path))
    with pytest.raises(BadInput, match="category is 'bird'"):
        settings = FeatureSettings(category="bird")
        features(frames=frames, masks=masks, given=Given(), settings=settings, out=tmp_path, run=Run())


def test_crop_is_square_and_centred() -> None:
    crop = crop_box(np.array([10.0, 20.0, 50.0, 40.0]), 100, 80)
    np.testing.assert_allclose(crop, [6.0, 6.0, 54.0, 54.0])
    np.testing.assert_allclose(crop_box(np.zeros(4), 100, 80), [0, -10, 100, 90])


def test_crop_samples_cell_centres() -> None:
    rows, columns = np.mgrid[0:60, 0:80].astype(np.float32)
    place = np.dstack([columns + 0.5, rows + 0.5])
    crop = np.array([10.0, 5.0, 50.0, 45.0])
    found = crop_resize(place, crop, 20)
    centres = 10.0 + (np.arange(20) + 0.5) * 2.0
    np.testing.assert_allclose(found[7, :, 0], centres, atol=0.05)
    np.testing.assert_allclose(found[:, 7, 1], centres - 5.0, atol=0.05)
    outside = crop_resize(place, np.array([-20.0, -20.0, 20.0, 20.0]), 20)
    assert (outside[:9, :9] == 0).all()


def test_descriptor_withstands_light_and_tells_places_apart() -> None:
    rng = np.random.default_rng(0)
    image = np.zeros((112, 112, 3), np.uint8)
    image[:, :56], image[:, 56:] = (180, 110, 50), (80, 90, 130)
    image = np.clip(image + cv2.GaussianBlur(rng.normal(0, 30, image.shape), (0, 0), 2), 0, 255).astype(np.uint8)
    mask = np.zeros((112, 112), np.float32)
    mask[20:90, 15:100] = 1
    dim = np.clip(image * 0.75, 0, 255).astype(np.uint8)
    a, b = describe_appearance(image, mask), describe_appearance(dim, mask)
    np.testing.assert_allclose(np.linalg.norm(a, axis=-1), mask, atol=1e-5)
    same = (a * b).sum(-1)[mask > 0].mean()
    other = (a[:, :56] * a[:, :55:-1])[30:80, 20:50].sum(-1).mean()
    assert same > 0.97 and other < 0.85
    assert not describe_appearance(image, np.zeros((112, 112), np.float32)).any()


def test_trust_tells_distinct_from_plain() -> None:
    rng = np.random.default_rng(0)
    distinct = rng.normal(size=(1, 24, 24, 16)).astype(np.float32)
    distinct /= np.linalg.norm(distinct, axis=-1, keepdims=True)
    distinct = np.repeat(distinct, 3, axis=0)
    plain = np.zeros_like(distinct)
    plain[..., 0] = 1
    assert match_trust(distinct, np.random.default_rng(0)) > 0.9
    assert match_trust(plain, np.random.default_rng(0)) < 0.05
    assert match_trust(np.zeros_like(plain), np.random.default_rng(0)) == 0.0


def test_sheets_have_the_promised_shape() -> None:
    assert frame_sheet(IMAGES).shape == (192, 1152, 3)
    assert mask_sheet(IMAGES, TRUTH.astype(np.uint8) * 255).dtype == np.uint8
    flow = np.zeros((20, 30, 2), np.float32)
    flow[:, 15:] = (4.0, 0.0)
    colours = flow_colours(flow, np.ones((20, 30)))
    assert (colours[0, 0] == 255).all() and colours[0, 20, 0] > 200 > colours[0, 20, 1]
    values = np.zeros((2, 8, 8, 16), np.float16)
    values[:, 2:6, 2:6] = np.random.default_rng(0).normal(size=(2, 4, 4, 16))
    painted = feature_colours(values)
    assert painted.shape == (2, 8, 8, 3) and (painted[0, 0, 0] == 24).all() and painted[0, 3, 3].std() > 0
    assert tile([IMAGES[0]] * 7, columns=3, side_px=32).shape == (96, 96, 3)
