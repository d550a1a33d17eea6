"""Settings of every type: described, merged, put into keys, rebuilt in the worker."""

from __future__ import annotations

import enum
import tomllib
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline import InputFile, Resources, Run, Stage, Video, stage
from pipeline.definition import Definition, StageInfo
from pipeline.describe import build, fields_of
from pipeline.errors import BadInput, printable
from pipeline.settings import coerce, resolve, to_toml, toml_value


class Mode(enum.Enum):
    FAST = 1
    GOOD = 2


@dataclass(frozen=True)
class Loss:
    rgb: float = 0.1
    """Weight of colour."""
    parts: tuple[str, ...] = ("a", "b")


@dataclass(frozen=True)
class Base:
    steps: int = 100
    """How many
    steps."""


@dataclass(frozen=True)
class Everything(Base):
    rate: float = 1
    on: bool = False
    name: str = "x"
    mode: Mode = Mode.FAST
    field_kind: Literal["mlp", "grid"] = "mlp"
    levels: Literal[1, 2, 4] = 1
    crop: tuple[float, float] | None = None
    sizes: list[int] = field(default_factory=lambda: [16, 32])
    network: InputFile = InputFile("")  # noqa: RUF009  (immutable)
    loss: Loss = Loss()


def definition() -> Definition:
    info = StageInfo("fit", "x:fit", None, fields=tuple(fields_of(Everything)))
    presets = {"preview": {"fit": {"steps": 5}}, "fine": {"fit": {"steps": 1000, "loss": {"rgb": 0.7}}}}
    return Definition(Path("/x"), {"fit": info}, {}, presets, None)


def merged(*overrides: tuple[str, str], toml: Path | None = None, preset: str | None = None) -> Everything:
    values = resolve(definition(), toml, list(overrides), preset).values["fit"]
    found = build(Everything, values)
    assert isinstance(found, Everything)
    return found


def test_defaults_come_back_as_they_were() -> None:
    assert merged() == Everything(steps=5)
    helps = {f["name"]: f["help"] for f in fields_of(Everything)}
    assert helps["steps"] == "How many\nsteps." and helps["loss.rgb"] == "Weight of colour."


def test_every_type_from_the_command_line() -> None:
    found = merged(
        ("fit.rate", "2e-3"),
        ("fit.on", "yes"),
        ("fit.name", "3"),
        ("fit.mode", "GOOD"),
        ("fit.field_kind", "grid"),
        ("fit.levels", "4"),
        ("fit.crop", "0.5,1"),
        ("fit.sizes", "[1, 2, 3]"),
        ("fit.network", "/tmp/net.onnx"),
        ("fit.loss.rgb", "1"),
        ("fit.loss.parts", "x,y,z"),
    )
    assert found == Everything(
        steps=5,
        rate=0.002,
        on=True,
        name="3",
        mode=Mode.GOOD,
        field_kind="grid",
        levels=4,
        crop=(0.5, 1.0),
        sizes=[1, 2, 3],
        network=InputFile("/tmp/net.onnx"),
        loss=Loss(1.0, ("x", "y", "z")),
    )
    assert isinstance(found.rate, float) and isinstance(found.network, InputFile)
    assert merged(("fit.crop", "none")).crop is None


def test_nested_tables_and_presets(tmp_path: Path) -> None:
    path = tmp_path / "pipeline.toml"
    path.write_text('[fit]\nrate = 3\nnetwork = "nets/a.onnx"\n[fit.loss]\nparts = ["q"]\n')
    found = merged(toml=path, preset="fine")
    assert (found.steps, found.rate, found.loss) == (1000, 3.0, Loss(0.7, ("q",)))
    assert found.network == str(tmp_path / "nets" / "a.onnx"), "relative to the file that names it"
    path.write_text("[fit.loss]\nrbg = 3\n")
    with pytest.raises(BadInput, match=r"loss\.rbg"):
        merged(toml=path)


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("fit.mode", "BEST"),
        ("fit.levels", "3"),
        ("fit.levels", "true"),
        ("fit.crop", "1,2,3"),
        ("fit.crop", "a,b"),
        ("fit.sizes", "1,x"),
        ("fit.steps", "1e999"),
        ("fit.rate", "inf"),
        ("fit.on", "2"),
    ],
)
def test_wrong_values_are_refused(name: str, text: str) -> None:
    with pytest.raises(BadInput, match=name):
        merged((name, text))


def test_settings_that_cannot_be_are_refused_when_described() -> None:
    @dataclass(frozen=True)
    class Odd:
        table: dict[str, int] = field(default_factory=dict)

    @dataclass(frozen=True)
    class NoDefault:
        steps: int

    for kind in (Odd, NoDefault):
        with pytest.raises(TypeError):
            fields_of(kind)


_scalars = st.booleans() | st.integers(-(2**62), 2**62) | st.floats(allow_nan=False, allow_infinity=False) | st.text()


@given(st.recursive(_scalars, lambda inner: st.lists(inner, max_size=3), max_leaves=5))
def test_values_survive_toml(value: Any) -> None:
    text = f"v = {toml_value(value)}"
    assert tomllib.loads(text)["v"] == value


@given(st.sampled_from(fields_of(Everything)), st.text() | _scalars | st.lists(_scalars, max_size=3) | st.none())
def test_no_value_crashes_the_reader(spec: dict[str, Any], value: Any) -> None:
    try:
        coerce(spec["type"], value, "x", Path("/"))
    except BadInput as error:
        assert "\n" not in str(error)


@given(st.text())
def test_messages_are_one_printable_line(text: str) -> None:
    assert printable(text).isprintable()
    assert "\n" not in str(BadInput(text, where=text, hint=text))


def test_merged_settings_read_back_the_same(tmp_path: Path) -> None:
    settings = resolve(definition(), None, [("fit.name", 'q"\\\n'), ("fit.crop", "1,2")], "fine")
    path = tmp_path / "pipeline.toml"
    path.write_text(to_toml(settings))
    assert resolve(definition(), path, [], None).values == settings.values


# ---------------------------------------------------------------------------------------------- contracts


def test_mistakes_in_a_contract_are_refused_at_once() -> None:
    def no_out(run: Run) -> None: ...

    def good(out: Path) -> None: ...

    with pytest.raises(TypeError, match="out"):
        stage(per=Video)(no_out)
    with pytest.raises(TypeError, match="Video or Scene"):
        stage(per=int)(good)
    with pytest.raises(TypeError, match="tuples"):
        stage(per=Video, given=".masks")(good)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="cpus"):
        Resources(cpus="many")
    found = stage(per=Video)(good)
    assert isinstance(found, Stage) and Resources(cpus="all").cores == 0
    with pytest.raises(TypeError, match="asks for"):
        found.check(lambda frames: None)


def test_a_run_without_an_engine_serves_tests() -> None:
    run = Run()
    assert list(run.progress([1, 2])) == [1, 2]
    run.metric("a", float("nan"))
    run.warn("careful")
    assert run.metrics == {"a": "nan"} and run.warnings == ["careful"]
    assert run.checkpoint_dir.is_dir() and not run.stop_requested
    run.request_stop()
    with pytest.raises(Exception, match="stopped"):
        list(run.progress([1]))
