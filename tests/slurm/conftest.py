"""A cluster for the session, and a laboratory on it. Runs by name: ``make test-slurm``."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.engine.laboratory import Lab
from tests.slurm.cluster import Cluster, missing

CROWD = Path(__file__).resolve().parent / "crowd"


@pytest.fixture(scope="session")
def cluster(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Cluster]:
    """Two nodes, four GPUs; skipped with a reason where there is no Slurm."""
    if not os.environ.get("BANMO_SLURM"):
        pytest.skip("a cluster is started by name: make test-slurm")
    pytest.importorskip("submitit", reason="the extra `slurm` is not installed")
    reason = missing()
    if reason:
        pytest.skip(reason)
    found = Cluster(tmp_path_factory.mktemp("cluster"))
    found.start()
    yield found
    found.stop()


@pytest.fixture
def lab(
    cluster: Cluster, tmp_path: Path, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> Iterator[Lab]:
    """Two clips, the crowd's pipeline, and a workspace."""
    monkeypatch.delenv("BANMO_DEFINITION", raising=False)
    for name, value in cluster.environment.items():
        monkeypatch.setenv(name, value)
    shutil.copytree(CROWD, tmp_path / "crowd", ignore=shutil.ignore_patterns("__pycache__"))
    clips = tmp_path / "clips"
    clips.mkdir()
    for i in range(2):
        (clips / f"c{i}.mp4").write_text(f"clip {i}")
    yield SlurmLab(tmp_path, capfd.readouterr)
    cluster.command("scancel", "--user", "root")


class SlurmLab(Lab):
    """A laboratory whose pipeline is the crowd's."""

    @property
    def package(self) -> Path:
        return self.root / "crowd"
