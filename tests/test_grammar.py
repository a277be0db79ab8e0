"""Production rules, matching, budgets, and derivations under several policies."""

from collections import Counter
from collections.abc import Callable

import networkx as nx
import numpy as np
import pytest
from conftest import CLASSES, GRAMMARS, rng
from hypothesis import given, settings
from hypothesis import strategies as st
from networkx.algorithms.isomorphism import DiGraphMatcher
from numpy.typing import NDArray

from drake_clutter.files import InputError
from drake_clutter.grammar import (
    ClutterGraph,
    NodeBudget,
    Orientation,
    SceneGrammar,
    uniform_choice,
)
from drake_clutter.grammar.clutter_graph import DUMMY, END, OBJECT_SLOT, OPEN_SLOT, PRIMITIVE, TRAY
from drake_clutter.grammar.production_rules import KEEP, ProductionRule

Choose = Callable[[ClutterGraph, NDArray[np.bool_]], int]
Nodes = list[tuple[int, str]]
Edges = list[tuple[int, int, Orientation | str]]

YCB = GRAMMARS["ycb7"]
STRUCTURE = ("drop_object", "stack_object", "end")
ORIENT = tuple(f"orient_{orientation.name.lower()}" for orientation in Orientation)
# A stack of two objects, and a stack of a pair with one object on top: the example of the paper.
EXAMPLE = (
    *(
        "drop_object",
        "stack_object",
        "end",
        "insert_tomato_soup_can",
        "insert_sugar_box",
        "orient_flat_0",
        "orient_flat_30",
    ),
    *(
        "drop_object",
        "stack_object",
        "end",
        "insert_meta_pudding_box_1",
        "insert_cracker_box",
        "orient_upright_90",
    ),
)


def ordered(graph: ClutterGraph) -> tuple[Nodes, Edges]:
    """Return nodes and edges with their kinds, in order."""
    return list(graph.digraph.nodes(data="kind")), list(graph.digraph.edges(data="kind"))


# --- The rule sheet ---


@pytest.mark.parametrize(
    ("objects", "count", "metas"),
    [
        (
            "ycb7",
            30,
            {
                **{"cracker_box": 2, "sugar_box": 2, "pudding_box": 2, "gelatin_box": 1},
                **{"master_chef_can": 1, "tomato_soup_can": 1, "large_marker": 1},
            },
        ),
        (
            "pantry14",
            49,
            {
                **{"cracker_box": 2, "sugar_box": 2, "pudding_box": 2, "gelatin_box": 1},
                **{"master_chef_can": 1, "tomato_soup_can": 1, "large_marker": 1},
                **{
                    "cereal_box_large": 2,
                    "cereal_box_small": 2,
                    "granola_box": 2,
                    "pasta_box": 2,
                    "lasagna_box": 2,
                },
                **{"chips_box": 1, "pringles_can": 1},
            },
        ),
    ],
)
def test_the_rules_are_those_of_the_sheet(objects: str, count: int, metas: dict[str, int]) -> None:
    names = [rule.name for rule in GRAMMARS[objects].rules]
    insertions = [f"insert_{name}" for name in metas]
    insertions += [
        f"insert_meta_{name}_{number}"
        for name, total in metas.items()
        for number in range(1, total + 1)
    ]
    assert len(names) == count
    assert Counter(names) == Counter([*STRUCTURE, *insertions, *ORIENT])
    assert len(insertions) == count - 13


def edges_by_kind(rule: ProductionRule) -> Counter[tuple[str, str, Orientation | str]]:
    """Return the edges of G_R as (parent's kind, child's kind, edge's kind).

    A node that keeps its kind is given by its name.
    """
    kinds = {name: name if kind == KEEP else kind for name, kind in rule.right_nodes.items()}
    return Counter(
        (kinds[parent], kinds[child], kind) for (parent, child), kind in rule.right_edges.items()
    )


