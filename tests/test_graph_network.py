"""The graph network: against one written with loops, in any order of nodes, alone and in a batch."""

from collections.abc import Iterator

import numpy as np
import pytest
import torch
from conftest import rng
from torch import Tensor, nn

from drake_clutter.agents.graph_kernels import (
    attention_pooled,
    composed_maximum,
    composed_pool,
    composed_update,
    message_maximum,
    updated,
)
from drake_clutter.agents.graph_network import GraphBatch, MessagePassing, RuleValues
from drake_clutter.agents.soft_q import stacked
from drake_clutter.tasks.generation import ClutterGeneration, GraphObservation

ENVIRONMENT = ClutterGeneration()


def observations(count: int, seed: int = 0) -> list[GraphObservation]:
    """Of random derivations, from the tray alone to finished graphs."""
    draw, seen = rng(seed), list[GraphObservation]()
    while len(seen) < count:
        observation, info = ENVIRONMENT.reset(seed=seed)
        over = False
        while not over:
            seen.append(observation)
            action = int(draw.choice(np.flatnonzero(info["action_mask"])))
            observation, _, over, _, info = ENVIRONMENT.step(action)
        seen.append(observation)
    return [seen[k] for k in draw.permutation(len(seen))[:count]]


def network(seed: int = 0) -> RuleValues:
    torch.manual_seed(seed)
    vocabulary = ENVIRONMENT.vocabulary
    return RuleValues(len(vocabulary.node_kinds), len(vocabulary.edge_kinds), len(ENVIRONMENT.grammar.rules)).double()


def fc(*layers_and_inputs: tuple[nn.Linear, Tensor]) -> Tensor:
    """One linear layer of all inputs side by side, then LeakyReLU."""
    weight = torch.cat([layer.weight for layer, _ in layers_and_inputs], dim=1)
    bias = sum(layer.bias for layer, _ in layers_and_inputs if layer.bias is not None)
    value = weight @ torch.cat([entry for _, entry in layers_and_inputs]) + bias
    return torch.where(value > 0, value, 0.01 * value)


def edges(observation: GraphObservation) -> Iterator[tuple[int, int, int]]:
    """Sender, receiver, and number of the kind, both ways."""
    kinds = len(ENVIRONMENT.vocabulary.edge_kinds)
    for (parent, child), kind in zip(observation["edge"].tolist(), observation["edge_kind"].tolist(), strict=True):
        if kind > 0:
            yield parent, child, kind - 1
            yield child, parent, kind - 1 + kinds


def by_loops(values: RuleValues, observation: GraphObservation) -> Tensor:
    """What the network says of one graph, as the paper describes it: node by node and edge by edge."""

    def leaky(value: Tensor) -> Tensor:
        return torch.where(value > 0, value, 0.01 * value)

    net = values.network
    count = int(observation["node_mask"].sum())
    node = []
    for k in range(count):
        features = torch.tensor([*observation["node_flags"][k], *observation["position"][k]], dtype=torch.float64)
        node.append(leaky(net.kind.weight[int(observation["node_kind"][k]) - 1] + net.feature(features)))
    glob = leaky(net.glob(torch.tensor(observation["remaining"], dtype=torch.float64)))
    for layer in net.layers:
        assert isinstance(layer, MessagePassing)
        most: list[Tensor | None] = [None] * count
        for sender, receiver, kind in edges(observation):
            message = fc((layer.message_sender, node[sender]), (layer.message_edge, leaky(net.edge.weight[kind])))
            so_far = most[receiver]
            most[receiver] = message if so_far is None else torch.maximum(so_far, message)
        node = [
            own
            + fc(
                (layer.update_node, own),
                (layer.update_maximum, torch.zeros_like(own) if m is None else m),
                (layer.update_global, glob),
            )
            for own, m in zip(node, most, strict=True)
        ]
        weight = torch.cat([layer.attention(own) for own in node]).softmax(dim=0)
        pooled = sum((w * own for w, own in zip(weight, node, strict=True)), torch.zeros_like(glob))
        glob = glob + fc((layer.global_pooled, pooled), (layer.global_global, glob))
    marked = []
    for mark in range(3):
        (at,) = np.flatnonzero(observation["node_flags"][:, 1 + mark]).tolist() or (None,)
        marked.append(torch.zeros_like(glob) if at is None else node[at])
    return torch.as_tensor(values.value(leaky(values.joined(torch.cat([glob, *marked])))))


