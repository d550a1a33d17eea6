"""Stages times videos gives nodes, in order; and which of them a command is about."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from pipeline.definition import Definition, StageInfo
from pipeline.errors import BadInput, did_you_mean
from pipeline.videos import VideoFile


@dataclass(frozen=True)
class Node:
    """One stage of one video, or one stage of the whole collection (`video` is None)."""

    info: StageInfo
    video: VideoFile | None

    @property
    def label(self) -> str:
        """``masks/cat-01`` or ``fit``."""
        return f"{self.info.name}/{self.video.name}" if self.video else self.info.name

    @property
    def video_name(self) -> str | None:
        """Name of its video, None for a scene stage."""
        return self.video.name if self.video else None

    def __hash__(self) -> int:
        return hash(self.label)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Node) and other.label == self.label


class Graph:
    """All nodes of a definition and a list of videos, in an order in which they can run."""

    def __init__(self, definition: Definition, videos: list[VideoFile]) -> None:
        self.definition, self.videos = definition, videos
        self.nodes: list[Node] = []
        self._by_stage: dict[str, list[Node]] = {}
        for info in definition.stages.values():
            nodes = [Node(info, v) for v in videos] if info.per_video else [Node(info, None)]
            self._by_stage[info.name] = nodes
            self.nodes += nodes
        self._video_index = {v.name: i for i, v in enumerate(videos)}

    def of_stage(self, stage: str) -> list[Node]:
        """The nodes of a stage, sorted by video."""
        return self._by_stage[stage]

    def inputs(self, node: Node) -> dict[str, list[Node]]:
        """Stage name -> the nodes whose folders this node reads."""
        found: dict[str, list[Node]] = {}
        for name in node.info.inputs:
            nodes = self._by_stage[name]
            if node.video is not None and nodes and nodes[0].video is not None:
                nodes = [nodes[self._video_index[node.video.name]]]
            found[name] = nodes
        return found

    def needed(self, targets: Iterable[Node]) -> list[Node]:
        """The targets and everything they read, directly or not, in order."""
        wanted: set[Node] = set()
        waiting = list(targets)
        while waiting:
            node = waiting.pop()
            if node not in wanted:
                wanted.add(node)
                waiting += [n for nodes in self.inputs(node).values() for n in nodes]
        return [n for n in self.nodes if n in wanted]


@dataclass(frozen=True)
class Selection:
    """What the command line asks for."""

    stages: tuple[str, ...] = ()
    until: str | None = None
    redo: tuple[str, ...] = ()
    videos: tuple[str, ...] = ()

    def is_everything(self) -> bool:
        """Whether the whole pipeline is meant."""
        return not (self.stages or self.until or self.videos)


def select(graph: Graph, selection: Selection) -> tuple[list[Node], set[Node]]:
    """Nodes the command is about, in order, and those of them that must run again. Raises BadInput."""
    definition = graph.definition
    order = list(definition.stages)
    chosen = order
    if selection.until:
        chosen = order[: max(order.index(s) for s in definition.names(selection.until)) + 1]
    if selection.stages:
        wanted = {s for word in selection.stages for s in definition.names(word)}
        chosen = [s for s in chosen if s in wanted]
    redo = {s for word in selection.redo for s in definition.names(word)}
    if selection.redo and selection.is_everything() is False and not redo & set(chosen):
        chosen = [s for s in order if s in redo or s in chosen]
    only = {find_video(graph.videos, word).name for word in selection.videos}
    targets = [n for s in chosen for n in graph.of_stage(s) if _about(n, only)]
    nodes = graph.needed(targets)
    forced = {n for n in nodes if n.info.name in redo and _about(n, only)}
    if selection.videos and not targets:
        raise BadInput("--video chooses among stages that run once a video", hint="leave --video out")
    broken = [n.info for n in nodes if n.info.error]
    if broken:
        raise BadInput(
            f"stage {broken[0].name} cannot be loaded: {broken[0].error}", hint="--until a stage before it still works"
        )
    return nodes, forced


def _about(node: Node, only: set[str]) -> bool:
    return not only or (node.video is not None and node.video.name in only)


def find_video(videos: list[VideoFile], word: str) -> VideoFile:
    """The video a word of the command line names: by its safe name or by what the user calls it."""
    for video in videos:
        if word in (video.name, video.display, str(video.path)):
            return video
    raise BadInput(f"there is no video {word!r}", hint=did_you_mean(word, [v.name for v in videos]))
