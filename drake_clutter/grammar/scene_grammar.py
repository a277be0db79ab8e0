"""Matching and applying production rules within a budget of nodes."""

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
from drake_clutter.limits import MAX_NODES

MIN_NODES = 3
"""Size of the smallest scene: tray, one object, end."""


@dataclass(frozen=True)
class NodeBudget:
    """Size that a derived graph may reach.

    Attributes:
        nodes: Largest number of nodes of all kinds.
        exact: Whether the graph must reach it. Otherwise a derivation may end one node short.
    """

    nodes: int
    exact: bool = True

    def __post_init__(self) -> None:
        if not MIN_NODES <= self.nodes <= MAX_NODES:
            raise InputError(
                f"nodes: {self.nodes}; expected {MIN_NODES} (tray, one object, end) or more, "
                f"up to {MAX_NODES}"
            )


@dataclass(frozen=True)
class Derivation:
    """A terminal graph and the names of the rules that derived it, in order.

    Attributes:
        graph: The terminal graph.
        rules: Names of the rules.
    """

    graph: ClutterGraph
    rules: tuple[str, ...]


Match = Mapping[str, int]
"""Node of the graph for each node of a G_L, by its name in the rule."""


class SceneGrammar:
    """The grammar G = (N_NT, N_T, E, R, S) for a set of object classes.

    Source: Kumar et al. 2022, eq. 1.

    Attributes:
        classes: Object classes by name.
        rules: All rules.
        rule_indices: Index of each rule by name.
        patterns: The different left-hand sides of the rules.
        pattern_indices: Index of each rule's left-hand side in `patterns`.
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
        """Return the first match of G_L in a graph, or None.

        The root of the match is the first possible node, breadth first; siblings are tried in
        order.
        """
        return _first_match(graph, left, graph.breadth_first_order())

    def find_matches(self, graph: ClutterGraph) -> list[Match | None]:
        """Return the first match of each of `patterns`, or None."""
        order = graph.breadth_first_order()
        return [_first_match(graph, left, order) for left in self.patterns]

    def feasible_rules(
        self, graph: ClutterGraph, budget: NodeBudget, matches: Sequence[Match | None] | None = None
    ) -> NDArray[np.bool_]:
        """Return which rules match and keep the graph within its budget.

        With an exact budget, the rest must also be fillable. It is, unless a single node remains
        and there is no open slot to stack on: an object on the tray and a pair add two nodes each.

        Args:
            graph: A derived graph.
            budget: Size that the graph may reach.
            matches: Result of `find_matches` for the graph, if known.

        Returns:
            One bool for each rule. Shape (rules,).
        """
        open_slots = sum(kind == OPEN_SLOT for kind in graph.kinds())
        remaining = budget.nodes - len(graph) - self._nodes_added
        allowed = remaining >= 0
        if budget.exact:
            allowed &= (remaining != 1) | (open_slots + self._open_slots_added > 0)
        has_match = np.array([match is not None for match in matches or self.find_matches(graph)])
        return np.asarray(allowed & has_match[self.pattern_indices])

    def apply_rule(self, graph: ClutterGraph, rule: ProductionRule) -> ClutterGraph:
        """Return a new graph in which the first match of G_L is replaced by G_R.

        Raises:
            ValueError: The rule does not match.
        """
        match = self.find_match(graph, rule.left)
        if match is None:
            raise ValueError(f"rule {rule.name} does not match the graph")
        result = graph.copy()
        self.rewrite_in_place(result, rule, match)
        return result

    @staticmethod
    def rewrite_in_place(graph: ClutterGraph, rule: ProductionRule, match: Match) -> None:
        """Replace a match of G_L by G_R in a graph."""
        nodes = dict(match)
        for parent, child in rule.left.edges:
            if (parent, child) not in rule.right_edges:
                graph.digraph.remove_edge(nodes[parent], nodes[child])
        next_node = max(graph.digraph) + 1
        for name, kind in rule.right_nodes.items():
            if name not in nodes:
                nodes[name] = next_node
                next_node += 1
            if kind != KEEP:
                graph.digraph.add_node(nodes[name], kind=kind)
        for (parent, child), edge_kind in rule.right_edges.items():
            graph.digraph.add_edge(nodes[parent], nodes[child], kind=edge_kind)

    def replay(self, rules: Sequence[str]) -> ClutterGraph:
        """Return the graph that a sequence of rules derives from the start graph.

        Args:
            rules: Names of the rules.

        Raises:
            ValueError: A rule is unknown, or does not match.
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
        """Apply rules to the start graph until no rule is feasible.

        Args:
            budget: Size that the graph may reach.
            choose: Returns the index of the next rule, given the graph and the mask of feasible
                rules.
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
    """Return the baseline policy RG, which chooses uniformly among the feasible rules."""
    return lambda _, mask: int(rng.choice(np.flatnonzero(mask)))


def _first_match(graph: ClutterGraph, left: Pattern, roots: Iterable[int]) -> Match | None:
    """Return the match with the first possible root, by backtracking.

    Args:
        graph: The graph.
        left: Left-hand side G_L.
        roots: Candidates for the root, in order.
    """
    # networkx's views would take longer than the matching itself.
    nodes = graph.digraph._node
    edges = graph.digraph._adj
    root_name, root_kinds = next(iter(left.nodes.items()))

    def extend(match: Match, pattern_edges: tuple[tuple[str, str], ...]) -> Match | None:
        if not pattern_edges:
            return match
        (parent, child), rest = pattern_edges[0], pattern_edges[1:]
        kinds = left.nodes[child]
        for node, edge in edges[match[parent]].items():
            if edge["kind"] == PRIMITIVE and nodes[node]["kind"] in kinds:
                extended = extend({**match, child: node}, rest)
                if extended is not None:
                    return extended
        return None

    for root in roots:
        if nodes[root]["kind"] in root_kinds:
            match = extend({root_name: root}, left.edges)
            if match is not None:
                return match
    return None
