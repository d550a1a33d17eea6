"""What the documents and the Makefile promise exists."""

from __future__ import annotations

import re
import shutil
import subprocess
from pathlib import Path

import pytest

from benchmarks.tier_a import place
from pipeline.errors import ExitCode

ROOT = Path(__file__).resolve().parent.parent
DOCUMENTS = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md")), ROOT / "workspace_template" / "README.md"]


def make(*words: str) -> str:
    if shutil.which("make") is None:
        pytest.skip("no make here")
    done = subprocess.run(["make", "-n", *words], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.parametrize("path", DOCUMENTS, ids=lambda p: str(p.relative_to(ROOT)))
def test_links_lead_somewhere(path: Path) -> None:
    for target in re.findall(r"\]\(([^)#]+)\)", path.read_text(encoding="utf-8")):
        if not target.startswith("http"):
            assert (path.parent / target).exists(), f"{path.name} links to {target}"


def test_documented_make_targets_exist() -> None:
    text = "\n".join(p.read_text(encoding="utf-8") for p in DOCUMENTS)
    targets = set(re.findall(r"^\s*make ([a-z-]+)\b", text, re.M)) | set(re.findall(r"`make ([a-z-]+)\b", text))
    assert {"reconstruct", "test", "status"} <= targets
    known = re.findall(r"^([a-z-]+):.*##", (ROOT / "Makefile").read_text(encoding="utf-8"), re.M)
    assert targets <= set(known)


def test_make_passes_paths_with_spaces_whole() -> None:
    lines = make("reconstruct", "VIDEOS=my clips/", "WORKSPACE=my work", "PRESET=preview", "ARGS=--fit.iterations 3")
    assert 'run "my clips/" --workspace "my work" --preset "preview"' in lines
    assert "--fit.iterations 3" in lines


def test_make_without_videos_films_its_own() -> None:
    lines = make("reconstruct")
    assert "synthetic.clips" in lines and 'run "build/sample-clips"' in lines
    assert "synthetic.clips" not in make("reconstruct", "VIDEOS=clips")


def test_every_exit_code_is_documented() -> None:
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    documented = {int(code) for code in re.findall(r"^\| (\d+) \|", text, re.M)}
    assert documented == {int(code) for code in ExitCode}


def test_true_masks_and_poses_are_put_beside_the_clips(tmp_path: Path) -> None:
    data = tmp_path / "fox"
    for folder, name in (("videos", "fox-00.mp4"), ("masks", "fox-00.mp4"), ("gt", "fox-00.json")):
        path = data / "clean" / folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(folder)
    place(data, "clean", tmp_path / "out")
    found = {p.name: p.read_text() for p in (tmp_path / "out").iterdir()}
    assert found == {"fox-00.mp4": "videos", "fox-00.masks.mp4": "masks", "fox-00.poses.json": "gt"}
    place(data, "clean", tmp_path / "raw", without="both")
    assert [p.name for p in (tmp_path / "raw").iterdir()] == ["fox-00.mp4"]
    (data / "clean" / "gt" / "fox-00.json").unlink()
    with pytest.raises(FileNotFoundError, match=r"fox-00\.json"):
        place(data, "clean", tmp_path / "out")
