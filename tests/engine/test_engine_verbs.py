"""Verbs that a pipeline brings with it, and what they may read."""

from __future__ import annotations

import io
import shutil
import sys
from pathlib import Path

import pytest

from pipeline import BadInput, Results
from pipeline.console import progress
from tests.engine.laboratory import Lab

VERB = '''"""A verb."""
import argparse
from pipeline import Results

SUMMARY = "count the words"
EXAMPLES = ("banmo count cat",)


def arguments(parser: argparse.ArgumentParser) -> None:
    """Its flags."""
    parser.add_argument("video")
    parser.add_argument("--twice", action="store_true", help="count them again")


def run(args: argparse.Namespace, results: Results) -> int:
    """Count."""
    words = len(list(results.folder("words", args.video).path.iterdir()))
    with results.publish_dir("counts") as out:
        (out / "count.txt").write_text(str(words * (2 if args.twice else 1)))
    return 0
'''


@pytest.fixture
def verbs(lab: Lab, monkeypatch: pytest.MonkeyPatch) -> Lab:
    """The toy pipeline with a verb."""
    (lab.package / "count.py").write_text(VERB)
    init = lab.package / "__init__.py"
    init.write_text(init.read_text() + '\nVERBS = {"count": "toy.count", "lost": "toy.lost"}\n')
    monkeypatch.syspath_prepend(str(lab.root))
    for name in [n for n in sys.modules if n == "toy" or n.startswith("toy.")]:
        monkeypatch.delitem(sys.modules, name)
    yield lab  # type: ignore[misc]
    for name in [n for n in sys.modules if n == "toy" or n.startswith("toy.")]:
        del sys.modules[name]


def test_a_verb_of_the_pipeline_runs_on_its_results(verbs: Lab) -> None:
    assert verbs.run().code == 0
    assert verbs.command("count", "cat", "--twice").code == 0, "the workspace remembers its pipeline"
    assert (verbs.workspace / "counts" / "count.txt").read_text() == "6"
    assert verbs.command("count", "dog").code == 0, "made again, in place of the first"
    assert (verbs.workspace / "counts" / "count.txt").read_text() == "3"
    assert not list(verbs.workspace.glob(".counts*"))


def test_adding_a_verb_reruns_nothing(verbs: Lab) -> None:
    assert verbs.run().code == 0
    init = verbs.package / "__init__.py"
    init.write_text(init.read_text().replace('"lost"', '"mislaid"'))
    assert verbs.pending() == {}


def test_help_lists_verbs_and_says_what_they_do(verbs: Lab) -> None:
    verbs.run()
    with pytest.raises(SystemExit):
        verbs.command("count", "--help")
    told = verbs.capture().out
    assert "Count the words." in told and "banmo count cat" in told and "--twice" in told and "exit codes" in told
    outcome = verbs.command("cuont")
    assert outcome.code == 2 and "did you mean count" in outcome.err


def test_faults_of_a_verb_are_one_sentence(verbs: Lab) -> None:
    verbs.run()
    for words, needle in (
        (("count", "cta"), "did you mean cat"),
        (("count", "cat", "--thrice"), "--twice"),
        (("count", "cat", "--words.count", "3"), "takes no settings"),
        (("lost",), "cannot be loaded"),
    ):
        outcome = verbs.command(*words)
        assert outcome.code in (1, 2) and outcome.err.count("\n") == 1 and needle in outcome.err, outcome.err


def test_results_tell_what_there_is(lab: Lab) -> None:
    with pytest.raises(BadInput, match="no workspace"):
        Results(lab.workspace)
    lab.run("--words.count", "4", "--until", "words")
    results = Results(lab.workspace)
    assert results.videos == ("cat", "dog") and results.source("cat") == lab.clips / "cat.mp4"
    assert results.settings("words")["count"] == 4
    with pytest.raises(BadInput, match="upper has no intact result for cat") as caught:
        results.folder("upper", "cat")
    assert "banmo run --until upper" in str(caught.value)
    with pytest.raises(BadInput, match="one result for each video"):
        results.folder("words")
    lab.run()
    results = Results(lab.workspace)
    assert results.folder("final").digest == lab.digests()["final"]
    labels = [(r.stage, r.video) for r in results.records()]
    assert len(labels) == len(set(labels)) == 8 and labels[-1][0] == "final"
    words = next(r for r in results.records() if (r.stage, r.video) == ("words", "cat"))
    assert words.metrics == {"count": 3} and "count 4 -> 3" in words.reason and words.seconds >= 0


def test_results_follow_the_last_run_back_to_an_earlier_setting(lab: Lab) -> None:
    lab.run("--words.count", "2")
    first = Results(lab.workspace).folder("final")
    lab.run("--words.count", "4")
    second = Results(lab.workspace).folder("final")
    lab.run("--words.count", "2")
    assert Results(lab.workspace).folder("final") == first != second


def test_damaged_results_are_not_shown_and_videos_may_be_gone(lab: Lab) -> None:
    lab.run()
    path = lab.object_path("upper/cat") / "inner" / "000.txt"
    path.chmod(0o644)
    path.write_text("x")
    shutil.move(lab.clips, lab.root / "elsewhere")
    results = Results(lab.workspace)
    with pytest.raises(BadInput, match="no intact result"):
        results.folder("upper", "cat")
    assert results.source("cat") is None and results.videos == ("cat", "dog")
    assert results.folder("words", "cat").path.is_dir()


def test_published_folders_replace_only_their_own(lab: Lab, tmp_path: Path) -> None:
    lab.run()
    results = Results(lab.workspace)
    for name in ("", "..", "objects", "objects/x", "../elsewhere", "latest"):
        with pytest.raises(BadInput), results.publish_dir(name):
            pass
    mine = lab.workspace / "mine"
    mine.mkdir()
    (mine / "thesis.txt").write_text("years")
    with pytest.raises(BadInput, match="not made by banmo"), results.publish_dir("mine"):
        pass
    (lab.workspace / "link").symlink_to(tmp_path / "outside")
    with pytest.raises(BadInput, match="out of the workspace"), results.publish_dir("link/inner"):
        pass
    with results.publish_dir("renders/walk") as out:
        (out / "a.txt").write_text("1")
    with pytest.raises(ZeroDivisionError), results.publish_dir("renders/walk") as out:
        (out / "a.txt").write_text(str(1 / 0))
    assert (lab.workspace / "renders" / "walk" / "a.txt").read_text() == "1"
    assert [p.name for p in (lab.workspace / "renders").iterdir()] == ["walk"]


def test_progress_passes_everything_on() -> None:
    stream = io.StringIO()
    assert list(progress(range(5), label="frames", stream=stream)) == [0, 1, 2, 3, 4]
    assert list(progress(iter("ab"), 0, stream=stream)) == ["a", "b"]
    assert stream.getvalue() == "", "quick work says nothing in a pipe"
