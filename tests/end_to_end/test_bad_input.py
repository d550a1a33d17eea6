"""Every kind of bad input: exit code 2, one clear sentence, nothing half done in the store, no file touched."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pytest

from synthetic.clips import write_video
from tests.end_to_end.conftest import Outcome, check_store, run_banmo

Watch = Callable[[Path], None]


def refused(outcome: Outcome, *words: str) -> str:
    """Exit 2 with exactly one sentence that mentions `words`; returns it."""
    assert outcome.code == 2, outcome.text
    assert "Traceback" not in outcome.text
    said = [line for line in outcome.err.splitlines() if line.startswith("banmo: ")]
    assert len(said) == 1, outcome.text
    for word in words:
        assert word.lower() in said[0].lower(), said[0]
    assert len(said[0]) < 400
    return said[0]


@pytest.fixture
def videos(tmp_path: Path) -> Path:
    folder = tmp_path / "videos"
    folder.mkdir()
    return folder


@pytest.fixture
def nowhere(tmp_path: Path) -> Path:
    return tmp_path / "workspace"


@pytest.fixture
def workspace(contracts: Path, nowhere: Path) -> Path:
    """A fresh workspace that knows the stages' contracts already: saves each test some seconds."""
    shutil.copytree(contracts, nowhere / "cache")
    return nowhere


