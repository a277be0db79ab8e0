"""Actor-critic network of the exploration agents, and the sampling of moves from it.

A move is chosen in two steps, with the autoregressive head of Janisch et al. 2020: the object to
pick is sampled, its node is marked, two more message-passing layers follow, then the node on which
the object is placed is sampled.

Symbols in shapes: B graphs with up to N nodes each and M nodes in all; H the width of an embedding.
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
    """Return a batch of observations, padded to the largest graph.

    Args:
        observations: B observations of `build_exploration_graph`.

    Returns:
        The same arrays with a first axis of length B.
    """
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
    if "target_kind" in observations[0]:
        shapes |= {"target_kind": (1,), "is_target": (nodes,)}
    batch = {
        name: np.zeros((len(observations), *shape), observations[0][name].dtype)
        for name, shape in shapes.items()
    }
    for k, observation in enumerate(observations):
        for name in shapes:
            corner = tuple(slice(size) for size in observation[name].shape)
            batch[name][k][corner] = observation[name]
    return batch


class GraphEncoding(NamedTuple):
    """Encoded graphs, from which the place is chosen.

    Attributes:
        nodes: Embeddings of the nodes. Shape (M, H).
        globals: Embeddings of the graphs. Shape (B, H).
        batch: The input of the encoder.
        node_index: Index of each node within its graph. Shape (M,).
        action_mask: Whether a move is allowed, by picked node and place. Shape (B, N, N).
    """

    nodes: Tensor
    globals: Tensor
    batch: GraphBatch
    node_index: Tensor
    action_mask: Tensor


class PolicyOutput(NamedTuple):
    """Output of the network for a batch of graphs.

    Attributes:
        pick_log_probs: Log-probability of picking each node; -inf if not allowed. Shape (B, N).
        value: Expected return. Shape (B,).
        encoding: Input of `ExplorerNetwork.place_log_probs`.
    """

    pick_log_probs: Tensor
    value: Tensor
    encoding: GraphEncoding


class ExplorerNetwork(RenamedParameters):
    """Policy and value function over the observations of `build_exploration_graph`."""

    renamed: ClassVar[Mapping[str, str]] = {
        "network": "encoder",
        "pick": "pick_head",
        "mark": "pick_marker",
        "after_pick": "post_pick_layers",
        "place": "place_head",
        "value": "value_head",
    }

    def __init__(self, num_node_kinds: int, width: int = 32, *, finds_target: bool = False) -> None:
        """Create a network.

        Args:
            num_node_kinds: Number of object classes, plus one for the tray.
            width: Width H of the embeddings.
            finds_target: Whether the policy is conditioned on a target. Before training, it acts
                as the same network without a target.
        """
        super().__init__()
        self.encoder = GraphNetwork(
            num_node_kinds, len(NODE_FEATURES), 2 * len(EDGE_KINDS), len(GLOBAL_FEATURES), width
        )
        self.pick_head = nn.Linear(width, 1)
        self.pick_marker = nn.Parameter(torch.zeros(width))
        self.post_pick_layers = MessagePassing(width, 3, 2)
        self.place_head = nn.Linear(width, 1)
        self.value_head = nn.Linear(width, 1)
        nn.init.normal_(self.pick_marker, std=1.0)
        self.finds_target = finds_target
        if finds_target:
            self.target_embedding = nn.Embedding(num_node_kinds, width)
            self.target_marker = nn.Parameter(torch.zeros(width))
            nn.init.zeros_(self.target_embedding.weight)

    def make_batch(self, observation: Mapping[str, NDArray[Any]]) -> tuple[GraphBatch, Tensor]:
        """Return the input of the encoder, and each node's index within its graph (M,).

        Args:
            observation: A batch of `collate_graphs`.
        """
        weight = self.value_head.weight
        graph, index, kind, *edges = pack_graphs(
            observation["node_kind"],
            observation["edge_links"],
            observation["edge_kind"],
            len(EDGE_KINDS),
        )
        connectivity = BatchConnectivity(
            *(torch.from_numpy(array).to(weight.device) for array in (graph, *edges))
        )
        batch = GraphBatch(
            node_kind=torch.from_numpy(kind).to(weight.device),
            node_features=torch.from_numpy(observation["node_features"][graph, index]).to(weight),
            connectivity=connectivity,
            global_features=torch.from_numpy(observation["global_features"]).to(weight),
        )
        return batch, torch.from_numpy(index).to(weight.device)

    def forward(self, observation: Mapping[str, NDArray[Any]]) -> PolicyOutput:
        """Return the distribution of the pick, and the value.

        Args:
            observation: A batch of `collate_graphs`.
        """
        batch, node_index = self.make_batch(observation)
        nodes, globals_ = self.encoder(batch, *self._target_offsets(observation, batch, node_index))
        action_mask = torch.from_numpy(observation["action_mask"]).to(nodes.device) > 0
        pick_log_probs = _masked_log_softmax(
            self.pick_head(nodes).squeeze(1),
            batch.connectivity.node_graph,
            node_index,
            action_mask.any(dim=2),
        )
        encoding = GraphEncoding(nodes, globals_, batch, node_index, action_mask)
        return PolicyOutput(pick_log_probs, self.value_head(globals_).squeeze(1), encoding)

    def _target_offsets(
        self, observation: Mapping[str, NDArray[Any]], batch: GraphBatch, node_index: Tensor
    ) -> tuple[Tensor | None, Tensor | None]:
        """Return what the target adds to nodes (M, H) and graphs (B, H); None without a target.

        Args:
            observation: A batch of `collate_graphs`.
            batch: See `make_batch`.
            node_index: See `make_batch`.
        """
        if not self.finds_target:
            return None, None
        device = node_index.device
        kind = torch.from_numpy(observation["target_kind"][:, 0].astype(np.int64)).to(device)
        is_target = torch.from_numpy(observation["is_target"]).to(device)
        marked = is_target[batch.connectivity.node_graph, node_index]
        return marked[:, None] * self.target_marker, self.target_embedding(kind - 1)

    def place_log_probs(self, output: PolicyOutput, picked: Tensor) -> Tensor:
        """Return the log-probability of each node as the place; -inf if not allowed.

        Args:
            output: Output of the network.
            picked: The picked node of each graph. Shape (B,).

        Returns:
            Log-probabilities. Shape (B, N).
        """
        encoding = output.encoding
        connectivity = encoding.batch.connectivity
        is_picked = encoding.node_index == picked[connectivity.node_graph]
        edge = leaky_relu(self.encoder.edge_kind_embedding.weight)
        nodes, _ = self.post_pick_layers(
            encoding.nodes + is_picked[:, None] * self.pick_marker,
            encoding.globals,
            edge,
            connectivity,
        )
        rows = torch.arange(len(encoding.globals), device=nodes.device)
        return _masked_log_softmax(
            self.place_head(nodes).squeeze(1),
            connectivity.node_graph,
            encoding.node_index,
            encoding.action_mask[rows, picked],
        )


def _masked_log_softmax(
    logits: Tensor, node_graph: Tensor, node_index: Tensor, mask: Tensor
) -> Tensor:
    """Return log-probabilities over the nodes of each graph; -inf outside the mask.

    Args:
        logits: Of all nodes. Shape (M,).
        node_graph: Graph of each node. Shape (M,).
        node_index: Index of each node within its graph. Shape (M,).
        mask: Which nodes may be chosen. Shape (B, N).

    Returns:
        Log-probabilities. Shape (B, N).
    """
    padded = logits.new_full(mask.shape, -torch.inf).index_put((node_graph, node_index), logits)
    return padded.masked_fill(~mask, -torch.inf).log_softmax(dim=1)


def sample_categorical(
    log_probs: NDArray[np.float32], rng: np.random.Generator | None
) -> NDArray[np.int64]:
    """Sample an index of each row by the Gumbel-max trick.

    Args:
        log_probs: Log-probabilities. Shape (B, N).
        rng: Random generator; None selects the most probable index.

    Returns:
        Indices. Shape (B,).
    """
    noise = 0.0 if rng is None else rng.gumbel(size=log_probs.shape)
    return np.asarray((log_probs + noise).argmax(axis=1))


class SampledActions(NamedTuple):
    """Moves sampled for a batch of observations.

    Attributes:
        actions: Picked node and place of each move. Shape (B, 2).
        log_probs: Log-probability of each move. Shape (B,).
        values: Expected return of each state. Shape (B,).
        pick_probs: Probability of picking each node. Shape (B, N).
    """

    actions: NDArray[np.int64]
    log_probs: NDArray[np.float32]
    values: NDArray[np.float32]
    pick_probs: NDArray[np.float32]


def sample_actions(
    network: ExplorerNetwork,
    observation: Mapping[str, NDArray[Any]],
    rng: np.random.Generator | None,
) -> SampledActions:
    """Sample a move for each observation of a batch.

    Args:
        network: The policy.
        observation: A batch of `collate_graphs`.
        rng: Random generator; None selects the most probable pick, then the most probable place.
    """
    with torch.no_grad():
        output: PolicyOutput = network(observation)
        pick_log_probs = output.pick_log_probs.cpu().numpy()
        picks = sample_categorical(pick_log_probs, rng)
        picked = torch.from_numpy(picks).to(output.pick_log_probs.device)
        place_log_probs = network.place_log_probs(output, picked).cpu().numpy()
    places = sample_categorical(place_log_probs, rng)
    rows = np.arange(len(picks))
    return SampledActions(
        actions=np.column_stack([picks, places]),
        log_probs=pick_log_probs[rows, picks] + place_log_probs[rows, places],
        values=output.value.cpu().numpy(),
        pick_probs=np.exp(pick_log_probs),
    )


def action_log_probs(output: PolicyOutput, place_log_probs: Tensor, actions: Tensor) -> Tensor:
    """Return the log-probability of each move. Shape (B,).

    Args:
        output: Output of the network.
        place_log_probs: Log-probabilities of the places, given the picks. Shape (B, N).
        actions: Picked node and place of each move. Shape (B, 2).
    """
    pick = output.pick_log_probs.gather(1, actions[:, :1]).squeeze(1)
    place = place_log_probs.gather(1, actions[:, 1:]).squeeze(1)
    return pick + place
