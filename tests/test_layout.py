"""Layouts: no penetration, supported objects, gaps and limits."""

from collections import Counter

import numpy as np
import pytest
from conftest import CLASSES, DEFAULT_CELL, GRAMMARS, rng, world_with
from numpy.typing import NDArray

from drake_clutter.config import ClutterConfig, LayoutConfig
from drake_clutter.grammar import ClutterGraph, Derivation, NodeBudget, Orientation, uniform_choice
from drake_clutter.grammar.clutter_graph import DUMMY
from drake_clutter.scenes.geometry import max_penetration
from drake_clutter.scenes.layout import (
    LayoutFailure,
    LayoutFailureReason,
    _sample_positions,
    lay_out,
)
from drake_clutter.scenes.scene import Scene, SceneObject
from drake_clutter.seeding import item_rng

RANDOM_SCENES = 2000
"""Number of random layouts; `benchmarks/layout_penetration.py` checks 10,000."""
ROUNDING = 1e-9

Footprint = tuple[NDArray[np.float64], NDArray[np.float64]]
"""Lower and upper corner of a footprint, (2,) each [m]."""


def derived(*rules: str) -> Derivation:
    return Derivation(GRAMMARS["pantry14"].replay(rules), rules)


def laid_out(derivation: Derivation, config: ClutterConfig | None = None, seed: int = 0) -> Scene:
    scene = lay_out(derivation, CLASSES, config or ClutterConfig(), rng(seed))
    assert isinstance(scene, Scene), str(scene)
    return scene


def random_layout(index: int) -> Scene | LayoutFailure:
    """Return the layout of a random graph of 3 to 25 nodes of either object set."""
    generator = item_rng(2022, index)
    grammar = GRAMMARS["ycb7" if index % 2 else "pantry14"]
    derivation = grammar.derive(
        NodeBudget(int(generator.integers(3, 26))), uniform_choice(generator)
    )
    return lay_out(derivation, grammar.classes, ClutterConfig(), generator)


def carriers(graph: ClutterGraph, node: int) -> list[int]:
    """Return the objects that carry a node: its parent, or both of a pair.

    It is empty for objects on the tray.
    """
    (parent, *_) = graph.digraph.predecessors(node)
    if parent == ClutterGraph.TRAY_NODE:
        return []
    return list(graph.digraph.predecessors(parent)) if graph.kind(parent) == DUMMY else [parent]


def twins(graph: ClutterGraph) -> list[tuple[int, int]]:
    """Return the two objects of every pair."""
    return [
        (one, other)
        for node, kind in graph.digraph.nodes(data="kind")
        if kind == DUMMY
        for one, other in [graph.digraph.predecessors(node)]
    ]


def check_scene(scene: Scene, config: LayoutConfig) -> None:
    """Assert all properties of a layout."""
    assert scene.graph is not None
    objects = {o.node: o for o in scene.objects}
    assert set(objects) == {node for node, _ in scene.graph.objects()}
    assert len(objects) == len(scene.objects)
    depth, first, second = max_penetration(scene.objects)
    assert depth <= ROUNDING, f"{first} and {second}"
    paired = twins(scene.graph)
    for o in scene.objects:
        assert o.node is not None
        below = [objects[node] for node in carriers(scene.graph, o.node)]
        lower, upper = o.bounds_T
        assert abs(lower[2] - max((b.top_height for b in below), default=0.0)) < ROUNDING
        assert (
            np.abs(o.bounds_T).max(axis=0)[:2].max()
            <= scene.support.size[0] / 2 - config.stack_gap + ROUNDING
        )
        assert upper[2] <= config.max_stack_height
        if below:
            own = [objects[node] for pair in paired if o.node in pair for node in pair] or [o]
            center = np.mean([b.X_TO.p[:2] for b in own], axis=0)
            assert center == pytest.approx(
                np.mean([b.X_TO.p[:2] for b in below], axis=0), abs=ROUNDING
            )
    for one, other in paired:
        a, b = sorted((objects[one], objects[other]), key=lambda o: o.X_TO.p[1])
        lying = scene.graph.edge_kind(one, scene.graph.children(one)[0]) is Orientation.FLAT_0
        assert b.bounds_T[0][1] - a.bounds_T[1][1] == pytest.approx(
            config.lying_gap if lying else config.standing_gap, abs=ROUNDING
        )
        assert a.X_TO.p[0] == b.X_TO.p[0]
    for (lower_a, upper_a), (lower_b, upper_b) in footprints(scene):
        assert np.maximum(lower_a - upper_b, lower_b - upper_a).max() >= config.stack_gap - ROUNDING