def test_left_and_right_of_every_kind_of_rule() -> None:
    rules = {rule.name: rule for rule in YCB.rules}
    drop, push, end = (rules[name] for name in STRUCTURE)
    assert list(drop.left.nodes.values()) == [{TRAY}]
    assert edges_by_kind(drop) == {
        ("tray", OBJECT_SLOT, PRIMITIVE): 1,
        (OBJECT_SLOT, OPEN_SLOT, PRIMITIVE): 1,
    }
    for rule in (push, end):
        assert list(rule.left.nodes.values()) == [{OBJECT_SLOT}, {OPEN_SLOT}]
        assert rule.left.edges == (("slot", "top"),)
    assert edges_by_kind(push) == {
        ("slot", OBJECT_SLOT, PRIMITIVE): 1,
        (OBJECT_SLOT, OPEN_SLOT, PRIMITIVE): 1,
    }
    assert edges_by_kind(end) == {("slot", END, PRIMITIVE): 1}

    single, lying, standing = (
        rules[name]
        for name in ("insert_sugar_box", "insert_meta_sugar_box_1", "insert_meta_sugar_box_2")
    )
    assert edges_by_kind(single) == {
        ("parent", "sugar_box", PRIMITIVE): 1,
        ("sugar_box", "child", PRIMITIVE): 1,
    }
    for rule, orientation in ((lying, Orientation.FLAT_0), (standing, Orientation.UPRIGHT_0)):
        assert rule.left.nodes["slot"] == {OBJECT_SLOT}
        assert rule.left.nodes["child"] == {OBJECT_SLOT, END}
        assert not rule.left.nodes["parent"] & {OBJECT_SLOT, OPEN_SLOT, END}
        assert edges_by_kind(rule) == {
            ("parent", "sugar_box", orientation): 2,
            ("sugar_box", DUMMY, orientation): 2,
            (DUMMY, "child", PRIMITIVE): 1,
        }
    for name, orientation in zip(ORIENT, Orientation, strict=True):
        assert rules[name].left.nodes["child"] == set(YCB.classes)
        assert edges_by_kind(rules[name]) == {("parent", "child", orientation): 1}
    growth = {"drop_object": 2, "stack_object": 1} | {name: 2 for name in rules if "meta" in name}
    assert {name: rule.nodes_added for name, rule in rules.items() if rule.nodes_added} == growth
    assert {rule.name: rule.open_slots_added for rule in YCB.rules if rule.open_slots_added} == {
        "drop_object": 1,
        "end": -1,
    }


def test_the_papers_example() -> None:
    graph = YCB.replay(EXAMPLE)
    assert ordered(graph) == (
        [
            (0, TRAY),
            (1, "tomato_soup_can"),
            (2, "sugar_box"),
            (3, END),
            (4, "pudding_box"),
            (5, "cracker_box"),
            (6, END),
            (7, "pudding_box"),
            (8, DUMMY),
        ],
        [
            (0, 1, Orientation.FLAT_0),
            (0, 4, Orientation.FLAT_0),
            (0, 7, Orientation.FLAT_0),
            (1, 2, Orientation.FLAT_30),
            (2, 3, PRIMITIVE),
            (4, 8, Orientation.FLAT_0),
            (5, 6, PRIMITIVE),
            (7, 8, Orientation.FLAT_0),
            (8, 5, Orientation.UPRIGHT_90),
        ],
    )
    assert graph.is_terminal
    assert list(graph.objects()) == [
        *(
            (1, "tomato_soup_can"),
            (2, "sugar_box"),
            (4, "pudding_box"),
            (5, "cracker_box"),
            (7, "pudding_box"),
        )
    ]


def test_terminal_only_when_the_last_orientation_is_given() -> None:
    for length in range(len(EXAMPLE)):
        terminal_so_far = length in (0, 7)  # the tray alone; the finished first stack
        assert YCB.replay(EXAMPLE[:length]).is_terminal == terminal_so_far


def test_an_insertion_waits_for_a_closed_top_and_a_terminal_parent() -> None:
    graph = ClutterGraph()
    budget = NodeBudget(20)

    def feasible(*rules: str) -> set[str]:
        mask = YCB.feasible_rules(YCB.replay(rules), budget)
        return {
            rule.name.split("_")[0]
            for rule, allowed in zip(YCB.rules, mask, strict=True)
            if allowed
        }

    assert YCB.feasible_rules(graph, budget).sum() == 1
    assert feasible("drop_object") == {"drop", "stack", "end"}
    assert feasible("drop_object", "end") == {"drop", "insert"}
    assert feasible("drop_object", "stack_object") == {"drop", "stack", "end", "insert"}
    two = YCB.replay(["drop_object", "stack_object", "stack_object", "end"])
    inserted = YCB.apply_rule(two, YCB.rules[YCB.rule_indices["insert_sugar_box"]])
    assert [inserted.kind(node) for node in range(5)] == [
        TRAY,
        "sugar_box",
        OBJECT_SLOT,
        OBJECT_SLOT,
        END,
    ]


def test_the_first_match_is_breadth_first_with_siblings_in_order() -> None:
    """A slot at depth one of the second stack is matched before one at depth two of the first."""
    begun = ("drop_object", "stack_object", "end", "insert_sugar_box", "drop_object", "end")
    graph = YCB.replay([*begun, "insert_cracker_box"])
    assert [graph.kind(child) for child in graph.children(0)] == ["sugar_box", "cracker_box"]
    oriented = YCB.replay([*begun, "insert_cracker_box", "orient_side_0", "orient_side_90"])
    assert [oriented.edge_kind(0, child) for child in oriented.children(0)] == [
        Orientation.SIDE_0,
        Orientation.SIDE_90,
    ]
    both_open = YCB.replay(["drop_object", "drop_object", "end"])
    assert [both_open.kind(both_open.children(child)[0]) for child in both_open.children(0)] == [
        END,
        OPEN_SLOT,
    ]