def test_the_same_as_with_loops() -> None:
    values, seen = network(), observations(30)
    together = values(stacked(seen))
    for k, observation in enumerate(seen):
        torch.testing.assert_close(together[k], by_loops(values, observation), rtol=1e-9, atol=1e-9)


def test_a_graph_does_not_feel_its_neighbours_in_the_batch() -> None:
    values, seen = network(1), observations(20, seed=1)
    together = values(stacked(seen))
    for k, observation in enumerate(seen):
        torch.testing.assert_close(values(stacked([observation]))[0], together[k], rtol=1e-9, atol=1e-9)


def test_the_order_of_nodes_and_edges_does_not_matter() -> None:
    values, draw = network(2), rng(2)
    for observation in observations(20, seed=2):
        nodes, linked = int(observation["node_mask"].sum()), int(observation["edge_mask"].sum())
        order, edge_order = draw.permutation(nodes), draw.permutation(linked)
        other = {name: array.copy() for name, array in observation.items()}
        for name in ("node_kind", "node_flags", "position"):
            other[name][:nodes] = observation[name][order]
        other["edge"][:linked] = np.argsort(order)[observation["edge"][:linked]][edge_order]
        other["edge_kind"][:linked] = observation["edge_kind"][:linked][edge_order]
        torch.testing.assert_close(values(stacked([other])), values(stacked([observation])), rtol=1e-9, atol=1e-9)


def test_what_is_known_of_a_graph_matters() -> None:
    """Every feature reaches the values."""
    values, (observation,) = network(3), observations(1, seed=5)
    before = values(stacked([observation]))
    for name in ("node_kind", "node_flags", "position", "edge_kind", "remaining"):
        other = {key: array.copy() for key, array in observation.items()}
        other[name].reshape(-1)[0] += 1
        assert not torch.allclose(values(stacked([other])), before), name


def scattered(count: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Graph of each of 12 nodes, and sender, receiver and kind of edges; nobody speaks to the seventh."""
    draw = torch.Generator().manual_seed(count)
    graph = torch.tensor([0, 0, 0, 1, 1, 2, 2, 2, 2, 2, 3, 3])
    sender, receiver, kind = (torch.randint(0, most, (count,), generator=draw) for most in (12, 12, 4))
    receiver[receiver == 7] = 6
    return graph, sender, receiver, kind


@pytest.mark.parametrize("width", [1, 5])
@pytest.mark.parametrize("step", ["maximum", "update", "pool"])
def test_what_is_compiled_is_what_is_composed(step: str, width: int) -> None:
    """With the gradients of all inputs."""
    draw = torch.Generator().manual_seed(width)
    graph, sender, receiver, kind = scattered(40)

    def drawn(*shape: int) -> Tensor:
        return torch.randn(*shape, dtype=torch.float64, generator=draw).requires_grad_()

    inputs: tuple[Tensor, ...]
    if step == "maximum":
        inputs = drawn(12, width), drawn(4, width)
        ours, theirs = (f(*inputs, sender, receiver, kind) for f in (message_maximum, composed_maximum))
        assert (ours[7] == 0).all()
    elif step == "update":
        inputs = drawn(12, width), drawn(4, width), drawn(12, width)
        ours, theirs = (f(*inputs[:2], graph, inputs[2]) for f in (updated, composed_update))
    else:
        inputs = drawn(12, width), drawn(12)
        ours, theirs = (f(*inputs, graph, 4) for f in (attention_pooled, composed_pool))
    torch.testing.assert_close(ours, theirs, rtol=1e-12, atol=1e-12)
    weight = torch.randn(ours.shape, dtype=torch.float64, generator=draw)
    for mine, expected in zip(*(torch.autograd.grad((weight * out).sum(), inputs) for out in (ours, theirs)), strict=True):
        torch.testing.assert_close(mine, expected, rtol=1e-12, atol=1e-12)


def test_a_lone_node_has_no_messages() -> None:
    layer = MessagePassing(4, 3)
    none = torch.zeros(0, dtype=torch.long)
    zero = torch.zeros(1, dtype=torch.long)
    alone = GraphBatch(zero, torch.zeros(1, 1), zero, none, none, none, torch.zeros(1, 1))
    node, glob = layer(torch.ones(1, 4), torch.ones(1, 4), torch.ones(2, 3), alone)
    assert torch.isfinite(node).all()
    assert torch.isfinite(glob).all()
