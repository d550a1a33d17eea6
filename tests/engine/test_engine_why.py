"""Every rerun has a reason; expensive reruns for code alone are asked about."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from pipeline.ledger import Ledger
from tests.engine.laboratory import Lab


def kinds(lab: Lab, stage: str, *words: str) -> list[str]:
    """Kinds of reasons of the first node of a stage."""
    row = lab.command("why", stage, *words, "--json").json[0]
    return [r["kind"] for r in row["reasons"]]


def test_never_run_and_up_to_date(lab: Lab) -> None:
    lab.run("--until", "words")
    assert kinds(lab, "words") == []
    assert kinds(lab, "measure") == ["never run"]
    assert "words/cat is up to date" in lab.command("why", "words", "cat").out


def test_settings_version_salt_damaged(lab: Lab) -> None:
    lab.run("--until", "words")
    assert kinds(lab, "words", "--words.count", "4") == ["settings"]
    text = lab.command("why", "words", "cat", "--words.count", "4").out
    assert "settings  count  3 -> 4" in text and "same  code, version, 2 inputs" not in text
    assert kinds(lab, "words", "--pipeline.salt", "x") == ["salt"]
    (lab.object_path("words/cat") / "000.txt").chmod(0o644)
    (lab.object_path("words/cat") / "000.txt").write_text("zap")
    assert kinds(lab, "words") == ["damaged"]
    lab.run("--until", "words")
    lab.edit("words.py", "version=1", "version=2")
    assert kinds(lab, "words") == ["version", "code"]


def test_reasons_recurse_to_the_root(lab: Lab) -> None:
    lab.run()
    text = lab.command("why", "merge", "--words.count", "4").out
    lines = [" ".join(line.split()) for line in text.splitlines()]
    assert lines[0].startswith("merge may run, once its inputs are known")
    assert "input upper/cat changed" in lines
    assert "because input words/cat changed" in lines
    assert "because settings count 3 -> 4" in lines
    row = lab.command("why", "merge", "--words.count", "4", "--json").json[0]
    inner = row["reasons"][0]["because"][0]["because"][0]
    assert inner == {"kind": "settings", "name": "count", "old": 3, "new": 4}


def test_an_input_that_already_changed_is_explained_by_its_records(lab: Lab) -> None:
    lab.run()
    lab.run("--until", "upper", "--upper.mark", "?")
    (lab.workspace / "pipeline.toml").write_text('[upper]\nmark = "?"\n')
    outcome = lab.run("-n", "--json")
    merge = next(s for s in outcome.json["steps"] if s["stage"] == "merge")
    assert [r["name"] for r in merge["reasons"]] == ["upper/cat", "upper/dog"]
    assert merge["reasons"][0]["because"][0]["name"] == "mark"


def test_videos_that_come_and_go_are_reasons(lab: Lab) -> None:
    lab.run()
    (lab.clips / "dog.MOV").rename(lab.root / "dog.MOV")
    names = {(r["name"], r.get("new")) for r in lab.command("why", "merge", "--json").json[0]["reasons"]}
    assert names == {("upper/dog", None), ("measure/dog", None)}


def test_a_code_edit_names_the_file(lab: Lab) -> None:
    lab.run()
    lab.edit("shouting.py", "# loud", "# silent")
    assert lab.pending() == {}
    lab.edit("shouting.py", "text.upper()", "text.lower().upper()")
    assert lab.pending()["upper/cat"] == ["code"]
    assert "code  toy/shouting.py" in lab.command("why", "upper", "cat").out
    assert "2 done, 6 up to date" in lab.run().out, "the bytes are the same: merge stands"


def test_a_renamed_video_keeps_its_results_and_its_history(lab: Lab) -> None:
    lab.run()
    (lab.clips / "cat.mp4").rename(lab.clips / "lion.mp4")
    pending = lab.pending()
    assert set(pending) == {"merge", "final"}, "names enter only where they name folders"
    reasons = lab.command("why", "words", "lion", "--words.count", "4", "--json").json[0]["reasons"]
    assert [r["kind"] for r in reasons] == ["settings"]


# ---------------------------------------------------------------------------------------------- the guard


@pytest.fixture
def expensive(lab: Lab) -> Lab:
    """A finished run whose `upper` of the cat took, as the ledger has it, an hour."""
    lab.run()
    pretend(lab, "upper/cat", 3600.0)
    return lab


def pretend(lab: Lab, label: str, seconds: float) -> None:
    record = lab.records()[label]
    path = lab.workspace / "actions" / record.stage / f"{record.key}.json"
    value = json.loads(path.read_text())
    value["seconds"] = seconds
    path.write_text(json.dumps(value))


def test_expensive_work_is_not_redone_for_code_alone(expensive: Lab) -> None:
    lab = expensive
    lab.edit("shouting.py", "text.upper()", "text.upper().strip()")
    stop = lab.run()
    assert stop.code == 3
    assert "upper/cat was made by other code; redoing it costs about 1 h 0 min" in stop.err
    assert "banmo run --redo upper" in stop.err and "banmo bless upper cat" in stop.err
    assert "toy/shouting.py" in stop.err
    assert lab.records()["upper/dog"].modules == lab.records()["upper/cat"].modules, "nothing was started"
    assert lab.run("--redo", "upper").code == 0
    assert lab.run().out.startswith("everything is up to date")


def test_bless_accepts_the_old_result(expensive: Lab) -> None:
    lab = expensive
    before = lab.digests()
    old = lab.records()["upper/cat"].key
    lab.edit("shouting.py", "text.upper()", "text.upper().strip()")
    done = lab.command("bless", "upper")
    assert done.code == 0, done.err
    assert lab.pending() == {}
    blessed = [r for r in Ledger(lab.workspace / "actions").all("upper") if r.blessed]
    assert {r.video for r in blessed} == {"cat", "dog"}
    assert old in {r.blessed["from"] for r in blessed if r.blessed}
    assert all(r.blessed["who"] for r in blessed if r.blessed)
    assert lab.digests() == before
    assert "blessed" in lab.command("inspect", "upper", "cat").out
    assert "nothing to bless" in lab.command("bless", "upper").out


def test_bless_refuses_other_changes(expensive: Lab) -> None:
    lab = expensive
    outcome = lab.command("bless", "upper", "--upper.mark", "?")
    assert outcome.code == 2 and "only a change of code can be" in outcome.err
    assert lab.command("bless", "measure", "--words.count", "4").code == 2


def test_settings_and_code_together_need_no_question(expensive: Lab) -> None:
    expensive.edit("shouting.py", "text.upper()", "text.upper().strip()")
    assert expensive.run("--upper.mark", "?").code == 0


def test_the_guard_also_holds_when_inputs_turn_out_equal(lab: Lab) -> None:
    """`merge` waits for `upper`, which is remade for a setting without effect; then only merge's code differs."""
    lab.run()
    pretend(lab, "merge", 7200.0)
    lab.edit("merge.py", '"steps.txt"', '"step.txt"')
    outcome = lab.run("--words.delay_s", "0.001")
    assert outcome.code == 3
    assert "merge was made by other code" in outcome.err
    assert "2 done, 4 up to date, 2 not run" in outcome.out


def test_the_threshold_is_a_setting(expensive: Lab) -> None:
    expensive.edit("shouting.py", "text.upper()", "text.upper().strip()")
    assert expensive.run("--pipeline.guard_minutes", "61").code == 0


def test_records_keep_what_was_done(lab: Lab) -> None:
    lab.run()
    record = lab.records()["words/cat"]
    assert record.metrics == {"count": 3}
    assert record.host and record.versions["python"]
    assert record.action["settings"] == {"count": 3, "delay_s": 0.0, "table": "", "trouble": ""}
    assert set(record.modules) == {"toy/__init__.py", "toy/words.py"}
    text = json.dumps(record.action)
    assert str(lab.root) not in text and Path(record.host).name not in text
