"""The explorers' network (SPEC section 4): message passing over the graph of what is known, and a move chosen in two steps.

First the object to pick; it is marked, two more layers of message passing follow, then the place is chosen: the autoregressive
head of Janisch et al.
"""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn.functional import leaky_relu

from drake_clutter.agents.graph_network import GraphBatch, GraphNetwork, MessagePassing
from drake_clutter.agents.message_passing import Links, pack
from drake_clutter.tasks.exploration_graph import EDGE_KINDS, FEATURES, GLOBALS, GraphObservation


def stacked_graphs(observations: Sequence[GraphObservation]) -> GraphObservation:
    """A batch: the arrays of `exploration_graph` with a first axis of graphs, padded to the largest."""
    nodes = max(len(observation["node_kind"]) for observation in observations)
    edges = nodes * (nodes - 1) // 2
    shapes = {
        "node_kind": (nodes,),
        "feature": (nodes, len(FEATURES)),
        "edge": (edges, 2),
        "edge_kind": (edges,),
        "glob": (len(GLOBALS),),
        "allowed": (nodes, nodes),
    }
    batch = {
        name: np.zeros((len(observations), *shape), observations[0][name].dtype)
        for name, shape in shapes.items()
    }
    for k, observation in enumerate(observations):
        for name in shapes:
            corner = tuple(slice(size) for size in observation[name].shape)
            batch[name][k][corner] = observation[name]
    return batch


class Evaluated(NamedTuple):
    """What the network says of a batch of B graphs with up to N nodes.

    Attributes:
        pick: (B, N) log-probability of each node as what is picked; -inf where it cannot be.
        value: (B,) expected sum of rewards.
        embedded: what the choice of the place goes on from.
    """

    pick: Tensor
    value: Tensor
    embedded: tuple[Tensor, Tensor, GraphBatch, Tensor, Tensor]


class ExplorerNetwork(nn.Module):
    """Policy and value over the arrays of `exploration_graph`."""

    def __init__(self, node_kinds: int, width: int = 32) -> None:
        """Makes a network.

        Args:
            node_kinds: the tray and the classes.
            width: of the embeddings.
        """
        super().__init__()
        self.network = GraphNetwork(
            node_kinds, len(FEATURES), 2 * len(EDGE_KINDS), len(GLOBALS), width
        )
        self.pick = nn.Linear(width, 1)
        self.mark = nn.Parameter(torch.zeros(width))
        self.after_pick = MessagePassing(width, 3, 2)
        self.place = nn.Linear(width, 1)
        self.value = nn.Linear(width, 1)
        nn.init.normal_(self.mark, std=1.0)

    def batch(self, observation: Mapping[str, NDArray[Any]]) -> tuple[GraphBatch, Tensor]:
        """The network's input, and the number of each node in its graph."""
        weight = self.value.weight
        graph, number, kind, *joined = pack(
            observation["node_kind"], observation["edge"], observation["edge_kind"], len(EDGE_KINDS)
        )
        feature = torch.from_numpy(observation["feature"][graph, number]).to(weight)
        links = Links(*(torch.from_numpy(array).to(weight.device) for array in (graph, *joined)))
        glob = torch.from_numpy(observation["glob"]).to(weight)
        return GraphBatch(
            torch.from_numpy(kind).to(weight.device), feature, links, glob
        ), torch.from_numpy(number).to(weight.device)

    def forward(self, observation: Mapping[str, NDArray[Any]]) -> Evaluated:
        """What to pick, and what is to be expected."""
        batch, number = self.batch(observation)
        node, glob = self.network(batch)
        allowed = torch.from_numpy(observation["allowed"]).to(node.device) > 0
        pick = _log_softmax(
            self.pick(node).squeeze(1), batch.links.graph, number, allowed.any(dim=2)
        )
        return Evaluated(pick, self.value(glob).squeeze(1), (node, glob, batch, number, allowed))

    def places(self, found: Evaluated, picked: Tensor) -> Tensor:
        """(B, N) log-probability of each node as the place, once (B,) nodes are picked; -inf where it cannot be."""
        node, glob, batch, number, allowed = found.embedded
        marked = (number == picked[batch.links.graph])[:, None] * self.mark
        edge = leaky_relu(self.network.edge.weight)
        node, _ = self.after_pick(node + marked, glob, edge, batch.links)
        rows = torch.arange(len(glob), device=node.device)
        return _log_softmax(
            self.place(node).squeeze(1), batch.links.graph, number, allowed[rows, picked]
        )


def _log_softmax(score: Tensor, graph: Tensor, number: Tensor, allowed: Tensor) -> Tensor:
    """(B, N) from (M,) scores of nodes; -inf where it is not allowed."""
    padded = score.new_full(allowed.shape, -torch.inf).index_put((graph, number), score)
    return padded.masked_fill(~allowed, -torch.inf).log_softmax(dim=1)


def chosen(
    log_probabilities: NDArray[np.float32], rng: np.random.Generator | None
) -> NDArray[np.int64]:
    """(B,) drawn from (B, N) log-probabilities, or without a generator the most likely."""
    noise = (
        0.0 if rng is None else rng.gumbel(size=log_probabilities.shape)
    )  # the largest with Gumbel noise is such a draw
    return np.asarray((log_probabilities + noise).argmax(axis=1))


def decide(
    network: ExplorerNetwork,
    observation: Mapping[str, NDArray[Any]],
    rng: np.random.Generator | None,
) -> tuple[NDArray[np.int64], NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
    """Moves for a batch, drawn, or without a generator the most likely.

    Returns:
        (B, 2) nodes x and y; (B,) log-probability of the move; (B,) value; (B, N) probability of each pick.
    """
    with torch.no_grad():
        found = network(observation)
        picks = found.pick.cpu().numpy()
        x = chosen(picks, rng)
        places = network.places(found, torch.from_numpy(x).to(found.pick.device)).cpu().numpy()
    y = chosen(places, rng)
    rows = np.arange(len(x))
    return (
        np.column_stack([x, y]),
        picks[rows, x] + places[rows, y],
        found.value.cpu().numpy(),
        np.exp(picks),
    )


def log_probability(found: Evaluated, places: Tensor, moves: Tensor) -> Tensor:
    """(B,) of moves (B, 2), nodes x and y."""
    return found.pick.gather(1, moves[:, :1]).squeeze(1) + places.gather(1, moves[:, 1:]).squeeze(1)
