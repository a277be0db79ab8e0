"""The graph network: a naive implementation as a reference, invariances and batches."""

from collections.abc import Iterator

import numpy as np
import pytest
import torch
from conftest import rng
from torch import Tensor

from drake_clutter.agents.graph_network import MessagePassing, RuleQNetwork
from drake_clutter.agents.message_passing import (
    BatchConnectivity,
    LayerWeights,
    message_passing,
    message_passing_reference,
)
from drake_clutter.agents.replay_buffer import collate
from drake_clutter.tasks.generation_task import ClutterGeneration, GenerationObservation

ENVIRONMENT = ClutterGeneration()


def observations(count: int, seed: int = 0) -> list[GenerationObservation]:
    """Yield observations of random derivations, from the tray alone to finished graphs."""
    draw, seen = rng(seed), list[GenerationObservation]()
    while len(seen) < count:
        observation, info = ENVIRONMENT.reset(seed=seed)
        over = False
        while not over:
            seen.append(observation)
            action = int(draw.choice(np.flatnonzero(info["action_mask"])))
            observation, _, over, _, info = ENVIRONMENT.step(action)
        seen.append(observation)
    return [seen[k] for k in draw.permutation(len(seen))[:count]]


def network(seed: int = 0) -> RuleQNetwork:
    torch.manual_seed(seed)
    vocabulary = ENVIRONMENT.vocabulary
    return RuleQNetwork(
        len(vocabulary.node_kinds), len(vocabulary.edge_kinds), len(ENVIRONMENT.grammar.rules)
    ).double()


def fc(*weights_and_inputs: tuple[Tensor, Tensor], bias: Tensor) -> Tensor:
    """Return LeakyReLU of one linear layer of the concatenated inputs."""
    weight = torch.cat([weight for weight, _ in weights_and_inputs], dim=1)
    value = weight @ torch.cat([entry for _, entry in weights_and_inputs]) + bias
    return torch.where(value > 0, value, 0.01 * value)


def edges(observation: GenerationObservation) -> Iterator[tuple[int, int, int]]:
    """Return sender, receiver and kind of all directed edges."""
    kinds = len(ENVIRONMENT.vocabulary.edge_kinds)
    for (parent, child), kind in zip(
        observation["edge_links"].tolist(), observation["edge_kind"].tolist(), strict=True
    ):
        if kind > 0:
            yield parent, child, kind - 1
            yield child, parent, kind - 1 + kinds


def by_loops(values: RuleQNetwork, observation: GenerationObservation) -> Tensor:
    """Return the values of one graph, computed node by node and edge by edge."""

    def leaky(value: Tensor) -> Tensor:
        return torch.where(value > 0, value, 0.01 * value)

    net = values.encoder
    count = int(observation["node_mask"].sum())
    node = []
    for k in range(count):
        features = torch.tensor(
            [*observation["node_flags"][k], *observation["position"][k]], dtype=torch.float64
        )
        node.append(
            leaky(
                net.node_kind_embedding.weight[int(observation["node_kind"][k]) - 1]
                + net.node_encoder(features)
            )
        )
    glob = leaky(
        net.global_encoder(torch.tensor(observation["remaining_nodes"], dtype=torch.float64))
    )
    for layer in map(LayerWeights._make, zip(*net.layers.weights, strict=True)):
        most: list[Tensor | None] = [None] * count
        for sender, receiver, kind in edges(observation):
            sent, edge = (
                (layer.sender, node[sender]),
                (layer.edge, leaky(net.edge_kind_embedding.weight[kind])),
            )
            message = fc(sent, edge, bias=layer.sender_bias)
            so_far = most[receiver]
            most[receiver] = message if so_far is None else torch.maximum(so_far, message)
        heard = [torch.zeros_like(node[0]) if m is None else m for m in most]
        node = [
            own
            + fc(
                (layer.node, own),
                (layer.max_message, m),
                (layer.global_to_node, glob),
                bias=layer.node_bias,
            )
            for own, m in zip(node, heard, strict=True)
        ]
        weight = torch.cat([layer.attention @ own + layer.attention_bias for own in node]).softmax(
            dim=0
        )
        pooled = sum((w * own for w, own in zip(weight, node, strict=True)), torch.zeros_like(glob))
        glob = glob + fc((layer.pooled, pooled), (layer.global_self, glob), bias=layer.pooled_bias)
    marked = []
    for mark in range(3):
        (at,) = np.flatnonzero(observation["node_flags"][:, 1 + mark]).tolist() or (None,)
        marked.append(torch.zeros_like(glob) if at is None else node[at])
    return torch.as_tensor(values.q_head(leaky(values.hidden_layer(torch.cat([glob, *marked])))))