def footprints(scene: Scene) -> list[tuple[Footprint, Footprint]]:
    """Return the axis-aligned footprints of every two stacks."""
    assert scene.graph is not None
    stack_of: dict[int, int] = {}
    for node in scene.graph.breadth_first_order():
        if node in {o.node for o in scene.objects}:
            below = carriers(scene.graph, node)
            pair = next((pair for pair in twins(scene.graph) if node in pair), (node,))
            stack_of[node] = stack_of[below[0]] if below else min(pair)
    stacks: dict[int, list[SceneObject]] = {}
    for o in scene.objects:
        assert o.node is not None
        stacks.setdefault(stack_of[o.node], []).append(o)
    boxes = [
        (
            np.min([o.bounds_T[0][:2] for o in s], axis=0),
            np.max([o.bounds_T[1][:2] for o in s], axis=0),
        )
        for s in stacks.values()
    ]
    return [(a, b) for index, a in enumerate(boxes) for b in boxes[:index]]


def test_random_scenes_keep_every_promise() -> None:
    results = Counter[str]()
    for index in range(RANDOM_SCENES):
        scene = random_layout(index)
        if isinstance(scene, LayoutFailure):
            results[scene.reason.name] += 1
            assert scene.required > scene.available or scene.reason is LayoutFailureReason.NO_ROOM
        else:
            results["laid out"] += 1
            check_scene(scene, LayoutConfig())
    assert results["laid out"] > 0.6 * RANDOM_SCENES


def test_a_stack_by_hand() -> None:
    """The heights of can (101 mm), box (60 mm) and marker (18 mm) add up; centers are aligned."""
    scene = laid_out(
        derived(
            *("drop_object", "stack_object", "stack_object", "end"),
            *("insert_tomato_soup_can", "insert_cracker_box", "insert_large_marker"),
            *("orient_flat_0", "orient_flat_0", "orient_flat_90"),
        )
    )
    can, box, marker = scene.objects
    assert [o.X_TO.p[2] for o in scene.objects] == pytest.approx([0.0505, 0.131, 0.170])
    assert marker.top_height == pytest.approx(0.179)
    for o in (box, marker):
        assert o.X_TO.p[:2] == pytest.approx(can.X_TO.p[:2])
    assert box.bounds_T[1] - box.bounds_T[0] == pytest.approx([0.230, 0.160, 0.060])
    assert marker.bounds_T[1] - marker.bounds_T[0] == pytest.approx([0.018, 0.121, 0.018], abs=1e-4)
    assert [o.name for o in scene.objects] == [
        "tomato_soup_can_1",
        "cracker_box_2",
        "large_marker_3",
    ]


@pytest.mark.parametrize(
    ("rule", "gap", "thickness"),
    [
        ("insert_meta_sugar_box_1", 0.002, 0.089),  # lying: 175 along x, 89 across
        ("insert_meta_sugar_box_2", 0.040, 0.038),  # standing: 89 along x, 38 across
        ("insert_meta_tomato_soup_can_1", 0.040, 0.066),
        ("insert_meta_large_marker_1", 0.002, 0.018),
    ],
)
def test_a_pair_by_hand(rule: str, gap: float, thickness: float) -> None:
    config = world_with("layout.lying_gap=0.002", "layout.standing_gap=0.040")
    scene = laid_out(
        derived("drop_object", "stack_object", "end", rule, "insert_gelatin_box", "orient_flat_0"),
        config,
    )
    one, other = (o for o in scene.objects if o.object_class.name != "gelatin_box")
    carried = scene.objects[-1]
    assert abs(one.X_TO.p - other.X_TO.p) == pytest.approx([0.0, thickness + gap, 0.0], abs=1e-4)
    assert carried.X_TO.p[:2] == pytest.approx((one.X_TO.p[:2] + other.X_TO.p[:2]) / 2)
    assert carried.bounds_T[0][2] == pytest.approx(one.top_height)


