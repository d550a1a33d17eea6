"""The main path: run, run again, change something, run what follows."""

from __future__ import annotations

import hashlib
import json
import subprocess
import sys
from pathlib import Path

from tests.engine.laboratory import Lab

EVERYTHING = {"words/cat", "words/dog", "upper/cat", "upper/dog", "measure/cat", "measure/dog", "merge", "final"}


def test_first_run_makes_everything_and_says_so(lab: Lab) -> None:
    outcome = lab.run()
    assert outcome.code == 0
    assert "8 done, 0 up to date" in outcome.out
    assert set(lab.records()) == EVERYTHING
    exports = lab.workspace / "exports"
    assert f"exports: {exports}" in outcome.out
    assert (exports / "parts" / "cat.txt").read_text().startswith("0 A CAT THAT WALKS !")
    assert not (exports / "parts" / "cat.txt").is_symlink()
    provenance = json.loads((exports / "provenance.json").read_text())
    assert provenance["videos"]["cat"]["sha256"] == hashlib.sha256(b"a cat that walks").hexdigest()
    latest = lab.workspace / "latest"
    assert (latest / "videos" / "cat" / "words" / "000.txt").read_text() == "0 a cat that walks "
    assert (latest / "final" / "final.txt").is_file()
    assert (lab.workspace / "tmp").exists() is False or not list((lab.workspace / "tmp").iterdir())


def test_provenance_tells_software_and_where_files_come_from(lab: Lab) -> None:
    table = lab.root / "table.txt"
    table.write_text("walks runs\n")
    table.with_suffix(".toml").write_text('[about]\nlicence = "MIT"\nsource = "somewhere"\n')
    lab.run(f"--words.table={table}")
    provenance = json.loads((lab.workspace / "exports" / "provenance.json").read_text())
    assert provenance["software"]["python"].count(".") == 2
    named = provenance["files_of_settings"]["words.table"]
    assert named == {"path": str(table), "about": {"licence": "MIT", "source": "somewhere"}}
    assert provenance["settings"]["words"]["table"] == str(table)


def test_second_run_does_nothing_and_imports_nothing_heavy(lab: Lab) -> None:
    lab.run()
    runs = list((lab.workspace / "runs").iterdir())
    code = (
        "import sys; from pipeline.cli import main; code = main(sys.argv[1:]);"
        "heavy = sorted({'torch', 'numpy', 'cv2', 'av', 'rich', 'toy'} & set(sys.modules));"
        "print('heavy:', heavy); sys.exit(code)"
    )
    child = subprocess.run(
        [sys.executable, "-c", code, "run", "--workspace", str(lab.workspace)], capture_output=True, text=True
    )
    assert child.returncode == 0, child.stderr
    assert "everything is up to date: 8 results" in child.stdout
    assert "heavy: []" in child.stdout
    assert list((lab.workspace / "runs").iterdir()) == runs, "a run that does nothing leaves nothing"


def test_a_changed_setting_reruns_its_stage_and_what_follows_only(lab: Lab) -> None:
    lab.run()
    before = lab.digests()
    outcome = lab.run("--upper.mark", "?")
    assert outcome.code == 0
    assert "4 done, 4 up to date" in outcome.out
    after = lab.digests()
    changed = {label for label in EVERYTHING if before[label] != after[label]}
    assert changed == {"upper/cat", "upper/dog", "merge", "final"}
    assert "everything is up to date" in lab.run().out, "the old results are still there"


def test_equal_bytes_stop_the_rerun(lab: Lab) -> None:
    lab.run()
    outcome = lab.run("--words.delay_s", "0.001")
    assert "2 done, 6 up to date" in outcome.out


def test_a_new_video_runs_alone_and_then_the_scene(lab: Lab) -> None:
    lab.run()
    (lab.clips / "fox.webm").write_text("a fox")
    assert "5 done, 6 up to date" in lab.run().out
    assert lab.pending("--skip-video", "fox") == {}
    assert set(lab.pending("--skip-video", "fox", "--skip-video", "dog")) == {"merge", "final"}


def test_stage_until_video_redo(lab: Lab) -> None:
    assert "2 done" in lab.run("--until", "words").out
    assert "1 done, 1 up to date" in lab.run("--stage", "upper", "--video", "cat").out
    assert not (lab.workspace / "exports").exists()
    assert lab.run().code == 0
    assert set(lab.pending("--redo", "upper")) == {"upper/cat", "upper/dog", "merge", "final"}
    assert lab.pending("--redo", "upper", "--video", "cat", "--stage", "upper") == {"upper/cat": ["asked for"]}
    started = lab.records()["upper/cat"].finished
    outcome = lab.run("--redo", "upper")
    assert "2 done, 6 up to date" in outcome.out, "the same bytes again: nothing follows"
    assert lab.records()["upper/cat"].finished > started
    assert set(lab.pending("--redo", "ends")) == {"merge", "final"}


def test_dry_run_and_check(lab: Lab) -> None:
    dry = lab.run("-n")
    assert dry.code == 0 and "8 of 8 to run" in dry.out
    assert not list((lab.workspace / "actions").glob("*/*.json"))
    assert lab.run("--check").code == 10
    lab.run()
    assert lab.run("--check").code == 0
    assert "everything is up to date" in lab.run("-n").out


