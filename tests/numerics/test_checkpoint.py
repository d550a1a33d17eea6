"""Checkpoints: whole or absent, two kept, a torn one skipped, nothing unpickled."""

from __future__ import annotations

import hashlib
import json
import pickle
from pathlib import Path

import pytest
import torch

from stages.checkpoint import Checkpoints


def tensors(value: float) -> dict[str, torch.Tensor]:
    return {
        "model.weight": torch.full((3, 2), value).T,  # not contiguous
        "adam.0.0.step": torch.tensor(value),
        "counters": torch.tensor([int(value), 1]),
    }


def saved_three(root: Path) -> Checkpoints:
    checkpoints = Checkpoints(root)
    for step in (50, 100, 150):
        checkpoints.save(tensors(step), {"bones": step}, step, [{"step": step, "total": 0.5}])
    return checkpoints


def test_what_was_saved_comes_back(tmp_path: Path) -> None:
    latest = saved_three(tmp_path).latest()
    assert latest is not None
    assert latest.step == 150 and latest.description == {"bones": 150}
    assert latest.history == [{"step": 150, "total": 0.5}]
    assert latest.tensors.keys() == tensors(150).keys()
    assert all(torch.equal(latest.tensors[k], v) for k, v in tensors(150).items())
    assert set(latest.model_tensors()) == {"weight"}


def test_two_are_kept_and_no_scratch(tmp_path: Path) -> None:
    saved_three(tmp_path)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["step-000000100", "step-000000150"]


def test_saving_a_step_again_changes_nothing(tmp_path: Path) -> None:
    checkpoints = saved_three(tmp_path)
    checkpoints.save(tensors(-1), {"bones": -1}, 150, [])
    latest = checkpoints.latest()
    assert latest is not None and latest.description == {"bones": 150}


def test_none_where_there_is_none(tmp_path: Path) -> None:
    assert Checkpoints(tmp_path).latest() is None
    assert Checkpoints(tmp_path / "absent").latest() is None


@pytest.mark.parametrize("name", ["state.safetensors", "state.json"])
@pytest.mark.parametrize("damage", ["cut", "zeros", "bit", "empty", "gone"])
def test_a_torn_newest_is_skipped(tmp_path: Path, name: str, damage: str) -> None:
    checkpoints = saved_three(tmp_path)
    file = tmp_path / "step-000000150" / name
    data = file.read_bytes()
    if damage == "gone":
        file.unlink()
    else:
        middle = data.index(b"sha256") + 12 if name == "state.json" else len(data) - 5
        flipped = data[:middle] + bytes([data[middle] ^ 1]) + data[middle + 1 :]
        torn = {"cut": data[: len(data) // 2], "zeros": bytes(len(data)), "bit": flipped, "empty": b""}
        file.write_bytes(torn[damage])
    latest = checkpoints.latest()
    assert latest is not None and latest.step == 100
    assert torch.equal(latest.tensors["model.weight"], tensors(100)["model.weight"])


def test_none_when_all_are_torn(tmp_path: Path) -> None:
    checkpoints = saved_three(tmp_path)
    for file in tmp_path.glob("*/state.safetensors"):
        file.write_bytes(file.read_bytes()[:-1])
    assert checkpoints.latest() is None


def test_an_unfinished_save_is_no_checkpoint(tmp_path: Path) -> None:
    checkpoints = saved_three(tmp_path)
    (tmp_path / "saving-12345").mkdir()
    (tmp_path / "saving-12345" / "state.safetensors").write_bytes(b"half")
    (tmp_path / "step-notes.txt").write_text("not a folder")
    latest = checkpoints.latest()
    assert latest is not None and latest.step == 150


class Trap:
    """Marks the folder when it is unpickled."""

    def __init__(self, mark: Path) -> None:
        self.mark = mark

    def __reduce__(self) -> tuple:
        return Path.touch, (self.mark,)


def test_nothing_is_unpickled(tmp_path: Path) -> None:
    """A pickle in place of the tensors, its digest made to fit, does not run."""
    mark = tmp_path / "ran"
    data = pickle.dumps(Trap(mark))
    checkpoints = saved_three(tmp_path / "points")
    folder = tmp_path / "points" / "step-000000150"
    (folder / "state.safetensors").write_bytes(data)
    facts = json.loads((folder / "state.json").read_text())
    facts["sha256"] = hashlib.sha256(data).hexdigest()
    (folder / "state.json").write_text(json.dumps(facts))
    latest = checkpoints.latest()
    assert latest is not None and latest.step == 100
    assert not mark.exists()
    pickle.loads(data)  # noqa: S301 - the trap is a real one
    assert mark.exists()
