"""The generation environment: observations, rewards and termination."""

import gymnasium
import networkx as nx
import numpy as np
import pytest
from conftest import CLASSES, GRAMMARS, rng
from gymnasium.utils.env_checker import check_env
from numpy.typing import NDArray

from drake_clutter.grammar import ClutterGraph, NodeBudget, canonical_form
from drake_clutter.grammar.clutter_graph import DUMMY, END, NON_TERMINAL_KINDS, PRIMITIVE
from drake_clutter.tasks.generation_task import (
    ClutterGeneration,
    GenerationObservation,
    GenerationTaskConfig,
    StackFailure,
    max_edges,
)


def random_action(mask: np.ndarray, generator: np.random.Generator) -> int:
    return int(generator.choice(np.flatnonzero(mask)))


def graph_of(observation: GenerationObservation, environment: ClutterGeneration) -> ClutterGraph:
    """Return the graph that an observation represents."""
    kinds, edge_kinds = environment.vocabulary.node_kinds, environment.vocabulary.edge_kinds
    nodes = {k: kinds[kind - 1] for k, kind in enumerate(observation["node_kind"].tolist()) if kind}
    edges = {
        (parent, child): edge_kinds[kind - 1]
        for (parent, child), kind in zip(
            observation["edge_links"].tolist(), observation["edge_kind"].tolist(), strict=True
        )
        if kind
    }
    return ClutterGraph.from_parts(nodes, edges)


def finished_stacks(graph: ClutterGraph) -> set[int]:
    """Return the object nodes of the stacks whose attributes are all terminal."""
    found = set()
    for bottom in graph.stack_bases():
        members = set(bottom).union(*(nx.descendants(graph.digraph, node) for node in bottom))
        edges = [
            e
            for e in graph.digraph.edges(data="kind")
            if e[1] in members and graph.kind(e[1]) != END
        ]
        if all(graph.kind(node) not in NON_TERMINAL_KINDS for node in members) and all(
            kind != PRIMITIVE for *_, kind in edges
        ):
            found |= {node for node in members if graph.kind(node) not in (END, DUMMY)}
    return found


def test_the_environment_passes_gymnasium_s_checks() -> None:
    environment = gymnasium.make("drake_clutter.tasks:ClutterGeneration-v0")
    assert isinstance(environment.unwrapped, ClutterGeneration)
    check_env(environment.unwrapped, skip_render_check=True)


def test_the_bounds_of_observations() -> None:
    environment = ClutterGeneration(task=GenerationTaskConfig(nodes=9))
    assert isinstance(environment.observation_space, gymnasium.spaces.Dict)
    spaces = environment.observation_space.spaces
    vocabulary = environment.vocabulary
    bounds = {
        name: (float(space.low.min()), float(space.high.max()))
        for name, space in spaces.items()
        if isinstance(space, gymnasium.spaces.Box)
    }
    assert bounds == {
        "node_kind": (0, len(vocabulary.node_kinds)),
        "node_mask": (0, 1),
        "node_flags": (0, 1),
        "position": (pytest.approx(-0.7), pytest.approx(0.7)),  # the size of the tray
        "edge_links": (0, 8),
        "edge_kind": (0, len(vocabulary.edge_kinds)),
        "edge_mask": (0, 1),
        "remaining_nodes": (0, pytest.approx(9 / 25)),
    }


