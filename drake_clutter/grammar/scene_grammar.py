"""Matching and applying production rules under a budget of nodes."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drake_clutter.catalog import ObjectClass
from drake_clutter.files import InputError
from drake_clutter.grammar.clutter_graph import OPEN_SLOT, PRIMITIVE, ClutterGraph
from drake_clutter.grammar.production_rules import (
    KEEP,
    Pattern,
    ProductionRule,
    make_production_rules,
)

MIN_NODES = 3  # tray, one object, end


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
        if self.nodes < MIN_NODES:
            raise InputError(
                f"nodes: {self.nodes}; allowed is {MIN_NODES} (tray, one object, end) or more"
            )


@dataclass(frozen=True)
class Derivation:
    """A terminal graph and the names of the rules that derived it, in order."""

    graph: ClutterGraph
    rules: tuple[str, ...]


Match = Mapping[str, int]
"""The graph's node for each node of a G_L, by its name in the rule."""


class SceneGrammar:
    """G = (N_NT, N_T, E, R, S) for a set of object classes (paper, eq. 1).

    Attributes:
        classes: by name.
        rules: in the order of the sheet.
        rule_indices: of each rule, by name.
        patterns: the few left-hand sides that the rules share.
        pattern_indices: (rules,) each rule's left-hand side among them.
    """

    def __init__(self, classes: Sequence[ObjectClass]) -> None:
        self.classes = {object_class.name: object_class for object_class in classes}
        self.rules = make_production_rules(classes)
        self.rule_indices = {rule.name: index for index, rule in enumerate(self.rules)}
        self.patterns = list({id(rule.left): rule.left for rule in self.rules}.values())
        self.pattern_indices = [
            next(k for k, left in enumerate(self.patterns) if left is rule.left)
            for rule in self.rules
        ]
        self._nodes_added = np.array([rule.nodes_added for rule in self.rules])
        self._open_slots_added = np.array([rule.open_slots_added for rule in self.rules])

    def find_match(self, graph: ClutterGraph, left: Pattern) -> Match | None:
        """The first subgraph that G_L matches: the tray leads to its root first, breadth first, siblings in order.

        Returns:
            The graph's node for each node of G_L, or None if nothing matches.
        """
        return _first_match(graph, left, graph.breadth_first_order())

    def find_matches(self, graph: ClutterGraph) -> list[Match | None]:
        """The first match of each of `patterns`."""
        order = graph.breadth_first_order()
        return [_first_match(graph, left, order) for left in self.patterns]

    def feasible_rules(
        self, graph: ClutterGraph, budget: NodeBudget, matches: Sequence[Match | None] | None = None
    ) -> NDArray[np.bool_]:
        """(rules,) which rules match and neither overrun the budget nor, if it is exact, leave it unfillable.

        What is left can be filled unless it is one node with no open slot to stack on: a drop and a pair both add two.

        Args:
            graph: a derived graph.
            budget: how large it may become.
            matches: of the graph, if they are known.
        """
        open_slots = sum(kind == OPEN_SLOT for kind in graph.kinds())
        remaining = budget.nodes - len(graph) - self._nodes_added
        allowed = remaining >= 0
        if budget.exact:
            allowed &= (remaining != 1) | (open_slots + self._open_slots_added > 0)
        has_match = np.array([match is not None for match in matches or self.find_matches(graph)])
        return np.asarray(allowed & has_match[self.pattern_indices])

    def apply_rule(self, graph: ClutterGraph, rule: ProductionRule) -> ClutterGraph:
        """A new graph in which the first match of G_L is replaced by G_R.

        Raises:
            ValueError: the rule does not match.
        """
        match = self.find_match(graph, rule.left)
        if match is None:
            raise ValueError(f"rule {rule.name} does not match the graph")
        result = graph.copy()
        self.rewrite_in_place(result, rule, match)
        return result

    @staticmethod
    def rewrite_in_place(graph: ClutterGraph, rule: ProductionRule, match: Match) -> None:
        """Replaces a match of G_L by G_R, in place."""
        nodes = dict(match)
        for parent, child in rule.left.edges:
            if (parent, child) not in rule.right_edges:
                graph.nx.remove_edge(nodes[parent], nodes[child])
        next_node = max(graph.nx) + 1
        for name, kind in rule.right_nodes.items():
            if name not in nodes:
                nodes[name] = next_node
                next_node += 1
            if kind != KEEP:
                graph.nx.add_node(nodes[name], kind=kind)
        for (parent, child), edge_kind in rule.right_edges.items():
            graph.nx.add_edge(nodes[parent], nodes[child], kind=edge_kind)

    def replay(self, rules: Sequence[str]) -> ClutterGraph:
        """The graph that a sequence of rules, by name, derives from the start graph.

        Raises:
            ValueError: an unknown rule, or one that does not match when its turn comes.
        """
        graph = ClutterGraph()
        for name in rules:
            if name not in self.rule_indices:
                raise ValueError(
                    f"rule {name!r} is unknown; known are {', '.join(self.rule_indices)}"
                )
            graph = self.apply_rule(graph, self.rules[self.rule_indices[name]])
        return graph

    def derive(
        self, budget: NodeBudget, choose: Callable[[ClutterGraph, NDArray[np.bool_]], int]
    ) -> Derivation:
        """Applies rules from the start graph on, until none is feasible.

        Args:
            budget: how large the graph may become.
            choose: given the graph and the mask of feasible rules, the index of the rule to apply.
        """
        graph, names = ClutterGraph(), []
        while (
            mask := self.feasible_rules(graph, budget, matches := self.find_matches(graph))
        ).any():
            rule_index = choose(graph, mask)
            rule, match = self.rules[rule_index], matches[self.pattern_indices[rule_index]]
            assert match is not None, f"rule {rule.name} was chosen, which is not feasible"
            self.rewrite_in_place(graph, rule, match)
            names.append(rule.name)
        return Derivation(graph, tuple(names))


def uniform_choice(rng: np.random.Generator) -> Callable[[ClutterGraph, NDArray[np.bool_]], int]:
    """The baseline RG: uniform over the feasible rules."""
    return lambda _, mask: int(rng.choice(np.flatnonzero(mask)))


def _first_match(graph: ClutterGraph, left: Pattern, roots: Iterable[int]) -> Match | None:
    """The match whose root is the first possible of the given nodes. Children are tried in order, with backtracking."""
    nodes, edges = (
        graph.nx._node,
        graph.nx._adj,
    )  # as networkx's own loops do: its views cost more than the matching
    root_name, root_kinds = next(iter(left.nodes.items()))

    def extend(match: Match, pattern_edges: tuple[tuple[str, str], ...]) -> Match | None:
        if not pattern_edges:
            return match
        (parent, child), rest = pattern_edges[0], pattern_edges[1:]
        kinds = left.nodes[child]
        for node, edge in edges[match[parent]].items():
            if edge["kind"] == PRIMITIVE and nodes[node]["kind"] in kinds:
                found = extend({**match, child: node}, rest)
                if found is not None:
                    return found
        return None

    for root in roots:
        if nodes[root]["kind"] in root_kinds:
            match = extend({root_name: root}, left.edges)
            if match is not None:
                return match
    return None
