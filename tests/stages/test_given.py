"""What lies beside a video stands in for a stage: checked, brought to the kept frames, refused in one sentence."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from pipeline import BadInput, Folder, Given, Run
from stages.features import FeatureSettings, features
from stages.features import _check as check_features
from stages.flow import FlowSettings, flow
from stages.flow import _check as check_flow
from stages.formats import read_clip, read_features, read_flow, read_mask_facts, read_masks, write_flow
from stages.masks import MaskSettings, _check, masks
from tests.stages.perception_clips import (
    given,
    moving_clip,
    overlap,
    write_frames_folder,
    write_masks_folder,
    write_pngs,
    write_video,
)

IMAGES, TRUTH, _ = moving_clip(8, 96)
PICTURES = TRUTH.astype(np.uint8) * 255
KEPT = [0, 2, 3, 6, 7]


@pytest.fixture
def frames(tmp_path: Path) -> Folder:
    """Five of eight source frames kept."""
    return write_frames_folder(tmp_path / "frames", IMAGES[KEPT], KEPT)


def run_masks(frames: Folder, out: Path, beside: Given) -> np.ndarray:
    out.mkdir(exist_ok=True)
    masks(frames=frames, given=beside, settings=MaskSettings(), out=out, run=Run(video="clip"))
    _check(out=out, frames=frames)
    return read_masks(out, read_clip(frames.path)) > 127


def test_masks_one_a_source_frame(tmp_path: Path, frames: Folder) -> None:
    folder = write_pngs(tmp_path / "clip.masks", PICTURES)
    np.testing.assert_array_equal(run_masks(frames, tmp_path / "out", given(masks=folder)), TRUTH[KEPT])
    facts = read_mask_facts(tmp_path / "out")
    assert facts.provider == "given-folder" and (facts.confidence == 1).all()


def test_masks_one_a_kept_frame_by_name_or_by_order(tmp_path: Path, frames: Folder) -> None:
    by_name = write_pngs(tmp_path / "a.masks", PICTURES[KEPT], [f"mask_{i:05d}.png" for i in KEPT])
    np.testing.assert_array_equal(run_masks(frames, tmp_path / "a", given(masks=by_name)), TRUTH[KEPT])
    by_order = write_pngs(tmp_path / "b.masks", PICTURES[KEPT], [f"m{i}.png" for i in range(100, 105)])
    np.testing.assert_array_equal(run_masks(frames, tmp_path / "b", given(masks=by_order)), TRUTH[KEPT])


def test_masks_of_another_size_are_scaled_and_of_another_shape_refused(tmp_path: Path, frames: Folder) -> None:
    large = np.stack([cv2.resize(p, (288, 288), interpolation=cv2.INTER_NEAREST) for p in PICTURES])
    found = run_masks(frames, tmp_path / "out", given(masks=write_pngs(tmp_path / "clip.masks", large)))
    assert overlap(found, TRUTH[KEPT]) > 0.97
    wide = write_pngs(tmp_path / "wide.masks", PICTURES[:, :60])
    with pytest.raises(BadInput, match="another shape"):
        run_masks(frames, tmp_path / "out2", given(masks=wide))


def test_mask_video(tmp_path: Path, frames: Folder) -> None:
    rgb = np.repeat(PICTURES[..., None], 3, axis=3)
    video = write_video(tmp_path / "clip.masks.mp4", rgb, options={"crf": "0"})
    np.testing.assert_array_equal(run_masks(frames, tmp_path / "out", given(masks_mp4=video)), TRUTH[KEPT])
    assert read_mask_facts(tmp_path / "out").provider == "given-video"
    short = write_video(tmp_path / "short.masks.mp4", rgb[:6])
    with pytest.raises(BadInput, match="6 masks, but the video has 8"):
        run_masks(frames, tmp_path / "out2", given(masks_mp4=short))


def test_mask_count_that_does_not_match(tmp_path: Path, frames: Folder) -> None:
    folder = write_pngs(tmp_path / "clip.masks", PICTURES[:7])
    for path in sorted(folder.iterdir()):
        path.rename(path.with_name(f"m{int(path.stem) + 50}.png"))
    with pytest.raises(BadInput, match="7 masks, but the video has 8"):
        run_masks(frames, tmp_path / "out", given(masks=folder))


def test_masks_that_never_cover_anything(tmp_path: Path, frames: Folder) -> None:
    folder = write_pngs(tmp_path / "clip.masks", np.zeros_like(PICTURES))
    with pytest.raises(BadInput, match="no frame's mask covers anything"):
        run_masks(frames, tmp_path / "out", given(masks=folder))


def test_missing_masks_are_flagged_and_said(tmp_path: Path, frames: Folder) -> None:
    pictures = PICTURES.copy()
    pictures[3] = 0
    out = tmp_path / "out"
    out.mkdir()
    run = Run(video="clip")
    beside = given(masks=write_pngs(tmp_path / "clip.masks", pictures))
    masks(frames=frames, given=beside, settings=MaskSettings(), out=out, run=run)
    facts = read_mask_facts(out)
    assert facts.flags[2] == ["missing"] and facts.confidence[2] == 0
    assert any("no object found in 1 of 5" in text for text in run.warnings)


def test_damaged_mask_file(tmp_path: Path, frames: Folder) -> None:
    folder = write_pngs(tmp_path / "clip.masks", PICTURES)
    (folder / "00002.png").write_bytes(b"no")
    with pytest.raises(BadInput, match=r"clip\.masks/00002\.png"):
        run_masks(frames, tmp_path / "out", given(masks=folder))


# --------------------------------------------------------------------------------------------- flow


def run_flow(frames: Folder, tmp_path: Path, folder: Path) -> Path:
    out = tmp_path / "flow-out"
    out.mkdir(exist_ok=True)
    flow(frames=frames, given=given(flow=folder), settings=FlowSettings(), out=out, run=Run())
    check_flow(out=out, frames=frames)
    return out


def write_given_flow(folder: Path, suffix: str = ".png") -> Path:
    values = np.full((96, 96, 2), 1.25, np.float32)
    for way, names in (("fw-01", KEPT[:-1]), ("bw-01", KEPT[1:])):
        (folder / way).mkdir(parents=True)
        for i in names:
            path = folder / way / f"{i:05d}{suffix}"
            if suffix == ".png":
                write_flow(path, values, np.ones((96, 96)))
            else:
                np.save(path, values)
    return folder


@pytest.mark.parametrize("suffix", [".png", ".npy"])
def test_given_flow_is_copied(tmp_path: Path, frames: Folder, suffix: str) -> None:
    out = run_flow(frames, tmp_path, write_given_flow(tmp_path / "clip.flow", suffix))
    values, sure = read_flow(out / "fw-01" / "00002.png")
    assert (values == 1.25).all() and (sure == 1).all()


def test_given_flow_that_does_not_match(tmp_path: Path, frames: Folder) -> None:
    folder = write_given_flow(tmp_path / "clip.flow")
    (folder / "fw-01" / "00003.png").unlink()
    with pytest.raises(BadInput, match="frame 00003 is missing"):
        run_flow(frames, tmp_path, folder)
    more = write_given_flow(tmp_path / "more.flow")
    write_flow(more / "fw-01" / "00001.png", np.zeros((96, 96, 2)), np.ones((96, 96)))
    with pytest.raises(BadInput, match="00001 fits no kept frame"):
        run_flow(frames, tmp_path, more)
    (tmp_path / "none.flow").mkdir()
    with pytest.raises(BadInput, match="at least fw-01 and bw-01"):
        run_flow(frames, tmp_path, tmp_path / "none.flow")


def test_given_flow_not_finite_or_of_another_size(tmp_path: Path, frames: Folder) -> None:
    folder = write_given_flow(tmp_path / "clip.flow", ".npy")
    np.save(folder / "fw-01" / "00002.npy", np.full((96, 96, 2), np.nan, np.float32))
    with pytest.raises(BadInput, match=r"fw-01/00002.npy holds values that are not finite"):
        run_flow(frames, tmp_path, folder)
    np.save(folder / "fw-01" / "00002.npy", np.zeros((48, 96, 2), np.float32))
    with pytest.raises(BadInput, match="96x48"):
        run_flow(frames, tmp_path, folder)


# --------------------------------------------------------------------------------------------- features


def run_features(frames: Folder, tmp_path: Path, array: np.ndarray | None, path: Path | None = None) -> np.ndarray:
    clip = read_clip(frames.path)
    truth = write_masks_folder(tmp_path / "masks", TRUTH[KEPT], clip)
    path = path or tmp_path / "clip.features.npy"
    if array is not None:
        np.save(path, array)
    out = tmp_path / "features-out"
    out.mkdir(exist_ok=True)
    features(frames=frames, masks=truth, given=given(features_npy=path), settings=FeatureSettings(), out=out, run=Run())
    check_features(out=out, frames=frames)
    return np.array(read_features(out)[0])


def test_given_features_on_crops_and_over_the_picture(tmp_path: Path, frames: Folder) -> None:
    rng = np.random.default_rng(0)
    array = rng.normal(size=(8, 112, 112, 16)).astype(np.float16)
    found = run_features(frames, tmp_path, array)
    wanted = array[2].astype(np.float32)
    wanted /= np.linalg.norm(wanted, axis=-1, keepdims=True)
    np.testing.assert_allclose(found[1].astype(np.float32), wanted, atol=2e-3)
    whole = np.zeros((5, 48, 48, 16), np.float32)
    whole[..., 3] = 2.0
    found = run_features(frames, tmp_path, whole)
    assert np.allclose(found[2, 56, 56, 3], 1.0)


def test_given_features_that_cannot_be_used(tmp_path: Path, frames: Folder) -> None:
    with pytest.raises(BadInput, match="floats of frames"):
        run_features(frames, tmp_path, np.zeros((8, 112, 112, 17), np.float32))
    with pytest.raises(BadInput, match="holds 6 frames, the video has 8"):
        run_features(frames, tmp_path, np.ones((6, 112, 112, 16), np.float16))
    bad = np.ones((8, 112, 112, 16), np.float16)
    bad[3, 5, 5, 0] = np.nan
    with pytest.raises(BadInput, match="frame 3 holds values that are not finite"):
        run_features(frames, tmp_path, bad)
    with pytest.raises(BadInput, match="nothing but zeros"):
        run_features(frames, tmp_path, np.zeros((8, 112, 112, 16), np.float16))
    path = tmp_path / "pickled.features.npy"
    np.save(path, np.array([{"a": 1}], dtype=object), allow_pickle=True)
    with pytest.raises(BadInput, match="cannot be read as a NumPy array"):
        run_features(frames, tmp_path, None, path)
