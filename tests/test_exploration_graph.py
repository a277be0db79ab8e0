"""The graph observation of explorers, and their network."""

from collections.abc import Sequence

import numpy as np
import pytest
import torch
from conftest import CLASSES, random_scene, resting, rng, scene_of

from drake_clutter.agents.explorer_network import (
    ExplorerNetwork,
    action_log_probs,
    collate_graphs,
    sample_actions,
)
from drake_clutter.config import ClutterConfig
from drake_clutter.grammar import Orientation
from drake_clutter.scenes.interfaces import Move
from drake_clutter.scenes.scene import TRAY, Pose, Scene
from drake_clutter.stability.ray_caster import RayCaster
from drake_clutter.tasks.belief import Belief
from drake_clutter.tasks.exploration_graph import (
    EDGE_KINDS,
    NODE_FEATURES,
    ExplorationObservation,
    build_exploration_graph,
)

NODE_KIND_IDS = {name: number for number, name in enumerate((TRAY, *CLASSES), start=1)}
RAYS = RayCaster(ClutterConfig().cell.camera)
# A marker below a cracker box, which carries a can; a pudding box close by, another one far away.
SCENE = scene_of(
    resting("large_marker", xy=(0.0, 0.0)),
    resting("cracker_box", xy=(0.0, 0.0), floor=0.018),
    resting("tomato_soup_can", xy=(0.05, 0.0), floor=0.078),
    resting("pudding_box", Orientation.FLAT_90, xy=(0.18, 0.0), name="close"),
    resting("pudding_box", xy=(-0.25, -0.25), name="far"),
)


def graph_of(
    scene: Scene, tried: Sequence[Move] = (), failed: Sequence[Move] = (), nodes: int = 0
) -> ExplorationObservation:
    return build_exploration_graph(
        scene.objects, RAYS.observe(scene)[0], tried, NODE_KIND_IDS, failed, nodes
    )


def feature(graph: ExplorationObservation, node: int, name: str) -> float:
    return float(graph["node_features"][node, NODE_FEATURES.index(name)])


def edges(graph: ExplorationObservation, names: tuple[str, ...]) -> dict[tuple[str, str], str]:
    """Return the kinds of edges by lower and upper node."""
    named = (TRAY, *names)
    joined = zip(graph["edge_links"].tolist(), graph["edge_kind"].tolist(), strict=True)
    return {(named[a], named[b]): EDGE_KINDS[kind - 1] for (a, b), kind in joined if kind}


def test_edge_kinds() -> None:
    found = edges(graph_of(SCENE), SCENE.names)
    assert len(found) == 5 + 10
    assert found["large_marker", "cracker_box"] == "supports"
    assert found["cracker_box", "tomato_soup_can"] == "supports"
    assert found["large_marker", "tomato_soup_can"] == "is_below"
    assert {found[pair] for pair in found if set(pair) == {"cracker_box", "close"}} == {"is_beside"}
    assert {found[pair] for pair in found if set(pair) == {"close", "far"}} == {"is_apart_from"}
    assert {upper for (lower, upper), kind in found.items() if kind == "tray_supports"} == {
        "large_marker",
        "close",
        "far",
    }
    assert {upper for (lower, upper), kind in found.items() if kind == "tray_is_below"} == {
        "cracker_box",
        "tomato_soup_can",
    }


def test_node_features() -> None:
    graph = graph_of(SCENE, (Move("far"), Move("far"), Move("close")), nodes=9)
    assert graph["node_kind"].tolist() == [
        NODE_KIND_IDS[TRAY],
        *(NODE_KIND_IDS[o.object_class.name] for o in SCENE.objects),
        0,
        0,
        0,
    ]
    assert [feature(graph, k, "in_view") for k in range(1, 6)] == [0, 1, 1, 1, 1]
    assert [feature(graph, k, "is_covered") for k in range(1, 6)] == [1, 1, 0, 0, 0]
    assert [feature(graph, k, "pick_count") for k in range(1, 6)] == pytest.approx(
        [0, 0, 0, 1 / 3, 2 / 3]
    )
    assert [feature(graph, k, "support_gap") for k in range(1, 6)] == [0.0] * 5
    assert feature(graph, 2, "extent_x") == pytest.approx(0.230 / 0.35)
    assert feature(graph, 4, "visible_fraction") == pytest.approx(1, abs=0.05)
    assert feature(graph, 2, "visible_fraction") < 0.95
    allowed = np.zeros((9, 9), int)
    allowed[2:6, [0, 2, 3, 4, 5]] = 1
    np.fill_diagonal(allowed, 0)
    assert np.array_equal(graph["action_mask"], allowed)
    assert graph["global_features"] == pytest.approx([3 / 20])


def test_the_sign_of_the_quaternion_does_not_depend_on_a_small_tilt() -> None:
    """After settling, components that should be 0 are slightly positive or negative."""
    tilted = []
    for tilt in (-1e-4, 0.0, 1e-4):
        turned = {}
        for o in SCENE.objects:
            w, x, y, z = o.X_TO.quaternion
            turned[o.name] = Pose(o.X_TO.translation, (w + tilt, x - tilt, y + tilt, z - tilt))
        tilted.append(graph_of(SCENE.with_poses(turned))["node_features"])
    assert tilted[0] == pytest.approx(tilted[1], abs=0.01)
    assert tilted[2] == pytest.approx(tilted[1], abs=0.01)