def test_settings_layers_and_presets(lab: Lab) -> None:
    lab.command("init", "--definition", str(lab.package))
    (lab.workspace / "pipeline.toml").write_text('[words]\ncount = 2\n[upper]\nmark = "."\n')
    lab.run("--preset", "large", "--upper.mark", "~")
    texts = sorted((lab.workspace / "latest/videos/cat/upper/inner").iterdir())
    assert len(texts) == 2, "pipeline.toml beats the preset"
    assert texts[0].read_text().endswith("~"), "the command line beats pipeline.toml"
    (lab.workspace / "pipeline.toml").write_text("")
    outcome = lab.run("--preset", "large")
    assert len(list((lab.workspace / "latest/videos/cat/words").iterdir())) == 9
    assert "warning: words/cat: so many words" in outcome.out


def test_a_file_counts_by_its_content_not_by_its_path(lab: Lab) -> None:
    one, two = lab.root / "one.txt", lab.root / "two.txt"
    one.write_text("table")
    two.write_text("table")
    lab.run("--words.table", str(one))
    assert lab.pending("--words.table", str(two)) == {}
    two.write_text("other")
    assert lab.pending("--words.table", str(two))["words/cat"] == ["settings"]
    missing = lab.run("--words.table", str(lab.root / "none.txt"))
    assert missing.code == 2 and "none.txt" in missing.err


def test_what_lies_beside_a_video_counts(lab: Lab) -> None:
    lab.run()
    (lab.clips / "cat.hint.txt").write_text("it is grey")
    assert set(lab.pending()) == {"words/cat", "upper/cat", "measure/cat", "merge", "final"}
    lab.run()
    assert "it is grey" in (lab.workspace / "latest/videos/cat/words/000.txt").read_text()
    (lab.clips / "cat.extra").mkdir()
    (lab.clips / "cat.extra" / "0.png").write_text("x")
    assert lab.pending()["words/cat"] == ["input"]
    names = {v["video"] for v in lab.command("status", "--json").json["nodes"] if v["video"]}
    assert names == {"cat", "dog"}, "what lies beside a video is no video"


def test_users_files_in_exports_survive(lab: Lab) -> None:
    lab.run()
    exports = lab.workspace / "exports"
    (exports / "notes.md").write_text("mine")
    (exports / "final.txt").write_text("edited")
    lab.run("--upper.mark", "?")
    assert (exports / "notes.md").read_text() == "mine"
    kept = list(exports.glob("kept-*/final.txt"))
    assert len(kept) == 1 and kept[0].read_text() == "edited"
    assert (exports / "final.txt").read_text() != "edited"


def test_the_users_files_are_never_touched(lab: Lab) -> None:
    pictures = lab.clips / "walk"
    pictures.mkdir()
    for i in range(3):
        (pictures / f"{i}.png").write_text(str(i))
    files = [p for p in sorted(lab.clips.rglob("*")) if p.is_file()]
    for path in files:
        path.chmod(0o444)
    for folder in (pictures, lab.clips):
        folder.chmod(0o555)
    before = {p: (p.read_bytes(), p.stat().st_mtime_ns, p.stat().st_ctime_ns) for p in files}
    assert lab.run().code == 0
    assert lab.run("--upper.mark", "?").code == 0
    assert {p for p in lab.clips.rglob("*") if p.is_file()} == set(files)
    assert {p: (p.read_bytes(), p.stat().st_mtime_ns, p.stat().st_ctime_ns) for p in files} == before
    lab.clips.chmod(0o755)
    pictures.chmod(0o755)


def test_a_video_replaced_with_the_same_size_and_time_is_noticed(lab: Lab) -> None:
    import os

    lab.run()
    video = lab.clips / "cat.mp4"
    status = video.stat()
    video.write_text("a cat that talks")
    os.utime(video, ns=(status.st_atime_ns, status.st_mtime_ns))
    assert video.stat().st_size == status.st_size
    assert "words/cat" in lab.pending()


def test_workspace_may_lie_anywhere_and_paths_do_not_count(lab: Lab, tmp_path: Path) -> None:
    lab.run()
    keys = {r.key for r in lab.records().values()}
    other = tmp_path / "elsewhere"
    lab.clips.rename(tmp_path / "renamed clips")
    lab.workspace.rename(other)
    from pipeline.cli import main

    lab.capture()
    arguments = ["run", str(tmp_path / "renamed clips"), "--workspace", str(other), "--definition", str(lab.package)]
    assert main(arguments) == 0
    assert "everything is up to date" in lab.capture().out
    assert {p.stem for p in (other / "actions").glob("*/*.json")} == keys


def test_a_workspace_is_made_from_the_template_beside_the_pipeline(lab: Lab) -> None:
    template = lab.root / "workspace_template"
    template.mkdir()
    (template / "pipeline.toml").write_text("[words]\ncount = 2\n")
    (template / "README.md").write_text("read me")
    assert lab.run("--until", "words").code == 0
    assert (lab.workspace / "README.md").read_text() == "read me"
    assert lab.records()["words/cat"].files == 2
    (lab.workspace / "README.md").write_text("mine")
    lab.command("init", "--definition", str(lab.package))
    assert (lab.workspace / "README.md").read_text() == "mine"
