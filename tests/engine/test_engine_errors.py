"""What is wrong is said in one sentence, with the right exit code, and nothing half-done stays."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from tests.engine.laboratory import Lab, wait_for

SUGGESTIONS = {
    "--words.cuont 3": "did you mean count?",
    "--wrods.count 3": "did you mean words?",
    "--set words.cuont=3": "did you mean count?",
    "--set words": "section.key=value",
    "--until uper": "did you mean upper?",
    "--stage uper": "did you mean upper?",
    "--redo mrege": "did you mean merge?",
    "--video kat": "did you mean cat?",
    "--skip-video kat": "did you mean cat?",
    "--preset lrage": "did you mean large?",
    "--dry-rum": "did you mean --dry-run?",
    "--words.count three": "'three' is not a whole number",
    "--words.count 1.5": "is not a whole number",
    "--words.delay_s nan": "is not a finite number",
    "--merge.deaf perhaps": "is not true or false",
    "--upper.count 3": "[words] has it",
    "--pipeline.guard_minuts 3": "did you mean guard_minutes?",
}


@pytest.mark.parametrize("words", SUGGESTIONS)
def test_mistakes_on_the_command_line_get_a_suggestion(lab: Lab, words: str) -> None:
    outcome = lab.run(*words.split())
    assert outcome.code == 2
    assert SUGGESTIONS[words] in outcome.err
    assert outcome.err.count("\n") == 1
    assert not list((lab.workspace / "actions").glob("*/*.json"))


FILES = {
    "[words]\ncuont = 3": "did you mean count?",
    "[wrods]\ncount = 3": "did you mean words?",
    "count = 3": "it belongs under [words]",
    "[words]\ncount = 'x'": "is not a whole number",
    "[words]\ncount = true": "is not a whole number",
    "[words\n": "not valid TOML",
    "words = 3": "is a table",
    "[pipeline]\npreset = 3": "preset is a text",
    "[pipeline]\npreset = 'lrage'": "did you mean large?",
    "[execution]\ncpu = 3": "did you mean cpus?",
    "\xff": "",
}


@pytest.mark.parametrize("text", FILES)
def test_mistakes_in_pipeline_toml_get_a_suggestion(lab: Lab, text: str) -> None:
    lab.command("init", "--definition", str(lab.package))
    (lab.workspace / "pipeline.toml").write_bytes(text.encode("latin-1"))
    outcome = lab.run()
    assert outcome.code == 2
    assert FILES[text] in outcome.err and "pipeline.toml" in outcome.err + "pipeline.toml" * (text.count("lrage"))
    assert outcome.err.count("\n") == 1


def test_unknown_verbs_and_missing_workspaces(lab: Lab) -> None:
    assert "did you mean status?" in lab.command("statsu").err
    for verb in ("status", "verify", "gc", "pin"):
        outcome = lab.command(verb)
        assert outcome.code == 2 and "no workspace here" in outcome.err
    assert lab.command("run").code == 2
    assert not lab.workspace.exists(), "a mistake makes no workspace"
    lab.command("init", "--definition", str(lab.package))
    assert "no videos named" in lab.command("run").err
    assert lab.command("inspect", "words").code == 2


def test_help_of_every_verb_shows_examples(lab: Lab) -> None:
    from pipeline import cli

    for verb in ("", *cli._VERBS):
        with pytest.raises(SystemExit) as stop:
            cli.main([*([verb] if verb else []), "--help"])
        assert stop.value.code == 0
        text = lab.capture().out
        assert "exit codes" in text
        assert not verb or f"  banmo {verb}" in text


# ---------------------------------------------------------------------------------------------- workers


def test_bad_input_from_a_worker_is_exactly_one_sentence(lab: Lab) -> None:
    outcome = lab.run("--words.trouble", "bad_input")
    assert outcome.code == 2
    assert outcome.err == f"banmo: {lab.clips / 'cat.mp4'}: it has no words; write some\n"
    assert "Traceback" not in outcome.out
    assert set(lab.records()) == {"words/dog", "upper/dog", "measure/dog"}, "the others are kept"
    assert lab.command("verify", "--deep").code == 0


def test_a_failure_keeps_the_others_and_tells_where_to_look(lab: Lab) -> None:
    outcome = lab.run("--words.trouble", "fail")
    assert outcome.code == 1
    assert "words failed on cat" in outcome.err
    assert "RuntimeError: words failed" in outcome.err
    assert "banmo log words cat" in outcome.err and "--skip-video cat" in outcome.err
    assert set(lab.records()) == {"words/dog", "upper/dog", "measure/dog"}
    log = lab.command("log", "words", "cat").out
    assert "Traceback" in log and "garbage on standard output" in log
    assert "it had nothing to say" in lab.command("log", "upper", "dog").out
    status = lab.command("status").out
    assert "words/cat failed: RuntimeError" in status
    assert not (lab.workspace / "exports").exists()
    assert lab.run().code == 0
    assert "failed" not in lab.command("status").out


def test_fail_fast_stops_the_rest(lab: Lab) -> None:
    outcome = lab.run("--words.trouble", "fail", "--fail-fast", "--execution.cpus", "1")
    assert outcome.code == 1
    assert lab.records() == {}


@pytest.mark.parametrize(
    ("trouble", "text"),
    [
        ("crash", "crashed (SIGSEGV) in native code"),
        ("nothing", "it wrote no files"),
        ("link", "link is not an ordinary file"),
        ("check", "the check refuses"),
    ],
)
def test_a_stage_that_breaks_its_contract_publishes_nothing(lab: Lab, trouble: str, text: str) -> None:
    outcome = lab.run("--words.trouble", trouble, "--video", "cat", "--until", "words")
    assert outcome.code == 1
    assert text in outcome.err
    assert not list((lab.workspace / "objects").glob("*/*"))
    assert not list((lab.workspace / "tmp").iterdir())
    assert lab.command("verify", "--deep").code == 0


def test_the_disk_is_asked_before_the_start(lab: Lab) -> None:
    outcome = lab.run("--words.trouble", "huge")
    assert outcome.code == 2
    assert "are needed and" in outcome.err and outcome.err.count("\n") == 1
    assert lab.records() == {}


def test_code_that_changes_under_way_is_not_filed_under_the_old_key(lab: Lab) -> None:
    child = lab.spawn("--words.delay_s", "0.4", "--until", "upper", "--video", "cat")
    wait_for(lambda: list(lab.workspace.glob("runs/*/logs/words-cat.txt")))
    lab.edit("shouting.py", "upper()", "lower()")
    out, err = child.communicate(timeout=60)
    assert child.returncode == 1, out
    assert "the code changed after the run was planned" in err
    assert set(lab.records()) == {"words/cat"}


def test_a_stage_that_cannot_be_imported_spares_the_others(lab: Lab) -> None:
    (lab.package / "final.py").write_text("import nothing_of_this_name\n")
    outcome = lab.run()
    assert outcome.code == 2 and "stage final cannot be loaded: ModuleNotFoundError" in outcome.err
    assert lab.run("--until", "merge").code == 0
    assert "final cannot be loaded" in lab.command("status").out
    (lab.package / "final.py").write_text("def broken(:\n")
    assert "not valid Python" in lab.run().err


# ---------------------------------------------------------------------------------------------- videos


def clear(folder: Path) -> None:
    for path in folder.iterdir():
        path.unlink()


def test_a_folder_without_videos(lab: Lab) -> None:
    clear(lab.clips)
    assert "this folder is empty" in lab.run().err
    (lab.clips / "notes.txt").write_text("x")
    assert "no videos in this folder" in lab.run().err
    (lab.clips / "0.png").write_text("x")
    outcome = lab.run()
    assert outcome.code == 2 and "a folder of their own" in outcome.err
    assert lab.run(videos=lab.clips / "notes.txt").code == 2
    assert "there is no such folder" in lab.run(videos=lab.root / "nowhere").err
    assert not lab.workspace.exists()


def test_two_videos_with_one_stem_are_both_named(lab: Lab) -> None:
    (lab.clips / "cat.webm").write_text("x")
    outcome = lab.run()
    assert outcome.code == 2
    assert "cat.mp4" in outcome.err and "cat.webm" in outcome.err and outcome.err.count("\n") == 1


def test_strange_names(lab: Lab) -> None:
    clear(lab.clips)
    names = [
        "-rf.mp4",
        "my cat (1).mp4",
        "my-cat-1-.mp4",
        "..hidden..mp4",
        "a\nb.mov",
        "猫 と 犬.mkv",
        "Ünï.AVI",
        "x" * 200 + ".gif",
    ]
    names = [n for n in names if not n.startswith("..")] + ["a..b.mp4", "$(rm -rf *).mp4", "'\";.mp4"]
    for name in names:
        (lab.clips / name).write_text(name)
    (lab.clips / os.fsdecode(b"\xff\xfe.mp4")).write_text("undecodable")
    (lab.clips / "linked.mp4").symlink_to(lab.clips / "Ünï.AVI")
    outcome = lab.run("--until", "words")
    assert outcome.code == 0, outcome.err
    found = [s["video"] for s in lab.command("status", "--json").json["nodes"] if s["stage"] == "words"]
    assert len(set(found)) == len(names) + 2
    for name in found:
        assert name and not name.startswith(("-", ".")) and "/" not in name and name.isprintable() and " " not in name
        assert len(name.encode()) < 100
        assert (lab.workspace / "latest" / "videos" / name / "words" / "000.txt").is_file()
    assert {"rf", "猫-と-犬", "Ünï"} <= set(found)
    assert "1 done" in lab.run("--until", "words", "--video", "my cat (1).mp4", "--redo", "words").out


def test_links_to_nothing_pipes_and_folders(lab: Lab) -> None:
    (lab.clips / "gone.mp4").symlink_to(lab.clips / "nothing.mp4")
    assert "a link to nothing" in lab.run().err
    (lab.clips / "gone.mp4").unlink()
    os.mkfifo(lab.clips / "pipe.mp4")
    outcome = lab.run()
    assert outcome.code == 2 and "not an ordinary file" in outcome.err
    (lab.clips / "pipe.mp4").unlink()
    (lab.clips / "empty").mkdir()
    (lab.clips / "notes").mkdir()
    (lab.clips / "notes" / "a.txt").write_text("x")
    assert lab.run("--until", "words").code == 0


@pytest.mark.skipif(os.geteuid() == 0, reason="the superuser may read everything")
def test_unreadable_files_and_folders(lab: Lab) -> None:
    video = lab.clips / "cat.mp4"
    video.chmod(0)
    outcome = lab.run()
    assert outcome.code == 2 and "cannot be read" in outcome.err and "cat.mp4" in outcome.err
    video.chmod(0o644)
    lab.clips.chmod(0)
    assert "cannot be read" in lab.run().err
    lab.clips.chmod(0o755)


def test_unreadable_is_said_in_one_sentence(lab: Lab, monkeypatch: pytest.MonkeyPatch) -> None:
    """What an ordinary user sees; the superuser's tests simulate the refusal."""
    from pipeline import videos

    def refuse(path: Path) -> str:
        raise PermissionError(13, "Permission denied", str(path))

    monkeypatch.setattr(videos, "sha256_file", refuse)
    outcome = lab.run()
    assert outcome.code == 2
    assert outcome.err.startswith("banmo: ") and outcome.err.count("\n") == 1
    assert "cannot be read (Permission denied)" in outcome.err


