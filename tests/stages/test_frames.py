"""frames: every container and codec, rotation, variable frame rate, selection, and bad input in one sentence."""

from __future__ import annotations

import json
from pathlib import Path

import av
import numpy as np
import pytest
from PIL import Image

from pipeline import BadInput, Folder, Run, Source
from stages.formats import read_clip
from stages.frames import FrameSettings, _bytes, _check, frames
from stages.perception.sampling import at_rate, evenly_in_time, fit_size, moving_frames
from tests.stages.perception_clips import frames_of, moving_clip, write_pngs, write_video

IMAGES = moving_clip(8, 96)[0]


def encoder_exists(name: str) -> bool:
    try:
        av.codec.Codec(name, "w")
    except Exception:
        return False
    return True


@pytest.mark.parametrize(
    ("suffix", "codec", "pixels", "tolerance"),
    [
        (".mp4", "libx264", "yuv420p", 12),
        (".mov", "libx264", "yuv444p", 12),
        (".mp4", "libx265", "yuv420p", 14),
        (".mkv", "libx265", "yuv420p10le", 14),
        (".webm", "libvpx-vp9", "yuv420p", 14),
        (".mkv", "ffv1", "yuv444p", 6),
        (".mov", "prores_ks", "yuv422p10le", 14),
        (".avi", "mpeg4", "yuv420p", 14),
        (".avi", "mjpeg", "yuvj420p", 14),
        (".gif", "gif", "rgb8", 40),
    ],
)
def test_containers_and_codecs(tmp_path: Path, suffix: str, codec: str, pixels: str, tolerance: float) -> None:
    if not encoder_exists(codec):
        pytest.skip(f"this build of FFmpeg has no encoder {codec}")
    options = {
        "libx265": {"x265-params": "log-level=none:crf=12"},
        "libvpx-vp9": {"crf": "15", "b": "0", "cpu-used": "8"},
    }
    video = write_video(tmp_path / f"clip{suffix}", IMAGES, codec, pixels, options=options.get(codec))
    folder = frames_of(video, tmp_path / "out")
    _check(out=folder.path)
    clip = read_clip(folder.path)
    assert len(clip) == len(IMAGES) and (clip.width, clip.height) == (96, 96)
    assert np.abs(clip.images().astype(int) - IMAGES).mean() < tolerance
    np.testing.assert_allclose(np.diff(clip.time_s), 0.05, atol=0.011)


