"""Matching and applying production rules under a budget of nodes."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drake_clutter.catalogue import ObjectClass
from drake_clutter.files import InputError
from drake_clutter.grammar.graph import OPEN_SLOT, PRIMITIVE, ClutterGraph
from drake_clutter.grammar.rules import KEEP, Pattern, ProductionRule, rule_sheet

SMALLEST_BUDGET = 3  # tray, one object, end


@dataclass(frozen=True)
class NodeBudget:
    """How large a derived graph may become.

    Attributes:
        nodes: the largest size, all kinds of nodes counted.
        exact: whether the graph must reach it. If not, a derivation may end one node short.
    """

    nodes: int
    exact: bool = True

    def __post_init__(self) -> None:
        if self.nodes < SMALLEST_BUDGET:
            raise InputError(f"nodes: {self.nodes}; allowed is {SMALLEST_BUDGET} (tray, one object, end) or more")


@dataclass(frozen=True)
class Derivation:
    """A terminal graph and the names of the rules that derived it, in order."""

    graph: ClutterGraph
    rules: tuple[str, ...]


class SceneGrammar:
    """G = (N_NT, N_T, E, R, S) for a set of object classes (paper, eq. 1)."""

    def __init__(self, classes: Sequence[ObjectClass]) -> None:
        self.classes = {object_class.name: object_class for object_class in classes}
        self.rules = rule_sheet(classes)
        self.index = {rule.name: index for index, rule in enumerate(self.rules)}

    def find_match(self, graph: ClutterGraph, left: Pattern) -> dict[str, int] | None:
        """The first subgraph that G_L matches: the tray leads to its root first, breadth first, siblings in order.

        Returns:
            The graph's node for each node of G_L, or None if nothing matches.
        """
        for root in graph.breadth_first():
            match = _extend(graph, left, root)
            if match is not None:
                return match
        return None

    def feasible(self, graph: ClutterGraph, budget: NodeBudget) -> NDArray[np.bool_]:
        """(rules,) which rules match and neither overrun the budget nor, if it is exact, leave it unfillable.

        What is left can be filled unless it is one node with no open slot to stack on: a drop and a pair both add two.
        """
        open_slots = sum(kind == OPEN_SLOT for _, kind in graph.nx.nodes(data="kind"))
        matches: dict[int, bool] = {}  # by identity: the thirty rules share four left-hand sides
        mask = np.zeros(len(self.rules), bool)
        for index, rule in enumerate(self.rules):
            remaining = budget.nodes - len(graph) - rule.growth
            stranded = budget.exact and remaining == 1 and open_slots + rule.open_slots_added == 0
            if remaining < 0 or stranded:
                continue
            if id(rule.left) not in matches:
                matches[id(rule.left)] = self.find_match(graph, rule.left) is not None
            mask[index] = matches[id(rule.left)]
        return mask

    def apply(self, graph: ClutterGraph, rule: ProductionRule) -> ClutterGraph:
        """A new graph in which the first match of G_L is replaced by G_R.

        Raises:
            ValueError: the rule does not match.
        """
        match = self.find_match(graph, rule.left)
        if match is None:
            raise ValueError(f"rule {rule.name} does not match the graph")
        result = graph.copy()
        for parent, child in rule.left.edges:
            if (parent, child) not in rule.right_edges:
                result.nx.remove_edge(match[parent], match[child])
        next_node = max(result.nx.nodes) + 1
        for name, kind in rule.right_nodes.items():
            if name not in match:
                match[name] = next_node
                next_node += 1
            if kind != KEEP:
                result.nx.add_node(match[name], kind=kind)
        for (parent, child), edge_kind in rule.right_edges.items():
            result.nx.add_edge(match[parent], match[child], kind=edge_kind)
        return result

    def replay(self, rules: Sequence[str]) -> ClutterGraph:
        """The graph that a sequence of rules, by name, derives from the start graph.

        Raises:
            ValueError: an unknown rule, or one that does not match when its turn comes.
        """
        graph = ClutterGraph()
        for name in rules:
            if name not in self.index:
                raise ValueError(f"rule {name!r} is unknown; known are {', '.join(self.index)}")
            graph = self.apply(graph, self.rules[self.index[name]])
        return graph

    def derive(self, budget: NodeBudget, choose: Callable[[ClutterGraph, NDArray[np.bool_]], int]) -> Derivation:
        """Applies rules from the start graph on, until none is feasible.

        Args:
            budget: how large the graph may become.
            choose: given the graph and the mask of feasible rules, the index of the rule to apply.
        """
        graph, names = ClutterGraph(), []
        while (mask := self.feasible(graph, budget)).any():
            rule = self.rules[choose(graph, mask)]
            graph = self.apply(graph, rule)
            names.append(rule.name)
        return Derivation(graph, tuple(names))


def uniform_choice(rng: np.random.Generator) -> Callable[[ClutterGraph, NDArray[np.bool_]], int]:
    """The baseline RG: uniform over the feasible rules."""
    return lambda _, mask: int(rng.choice(np.flatnonzero(mask)))


def _extend(graph: ClutterGraph, left: Pattern, root: int) -> dict[str, int] | None:
    """The match of a pattern whose root is the given node, or None. Children are tried in order, with backtracking."""
    kinds = graph.nx.nodes
    root_name = next(iter(left.nodes))
    if kinds[root]["kind"] not in left.nodes[root_name]:
        return None

    def extend(match: Mapping[str, int], edges: tuple[tuple[str, str], ...]) -> dict[str, int] | None:
        if not edges:
            return dict(match)
        (parent, child), rest = edges[0], edges[1:]
        for node, edge in graph.nx.adj[match[parent]].items():
            if edge["kind"] == PRIMITIVE and kinds[node]["kind"] in left.nodes[child]:
                found = extend({**match, child: node}, rest)
                if found is not None:
                    return found
        return None

    return extend({root_name: root}, left.edges)