@pytest.mark.parametrize("objects", ["ycb7", "pantry14"])
def test_the_observation_represents_the_graph(objects: str) -> None:
    """It includes the finished stacks and the positions of their objects."""
    grammar = GRAMMARS[objects]
    environment, generator = (
        ClutterGeneration(list(grammar.classes.values()), GenerationTaskConfig(nodes=14)),
        rng(1),
    )
    num_stacks = 0
    for episode in range(25):
        observation, info = environment.reset(seed=episode)
        terminated = False
        while not terminated:
            graph = environment.partial.graph
            observed = graph_of(observation, environment)
            assert [observed.kind(k) for k in observed.digraph] == graph.kinds()
            assert dict(observed.digraph.edges) == dict(graph.digraph.edges)
            assert (info["action_mask"] == grammar.feasible_rules(graph, NodeBudget(14))).all()
            assert (observation["node_mask"] == (observation["node_kind"] > 0)).all()
            assert (observation["edge_mask"] == (observation["edge_kind"] > 0)).all()
            assert observation["remaining_nodes"] == pytest.approx((14 - len(graph)) / 25)
            simulated = set(np.flatnonzero(observation["node_flags"][:, 0]).tolist())
            assert simulated == finished_stacks(graph)
            num_stacks += bool(simulated)
            for node in range(14):
                if node in simulated:
                    assert observation["position"][node, 2] > 0
                else:
                    assert (observation["position"][node] == 0).all()
            observation, _, terminated, truncated, info = environment.step(
                random_action(info["action_mask"], generator)
            )
            assert not truncated
    assert num_stacks > 50


def test_the_flags_mark_the_nodes_that_rules_rewrite() -> None:
    environment, generator = ClutterGeneration(task=GenerationTaskConfig(nodes=14)), rng(2)
    grammar, changed_kinds = environment.grammar, 0
    for episode in range(15):
        observation, info = environment.reset(seed=episode)
        terminated = False
        while not terminated:
            action = random_action(info["action_mask"], generator)
            rule, before = grammar.rules[action], environment.partial.graph.copy()
            marked = (
                np.flatnonzero(
                    observation["node_flags"][
                        :, 1 + ["top", "slot", "child"].index(rule.left.target)
                    ]
                )
                if (rule.left.target != "tray")
                else np.array([0])
            )
            observation, _, terminated, _, info = environment.step(action)
            after = environment.partial.graph
            changed = {n for n in before.digraph if before.kind(n) != after.kind(n)}
            changed |= {
                child
                for _, child in set(before.digraph.edges) & set(after.digraph.edges)
                if any(
                    before.edge_kind(p, child) != after.edge_kind(p, child)
                    for p in before.digraph.predecessors(child)
                )
                and rule.left.target == "child"
            }
            if changed:
                changed_kinds += 1
                assert changed == set(marked.tolist()), rule.name
    assert changed_kinds > 200


def test_rewards_sum_up_to_the_terminal_reward() -> None:
    task = GenerationTaskConfig(
        nodes=14, hidden_reward=0.5, balance_reward=0.25, instability_reward=-1.0
    )
    environment, generator = ClutterGeneration(task=task), rng(3)
    stable = unstable = 0
    balanced = set()
    for episode in range(120):
        _, info = environment.reset(seed=episode)
        total, terminated = 0.0, False
        while not terminated:
            _, reward, terminated, _, info = environment.step(
                random_action(info["action_mask"], generator)
            )
            total += float(reward)
        if "scene" in info:
            stable += 1
            assert info["verdict"].stable
            sizes = [len(stack) for stack in info["scene"].graph.stack_objects()]
            balanced.add(max(sizes) <= 0.6 * sum(sizes))
            assert total == pytest.approx(
                0.5 * len(info["verdict"].hidden) + (0.25 if max(sizes) <= 0.6 * sum(sizes) else 0)
            )
            assert info["scene"].graph.is_terminal
            assert len(info["scene"].graph) == 14
            derived = environment.grammar.replay(info["scene"].derivation)
            assert canonical_form(derived, CLASSES) == canonical_form(info["scene"].graph, CLASSES)
        else:
            unstable += 1
            assert total == pytest.approx(-1.0)
    assert stable > 20
    assert unstable > 20
    assert balanced == {True, False}