def test_invalid_moves_are_masked() -> None:
    onto_all = [Move("far", name) for name in (TRAY, "cracker_box", "tomato_soup_can", "close")]
    graph = graph_of(SCENE, failed=[Move("close"), *onto_all])
    free = graph_of(SCENE)["action_mask"]
    assert free[4, 0] == free[5, 2] == 1
    free[4, 0], free[5] = 0, 0
    assert np.array_equal(graph["action_mask"], free)
    torch.manual_seed(0)
    moves, _, _, pick_probs = sample_actions(
        ExplorerNetwork(len(NODE_KIND_IDS)), collate_graphs([graph] * 500), rng()
    )
    assert pick_probs[0, 5] == 0
    assert (free[moves[:, 0], moves[:, 1]] == 1).all()


def test_the_support_gap_shows_an_unknown_support() -> None:
    """K_t lacks the marker, which was never in view, so its box is 18 mm above the tray."""
    observation = RAYS.observe(SCENE)[0]
    known = Belief().update(observation).objects
    assert [o.name for o in known] == ["cracker_box", "tomato_soup_can", "close", "far"]
    graph = build_exploration_graph(known, observation, (), NODE_KIND_IDS)
    heights = [feature(graph, k, "support_gap") for k in range(1, 5)]
    assert heights == pytest.approx([(0.018 - 0.006) / 0.35, 0, 0, 0], abs=1e-6)


def test_objects_out_of_view_keep_their_last_pose() -> None:
    covered = SCENE.with_poses({"large_marker": resting("large_marker", xy=(0.0, 0.3)).X_TO})
    belief = Belief().update(RAYS.observe(covered)[0]).update(RAYS.observe(SCENE)[0])
    known = belief.objects
    assert known[0].name == "large_marker"
    assert {o.name: o.X_TO for o in known}["large_marker"] == covered["large_marker"].X_TO
    graph = build_exploration_graph(known, RAYS.observe(SCENE)[0], (), NODE_KIND_IDS)
    assert graph["action_mask"].any(axis=1).tolist() == [False, False, True, True, True, True]


@pytest.mark.parametrize("seed", range(4))
def test_the_network_is_equivariant_to_the_order_of_the_objects(seed: int) -> None:
    scene = random_scene(seed)
    order = rng(seed).permutation(len(scene.objects))
    shuffled = Scene(tuple(scene.objects[k] for k in order), scene.support)
    torch.manual_seed(seed)
    network = ExplorerNetwork(len(NODE_KIND_IDS)).double()
    one, other = (network(collate_graphs([graph_of(s)])) for s in (scene, shuffled))
    assert torch.allclose(one.value, other.value)
    nodes = torch.from_numpy(np.concatenate([[0], order + 1]))
    assert torch.allclose(one.pick_log_probs[:, nodes], other.pick_log_probs)
    picked = int(one.pick_log_probs.argmax())
    there = int((nodes == picked).nonzero())
    places = (
        network.place_log_probs(one, torch.tensor([picked])),
        network.place_log_probs(other, torch.tensor([there])),
    )
    assert torch.allclose(places[0][:, nodes], places[1])


def test_batched_graphs_give_the_same_output_as_single_graphs() -> None:
    """Graphs that are smaller than the largest of the batch are padded."""
    graphs = [graph_of(random_scene(seed, 8, 25)) for seed in range(6)]
    torch.manual_seed(0)
    network = ExplorerNetwork(len(NODE_KIND_IDS)).double()
    together = network(collate_graphs(graphs))
    picked = together.pick_log_probs.argmax(dim=1)
    places = network.place_log_probs(together, picked)
    for k, graph in enumerate(graphs):
        alone, count = network(collate_graphs([graph])), len(graph["node_kind"])
        assert torch.allclose(alone.pick_log_probs[0], together.pick_log_probs[k, :count])
        assert torch.allclose(alone.value[0], together.value[k])
        assert torch.allclose(
            network.place_log_probs(alone, picked[k : k + 1])[0], places[k, :count]
        )
        assert (together.pick_log_probs[k, count:] == -torch.inf).all()


def test_moves_are_sampled_with_their_probabilities() -> None:
    torch.manual_seed(1)
    network, graph = ExplorerNetwork(len(NODE_KIND_IDS)), graph_of(SCENE)
    count = 4000
    moves, chance, _, pick_probs = sample_actions(network, collate_graphs([graph] * count), rng())
    assert pick_probs[0].sum() == pytest.approx(1, abs=1e-5)
    assert (graph["action_mask"][moves[:, 0], moves[:, 1]] == 1).all()
    frequencies = np.bincount(moves[:, 0], minlength=len(pick_probs[0])) / count
    assert frequencies == pytest.approx(pick_probs[0], abs=4 * 0.5 / count**0.5)
    found = network(collate_graphs([graph] * 50))
    again = action_log_probs(
        found,
        network.place_log_probs(found, torch.from_numpy(moves[:50, 0])),
        torch.from_numpy(moves[:50]),
    )
    assert again.detach().numpy() == pytest.approx(chance[:50], abs=1e-5)
    (likeliest,) = sample_actions(network, collate_graphs([graph]), None)[0].tolist()
    assert likeliest[0] == pick_probs[0].argmax()