def tower(count: int) -> Derivation:
    """Return the derivation of a stack of upright cracker boxes, 230 mm each."""
    inserted = ["insert_cracker_box"] * count + ["orient_upright_0"] * count
    return derived("drop_object", *["stack_object"] * (count - 1), "end", *inserted)


def test_too_high() -> None:
    assert laid_out(tower(2)).objects[-1].top_height == pytest.approx(0.46)
    failure = lay_out(tower(3), CLASSES, ClutterConfig(), rng())
    assert isinstance(failure, LayoutFailure)
    assert (failure.reason, failure.available) == (LayoutFailureReason.TOO_HIGH, 0.50)
    assert failure.required == pytest.approx(0.69)
    assert str(failure) == "stack too high: 0.69 of 0.5 m"
    lower_cap = lay_out(tower(2), CLASSES, world_with("layout.max_stack_height=0.45"), rng())
    assert isinstance(lower_cap, LayoutFailure)
    assert lower_cap.reason is LayoutFailureReason.TOO_HIGH


BOX_ON_TRAY = ("drop_object", "end", "insert_cracker_box", "orient_flat_0")


@pytest.mark.parametrize(
    ("count", "side"),
    [
        (1, 0.24),  # 230 mm and two gaps of 10 mm
        (14, 0.70),  # 14 times 230 mm x 160 mm is more than the tray
    ],
)
def test_no_room(count: int, side: float) -> None:
    config = world_with(f"layout.tray_side={side}", "layout.placement_attempts=20")
    failure = lay_out(derived(*BOX_ON_TRAY * count), CLASSES, config, rng())
    assert isinstance(failure, LayoutFailure)
    assert failure.reason is LayoutFailureReason.NO_ROOM
    assert failure.required == pytest.approx(count * 0.230 * 0.160)


def test_the_smallest_tray_that_holds_a_box() -> None:
    config = world_with("layout.tray_side=0.2501")
    (box,) = laid_out(derived(*BOX_ON_TRAY), config).objects
    assert abs(box.X_TO.p[0]) <= 0.00005 + ROUNDING


def test_the_same_seed_gives_the_same_layout() -> None:
    derivation = GRAMMARS["ycb7"].derive(NodeBudget(20), uniform_choice(rng(3)))
    again = GRAMMARS["ycb7"].derive(NodeBudget(20), uniform_choice(rng(3)))
    assert again.rules == derivation.rules
    assert laid_out(again, seed=1).objects == laid_out(derivation, seed=1).objects
    assert laid_out(derivation, seed=2).objects != laid_out(derivation, seed=1).objects
    assert laid_out(derivation).derivation == derivation.rules


@pytest.mark.parametrize("axis", [0, 1])
def test_stacks_are_spread_over_the_whole_tray(axis: int) -> None:
    """Positions are uniform over the allowed ones: mean and spread of 400 samples."""
    derivation = derived("drop_object", "end", "insert_tomato_soup_can", "orient_flat_0")
    drawn = np.array(
        [laid_out(derivation, seed=seed).objects[0].X_TO.p[axis] for seed in range(400)]
    )
    reach = 0.35 - 0.010 - 0.033
    assert abs(drawn).max() <= reach + ROUNDING
    assert abs(drawn).max() > 0.98 * reach
    assert abs(drawn.mean()) < 4 * reach / np.sqrt(3 * 400)
    assert drawn.std() == pytest.approx(reach / np.sqrt(3), rel=0.1)


def test_a_stack_that_just_fits_is_in_the_middle() -> None:
    support = DEFAULT_CELL.support
    config = LayoutConfig()
    half_size = support.half_size - config.stack_gap
    centers = _sample_positions(half_size[None], support, config, rng())
    assert centers is not None
    assert centers == pytest.approx(np.zeros((1, 2)), abs=1e-12)
    assert _sample_positions(half_size[None] + 0.001, support, config, rng()) is None
