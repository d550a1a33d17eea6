"""What has to run: for every node a hit in the ledger, a run with its reasons, or a wait for another node."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

from pipeline.action import Action, action
from pipeline.graph import Graph, Node
from pipeline.ledger import Record
from pipeline.locks import Patience
from pipeline.reasons import Reason, compare, nearest
from pipeline.remote import Remote
from pipeline.settings import Settings, stage_values
from pipeline.transfer import fetch
from pipeline.videos import SourceDigests
from pipeline.workspace import Workspace

HIT, RUN, WAIT = "hit", "run", "wait"


@dataclass
class Step:
    """The decision about one node. `record` is the hit, or the nearest earlier result for times and reasons."""

    node: Node
    status: str
    action: Action | None = None
    record: Record | None = None
    reasons: list[Reason] = field(default_factory=list)
    waits_for: list[str] = field(default_factory=list)


class Planner:
    """Decides node by node, in order; told of each result, it can decide the nodes that waited for it."""

    def __init__(
        self,
        workspace: Workspace,
        graph: Graph,
        settings: Settings,
        sources: SourceDigests,
        forced: set[Node] | None = None,
    ) -> None:
        self.workspace, self.graph, self.settings, self.sources = workspace, graph, settings, sources
        self.forced = set(forced or ())
        self._per_video = {i.name for i in graph.definition.stages.values() if i.per_video}
        self.results: dict[str, Record] = {}
        """Label -> the record that stands for this node now."""
        self.steps: dict[str, Step] = {}
        self._texts: dict[str, dict[str, Any]] = {}
        self._salt = settings.pipeline.salt
        self.patience = Patience(settings.store.latency_s)

    def plan(self, nodes: list[Node]) -> list[Step]:
        """Decide every node as far as it can be decided now."""
        return [self.decide(node) for node in nodes]

    def decide(self, node: Node) -> Step:
        """Decide one node; its inputs must have been decided before."""
        waits = self._missing(node)
        if waits:
            step = Step(node, WAIT, waits_for=waits)
            step.reasons, step.record = self._expected(node)
        else:
            wanted = self.action(node)
            record = self.workspace.ledger.find(node.info.name, wanted.key)
            if self._elsewhere is not None and node not in self.forced and not self._serves(node, record):
                found = fetch(self.workspace, self._elsewhere, node.info.name, wanted.key, self.patience)
                record = found or record
            if record is None:
                record, reasons = self._reasons(node, wanted)
                step = Step(node, RUN, wanted, record, reasons)
            elif not self._serves(node, record):
                step = Step(node, RUN, wanted, record, [Reason("damaged", f"objects/{node.info.name}/{record.digest}")])
            elif node in self.forced:
                step = Step(node, RUN, wanted, record, [Reason("asked for")])
            else:
                step = Step(node, HIT, wanted, record)
                self.results[node.label] = record
        self.steps[node.label] = step
        return step

    def _serves(self, node: Node, record: Record | None) -> bool:
        """Whether the folder of a record is whole; a network disk may show it later than the record."""
        if record is None:
            return False
        objects, kind = self.workspace.objects, node.info.name
        if objects.sound(kind, record.digest):
            return True
        if not self.workspace.is_far or not objects.quick_check(kind, record.digest, record.files, record.bytes):
            return False
        return self.patience.until(lambda: objects.sound(kind, record.digest))

    @cached_property
    def _elsewhere(self) -> Remote | None:
        """The shared store, if one is named."""
        shared = self.settings.store.shared
        return Remote(shared) if shared else None

    def finished(self, node: Node, record: Record) -> None:
        """Tell the planner that a node now has this result."""
        self.results[node.label] = record
        self.forced.discard(node)

    # ------------------------------------------------------------------ actions

    def action(self, node: Node) -> Action:
        """The action of a node whose inputs are known."""
        info = node.info
        assert info.code is not None
        return action(
            stage=info.name,
            version=info.version,
            code=info.code.digest,
            settings=self._settings_for_key(node),
            inputs=self._inputs(node, {}),
            salt=self._salt,
        )

    def _settings_for_key(self, node: Node) -> dict[str, Any]:
        known = self._texts.get(node.info.name)
        if known is not None:
            return known
        kinds = {f["name"]: f["type"] for f in node.info.fields}
        values = stage_values(self.settings, node.info)
        found = {key: self._by_content(kinds[key], value) for key, value in values.items()}
        if not any(self._names_files(kind) for kind in kinds.values()):
            self._texts[node.info.name] = found  # the same for every video, and nothing on disk can change it
        return found

    def _names_files(self, kind: dict[str, Any]) -> bool:
        inner = [kind["item"]] if "item" in kind else kind.get("items", [])
        return kind["kind"] == "file" or any(self._names_files(k) for k in inner)

    def _by_content(self, kind: dict[str, Any], value: Any) -> Any:
        """A setting with the paths of files replaced by the digests of their content."""
        if value is None or value == "":
            return value
        if kind["kind"] == "file":
            return {"file": self.sources.of(Path(value))}
        if kind["kind"] == "optional":
            return self._by_content(kind["item"], value)
        if kind["kind"] == "list":
            return [self._by_content(kind["item"], v) for v in value]
        if kind["kind"] == "tuple":
            return [self._by_content(k, v) for k, v in zip(kind["items"], value, strict=True)]
        return value

    def _inputs(self, node: Node, missing: dict[str, Any]) -> dict[str, Any]:
        """Digests of everything the node reads. `missing` stands in for nodes without a result."""
        found: dict[str, Any] = {}
        for name, nodes in self.graph.inputs(node).items():
            digests = {}
            for source in nodes:
                record = self.results.get(source.label)
                digests[source.video_name or ""] = record.digest if record else missing.get(source.label)
            by_video = node.video is None and bool(nodes) and nodes[0].video is not None
            found[name] = digests if by_video else next(iter(digests.values()))
        videos = [node.video] if node.video else self.graph.videos
        if "video" in node.info.takes:
            digests = {v.name: self.sources.of(v.path) for v in videos}
            found["video"] = digests[node.video.name] if node.video else digests
        if "given" in node.info.takes:
            beside = {v.name: {s: self.sources.of(v.given[s]) for s in node.info.given if s in v.given} for v in videos}
            found["given"] = beside[node.video.name] if node.video else beside
        return found

    def _missing(self, node: Node) -> list[str]:
        found = [n.label for nodes in self.graph.inputs(node).values() for n in nodes if n.label not in self.results]
        return list(dict.fromkeys(found))

    # ------------------------------------------------------------------ reasons

    def _reasons(self, node: Node, wanted: Action) -> tuple[Record | None, list[Reason]]:
        earlier = nearest(wanted.text, self.workspace.ledger, node.info.name, node.video_name)
        if earlier is None:
            return None, [Reason("never run")]
        assert node.info.code is not None
        reasons = compare(wanted.text, node.info.code.modules, earlier, self._because, self._per_video)
        return earlier, reasons or [Reason("never run")]

    def _expected(self, node: Node) -> tuple[list[Reason], Record | None]:
        """Reasons of a node whose inputs are not known yet: those inputs stand as changed, because of their own."""
        info = node.info
        assert info.code is not None
        text = action(
            stage=info.name,
            version=info.version,
            code=info.code.digest,
            settings=self._settings_for_key(node),
            inputs=self._inputs(node, {label: f"of {label}" for label in self._missing(node)}),
            salt=self._salt,
        ).text
        earlier = nearest(text, self.workspace.ledger, info.name, node.video_name)
        if earlier is None:
            return [Reason("never run")], None
        return compare(text, info.code.modules, earlier, self._because, self._per_video), earlier

    def _because(self, stage: str, video: str | None, new: str | None, old: str | None) -> list[Reason]:
        """Why the folder of an input changed from digest `old` to `new`."""
        label = f"{stage}/{video}" if video else stage
        step = self.steps.get(label)
        if step is None:
            return []
        if step.status != HIT:
            return step.reasons
        now = self.results.get(label)
        before = [r for r in self.workspace.ledger.of_video(stage, video) if r.digest == old]
        if now is None or not before:
            return []
        return compare(now.action, now.modules, before[0], self._because, self._per_video)
