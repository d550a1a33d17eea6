"""What the live view shows; and its server, where viser is installed."""

from __future__ import annotations

import argparse
import importlib.util
import json
import os
import socket
import threading
import urllib.request
from pathlib import Path

import numpy as np
import pytest
import torch

from pipeline import BadInput
from pipeline.results import Results
from pipeline.workspace import Workspace
from stages.animating.glb import read_glb
from stages.animating.playing import Player
from stages.checkpoint import Checkpoints
from stages.verbs import view
from stages.viewing.content import LOOKS, Finished, Growing, ramp
from tests.numerics.analytic_scene import model_of, scene, sphere
from tests.numerics.test_animating import PLACES, TIMES, glb_bytes

VISER = importlib.util.find_spec("viser") is not None


@pytest.fixture
def finished() -> Finished:
    return Finished(Player.of(read_glb(glb_bytes())))


def test_a_moment_is_the_posed_surface_in_place(finished: Finished) -> None:
    assert finished.clips == ["walk"] and finished.seconds("walk") == pytest.approx(TIMES[-1])
    assert finished.seconds("at rest") == 0
    rest, moved = finished.at("at rest", 0.0, "colour"), finished.at("walk", 0.2, "colour")
    np.testing.assert_allclose(rest.vertices[:4], PLACES, atol=1e-5)
    assert np.abs(moved.vertices - rest.vertices).max() > 0.05
    assert rest.bones.shape == (3, 2, 3) and rest.colours.dtype == np.uint8


def test_every_look_has_colours(finished: Finished) -> None:
    assert "what was seen" not in finished.looks, "this file does not say"
    for look in finished.looks:
        assert look in LOOKS and finished.at("walk", 0.1, look).colours.shape == (12, 3)
    assert (finished.at("walk", 0.1, "bones' skin").colours != finished.at("walk", 0.1, "colour").colours).any()
    np.testing.assert_allclose(ramp(np.array([0.0, 1.0])), [[0.27, 0, 0.33], [0.99, 0.91, 0.14]])


def test_what_the_browser_plays_is_one_clip_in_place(finished: Finished) -> None:
    for look in finished.looks:
        glb = read_glb(finished.playing("walk", look))
        assert [a.name for a in glb.animations] == ["walk"]
        moved = {glb.names[t.node] for t in glb.animations[0].tracks}
        assert "root_motion" not in moved and "neck" in moved
        there = Player.of(glb)
        np.testing.assert_allclose(
            there.surface(there.scene(glb.animations[0], np.array([0.2])))[0],
            finished.at("walk", 0.2, look).vertices,
            atol=1e-5,
        )


def checkpoint(root: Path, step: int) -> None:
    model = model_of(scene(sphere(0.5), frames=2), lambda p: p.norm(dim=-1) - 0.5)
    tensors = {f"model.{k}": v for k, v in model.state_dict().items()}
    history = [{"step": s, "total": 1.0 / s} for s in range(1, step + 1)]
    Checkpoints(root).save(tensors, json.loads(json.dumps(model.describe())), step, history)


def test_the_newest_checkpoint_is_shown(tmp_path: Path) -> None:
    growing = Growing(tmp_path, resolution=32)
    assert not growing.refresh() and growing.shown is None
    checkpoint(tmp_path / "key", 3)
    assert growing.refresh() and growing.step == 3 and len(growing.loss) == 3
    assert growing.shown is not None
    radius = np.linalg.norm(growing.shown.vertices, axis=1)
    assert abs(float(radius.mean()) - 0.5) < 0.05
    corners = growing.shown.vertices[growing.shown.faces]
    outward = (np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]) * corners.mean(1)).sum(1)
    assert (outward > 0).mean() > 0.99, "faces look outward"
    assert not growing.refresh(), "nothing newer"
    checkpoint(tmp_path / "key", 5)
    newest = tmp_path / "key" / "step-000000005" / "state.json"
    os.utime(newest, (newest.stat().st_atime, newest.stat().st_mtime + 5))
    assert growing.refresh() and growing.step == 5


def arguments(**changes: object) -> argparse.Namespace:
    parser = argparse.ArgumentParser()
    view.arguments(parser)
    return argparse.Namespace(**{**vars(parser.parse_args([])), **changes})


def test_it_listens_on_this_machine_alone_unless_told() -> None:
    assert arguments().host == "127.0.0.1"


@pytest.mark.skipif(VISER, reason="viser is installed here")
def test_without_viser_it_says_how_to_get_it(tmp_path: Path) -> None:
    with pytest.raises(BadInput, match=r"\[view\]"):
        view.run(arguments(), Results(Workspace.open(tmp_path, create=True).root))


@pytest.mark.skipif(not VISER, reason="viser is not installed (pip install 'banmo-pipeline[view]')")
@pytest.mark.parametrize("fitting", [False, True])
def test_the_server_answers(tmp_path: Path, fitting: bool, capsys: pytest.CaptureFixture[str]) -> None:
    torch.set_num_threads(1)
    workspace = Workspace.open(tmp_path / "w", create=True)
    (tmp_path / "model.glb").write_bytes(glb_bytes())
    if fitting:
        checkpoint(workspace.checkpoints / "key", 3)
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    asked = arguments(port=port, seconds=6.0, glb=tmp_path / "model.glb", fitting=fitting)
    thread = threading.Thread(target=view.run, args=(asked, Results(workspace.root)))
    thread.start()
    page = b""
    for _ in range(50):
        try:
            page = urllib.request.urlopen(f"http://127.0.0.1:{port}", timeout=1).read()
            break
        except OSError:
            thread.join(0.1)
    thread.join()
    assert b"<html" in page.lower()
    assert f"http://127.0.0.1:{port}" in capsys.readouterr().out
