"""What the author of a stage needs to know.

A stage is one decorated function. Its parameters are bound by name:

* the name of an earlier stage gives that stage's folder (:class:`Folder`; ``dict[str, Folder]`` keyed by video in a
  scene stage that reads a video stage);
* ``video`` is the user's own file or image folder (:class:`Source`; ``dict[str, Source]`` in a scene stage);
* ``given`` is what lies beside the video (:class:`Given`; ``dict[str, Given]`` in a scene stage);
* ``settings`` is a frozen dataclass, filled from the section of pipeline.toml named like the stage;
* ``out`` is an empty folder to fill; ``run`` (:class:`Run`) is the stage's line to the outside.

Example::

    @dataclass(frozen=True)
    class MaskSettings:
        threshold: float = 0.5
        \"\"\"Probability above which a pixel is the object.\"\"\"

    @stage(per=Video, version=1, given=(".masks",), needs=Resources(cpus=1))
    def masks(frames: Folder, given: Given, settings: MaskSettings, out: Path, run: Run) -> None:
        \"\"\"Foreground probability of every frame, one 8-bit PNG each.\"\"\"

    @masks.check
    def _check(out: Path, frames: Folder) -> None:      # raises: the result is never published
        ...

    @masks.estimate
    def _bytes(video: Source, settings: MaskSettings) -> int:    # disk needed, asked before the run starts
        ...

    @masks.sheet
    def _sheet(out: Path, picture: Path) -> None:       # writes a PNG contact sheet for ``inspect``
        ...

``check``, ``estimate`` and ``sheet`` may take any of the stage's parameters by name (``estimate``: only ``video``,
``given`` and ``settings``).
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any


class Video:
    """Marks a stage that runs once for each video."""


class Scene:
    """Marks a stage that runs once for the whole collection."""


@dataclass(frozen=True)
class Resources:
    """What an action holds while it runs. Never part of its key.

    ``cpus="all"`` (or 0) takes every core of the machine; ``gpus`` are used where the machine has them, and the
    stage runs on the CPU where it has none. ``distributed=True`` says that the stage can be started in several
    processes (``[execution] ranks``), which find torch's RANK, WORLD_SIZE, LOCAL_RANK, MASTER_ADDR and MASTER_PORT in
    their environment; `cpus` is then shared among them, `gpus` is for each. All read the same checkpoint folder; what
    ranks other than 0 write to ``out`` is thrown away. The wish to stop may reach them at different steps: agree first.
    """

    cpus: int | str = 1
    gpus: int = 0
    distributed: bool = False

    def __post_init__(self) -> None:
        if not (self.cpus == "all" or (isinstance(self.cpus, int) and self.cpus >= 0)) or self.gpus < 0:
            raise ValueError(f'Resources(cpus={self.cpus!r}, gpus={self.gpus!r}): cpus is a count or "all"')

    @property
    def cores(self) -> int:
        """Cores asked for; 0 means all."""
        return 0 if isinstance(self.cpus, str) else self.cpus


@dataclass(frozen=True)
class Folder:
    """The published, read-only folder of an earlier stage."""

    path: Path
    digest: str = ""

    def __truediv__(self, name: str | Path) -> Path:
        return self.path / name

    def __fspath__(self) -> str:
        return str(self.path)


@dataclass(frozen=True)
class Source:
    """A video of the user: a file, or a folder of images. Never written to."""

    path: Path
    name: str = ""
    digest: str = ""
    is_folder: bool = False

    def __fspath__(self) -> str:
        return str(self.path)


@dataclass(frozen=True)
class Given:
    """What lies beside a video under its stem: ``given.get(".masks")`` is the path of ``<stem>.masks`` or None."""

    paths: Mapping[str, Path] = field(default_factory=dict)
    digests: Mapping[str, str] = field(default_factory=dict)

    def get(self, suffix: str) -> Path | None:
        """The file or folder ``<stem><suffix>`` beside the video, or None."""
        return self.paths.get(suffix)

    def __bool__(self) -> bool:
        return bool(self.paths)

    def __contains__(self, suffix: str) -> bool:
        return suffix in self.paths

    def __iter__(self) -> Iterator[str]:
        return iter(self.paths)


class InputFile(str):
    """Path to a file (or folder) named by a setting; "" means none.

    Relative paths in pipeline.toml are relative to the workspace, on the command line to the current folder.
    The digest of the content enters the action key, the path does not.
    """


_SPECIAL = ("video", "given", "settings", "out", "run", "picture")


class Stage:
    """A stage as its decorator made it; calling it calls the function."""

    def __init__(
        self,
        function: Callable[..., None],
        *,
        per: type,
        version: int,
        given: tuple[str, ...],
        needs: Resources,
        data: tuple[str, ...],
    ) -> None:
        if per not in (Video, Scene):
            raise TypeError(f"@stage(per={per!r}): per is Video or Scene")
        if isinstance(given, str) or isinstance(data, str):
            raise TypeError("@stage: given= and data= are tuples of strings")
        self.function, self.per, self.version = function, per, version
        self.given, self.needs, self.data = tuple(given), needs, tuple(data)
        self.name = function.__name__
        self.__doc__ = function.__doc__
        self.__name__ = self.name
        self.__module__ = function.__module__
        self.__wrapped__ = function
        self.checks: list[Callable[..., None]] = []
        self.estimator: Callable[..., int] | None = None
        self.sheet_writer: Callable[..., None] | None = None
        self.parameters = tuple(inspect.signature(function).parameters)
        if "out" not in self.parameters:
            raise TypeError(f"stage {self.name}: it needs a parameter `out: Path`, the folder it fills")
        if "given" in self.parameters and not self.given:
            raise TypeError(f"stage {self.name}: takes `given` but declares no @stage(given=(...))")

    def __call__(self, *args: Any, **kwargs: Any) -> None:
        self.function(*args, **kwargs)

    @property
    def inputs(self) -> tuple[str, ...]:
        """Names of the earlier stages it reads."""
        return tuple(p for p in self.parameters if p not in _SPECIAL)

    def check(self, function: Callable[..., None]) -> Callable[..., None]:
        """Register a check of the result: when it raises, the result is never published."""
        self._known_names(function, (*self.parameters, "out"))
        self.checks.append(function)
        return function

    def estimate(self, function: Callable[..., int]) -> Callable[..., int]:
        """Register the number of bytes one action will write, asked before a run starts."""
        self._known_names(function, ("video", "given", "settings"))
        self.estimator = function
        return function

    def sheet(self, function: Callable[..., None]) -> Callable[..., None]:
        """Register the writer of a contact sheet (a PNG at ``picture``) for ``inspect``."""
        self._known_names(function, (*self.parameters, "out", "picture"))
        self.sheet_writer = function
        return function

    def _known_names(self, function: Callable[..., Any], known: tuple[str, ...]) -> None:
        for name in inspect.signature(function).parameters:
            if name not in known:
                raise TypeError(f"stage {self.name}: its hook asks for {name!r}, known: {', '.join(known)}")


def stage(
    *,
    per: type,
    version: int = 1,
    given: tuple[str, ...] = (),
    needs: Resources | None = None,
    data: tuple[str, ...] = (),
) -> Callable[[Callable[..., None]], Stage]:
    """Make a stage of a function.

    `version` enters the key: raise it to force a rerun. `given` are suffixes of files or folders that may lie beside
    a video. `data` are files or glob patterns beside the code, relative to the package of the pipeline, whose content
    counts as code.
    """

    def decorate(function: Callable[..., None]) -> Stage:
        return Stage(function, per=per, version=version, given=given, needs=needs or Resources(), data=data)

    return decorate
