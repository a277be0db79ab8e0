"""The scene graph of Kumar et al. (2022): tray, objects, and what they carry."""

import hashlib
from collections.abc import Iterator, Mapping

import networkx as nx

from drake_clutter.catalog import ObjectClass
from drake_clutter.grammar.orientation import Orientation, symmetry_key

TRAY = "tray"
"""Kind of the root node."""
OBJECT_SLOT = "object_slot"
"""Non-terminal kind: an object whose class is not chosen yet."""
OPEN_SLOT = "open_slot"
"""Non-terminal kind: the top of a stack that can still grow."""
END = "end"
"""Terminal kind: the top of a stack that is complete."""
DUMMY = "dummy"
"""Terminal kind: the common top of a pair, on which an object can stand."""
NON_TERMINAL_KINDS = frozenset({OBJECT_SLOT, OPEN_SLOT})
"""Kinds that no terminal graph contains."""
STRUCTURE_KINDS = frozenset({TRAY, END, DUMMY}) | NON_TERMINAL_KINDS
"""Kinds of nodes that are not objects; other kinds are names of object classes."""

PRIMITIVE = "primitive"
"""Kind of a non-terminal edge.

Every other edge has the `Orientation` of the node it leads to, or of the pair it joins to a dummy.
"""

EdgeKind = Orientation | str
"""Kind of an edge: an orientation, or `PRIMITIVE`."""


class ClutterGraph:
    """A directed graph of nodes and edges with kinds, rooted at the tray (node 0).

    An edge leads from an object to one that it carries. The children of a node keep the order in
    which they were added. A primitive edge into an `end` node carries no orientation and counts as
    terminal.

    Attributes:
        digraph: The networkx graph, with attributes `kind` of nodes and edges.
    """

    TRAY_NODE = 0

    def __init__(self) -> None:
        """Create the start graph S: one tray."""
        self.digraph = nx.DiGraph()
        self.digraph.add_node(self.TRAY_NODE, kind=TRAY)

    @classmethod
    def from_parts(
        cls, nodes: Mapping[int, str], edges: Mapping[tuple[int, int], EdgeKind]
    ) -> "ClutterGraph":
        """Return a graph with the given kinds of nodes and edges.

        Args:
            nodes: Kinds by node.
            edges: Kinds by (parent, child).

        Raises:
            ValueError: Node 0 is not the only tray, an edge refers to an unknown node, a node
                cannot be reached from the tray, the graph has a cycle, or an `end` node has
                children.
        """
        if [node for node, kind in nodes.items() if kind == TRAY] != [cls.TRAY_NODE]:
            raise ValueError("nodes: expected exactly one tray, as node 0")
        graph = cls()
        for node, kind in nodes.items():
            graph.digraph.add_node(node, kind=kind)
        for (parent, child), edge_kind in edges.items():
            if parent not in nodes or child not in nodes:
                raise ValueError(f"edges: {parent} -> {child} refers to a node that does not exist")
            graph.digraph.add_edge(parent, child, kind=edge_kind)
        if len(graph.breadth_first_order()) != len(nodes) or not nx.is_directed_acyclic_graph(
            graph.digraph
        ):
            raise ValueError(
                "edges: expected an acyclic graph in which every node is reachable from the tray"
            )
        if any(graph.kind(node) == END and graph.children(node) for node in nodes):
            raise ValueError("edges: an `end` node must not have children")
        return graph

    def __len__(self) -> int:
        """Return the number of nodes of all kinds."""
        return len(self.digraph)

    def copy(self) -> "ClutterGraph":
        """Return an independent copy with the same order of nodes and edges."""
        copied = ClutterGraph.__new__(ClutterGraph)
        copied.digraph = self.digraph.copy()
        return copied

    def kind(self, node: int) -> str:
        """Return the kind of a node."""
        return str(self.digraph.nodes[node]["kind"])

    def kinds(self) -> list[str]:
        """Return the kinds of all nodes, in order of creation."""
        return [node["kind"] for node in self.digraph._node.values()]

    def edge_kind(self, parent: int, child: int) -> EdgeKind:
        """Return the kind of an edge."""
        kind: EdgeKind = self.digraph.edges[parent, child]["kind"]
        return kind

    def children(self, node: int) -> list[int]:
        """Return the nodes that a node carries, in order."""
        return list(self.digraph.successors(node))

    def breadth_first_order(self) -> list[int]:
        """Return all nodes reachable from the tray, breadth first, siblings in order."""
        # networkx's own traversal takes several times as long, and this runs for every rule.
        edges = self.digraph._adj
        order = [self.TRAY_NODE]
        reached = {self.TRAY_NODE}
        for node in order:
            for child in edges[node]:
                if child not in reached:
                    reached.add(child)
                    order.append(child)
        return order

    def stack_bases(self) -> list[list[int]]:
        """Return the nodes on the tray by stack: one object, or both objects of a pair."""
        bases: dict[int, list[int]] = {}
        for node in self.children(self.TRAY_NODE):
            base = next((child for child in self.children(node) if self.kind(child) == DUMMY), node)
            bases.setdefault(base, []).append(node)
        return list(bases.values())

    def stack_objects(self) -> list[list[int]]:
        """Return the object nodes of every stack, in the order of the stacks."""
        stacks = []
        for bottom in self.stack_bases():
            members = set(bottom).union(*(nx.descendants(self.digraph, node) for node in bottom))
            stacks.append(
                [node for node in sorted(members) if self.kind(node) not in STRUCTURE_KINDS]
            )
        return stacks

    def largest_stack_fraction(self) -> float:
        """Return the fraction of the objects in the largest stack; 0 without objects."""
        sizes = [len(stack) for stack in self.stack_objects()]
        return max(sizes) / sum(sizes) if sizes else 0.0

    def objects(self) -> Iterator[tuple[int, str]]:
        """Return (node, class name) of every object node, in order of creation."""
        return (
            (node, kind)
            for node, kind in self.digraph.nodes(data="kind")
            if kind not in STRUCTURE_KINDS
        )

    @property
    def is_terminal(self) -> bool:
        """Whether all node and edge kinds are terminal, so that the graph can become a scene."""
        return not any(
            kind in NON_TERMINAL_KINDS for _, kind in self.digraph.nodes(data="kind")
        ) and not any(
            kind == PRIMITIVE and self.kind(child) != END
            for _, child, kind in self.digraph.edges(data="kind")
        )


def canonical_form(graph: ClutterGraph, classes: Mapping[str, ObjectClass]) -> str:
    """Return a hash that identifies a terminal graph up to symmetries.

    Graphs have equal hashes if they differ only by the order of siblings and by orientations that
    look the same, see `symmetry_key`.

    Args:
        graph: A terminal graph.
        classes: Object classes by name.
    """
    digests: dict[int, str] = {}
    for node in reversed(list(nx.topological_sort(graph.digraph))):
        children = []
        for child in graph.children(node):
            edge = graph.edge_kind(node, child)
            kind = graph.kind(child)
            # The edge into an end or dummy node follows from the neighboring edges.
            is_oriented = isinstance(edge, Orientation) and kind in classes
            label = str(symmetry_key(classes[kind], Orientation(edge))) if is_oriented else ""
            children.append(label + digests[child])
        description = f"{graph.kind(node)}({','.join(sorted(children))})"
        digests[node] = hashlib.sha256(description.encode()).hexdigest()
    return digests[ClutterGraph.TRAY_NODE]