def test_apply_leaves_its_argument_alone() -> None:
    graph = YCB.replay(EXAMPLE[:5])
    before = ordered(graph.copy())
    for rule, feasible in zip(YCB.rules, YCB.feasible_rules(graph, NodeBudget(20)), strict=True):
        if feasible:
            YCB.apply_rule(graph, rule)
    assert ordered(graph) == before


def test_a_rule_that_does_not_match_or_exist_is_refused() -> None:
    with pytest.raises(ValueError, match="rule end does not match"):
        YCB.replay(["end"])
    with pytest.raises(ValueError, match="'insert_teapot' is unknown; known are drop_object"):
        YCB.replay(["drop_object", "insert_teapot"])


@pytest.mark.parametrize("nodes", [-1, 0, 2])
def test_a_budget_too_small_for_an_object_is_refused(nodes: int) -> None:
    with pytest.raises(InputError, match=f"nodes: {nodes}; expected 3"):
        NodeBudget(nodes)


# --- Derivations ---


def seeded_uniform(seed: int) -> Choose:
    return uniform_choice(rng(seed))


def preferring(*prefixes: str) -> Callable[[int], Choose]:
    """Choose uniformly among the feasible rules of the first kind that has any.

    Rules of kinds that are not named come last.
    """

    def make(seed: int) -> Choose:
        generator = rng(seed)

        def choose(graph: ClutterGraph, mask: NDArray[np.bool_]) -> int:
            names = {
                int(index): YCB_AND_PANTRY[len(mask)].rules[index].name
                for index in np.flatnonzero(mask)
            }
            for prefix in (*prefixes, ""):
                if fitting := [index for index, name in names.items() if name.startswith(prefix)]:
                    return int(generator.choice(fitting))
            raise AssertionError("no rule is feasible")

        return choose

    return make


YCB_AND_PANTRY = {len(grammar.rules): grammar for grammar in GRAMMARS.values()}
POLICIES: dict[str, Callable[[int], Choose]] = {
    "uniform": seeded_uniform,
    "lowest index": lambda _: lambda _, mask: int(np.flatnonzero(mask)[0]),
    "highest index": lambda _: lambda _, mask: int(np.flatnonzero(mask)[-1]),
    "structure first": preferring("drop", "stack", "end"),
    "drop only": preferring("drop"),
    "one tower": preferring("stack", "insert_meta"),
    "close at once": preferring("end", "insert_meta", "orient"),
    "insert first": preferring("insert"),
    "pairs first": preferring("insert_meta", "end"),
    "orient first": preferring("orient", "insert", "end"),
}


@settings(max_examples=30)
@pytest.mark.parametrize("policy", POLICIES)
@given(
    objects=st.sampled_from(sorted(GRAMMARS)),
    nodes=st.integers(3, 40),
    exact=st.booleans(),
    seed=st.integers(0, 2**32 - 1),
)
def test_every_derivation_ends_terminal_and_in_budget(
    policy: str, objects: str, nodes: int, exact: bool, seed: int
) -> None:
    grammar = GRAMMARS[objects]
    derivation = grammar.derive(NodeBudget(nodes, exact), POLICIES[policy](seed))
    graph = derivation.graph
    assert graph.is_terminal
    assert len(graph) == nodes if exact else nodes - 1 <= len(graph) <= nodes
    assert len(graph.breadth_first_order()) == len(graph)
    assert ordered(grammar.replay(derivation.rules)) == ordered(graph)
    rebuilt = ClutterGraph.from_parts(
        dict(ordered(graph)[0]), {(a, b): kind for a, b, kind in ordered(graph)[1]}
    )
    assert ordered(rebuilt) == ordered(graph)
    assert sum(1 for _ in graph.objects()) >= 1


def test_both_object_sets_use_every_rule() -> None:
    for grammar in GRAMMARS.values():
        generator = rng(5)
        used = {
            name
            for _ in range(60)
            for name in grammar.derive(NodeBudget(25), uniform_choice(generator)).rules
        }
        assert used == set(grammar.rule_indices)


def matches_by_networkx(graph: ClutterGraph, rule: ProductionRule) -> bool:
    """Return whether G_L is monomorphic to a subgraph, by an independent library."""
    pattern = nx.DiGraph()
    for name, kinds in rule.left.nodes.items():
        pattern.add_node(name, kinds=kinds)
    pattern.add_edges_from(rule.left.edges)
    matcher = DiGraphMatcher(
        graph.digraph,
        pattern,
        lambda host, left: host["kind"] in left["kinds"],
        lambda host, _: host["kind"] == PRIMITIVE,
    )
    return bool(matcher.subgraph_is_monomorphic())


