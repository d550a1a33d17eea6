"""Everything a command works with: workspace, definition, settings, videos, graph."""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pipeline.definition import Definition, load, locate
from pipeline.errors import BadInput
from pipeline.graph import Graph, Node, Selection, find_video, select
from pipeline.plan import Planner
from pipeline.settings import Settings, resolve
from pipeline.videos import SourceDigests, VideoFile, discover
from pipeline.workspace import Workspace


@dataclass(frozen=True)
class Options:
    """What every command understands."""

    workspace: Path = Path("workspace")
    definition: str = ""
    preset: str | None = None
    overrides: list[tuple[str, str]] = field(default_factory=list)
    videos: Path | None = None
    skip_videos: tuple[str, ...] = ()


@dataclass
class Project:
    """An opened workspace with its pipeline, settings and videos."""

    workspace: Workspace
    definition: Definition
    settings: Settings
    videos_dir: Path
    videos: list[VideoFile]
    graph: Graph
    sources: SourceDigests
    remembered: dict[str, Any]

    @classmethod
    def open(cls, options: Options, *, create: bool = False, recall: bool = False) -> Project:
        """Open a workspace; `recall` takes the command-line settings of the last run where none are given now."""
        if create:
            precheck(options)
        workspace = Workspace.open(options.workspace, create=create, template=template_of(options))
        memory = workspace.remembered()
        package = package_of(options, memory)
        definition = load(package, workspace.cache)
        overrides, preset, skip = list(options.overrides), options.preset, list(options.skip_videos)
        if recall and not overrides and preset is None and not skip:
            overrides = [(str(n), str(t)) for n, t in memory.get("overrides", [])]
            preset, skip = memory.get("preset"), [str(s) for s in memory.get("skip_videos", [])]
        settings = resolve(definition, workspace.settings_path, overrides, preset)
        if create:
            workspace.use_locks(settings.store.locks, settings.store.expire_s)
        folder = _videos_dir(options, settings, memory, workspace)
        videos = discover(folder, definition.given_suffixes)
        left_out = {find_video(videos, word).name for word in (*skip, *settings.pipeline.skip_videos)}
        videos = [v for v in videos if v.name not in left_out]
        if not videos:
            raise BadInput("every video is left out", where=folder)
        remembered = {
            "videos": str(folder),
            "definition": package,
            "preset": preset,
            "overrides": [list(o) for o in overrides],
            "skip_videos": skip,
        }
        sources = SourceDigests(workspace.cache / "digests.json")
        graph = Graph(definition, videos)
        return cls(workspace, definition, settings, folder, videos, graph, sources, remembered)

    def planner(self, forced: set[Node] | None = None) -> Planner:
        """A planner over this project."""
        return Planner(self.workspace, self.graph, self.settings, self.sources, forced)

    def select(self, selection: Selection) -> tuple[list[Node], set[Node]]:
        """Nodes a command is about, and those that must run again."""
        return select(self.graph, selection)


def package_of(options: Options, memory: dict[str, Any]) -> str:
    """The package that defines the pipeline: named now, by the environment (tests), last time, or the default."""
    package = options.definition or os.environ.get("BANMO_DEFINITION", "") or str(memory.get("definition") or "stages")
    return str(Path(package).resolve()) if "/" in package else package


def template_of(options: Options) -> Path | None:
    """The workspace template that lies beside the pipeline's package, for a workspace that is not there yet."""
    if (options.workspace / "FORMAT").is_file():
        return None
    return locate(package_of(options, {})).parent / "workspace_template"


def precheck(options: Options) -> None:
    """Refuse a first run without usable videos before a workspace is made."""
    known = (options.workspace / "FORMAT").is_file()
    if options.videos is None and not known:
        raise BadInput("no videos named", hint="banmo run VIDEOS, where VIDEOS is a folder of clips")
    if options.videos is not None and not known:
        discover(options.videos)


def _videos_dir(options: Options, settings: Settings, memory: dict[str, Any], workspace: Workspace) -> Path:
    if options.videos is not None:
        folder = options.videos
    elif settings.pipeline.videos:
        folder = workspace.root / Path(settings.pipeline.videos).expanduser()
    elif memory.get("videos"):
        folder = Path(str(memory["videos"]))
    else:
        raise BadInput("no videos named", hint="banmo run VIDEOS, where VIDEOS is a folder of clips")
    folder = Path(os.path.abspath(folder))
    if folder.resolve().is_relative_to(workspace.root.resolve()) and folder.resolve() == workspace.root.resolve():
        raise BadInput("the workspace cannot lie on the videos", where=folder, hint="choose another --workspace")
    return folder