def moving_square(frames: int = 8, size: int = 72) -> np.ndarray:
    """(T, H, W, 3): a bright square that wanders over a textured ground."""
    ground = np.random.default_rng(0).integers(40, 90, (size, size, 3), np.uint8)
    images = np.repeat(ground[None], frames, 0)
    for t in range(frames):
        images[t, size // 3 : 2 * size // 3, 10 + 3 * t : 30 + 3 * t] = (220, 160, 60)
    return images


def run(videos: Path, workspace: Path, *more: str) -> Outcome:
    return run_banmo("run", videos, "--workspace", workspace, *more)


def no_results(workspace: Path, *stages: str) -> None:
    """The store is sound and holds no result of these stages."""
    check_store(workspace)
    for stage in stages:
        folder = workspace / "objects" / stage
        assert not folder.is_dir() or not list(folder.iterdir()), f"{stage} left something behind"
    assert not list((workspace / "actions").glob(f"{stages[0]}/*")) if stages else True


def test_empty_folder(videos: Path, nowhere: Path) -> None:
    refused(run(videos, nowhere), "videos", "empty")
    assert not nowhere.exists(), "nothing is made for nothing"


def test_no_such_folder(videos: Path, nowhere: Path) -> None:
    refused(run(videos / "missing", nowhere), "missing")
    assert not nowhere.exists()


def test_folder_without_videos(videos: Path, workspace: Path, untouched: Watch) -> None:
    (videos / "notes.txt").write_text("no clip here")
    untouched(videos)
    refused(run(videos, workspace), "videos")


@pytest.mark.parametrize(
    "content", [b"", b"this is a text, not a film\n" * 50, bytes(5000)], ids=["empty", "text", "zeros"]
)
def test_not_a_video(videos: Path, workspace: Path, untouched: Watch, content: bytes) -> None:
    (videos / "cat.mp4").write_bytes(content)
    untouched(videos)
    refused(run(videos, workspace), "cat.mp4")
    no_results(workspace, "frames")


def test_sound_without_pictures(videos: Path, workspace: Path, untouched: Watch) -> None:
    with av.open(str(videos / "cat.mp4"), "w") as container:
        stream = container.add_stream("aac", rate=44100)
        frame = av.AudioFrame.from_ndarray(np.zeros((1, 4096), np.float32), format="fltp", layout="mono")
        frame.sample_rate, frame.pts, frame.time_base = 44100, 0, Fraction(1, 44100)
        container.mux(stream.encode(frame))
        container.mux(stream.encode())
    untouched(videos)
    refused(run(videos, workspace), "cat.mp4", "video")
    no_results(workspace, "frames")


@pytest.mark.parametrize("faststart", [False, True], ids=["index-lost", "index-kept"])
def test_truncated(videos: Path, workspace: Path, untouched: Watch, faststart: bool) -> None:
    path = videos / "cat.mp4"
    images = moving_square(24)
    with av.open(str(path), "w", options={"movflags": "+faststart"} if faststart else {}) as container:
        stream = container.add_stream("libx264", rate=20, options={"g": "1", "crf": "10"})
        stream.height, stream.width, stream.pix_fmt = 72, 72, "yuv420p"
        for image in images:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")))
        container.mux(stream.encode())
    path.write_bytes(path.read_bytes()[: path.stat().st_size * 6 // 10])
    untouched(videos)
    refused(run(videos, workspace), "cat.mp4")
    no_results(workspace, "frames")


def test_eight_pixels(videos: Path, workspace: Path, untouched: Watch) -> None:
    with av.open(str(videos / "cat.mkv"), "w") as container:
        stream = container.add_stream("ffv1", rate=20)
        stream.height, stream.width, stream.pix_fmt = 8, 8, "yuv420p"
        for t in range(6):
            image = np.full((8, 8, 3), 40 * t, np.uint8)
            container.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")))
        container.mux(stream.encode())
    untouched(videos)
    refused(run(videos, workspace), "cat.mkv", "8x8")
    no_results(workspace, "frames")


def test_one_frame(videos: Path, workspace: Path) -> None:
    write_video(videos / "cat.mp4", moving_square(1), 20)
    refused(run(videos, workspace), "cat.mp4", "frame")
    no_results(workspace, "frames")


def test_no_frames_left_after_filtering(videos: Path, workspace: Path) -> None:
    write_video(videos / "cat.mp4", moving_square(), 20)
    refused(run(videos, workspace, "--frames.start_s", "1000"), "cat.mp4", "frame")
    no_results(workspace, "frames")


def test_link_to_nothing(videos: Path, workspace: Path) -> None:
    (videos / "cat.mp4").symlink_to(videos / "gone.mp4")
    refused(run(videos, workspace), "cat.mp4", "link")


def test_unreadable(clips: Path, videos: Path, workspace: Path) -> None:
    """A clip whose permissions forbid reading it."""
    shutil.copyfile(clips / "cat-00.mp4", videos / "cat.mp4")
    (videos / "cat.mp4").chmod(0o000)
    before: tuple[str, ...] = ()
    if os.geteuid() == 0:  # root reads everything unless it lays its capabilities down
        before = ("setpriv", "--bounding-set=-dac_override,-dac_read_search")
        if shutil.which("setpriv") is None:
            pytest.skip("run as root, and there is no setpriv to lay privileges down")
    outcome = run_banmo("run", videos, "--workspace", workspace, before=before)
    refused(outcome, "cat.mp4", "permission")
    no_results(workspace, "frames")


def test_same_name_twice(videos: Path, workspace: Path, untouched: Watch) -> None:
    write_video(videos / "cat.mp4", moving_square(), 20)
    write_video(videos / "cat.mov", moving_square(), 20)
    untouched(videos)
    refused(run(videos, workspace), "cat.mov", "cat.mp4", "same name")
    assert not (workspace / "objects").exists() or not list((workspace / "objects").iterdir())


@pytest.mark.parametrize(
    "name", ["two words", "katze-äöü-猫", "-rf", "line\nbreak", "..", "a..b", "$(touch x);&", "'quoted\""]
)
def test_odd_names_work_and_stay_inside(tmp_path: Path, contracts: Path, name: str) -> None:
    """A clip may be called anything; its results lie inside the workspace and lines of output stay lines."""
    videos, workspace = tmp_path / "odd videos", tmp_path / "work space"
    videos.mkdir()
    shutil.copytree(contracts, workspace / "cache")
    if name == "..":  # a hidden file is not a clip, and a folder above is not either
        write_video(videos / "cat.mp4", moving_square(), 20)
        outcome = run_banmo("run", videos, "--workspace", workspace, "--video", "../cat")
        refused(outcome, "../cat")
        return
    write_video(tmp_path / "plain.mp4", moving_square(), 20)
    (tmp_path / "plain.mp4").rename(videos / f"{name}.mp4")
    before = {p.name for p in tmp_path.iterdir()}
    outcome = run(videos, workspace, "--until", "frames")
    assert outcome.code == 0, outcome.text
    assert {p.name for p in tmp_path.iterdir()} == before
    assert check_store(workspace) == 1
    shown = list((workspace / "latest" / "videos").iterdir())
    assert len(shown) == 1
    assert "\n" not in shown[0].name and "/" not in shown[0].name and not shown[0].name.startswith(("-", "."))
    again = run(videos, workspace, "--until", "frames")
    assert again.code == 0 and "up to date" in again.out


# --------------------------------------------------------------------------- what lies beside a clip


@pytest.fixture
def given(clips: Path, videos: Path) -> Path:
    """One clip with true masks and poses beside it, writable."""
    for suffix in (".mp4", ".masks.mp4", ".poses.json"):
        shutil.copyfile(clips / f"cat-00{suffix}", videos / f"cat{suffix}")
    return videos


def test_too_few_masks(given: Path, workspace: Path, untouched: Watch) -> None:
    write_video(given / "cat.masks.mp4", np.zeros((5, 72, 72), np.uint8), 20, lossless=True)
    untouched(given)
    refused(run(given, workspace, "--until", "masks"), "cat.masks.mp4", "5", "8")
    no_results(workspace, "masks")


def test_masks_of_another_shape(given: Path, workspace: Path) -> None:
    write_video(given / "cat.masks.mp4", np.zeros((8, 72, 144), np.uint8), 20, lossless=True)
    refused(run(given, workspace, "--until", "masks"), "cat.masks")
    no_results(workspace, "masks")


Change = Callable[[dict[str, list]], None]


def _nan(poses: dict[str, list]) -> None:
    poses["object_to_camera"][3][0][3] = float("nan")


def _stretched(poses: dict[str, list]) -> None:
    poses["object_to_camera"][5] = (np.diag([2.0, 2, 2, 1]) @ np.array(poses["object_to_camera"][5])).tolist()


def _mirrored(poses: dict[str, list]) -> None:
    poses["object_to_camera"] = (np.diag([-1.0, 1, 1, 1]) @ np.array(poses["object_to_camera"])).tolist()


def _short(poses: dict[str, list]) -> None:
    poses["object_to_camera"] = poses["object_to_camera"][:5]


def _without(poses: dict[str, list]) -> None:
    del poses["object_to_camera"]


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (_nan, ("3", "finite")),
        (_stretched, ("5", "rigid")),
        (_mirrored, ("rigid",)),
        (_short, ("5", "8")),
        (_without, ("object_to_camera",)),
    ],
    ids=["nan", "stretched", "mirrored", "too-few", "missing"],
)
def test_bad_poses(given: Path, workspace: Path, untouched: Watch, change: Change, words: tuple[str, ...]) -> None:
    path = given / "cat.poses.json"
    poses = json.loads(path.read_text())
    change(poses)
    path.write_text(json.dumps(poses))
    untouched(given)
    refused(run(given, workspace, "--until", "poses"), "cat.poses.json", *words)
    no_results(workspace, "poses")


def test_poses_that_are_no_json(given: Path, workspace: Path) -> None:
    (given / "cat.poses.json").write_text('{"K": [[1, 0')
    refused(run(given, workspace, "--until", "poses"), "cat.poses.json")


def test_one_bad_clip_does_not_spoil_the_others(given: Path, workspace: Path, untouched: Watch) -> None:
    (given / "broken.mp4").write_bytes(b"not a film")
    untouched(given)
    outcome = run(given, workspace, "--until", "masks")
    refused(outcome, "broken.mp4")
    assert check_store(workspace) == 2, "frames and masks of the good clip are kept"
    rest = run(given, workspace, "--until", "masks", "--skip-video", "broken")
    assert rest.code == 0 and "up to date" in rest.out


# --------------------------------------------------------------------------- settings and the command line


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (("--masks.treshold", "0.4"), ("treshold", "threshold")),
        (("--maks.threshold", "0.4"), ("maks", "masks")),
        (("--masks.threshold", "many"), ("threshold", "number")),
        (("--preset", "previw"), ("previw", "preview")),
        (("--stage", "mask"), ("mask", "masks")),
        (("--video", "dog"), ("dog",)),
    ],
)
def test_misspelt(given: Path, workspace: Path, words: tuple[str, str], expected: tuple[str, ...]) -> None:
    refused(run(given, workspace, *words), *expected)
    no_results(workspace, "frames")


def test_unknown_key_in_the_file(given: Path, workspace: Path) -> None:
    (workspace / "pipeline.toml").write_text("[frames]\nmax_side = 100\n")
    refused(run(given, workspace), "max_side", "max_side_px", "pipeline.toml")
    no_results(workspace, "frames")