@pytest.mark.parametrize("objects", sorted(GRAMMARS))
def test_feasible_rules_are_those_that_match_and_fit(objects: str) -> None:
    """The budget's part of feasibility follows from size and open slots.

    It is recomputed here from the result of the rule.
    """
    grammar = GRAMMARS[objects]
    compared = Counter[bool]()
    for seed in range(6):
        generator = rng(seed)
        budget = NodeBudget(5 + 3 * seed, exact=seed % 2 == 0)
        graph = ClutterGraph()
        while (mask := grammar.feasible_rules(graph, budget)).any():
            for rule, feasible in zip(grammar.rules, mask, strict=True):
                expected = matches_by_networkx(graph, rule)
                if expected:
                    result = grammar.apply_rule(graph, rule)
                    left = budget.nodes - len(result)
                    can_stack = OPEN_SLOT in dict(ordered(result)[0]).values()
                    expected = left >= 0 and (not budget.exact or left != 1 or can_stack)
                assert feasible == expected, f"{rule.name} at seed {seed}"
                compared[expected] += 1
            graph = grammar.apply_rule(
                graph, grammar.rules[int(generator.choice(np.flatnonzero(mask)))]
            )
    assert min(compared.values()) > 500


@pytest.mark.parametrize("nodes", [3, 4, 5, 6, 7])
@pytest.mark.parametrize("exact", [True, False])
def test_feasible_is_exactly_what_can_be_completed(nodes: int, exact: bool) -> None:
    """A rule is feasible if and only if a continuation reaches a terminal graph of the size.

    All states of a small grammar: one class with one pair, and one of the ten orientations, which
    all match alike.
    """
    grammar = SceneGrammar([CLASSES["gelatin_box"]])
    rules = [
        rule
        for rule in grammar.rules
        if not rule.name.startswith("orient") or rule.name == ORIENT[0]
    ]

    def key(graph: ClutterGraph) -> str:
        return repr(ordered(graph))

    start = ClutterGraph()
    states, successors, queue = {key(start): start}, {}, [start]
    while queue:
        graph = queue.pop()
        results = {
            rule.name: grammar.apply_rule(graph, rule)
            for rule in rules
            if matches_by_networkx(graph, rule)
        }
        successors[key(graph)] = {
            name: key(result) for name, result in results.items() if len(result) <= nodes
        }
        for result in results.values():
            if len(result) <= nodes and key(result) not in states:
                states[key(result)] = result
                queue.append(result)

    # A graph of the right size that is terminal is an end; the tray alone is not one of them.
    completable = {
        name
        for name, graph in states.items()
        if graph.is_terminal and (len(graph) == nodes or not exact)
    }
    completable -= set() if exact else {key(start)}
    grown = True
    while grown:
        more = {
            name for name, following in successors.items() if completable & set(following.values())
        } - completable
        completable |= more
        grown = bool(more)

    reachable, queue = {key(start)}, [start]
    while queue:
        graph = queue.pop()
        mask = dict(
            zip(
                grammar.rule_indices,
                grammar.feasible_rules(graph, NodeBudget(nodes, exact)),
                strict=True,
            )
        )
        following = successors[key(graph)]
        for rule in rules:
            assert mask[rule.name] == (
                rule.name in following and following[rule.name] in completable
            )
            if mask[rule.name] and following[rule.name] not in reachable:
                reachable.add(following[rule.name])
                queue.append(states[following[rule.name]])
        if not any(mask.values()):
            assert graph.is_terminal
            assert len(graph) == nodes if exact else len(graph) >= nodes - 1
    assert len(reachable) >= nodes


# --- Graphs ---


@pytest.mark.parametrize(
    ("nodes", "edges", "message"),
    [
        ({0: "sugar_box"}, {}, "exactly one tray"),
        ({0: TRAY, 1: TRAY}, {(0, 1): PRIMITIVE}, "exactly one tray"),
        ({0: TRAY, 1: END}, {}, "is reachable from the tray"),
        ({0: TRAY, 1: END}, {(0, 2): PRIMITIVE}, "0 -> 2 refers to a node that does not exist"),
        (
            {0: TRAY, 1: "sugar_box", 2: END},
            {(0, 1): PRIMITIVE, (1, 2): PRIMITIVE, (2, 1): PRIMITIVE},
            "acyclic",
        ),
        ({0: TRAY, 1: "sugar_box"}, {(0, 1): PRIMITIVE, (1, 1): PRIMITIVE}, "acyclic"),
    ],
)
def test_graphs_that_are_none(
    nodes: dict[int, str], edges: dict[tuple[int, int], str], message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        ClutterGraph.from_parts(nodes, edges)
