"""Commands that work on a finished reconstruction, through the real command line."""

from __future__ import annotations

import json
from pathlib import Path

import av
import numpy as np
import pytest
from PIL import Image

from stages.animating.glb import read_glb
from stages.animating.playing import Player
from synthetic.clips import write_clips
from tests.end_to_end.conftest import TINY, Outcome, run_banmo

Finished = tuple[Path, Outcome]


@pytest.fixture(scope="module")
def made(finished: Finished, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished workspace whose files these tests add to; none of them changes a result."""
    import shutil

    assert finished[1].code == 0, finished[1].text
    target = tmp_path_factory.mktemp("verbs") / "workspace"
    shutil.copytree(finished[0], target, symlinks=True)
    return target


def frames_of(path: Path) -> list[np.ndarray]:
    with av.open(str(path)) as container:
        return [f.to_ndarray(format="rgb24") for f in container.decode(video=0)]


def test_render_a_turn(made: Path) -> None:
    done = run_banmo("render", "--workspace", made, "--size", "64x48", "--seconds", "0.5", "--fps", "8")
    assert done.code == 0, done.text
    pictures = frames_of(made / "render" / "rest-turntable" / "colour.mp4")
    assert len(pictures) == 4 and pictures[0].shape == (48, 64, 3)
    assert np.abs(pictures[0].astype(float) - pictures[2]).mean() > 1, "the camera goes round"


def test_render_bullet_time_as_pictures_and_gif(made: Path) -> None:
    common = (
        "render",
        "--workspace",
        made,
        "--clip",
        "cat-00",
        "--at",
        "0.1",
        "--size",
        "48x48",
        "--seconds",
        "0.5",
        "--fps",
        "6",
    )
    done = run_banmo(*common, "--format", "png", "--show", "colour,silhouette,depth,normals,correspondence")
    assert done.code == 0, done.text
    folder = made / "render" / "cat-00-bullet"
    for kind in ("colour", "silhouette", "depth", "normals", "correspondence"):
        assert len(list((folder / kind).glob("*.png"))) == 3
    alpha = np.asarray(Image.open(folder / "colour" / "00000.png"))[..., 3]
    assert 0 < (alpha > 128).mean() < 1
    done = run_banmo(*common, "--format", "gif", "--to", "gifs")
    assert done.code == 0, done.text
    assert Image.open(made / "gifs" / "colour.gif").n_frames == 3


def test_render_along_a_path_and_through_the_clips_camera(made: Path, tmp_path: Path) -> None:
    path = tmp_path / "path.json"
    path.write_text(json.dumps({"keys": [{"at": 0, "azimuth": 0}, {"at": 0.5, "azimuth": 60, "elevation": 30}]}))
    common = ("render", "--workspace", made, "--clip", "cat-01")
    done = run_banmo(*common, "--path", path, "--size", "48x48", "--fps", "4")
    assert done.code == 0, done.text
    assert len(frames_of(made / "render" / "cat-01-path" / "colour.mp4")) == 3
    done = run_banmo(*common, "--filmed", "--show", "silhouette")
    assert done.code == 0, done.text
    shown = frames_of(made / "render" / "cat-01-filmed" / "silhouette.mp4")
    assert len(shown) == 8 and shown[0].shape == (72, 72, 3), "as many and as large as the clip"
    mask = next((made / "latest" / "videos" / "cat-01" / "masks").glob("00000.png"))
    there, drawn = np.asarray(Image.open(mask)) > 127, shown[0].mean(-1) > 127
    assert (there & drawn).sum() > 0.3 * there.sum(), "it stands where the clip shows it"


def test_animate_by_the_files_that_were_exported(made: Path) -> None:
    """A clip's motion as BVH, put onto the model again, is that clip's motion."""
    bvh = made / "exports" / "motion" / "cat-00.bvh"
    done = run_banmo("animate", "--workspace", made, "--from", bvh, "--name", "again")
    assert done.code == 0, done.text
    facts = json.loads((made / "animate" / "again" / "motion.json").read_text())
    assert not facts["still"] and facts["frames"] == 8
    player = Player.of(read_glb((made / "animate" / "again" / "model.glb").read_bytes()))
    glb = player.glb
    times = glb.animation("again").time_s
    old, new = (
        player.surface(player.scene(glb.animation(n), times, root_motion=motion))
        for n, motion in (("cat-00", False), ("again", False))
    )
    assert np.abs(old - new).max() < 5e-3
    moved = player.surface(player.scene(glb.animation("again"), times))
    filmed = player.surface(player.scene(glb.animation("cat-00"), times))
    assert np.abs(moved - filmed).max() < 1e-2, "with the motion of the whole"
    assert len(frames_of(made / "animate" / "again" / "preview.mp4")) >= 1


def test_retarget_a_clip_and_then_nothing(made: Path, tmp_path: Path) -> None:
    drive = tmp_path / "drive"
    drive.mkdir()
    write_clips(drive, clips=1, frames=7, size=72, seed=11, truth=True)
    clip = next(p for p in drive.glob("*.mp4") if ".masks" not in p.name)
    words = ("retarget", "--model", made, "--video", clip, "--track.iterations=6", "--track.frames_per_step=4",
             "--track.pixels_per_frame=24", "--track.probe_samples=16", "--track.fine_samples=4")  # fmt: skip
    done = run_banmo(*words)
    assert done.code == 0, done.text
    exports = made / "retarget" / clip.stem / "exports"
    assert str(exports / "model.glb") in done.out
    glb = read_glb((exports / "model.glb").read_bytes())
    assert [a.name for a in glb.animations] == ["cat-00", "cat-01", "cat-00 (driven)"], "a clip of that name stays"
    assert len(glb.animation("cat-00 (driven)").time_s) == 7
    before = read_glb((made / "exports" / "model.glb").read_bytes())
    np.testing.assert_array_equal(glb.attribute("POSITION"), before.attribute("POSITION"))
    assert len(frames_of(exports / f"overlay-{clip.stem}.mp4")) == 7
    assert json.loads((exports / "motion.json").read_text())["iou_mean"] > 0.1
    again = run_banmo(*words)
    assert again.code == 0 and "up to date" in again.out, again.text


def test_a_clip_that_is_added_joins_the_model(copy_of_finished: Path, clips: Path, tmp_path: Path) -> None:
    """Only what is new is computed; the fit goes on from the model that was there."""
    import shutil

    more = tmp_path / "more"
    shutil.copytree(clips, more)
    for path in more.iterdir():
        path.chmod(0o644)
    extra = tmp_path / "extra"
    write_clips(extra, clips=3, frames=8, size=72, seed=3, truth=True)
    for path in extra.glob("cat-02*"):
        shutil.copyfile(path, more / path.name)
    steps = ("--fit.iterations=8", "--correct.iterations=4", "--refine.iterations=4")
    done = run_banmo("extend", more, "--workspace", copy_of_finished, *TINY, *steps)
    assert done.code == 0, done.text
    assert "masks/cat-02: done" in done.out and "masks/cat-00: done" not in done.out
    glb = read_glb((copy_of_finished / "exports" / "model.glb").read_bytes())
    assert [a.name for a in glb.animations] == ["cat-00", "cat-01", "cat-02"]
    kept = next((copy_of_finished / "earlier").iterdir())
    before = json.loads((kept / "model.json").read_text())
    after = json.loads((copy_of_finished / "latest" / "fit" / "model.json").read_text())
    assert before["bones"] == after["bones"] and before["bounds"] == after["bounds"], "the same bones in the same box"
    assert f'warm = "earlier/{kept.name}"' in done.out


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("render", "--clip", "dog"), "no animation 'dog'"),
        (("render", "--at", "1"), "--clip"),
        (("render", "--show", "smell"), "smell"),
        (("render", "--size", "1x1"), "size"),
        (("render", "--glb", "nothing.glb"), "no such file"),
        (("render", "--to", "objects"), "cannot be the name"),
        (("animate", "--from", "nothing.bvh"), "cannot be read"),
        (("animate", "--from", "{bad}"), "not a BVH"),
        (("retarget", "--video", "nothing.mp4"), "no such clip"),
    ],
)
def test_what_cannot_be_done_is_said_in_a_sentence(
    made: Path, tmp_path: Path, words: tuple[str, ...], said: str
) -> None:
    bad = tmp_path / "bad.bvh"
    bad.write_text("nonsense")
    done = run_banmo(*(w.format(bad=bad) for w in words), "--workspace", made)
    assert done.code == 2, done.text
    assert said in done.err and "Traceback" not in done.err and len(done.err.strip().splitlines()) == 1


@pytest.mark.parametrize("verb", ["render", "retarget", "animate", "extend", "view"])
def test_every_command_explains_itself(made: Path, verb: str) -> None:
    done = run_banmo(verb, "--help", "--workspace", made)
    assert done.code == 0 and f"banmo {verb} " in done.out and "examples:" in done.out
