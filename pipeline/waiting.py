"""Which nodes wait for which: one step of work for each edge of the graph, however many nodes there are."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

from pipeline.graph import Graph, Node


class Waiting:
    """Nodes whose inputs are not all known. Told of results and losses, it says who is free to be decided."""

    def __init__(self, graph: Graph, nodes: Iterable[Node], known: Iterable[str]) -> None:
        self._graph = graph
        self._known = set(known)
        self._missing: dict[Node, set[str]] = {}
        self._readers: dict[str, list[Node]] = {}
        self._free: list[Node] = []
        for node in nodes:
            self.add(node)

    @property
    def free(self) -> bool:
        """Whether somebody can be decided now."""
        return bool(self._free)

    def __bool__(self) -> bool:
        return bool(self._missing or self._free)

    def __iter__(self) -> Iterator[Node]:
        return iter([*self._free, *self._missing])

    def add(self, node: Node) -> None:
        """A node waits (again)."""
        inputs = {n.label for nodes in self._graph.inputs(node).values() for n in nodes}
        missing = inputs - self._known
        if not missing:
            self._free.append(node)
            return
        self._missing[node] = missing
        for label in missing:
            self._readers.setdefault(label, []).append(node)

    def result(self, label: str) -> None:
        """A node has a result now."""
        self._known.add(label)
        for node in self._readers.pop(label, ()):
            missing = self._missing.get(node)
            if missing is None:
                continue
            missing.discard(label)
            if not missing:
                del self._missing[node]
                self._free.append(node)

    def lost(self, label: str) -> list[tuple[Node, str]]:
        """A node will have no result in this run: who waits for it in vain, directly or not, and for whom."""
        found: list[tuple[Node, str]] = []
        labels = [label]
        while labels:
            gone = labels.pop(0)
            for node in self._readers.pop(gone, ()):
                if self._missing.pop(node, None) is not None:
                    found.append((node, gone))
                    labels.append(node.label)
        return found

    def take_free(self) -> list[Node]:
        """The nodes that can be decided now, each once."""
        found, self._free = self._free, []
        return found