@pytest.mark.parametrize("turn", [90, 180, 270])
def test_rotation_metadata_is_applied(tmp_path: Path, turn: int) -> None:
    wide = IMAGES[:, :80]
    video = write_video(tmp_path / "phone.mp4", wide, rotation_deg=turn if turn <= 180 else turn - 360)
    clip = read_clip(frames_of(video, tmp_path / "out").path)
    upright = np.rot90(wide, turn // 90, axes=(1, 2))  # both counterclockwise
    assert clip.images().shape == upright.shape
    assert np.abs(clip.images().astype(int) - upright).mean() < 12
    assert clip.rotation_deg == (-turn) % 360


def test_variable_frame_rate_keeps_true_times(tmp_path: Path) -> None:
    times_ms = [0, 40, 80, 300, 340, 380, 900, 940]
    video = write_video(tmp_path / "vfr.mkv", IMAGES, times=times_ms)
    clip = read_clip(frames_of(video, tmp_path / "out").path)
    np.testing.assert_allclose(clip.source_time_s * 1000, times_ms, atol=2)


def test_image_folder_in_natural_order(tmp_path: Path) -> None:
    folder = write_pngs(tmp_path / "shots", IMAGES, [f"shot{i}.png" for i in range(6, 6 + len(IMAGES))])
    (folder / "notes.txt").write_text("not an image")
    clip = read_clip(frames_of(folder, tmp_path / "out", folder_fps=5.0).path)
    np.testing.assert_array_equal(clip.images(), IMAGES)
    np.testing.assert_allclose(np.diff(clip.time_s), 0.2)


def test_exif_orientation_and_focal_length(tmp_path: Path) -> None:
    folder = tmp_path / "photos"
    folder.mkdir()
    exif = Image.Exif()
    exif[0x0112] = 6  # the top is on the right: turn clockwise
    exif.get_ifd(0x8769)[0xA405] = 72  # 72 mm equivalent: twice the width of the film
    for i, image in enumerate(IMAGES[:3, :80]):
        Image.fromarray(image).save(folder / f"{i}.jpg", quality=95, exif=exif)
    clip = read_clip(frames_of(folder, tmp_path / "out").path)
    assert (clip.width, clip.height) == (80, 96)
    assert np.abs(clip.image(0).astype(int) - np.rot90(IMAGES[0, :80], -1)).mean() < 12
    assert clip.focal_hint_px == pytest.approx(2.0 * 96)


def test_static_frames_are_dropped_and_times_kept(tmp_path: Path) -> None:
    doubled = np.repeat(IMAGES, 2, axis=0)
    video = write_video(tmp_path / "doubled.mkv", doubled, "ffv1", "yuv444p")
    clip = read_clip(frames_of(video, tmp_path / "out").path)
    np.testing.assert_array_equal(clip.source_idx, np.arange(0, 16, 2))
    assert len(clip.source_time_s) == 16
    everything = read_clip(frames_of(video, tmp_path / "all", least_change=0.0).path)
    assert len(everything) == 16


def test_size_rate_and_count_settings(tmp_path: Path) -> None:
    video = write_video(tmp_path / "clip.mp4", IMAGES)
    clip = read_clip(frames_of(video, tmp_path / "a", max_side_px=64, max_frames=4).path)
    assert (clip.width, clip.height, len(clip)) == (64, 64, 4)
    assert clip.source_idx[0] == 0 and clip.source_idx[-1] == 7
    assert len(read_clip(frames_of(video, tmp_path / "b", fps=10.0).path)) == 4
    assert list(read_clip(frames_of(video, tmp_path / "c", start_s=0.1, end_s=0.26).path).source_idx) == [2, 3, 4, 5]


def test_names_with_colons_and_dashes_are_files(tmp_path: Path) -> None:
    for name in ("http:clip.mp4", "-clip.mp4", "ein Fuchs ☃.mp4"):
        video = write_video(tmp_path / "plain.mp4", IMAGES).rename(tmp_path / name)
        assert len(read_clip(frames_of(video, tmp_path / f"out {name}").path)) == len(IMAGES)


def test_sampling_figures() -> None:
    times = np.array([0.0, 0.1, 0.2, 0.9, 1.0])
    np.testing.assert_array_equal(evenly_in_time(times, 3), [0, 2, 4])  # 0.2 s is nearer to the middle than 0.9 s
    np.testing.assert_array_equal(evenly_in_time(times, 9), np.arange(5))
    np.testing.assert_array_equal(at_rate(times, 10.0), np.arange(5))
    assert fit_size(1920, 1080, 480) == (480, 270)
    assert fit_size(200, 100, 480) == (200, 100)
    thumbs = np.zeros((4, 2, 2), np.float32)
    thumbs[2, 0, 0] = 5.0
    np.testing.assert_array_equal(moving_frames(thumbs, 1.0), [0, 2, 3])


# --------------------------------------------------------------------------------------------- bad input


def refused(path: Path, tmp_path: Path, **settings: object) -> str:
    with pytest.raises(BadInput) as caught:
        frames_of(path, tmp_path / "refused", **settings)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_no_video_stream(tmp_path: Path) -> None:
    path = tmp_path / "song.mp4"
    with av.open(str(path), "w") as container:
        stream = container.add_stream("aac", rate=16000)
        frame = av.AudioFrame.from_ndarray(np.zeros((1, 4096), np.float32), format="fltp", layout="mono")
        frame.rate = 16000
        container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    assert "no video stream" in refused(path, tmp_path)


def test_truncated_without_index(tmp_path: Path) -> None:
    path = write_video(tmp_path / "cut.mp4", IMAGES)
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    assert "truncated" in refused(path, tmp_path)


def test_truncated_with_index_first(tmp_path: Path) -> None:
    images = np.concatenate([IMAGES] * 4)
    path = write_video(tmp_path / "cut.mp4", images, container_options={"movflags": "faststart"})
    path.write_bytes(path.read_bytes()[: int(path.stat().st_size * 0.6)])
    text = refused(path, tmp_path)
    assert "breaks off after" in text and "accept_damaged" in text
    assert 2 <= len(read_clip(frames_of(path, tmp_path / "ok", accept_damaged=True).path)) < len(images)


def test_truncated_matroska(tmp_path: Path) -> None:
    path = write_video(tmp_path / "cut.mkv", np.concatenate([IMAGES] * 6), options={"g": "8"})
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    assert "truncated" in refused(path, tmp_path)


def test_not_a_video(tmp_path: Path) -> None:
    path = tmp_path / "noise.mp4"
    path.write_bytes(np.random.default_rng(0).bytes(5000))
    assert "noise.mp4" in refused(path, tmp_path)
    (tmp_path / "empty.mp4").write_bytes(b"")
    assert "empty.mp4" in refused(tmp_path / "empty.mp4", tmp_path)


def test_zero_frames_after_filtering(tmp_path: Path) -> None:
    path = write_video(tmp_path / "clip.mp4", IMAGES)
    assert "no frame of 8 is left" in refused(path, tmp_path, start_s=5.0)
    still = write_video(tmp_path / "still.mp4", np.repeat(IMAGES[:1], 8, axis=0))
    assert "only one frame of 8 is left" in refused(still, tmp_path)


def test_one_frame(tmp_path: Path) -> None:
    assert "has only one frame" in refused(write_video(tmp_path / "one.mp4", IMAGES[:1]), tmp_path)


def test_eight_pixels(tmp_path: Path) -> None:
    text = refused(write_video(tmp_path / "tiny.mp4", IMAGES[:, :8, :8]), tmp_path)
    assert "8x8" in text and "at least 64" in text


def test_reduced_below_the_least_side(tmp_path: Path) -> None:
    path = write_video(tmp_path / "clip.mp4", IMAGES)
    assert "max_side_px" in refused(path, tmp_path, max_side_px=32)


def test_image_folder_faults(tmp_path: Path) -> None:
    (tmp_path / "void").mkdir()
    assert "holds no images" in refused(tmp_path / "void", tmp_path)
    folder = write_pngs(tmp_path / "mixed", IMAGES[:3])
    Image.fromarray(IMAGES[0, :70]).save(folder / "00003.png")
    assert "one size" in refused(folder, tmp_path)
    broken = write_pngs(tmp_path / "broken", IMAGES[:3])
    (broken / "00001.png").write_bytes(b"\x89PNG nothing")
    assert "cannot be read as an image" in refused(broken, tmp_path)


def test_source_is_never_written_to(tmp_path: Path) -> None:
    path = write_video(tmp_path / "clip.mp4", IMAGES)
    before = path.read_bytes()
    path.chmod(0o444)
    frames_of(path, tmp_path / "out")
    assert path.read_bytes() == before


def test_check_refuses_a_missing_or_odd_frame(tmp_path: Path) -> None:
    folder = frames_of(write_video(tmp_path / "clip.mp4", IMAGES), tmp_path / "out")
    info = json.loads((folder / "frames.json").read_text())
    (folder.path / info["frames"][3]["name"]).unlink()
    with pytest.raises((ValueError, OSError)):
        _check(out=folder.path)


def test_two_runs_write_the_same_bytes(tmp_path: Path) -> None:
    video = write_video(tmp_path / "clip.mp4", IMAGES)
    folders = []
    for name in ("a", "b"):
        out = tmp_path / name
        out.mkdir()
        frames(video=Source(video, "clip"), settings=FrameSettings(), out=out, run=Run())
        folders.append(Folder(out))
    for path in sorted(folders[0].path.iterdir()):
        assert path.read_bytes() == (folders[1] / path.name).read_bytes()


def test_disk_estimate_is_above_what_is_written(tmp_path: Path) -> None:
    video = write_video(tmp_path / "clip.mkv", IMAGES, "ffv1", "yuv444p")
    folder = frames_of(video, tmp_path / "out")
    written = sum(p.stat().st_size for p in folder.path.iterdir())
    estimate = _bytes(Source(video, "clip"), FrameSettings())
    assert 0.5 * written < estimate < 4 * written
    assert _bytes(Source(video, "clip"), FrameSettings(max_frames=4)) == estimate // 2
    (tmp_path / "noise.mp4").write_bytes(b"no video")
    assert _bytes(Source(tmp_path / "noise.mp4", "noise"), FrameSettings()) == 0
    pictures = write_pngs(tmp_path / "pictures", IMAGES)
    assert _bytes(Source(pictures, "pictures", is_folder=True), FrameSettings()) == estimate
