"""Keys never change by accident; code counts by what it does."""

from __future__ import annotations

import enum
import random
import shutil
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.action import action, canonical, key_of
from pipeline.source import CodeReader
from tests.engine.laboratory import TOY

GOLDEN = {
    "plain": (
        {"stage": "masks", "version": 1, "code": "6f5e", "settings": {"dilate_px": 3, "threshold": 0.5}, "inputs": {}},
        "9832cf2a105ba143e96ce87910f59b181d31e701a9af992b083459513d03fb4c",
    ),
    "inputs": (
        {
            "stage": "fit",
            "version": 2,
            "code": "00ff",
            "settings": {"b": True, "a": None, "sizes": (1, 2), "name": "Füchsin"},
            "inputs": {"frames": {"fox": "aa", "cat": "bb"}, "given": {"cat": {".masks": "cc"}}},
            "salt": "pepper",
        },
        "2e0f415b8555ac8c61c8613569f6ebff6a93bb2d0edace4f949f3621706c5226",
    ),
}


@pytest.mark.parametrize("name", GOLDEN)
def test_golden_keys(name: str) -> None:
    parts, key = GOLDEN[name]
    assert action(**parts).key == key  # type: ignore[arg-type]


class Colour(enum.Enum):
    RED = 1


def test_canonical_text() -> None:
    value = {"b": (1, 2.5), "a": Colour.RED, "ü": "é", "z": None, "t": True}
    assert canonical(value) == '{"a":"RED","b":[1,2.5],"t":true,"z":null,"ü":"é"}'
    assert canonical(0.1 + 0.2) == "0.30000000000000004"
    assert canonical(-0.0) == canonical(0.0)
    for bad in (float("nan"), float("inf"), {"x": object()}, {1: 2}, {"p": Path("x")}, b"x"):
        with pytest.raises((ValueError, TypeError)):
            canonical(bad)


_json = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False, allow_infinity=False) | st.text("abü\n"),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text("abc", max_size=3), inner, max_size=3),
    max_leaves=8,
)


@given(st.dictionaries(st.text("abcdef", min_size=1, max_size=4), _json, max_size=5), st.randoms())
def test_key_does_not_depend_on_the_order_of_entries(value: dict[str, object], chance: random.Random) -> None:
    items = list(value.items())
    chance.shuffle(items)
    assert key_of(dict(items)) == key_of(value)


# ---------------------------------------------------------------------------------------------- code


@pytest.fixture
def package(tmp_path: Path) -> Path:
    shutil.copytree(TOY, tmp_path / "toy", ignore=shutil.ignore_patterns("__pycache__"))
    return tmp_path / "toy"


def fingerprints(package: Path) -> dict[str, str]:
    reader = CodeReader(package)
    return {name: reader.fingerprint(f"toy.{name}").digest for name in ("words", "upper", "measure", "merge", "final")}


def edited(package: Path, name: str, old: str, new: str) -> set[str]:
    """The stages whose fingerprint an edit changes."""
    before = fingerprints(package)
    path = package / name
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))
    after = fingerprints(package)
    return {stage for stage in before if before[stage] != after[stage]}


def test_comments_docstrings_and_layout_do_not_count(package: Path) -> None:
    assert edited(package, "shouting.py", "  # loud", "  # very loud indeed") == set()
    assert edited(package, "shouting.py", '    """Upper case and a mark."""\n', '    """Otherwise put."""\n') == set()
    assert (
        edited(package, "shouting.py", "text.upper() + mark", "(\n        text.upper()\n        + mark\n    )") == set()
    )
    assert edited(package, "words.py", '    """How many files to make."""\n', "\n\n") == set()
    assert edited(package, "shouting.py", "def shout", "\n\n\n# a remark\ndef shout") == set()


def test_a_helper_counts_for_those_who_use_it(package: Path) -> None:
    assert edited(package, "shouting.py", "text.upper() + mark", "text.upper() + mark + mark") == {"upper"}


def test_a_stage_counts_for_itself_alone(package: Path) -> None:
    assert edited(package, "measure.py", "len(p", "1 + len(p") == {"measure"}


def test_the_lists_of_the_pipeline_do_not_count_but_other_code_of_the_package_does(package: Path) -> None:
    assert edited(package, "__init__.py", '    "toy.final:final",\n', "") == set()
    (package / "__init__.py").write_text((package / "__init__.py").read_text() + "\nimport toy.shouting\n")
    every = {"words", "upper", "measure", "merge", "final"}
    assert edited(package, "shouting.py", "text.upper()", "text.lower()") == every, "parents run on import"


def test_all_forms_of_import_are_followed(package: Path) -> None:
    (package / "deep").mkdir()
    (package / "deep" / "__init__.py").write_text("")
    (package / "deep" / "a.py").write_text("from . import b\n")
    (package / "deep" / "b.py").write_text("from ..deep.c import X\n")
    (package / "deep" / "c.py").write_text("def f():\n    import toy.deep.d as d\n    return d\nX = 1\n")
    (package / "deep" / "d.py").write_text("Y = 1\n")
    (package / "measure.py").write_text("from toy.deep import a\n" + (package / "measure.py").read_text())
    modules = CodeReader(package).fingerprint("toy.measure").modules
    assert {"toy/deep/a.py", "toy/deep/b.py", "toy/deep/c.py", "toy/deep/d.py", "toy/deep/__init__.py"} <= set(modules)
    assert edited(package, "deep/d.py", "Y = 1", "Y = 2") == {"measure"}


def test_declared_data_counts_by_its_bytes(package: Path) -> None:
    (package / "weights").mkdir()
    (package / "weights" / "net.bin").write_bytes(b"1")
    before = CodeReader(package).fingerprint("toy.measure", ("weights/*.bin",))
    assert "toy/weights/net.bin" in before.modules
    (package / "weights" / "net.bin").write_bytes(b"2")
    assert CodeReader(package).fingerprint("toy.measure", ("weights/*.bin",)).digest != before.digest
    with pytest.raises(Exception, match="missing"):
        CodeReader(package).fingerprint("toy.measure", ("weights/none.bin",))
    with pytest.raises(Exception, match="inside"):
        CodeReader(package).fingerprint("toy.measure", ("../secret",))


def test_the_memo_never_hides_an_edit(package: Path, tmp_path: Path) -> None:
    memo = tmp_path / "memo.json"
    reader = CodeReader(package, memo)
    before = reader.fingerprint("toy.upper").digest
    reader.save()
    assert CodeReader(package, memo).fingerprint("toy.upper").digest == before
    path = package / "shouting.py"
    path.write_text(path.read_text().replace("upper()", "lower()"))
    assert CodeReader(package, memo).fingerprint("toy.upper").digest != before
    memo.write_text("torn {")
    assert CodeReader(package, memo).fingerprint("toy.upper").digest != before