def test_the_network_agrees_with_a_naive_implementation() -> None:
    values, seen = network(), observations(30)
    together = values(collate(seen))
    for k, observation in enumerate(seen):
        torch.testing.assert_close(together[k], by_loops(values, observation), rtol=1e-9, atol=1e-9)


def test_graphs_of_a_batch_do_not_affect_each_other() -> None:
    values, seen = network(1), observations(20, seed=1)
    together = values(collate(seen))
    for k, observation in enumerate(seen):
        torch.testing.assert_close(
            values(collate([observation]))[0], together[k], rtol=1e-9, atol=1e-9
        )


def test_the_network_is_invariant_to_the_order_of_nodes_and_edges() -> None:
    values, draw = network(2), rng(2)
    for observation in observations(20, seed=2):
        nodes, linked = int(observation["node_mask"].sum()), int(observation["edge_mask"].sum())
        order, edge_order = draw.permutation(nodes), draw.permutation(linked)
        other = {name: array.copy() for name, array in observation.items()}
        for name in ("node_kind", "node_flags", "position"):
            other[name][:nodes] = observation[name][order]
        other["edge_links"][:linked] = np.argsort(order)[observation["edge_links"][:linked]][
            edge_order
        ]
        other["edge_kind"][:linked] = observation["edge_kind"][:linked][edge_order]
        torch.testing.assert_close(
            values(collate([other])), values(collate([observation])), rtol=1e-9, atol=1e-9
        )


def test_every_feature_affects_the_values() -> None:
    """A change of any feature changes the values."""
    values, (observation,) = network(3), observations(1, seed=5)
    before = values(collate([observation]))
    for name in ("node_kind", "node_flags", "position", "edge_kind", "remaining_nodes"):
        other = {key: array.copy() for key, array in observation.items()}
        other[name].reshape(-1)[0] += 1
        assert not torch.allclose(values(collate([other])), before), name


@pytest.mark.parametrize("width", [1, 5])
def test_the_compiled_layers_agree_with_the_reference(width: int) -> None:
    """Outputs and gradients of all inputs and weights agree; node 6 receives no message."""
    draw = torch.Generator().manual_seed(width)
    sender, receiver, kind = (torch.randint(0, most, (40,), generator=draw) for most in (12, 12, 4))
    receiver[receiver == 7] = 6
    links = BatchConnectivity(
        torch.tensor([0, 0, 0, 1, 1, 2, 2, 2, 2, 2, 3, 3]), sender, receiver, kind
    )
    weights = MessagePassing(width, 3, layers=2).double().weights

    def drawn(*shape: int) -> Tensor:
        return torch.randn(*shape, dtype=torch.float64, generator=draw).requires_grad_()

    inputs = drawn(12, width), drawn(4, width), drawn(4, 3)
    node, glob = (
        torch.randn(12, width, generator=draw).double(),
        torch.randn(4, width, generator=draw).double(),
    )
    found = []
    for layer_of in (message_passing, message_passing_reference):
        out, out_glob = layer_of(*inputs, links, weights)
        found.append(
            (
                out,
                out_glob,
                *torch.autograd.grad(
                    (node * out).sum() + (glob * out_glob).sum(), (*inputs, *weights)
                ),
            )
        )
    for mine, expected in zip(*found, strict=True):
        torch.testing.assert_close(mine, expected, rtol=1e-12, atol=1e-12)


def test_a_graph_of_one_node_has_no_messages() -> None:
    layers = MessagePassing(4, 3, layers=1)
    none, zero = torch.zeros(0, dtype=torch.long), torch.zeros(1, dtype=torch.long)
    node, glob = layers(
        torch.ones(1, 4),
        torch.ones(1, 4),
        torch.ones(2, 3),
        BatchConnectivity(zero, none, none, none),
    )
    assert torch.isfinite(node).all()
    assert torch.isfinite(glob).all()
