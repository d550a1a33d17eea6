"""The laboratory as a fixture."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from tests.engine.laboratory import TOY, Lab


@pytest.fixture
def lab(tmp_path: Path, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> Lab:
    """Two clips and a fresh workspace."""
    monkeypatch.delenv("BANMO_DEFINITION", raising=False)
    shutil.copytree(TOY, tmp_path / "toy", ignore=shutil.ignore_patterns("__pycache__"))
    clips = tmp_path / "clips"
    clips.mkdir()
    (clips / "cat.mp4").write_text("a cat that walks")
    (clips / "dog.MOV").write_text("a dog that sits")
    return Lab(tmp_path, capfd.readouterr)
