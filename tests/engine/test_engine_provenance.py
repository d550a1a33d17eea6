"""Files that come with a pipeline are named in the provenance of what used them, with licence, source and digest."""

from __future__ import annotations

import hashlib
import tomllib
from pathlib import Path

import stages
from pipeline.exports import _brought_along

STAGES = Path(stages.__file__).parent


def test_only_what_was_used_is_named_and_by_whom(tmp_path: Path) -> None:
    (tmp_path / "weights").mkdir()
    (tmp_path / "weights" / "a.bin").write_bytes(b"a")
    (tmp_path / "weights" / "b.bin").write_bytes(b"b")
    (tmp_path / "weights" / "about.toml").write_text(
        '["a.bin"]\nlicence = "MIT"\nknown_by = ["a.bin", "kind=cat"]\n'
        '["b.bin"]\nlicence = "MIT"\nknown_by = ["b.bin"]\n'
    )
    said = {"words/one": {"network": "a.bin"}, "words/two": {"kind": "cat"}, "final": {"sort": "cat"}}
    expected = {"licence": "MIT", "sha256": hashlib.sha256(b"a").hexdigest(), "used_by": ["words/one", "words/two"]}
    assert _brought_along(tmp_path, said) == {"a.bin": expected}
    (tmp_path / "inner").mkdir()
    assert set(_brought_along(tmp_path / "inner", said)) == {"a.bin"}  # a pipeline inside the package
    assert _brought_along(tmp_path, {}) == {}


def test_a_pipeline_without_such_files_has_none(tmp_path: Path) -> None:
    (tmp_path / "own").mkdir()
    assert _brought_along(tmp_path / "own", {"words": {"network": "a.bin"}}) == {}


def test_every_file_of_ours_has_its_licence() -> None:
    table = tomllib.loads((STAGES / "weights" / "about.toml").read_text(encoding="utf-8"))
    shipped = {p.name for p in (STAGES / "weights").iterdir() if p.suffix in (".onnx", ".npz")}
    assert shipped == set(table)
    assert all(row["licence"] == "Apache-2.0" and row["source"] and row["known_by"] for row in table.values())


def test_a_quadrupeds_networks_are_found_by_what_the_stages_say() -> None:
    said = {
        "features/fox": {"network": "posenet-quadruped.onnx", "category": "quadruped"},
        "flow/fox": {"provider": "dis"},
    }
    found = _brought_along(STAGES, said)
    assert set(found) == {"posenet-quadruped.onnx"}
    masks = {"found_by": "finder-int8.onnx", "category_prior": "quadruped", "refined_by": "refine-int8.onnx"}
    found = _brought_along(STAGES, {"masks/fox": {**masks, "found_again_by": "none"}})
    assert set(found) == {"finder-int8.onnx", "refine-int8.onnx"}
    followed = _brought_along(STAGES, {"posture": {"limbs": "quadruped"}})
    assert set(followed) == {"quadruped.npz", "quadruped-skeleton.npz"}
    assert all(len(row["sha256"]) == 64 for row in found.values())
    assert "human.npz" not in _brought_along(STAGES / "retargeting", said)