def test_a_video_that_changes_while_it_is_read(lab: Lab) -> None:
    lab.edit(
        "words.py",
        "    hint = given",
        '    video.path.write_text("changed") if run.video == "cat" else 0\n    hint = given',
    )
    outcome = lab.run("--until", "words")
    assert outcome.code == 2 and "it changed while it was being read" in outcome.err
    assert set(lab.records()) == {"words/dog"}


def test_an_orphan_beside_no_video_is_mentioned(lab: Lab) -> None:
    (lab.clips / "cta.hint.txt").write_text("x")
    assert "note: cta.hint.txt belongs to no video here" in lab.run("--until", "words").out


def test_a_video_replaced_between_plan_and_start_is_planned_anew(lab: Lab) -> None:
    child = lab.spawn("--words.delay_s", "0.3", "--execution.cpus", "1", "--until", "words")
    wait_for(lambda: list(lab.workspace.glob("runs/*/logs/words-cat.txt")))
    (lab.clips / "dog.MOV").write_text("quite another dog")
    out, err = child.communicate(timeout=60)
    assert child.returncode == 0, out + err
    assert "quite another dog" in (lab.workspace / "latest/videos/dog/words/000.txt").read_text()
    assert lab.pending("--until", "words", "--words.delay_s", "0.3") == {}, "filed under what was read"


def test_a_video_that_vanishes_under_way_spares_the_others(lab: Lab) -> None:
    child = lab.spawn("--words.delay_s", "0.3", "--execution.cpus", "1", "--until", "words")
    wait_for(lambda: list(lab.workspace.glob("runs/*/logs/words-cat.txt")))
    (lab.clips / "dog.MOV").unlink()
    _, err = child.communicate(timeout=60)
    assert child.returncode == 2
    assert "dog.MOV: it cannot be read (no such file)" in err and err.count("\n") == 1
    assert set(lab.records()) == {"words/cat"}
