"""The explorers' network (SPEC section 4): message passing over the graph of what is known, and a move chosen in two steps.

First the object to pick; it is marked, two more layers of message passing follow, then the place is chosen: the autoregressive
head of Janisch et al.
"""

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn.functional import leaky_relu

from drake_clutter.agents.graph_network import GraphBatch, GraphNetwork, MessagePassing
from drake_clutter.agents.message_passing import BatchConnectivity, pack_graphs
from drake_clutter.learning.checkpoint import RenamedParameters
from drake_clutter.tasks.exploration_graph import (
    EDGE_KINDS,
    GLOBAL_FEATURES,
    NODE_FEATURES,
    ExplorationObservation,
)


def collate_graphs(observations: Sequence[ExplorationObservation]) -> ExplorationObservation:
    """A batch: the arrays of `exploration_graph` with a first axis of graphs, padded to the largest."""
    nodes = max(len(observation["node_kind"]) for observation in observations)
    edges = nodes * (nodes - 1) // 2
    shapes = {
        "node_kind": (nodes,),
        "node_features": (nodes, len(NODE_FEATURES)),
        "edge_links": (edges, 2),
        "edge_kind": (edges,),
        "global_features": (len(GLOBAL_FEATURES),),
        "action_mask": (nodes, nodes),
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


class PolicyOutput(NamedTuple):
    """What the network says of a batch of B graphs with up to N nodes.

    Attributes:
        pick_log_probs: (B, N) log-probability of each node as what is picked; -inf where it cannot be.
        value: (B,) expected sum of rewards.
        encoding: what the choice of the place goes on from.
    """

    pick_log_probs: Tensor
    value: Tensor
    encoding: tuple[Tensor, Tensor, GraphBatch, Tensor, Tensor]


class ExplorerNetwork(RenamedParameters):
    """Policy and value over the arrays of `exploration_graph`."""

    renamed: ClassVar[Mapping[str, str]] = {
        "network": "encoder",
        "pick": "pick_head",
        "mark": "pick_marker",
        "after_pick": "post_pick_layers",
        "place": "place_head",
        "value": "value_head",
    }

    def __init__(self, node_kinds: int, width: int = 32) -> None:
        """Makes a network.

        Args:
            node_kinds: the tray and the classes.
            width: of the embeddings.
        """
        super().__init__()
        self.encoder = GraphNetwork(
            node_kinds, len(NODE_FEATURES), 2 * len(EDGE_KINDS), len(GLOBAL_FEATURES), width
        )
        self.pick_head = nn.Linear(width, 1)
        self.pick_marker = nn.Parameter(torch.zeros(width))
        self.post_pick_layers = MessagePassing(width, 3, 2)
        self.place_head = nn.Linear(width, 1)
        self.value_head = nn.Linear(width, 1)
        nn.init.normal_(self.pick_marker, std=1.0)

    def make_batch(self, observation: Mapping[str, NDArray[Any]]) -> tuple[GraphBatch, Tensor]:
        """The network's input, and the number of each node in its graph."""
        weight = self.value_head.weight
        graph, number, kind, *joined = pack_graphs(
            observation["node_kind"],
            observation["edge_links"],
            observation["edge_kind"],
            len(EDGE_KINDS),
        )
        feature = torch.from_numpy(observation["node_features"][graph, number]).to(weight)
        links = BatchConnectivity(
            *(torch.from_numpy(array).to(weight.device) for array in (graph, *joined))
        )
        glob = torch.from_numpy(observation["global_features"]).to(weight)
        return GraphBatch(
            torch.from_numpy(kind).to(weight.device), feature, links, glob
        ), torch.from_numpy(number).to(weight.device)

    def forward(self, observation: Mapping[str, NDArray[Any]]) -> PolicyOutput:
        """What to pick, and what is to be expected."""
        batch, number = self.make_batch(observation)
        node, glob = self.encoder(batch)
        allowed = torch.from_numpy(observation["action_mask"]).to(node.device) > 0
        pick = _log_softmax(
            self.pick_head(node).squeeze(1),
            batch.connectivity.node_graph,
            number,
            allowed.any(dim=2),
        )
        return PolicyOutput(
            pick, self.value_head(glob).squeeze(1), (node, glob, batch, number, allowed)
        )

    def place_log_probs(self, found: PolicyOutput, picked: Tensor) -> Tensor:
        """(B, N) log-probability of each node as the place, once (B,) nodes are picked; -inf where it cannot be."""
        node, glob, batch, number, allowed = found.encoding
        marked = (number == picked[batch.connectivity.node_graph])[:, None] * self.pick_marker
        edge = leaky_relu(self.encoder.edge_kind_embedding.weight)
        node, _ = self.post_pick_layers(node + marked, glob, edge, batch.connectivity)
        rows = torch.arange(len(glob), device=node.device)
        return _log_softmax(
            self.place_head(node).squeeze(1),
            batch.connectivity.node_graph,
            number,
            allowed[rows, picked],
        )


def _log_softmax(score: Tensor, graph: Tensor, number: Tensor, allowed: Tensor) -> Tensor:
    """(B, N) from (M,) scores of nodes; -inf where it is not allowed."""
    padded = score.new_full(allowed.shape, -torch.inf).index_put((graph, number), score)
    return padded.masked_fill(~allowed, -torch.inf).log_softmax(dim=1)


def sample_categorical(
    log_probabilities: NDArray[np.float32], rng: np.random.Generator | None
) -> NDArray[np.int64]:
    """(B,) drawn from (B, N) log-probabilities, or without a generator the most likely."""
    noise = (
        0.0 if rng is None else rng.gumbel(size=log_probabilities.shape)
    )  # the largest with Gumbel noise is such a draw
    return np.asarray((log_probabilities + noise).argmax(axis=1))


def sample_actions(
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
        picks = found.pick_log_probs.cpu().numpy()
        x = sample_categorical(picks, rng)
        places = (
            network.place_log_probs(found, torch.from_numpy(x).to(found.pick_log_probs.device))
            .cpu()
            .numpy()
        )
    y = sample_categorical(places, rng)
    rows = np.arange(len(x))
    return (
        np.column_stack([x, y]),
        picks[rows, x] + places[rows, y],
        found.value.cpu().numpy(),
        np.exp(picks),
    )


def action_log_probs(found: PolicyOutput, places: Tensor, moves: Tensor) -> Tensor:
    """(B,) of moves (B, 2), nodes x and y."""
    return found.pick_log_probs.gather(1, moves[:, :1]).squeeze(1) + places.gather(
        1, moves[:, 1:]
    ).squeeze(1)
