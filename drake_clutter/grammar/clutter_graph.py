"""The paper's scene graph: a tray, what stands on it, and what stands on that."""

import hashlib
from collections.abc import Iterator, Mapping

import networkx as nx

from drake_clutter.catalog import ObjectClass
from drake_clutter.grammar.orientation import Orientation, symmetry_key

TRAY = "tray"
OBJECT_SLOT = "object_slot"
OPEN_SLOT = "open_slot"
END = "end"
DUMMY = "dummy"
NON_TERMINAL_KINDS = frozenset({OBJECT_SLOT, OPEN_SLOT})
STRUCTURE_KINDS = frozenset({TRAY, END, DUMMY}) | NON_TERMINAL_KINDS
"""Kinds of nodes that are no objects; every other kind is the name of an object class."""

PRIMITIVE = "primitive"
"""The non-terminal edge. Every other edge is the `Orientation` of the node it leads to, or of the pair it joins to a dummy."""

EdgeKind = Orientation | str


class ClutterGraph:
    """A directed graph whose nodes have a `kind` and whose edges have a `kind`, rooted at the tray, node 0.

    An edge leads from what carries to what is carried. The children of a node keep the order in which they were added.
    A primitive edge into an `end` carries no orientation, so it counts as terminal as it stands.
    """

    TRAY_NODE = 0

    def __init__(self) -> None:
        """The start graph S: one tray."""
        self.nx = nx.DiGraph()
        self.nx.add_node(self.TRAY_NODE, kind=TRAY)

    @classmethod
    def from_parts(
        cls, nodes: Mapping[int, str], edges: Mapping[tuple[int, int], EdgeKind]
    ) -> "ClutterGraph":
        """A graph of the given kinds.

        Raises:
            ValueError: node 0 is not the only tray, an edge's end is unknown, a node cannot be reached from the tray, or
                something stands on an end.
        """
        if [node for node, kind in nodes.items() if kind == TRAY] != [cls.TRAY_NODE]:
            raise ValueError("nodes: allowed is exactly one tray, with id 0")
        graph = cls()
        for node, kind in nodes.items():
            graph.nx.add_node(node, kind=kind)
        for (parent, child), edge_kind in edges.items():
            if parent not in nodes or child not in nodes:
                raise ValueError(f"edges: {parent} -> {child} joins a node that is not there")
            graph.nx.add_edge(parent, child, kind=edge_kind)
        if len(graph.breadth_first_order()) != len(nodes) or not nx.is_directed_acyclic_graph(
            graph.nx
        ):
            raise ValueError(
                "edges: allowed is an acyclic graph in which the tray leads to every node"
            )
        if any(graph.kind(node) == END and graph.children(node) for node in nodes):
            raise ValueError("edges: nothing may stand on an end")
        return graph

    def __len__(self) -> int:
        """The graph's size: its nodes, all kinds counted."""
        return len(self.nx)

    def copy(self) -> "ClutterGraph":
        """A graph of its own with the same nodes, edges and order."""
        copied = ClutterGraph.__new__(ClutterGraph)
        copied.nx = self.nx.copy()
        return copied

    def kind(self, node: int) -> str:
        """The kind of a node."""
        return str(self.nx.nodes[node]["kind"])

    def kinds(self) -> list[str]:
        """The kind of every node, in order of creation."""
        return [node["kind"] for node in self.nx._node.values()]

    def edge_kind(self, parent: int, child: int) -> EdgeKind:
        """The kind of an edge."""
        kind: EdgeKind = self.nx.edges[parent, child]["kind"]
        return kind

    def children(self, node: int) -> list[int]:
        """What a node carries, in order."""
        return list(self.nx.successors(node))

    def breadth_first_order(self) -> list[int]:
        """All nodes that the tray leads to, breadth first, siblings in order."""
        # networkx's own walk costs several times as much, and is taken at every rule.
        edges, order = self.nx._adj, [self.TRAY_NODE]
        reached = {self.TRAY_NODE}
        for node in order:
            for child in edges[node]:
                if child not in reached:
                    reached.add(child)
                    order.append(child)
        return order

    def stack_bases(self) -> list[list[int]]:
        """The nodes that stand on the tray, stack by stack: one, or the two of a pair."""
        bases: dict[int, list[int]] = {}
        for node in self.children(self.TRAY_NODE):
            base = next((child for child in self.children(node) if self.kind(child) == DUMMY), node)
            bases.setdefault(base, []).append(node)
        return list(bases.values())

    def stack_objects(self) -> list[list[int]]:
        """The object nodes of every stack, in the stacks' order."""
        stacks = []
        for bottom in self.stack_bases():
            members = set(bottom).union(*(nx.descendants(self.nx, node) for node in bottom))
            stacks.append(
                [node for node in sorted(members) if self.kind(node) not in STRUCTURE_KINDS]
            )
        return stacks

    def largest_stack_fraction(self) -> float:
        """Of the objects, the share that the stack with most of them holds; 0 without objects."""
        sizes = [len(stack) for stack in self.stack_objects()]
        return max(sizes) / sum(sizes) if sizes else 0.0

    def objects(self) -> Iterator[tuple[int, str]]:
        """(node, class) of every object node, in order of creation."""
        return (
            (node, kind) for node, kind in self.nx.nodes(data="kind") if kind not in STRUCTURE_KINDS
        )

    @property
    def is_terminal(self) -> bool:
        """Whether every attribute is terminal, so that the graph can become a scene."""
        return not any(
            kind in NON_TERMINAL_KINDS for _, kind in self.nx.nodes(data="kind")
        ) and not any(
            kind == PRIMITIVE and self.kind(child) != END
            for _, child, kind in self.nx.edges(data="kind")
        )


def canonical_form(graph: ClutterGraph, classes: Mapping[str, ObjectClass]) -> str:
    """A digest, equal for two terminal graphs exactly when they differ only by sibling order and by symmetric orientations."""
    digests: dict[int, str] = {}
    for node in reversed(list(nx.topological_sort(graph.nx))):
        children = []
        for child in graph.children(node):
            edge, kind = graph.edge_kind(node, child), graph.kind(child)
            # An edge into an end or a dummy says nothing that its neighbours do not.
            is_oriented = isinstance(edge, Orientation) and kind in classes
            label = str(symmetry_key(classes[kind], Orientation(edge))) if is_oriented else ""
            children.append(label + digests[child])
        description = f"{graph.kind(node)}({','.join(sorted(children))})"
        digests[node] = hashlib.sha256(description.encode()).hexdigest()
    return digests[ClutterGraph.TRAY_NODE]