def test_an_infeasible_rule_changes_nothing() -> None:
    environment = ClutterGeneration(task=GenerationTaskConfig(nodes=8))
    before, info = environment.reset(seed=0)
    infeasible = int(np.flatnonzero(info["action_mask"] == 0)[0])
    after, reward, terminated, _, later = environment.step(infeasible)
    assert reward == 0
    assert not terminated
    assert all((before[name] == after[name]).all() for name in before)
    assert (later["action_mask"] == info["action_mask"]).all()


def derived(
    environment: ClutterGeneration, rules: list[str]
) -> tuple[float, bool, dict[str, object]]:
    """Return the return, the termination and the last info of a derivation by rule names."""
    environment.reset(seed=0)
    total, terminated = 0.0, False
    info: dict[str, object] = {}
    for name in rules:
        assert not terminated, f"terminated before {name}"
        _, reward, terminated, _, info = environment.step(environment.grammar.rule_indices[name])
        total += float(reward)
    return total, terminated, info


def test_an_unstable_stack_ends_the_episode() -> None:
    """A flat cracker box on a lying marker is not stable."""
    environment = ClutterGeneration(task=GenerationTaskConfig(nodes=10))
    rules = [
        "drop_object",
        "stack_object",
        "end",
        "insert_large_marker",
        "insert_cracker_box",
        "orient_flat_0",
        "orient_flat_0",
    ]
    total, terminated, info = derived(environment, rules)
    assert terminated
    assert total == -1.0
    assert info["failure"] is StackFailure.UNSTABLE


def test_a_stack_that_is_too_high_ends_the_episode() -> None:
    """Three upright cracker boxes are 0.69 m high."""
    environment = ClutterGeneration(task=GenerationTaskConfig(nodes=10))
    rules = [
        "drop_object",
        "stack_object",
        "stack_object",
        "end",
        *["insert_cracker_box"] * 3,
        *["orient_upright_0"] * 3,
    ]
    total, terminated, info = derived(environment, rules)
    assert (total, terminated, info["failure"]) == (-1.0, True, StackFailure.TOO_HIGH)


def test_a_hidden_object_is_rewarded_when_its_stack_is_finished() -> None:
    """A flat gelatin box is hidden by a flat cracker box; another stack follows."""
    environment = ClutterGeneration(task=GenerationTaskConfig(nodes=7))
    rules = [
        "drop_object",
        "stack_object",
        "end",
        "insert_gelatin_box",
        "insert_cracker_box",
        "orient_flat_0",
        "orient_flat_0",
    ]
    total, terminated, _ = derived(environment, rules)
    assert (total, terminated) == (0.5, False)


def test_graphs_of_hundreds_of_nodes_are_observed() -> None:
    environment, generator = ClutterGeneration(task=GenerationTaskConfig(nodes=200)), rng(0)
    observation, info = environment.reset(seed=0)
    structure = np.array(
        [
            rule.left.target in ("tray", "top") and rule.name != "end"
            for rule in environment.grammar.rules
        ]
    )
    while (mask := info["action_mask"].astype(bool) & structure).any():
        observation, *_, info = environment.step(random_action(mask, generator))
    graph = graph_of(observation, environment)
    assert len(graph) > 190
    assert dict(graph.digraph.edges) == dict(environment.partial.graph.digraph.edges)


def test_the_maximum_number_of_edges() -> None:
    """A graph with as many pairs as possible has the most edges."""
    for nodes in range(3, 30):
        grammar, generator, most = GRAMMARS["ycb7"], rng(nodes), 0
        pairs = [k for k, rule in enumerate(grammar.rules) if rule.name.startswith("insert_meta")]

        def choose(
            _: object,
            mask: NDArray[np.bool_],
            generator: np.random.Generator = generator,
            pairs: list[int] = pairs,
        ) -> int:
            chosen = np.array(pairs)[mask[pairs]] if mask[pairs].any() else np.flatnonzero(mask)
            return int(generator.choice(chosen))

        for _ in range(10):
            graph = grammar.derive(NodeBudget(nodes), choose).graph
            most = max(most, graph.digraph.number_of_edges())
        assert most <= max_edges(nodes)
