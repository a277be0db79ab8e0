"""Message passing over clutter graphs with a global attention node (Janisch et al., "Symbolic relational deep reinforcement
learning based on graph neural networks", the network of their BlockWorld experiments; SPEC section 3).

The graphs of a batch lie behind each other in one list of nodes and one of edges: nothing is computed for padding.
"""

from collections.abc import Mapping
from typing import Any, ClassVar, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn.functional import leaky_relu

from drake_clutter.agents.message_passing import (
    BatchConnectivity,
    LayerWeights,
    message_passing,
    pack_graphs,
)
from drake_clutter.learning.checkpoint import RenamedParameters


class GraphBatch(NamedTuple):
    """B graphs with M nodes and Z edges in all.

    Attributes:
        node_kind: (M,) number of a node's kind. feature: (M, F) what else is known of it.
        connectivity: how the nodes hang together.
        global_features: (B, G) features of the whole graph.
    """

    node_kind: Tensor
    node_features: Tensor
    connectivity: BatchConnectivity
    global_features: Tensor


class MessagePassing(RenamedParameters):
    """The layers, see `message_passing`.

    A linear layer of several inputs is the sum of one of each: what many nodes share is multiplied once.
    """

    renamed: ClassVar[Mapping[str, str]] = {
        "maximum": "max_message",
        "glob": "global_to_node",
        "old": "global_self",
    }

    def __init__(self, width: int, edge_width: int, layers: int) -> None:
        super().__init__()

        def linear(outputs: int, inputs: int, bias: bool = True) -> list[nn.Parameter]:
            each = [
                [*nn.Linear(inputs, outputs, bias).parameters()] for _ in range(layers)
            ]  # as PyTorch begins
            return [
                nn.Parameter(torch.stack(weights).detach()) for weights in zip(*each, strict=True)
            ]

        self.sender, self.sender_bias = linear(width, width)
        (self.edge,) = linear(width, edge_width, bias=False)
        self.node, self.node_bias = linear(width, width)
        (self.max_message,) = linear(width, width, bias=False)
        (self.global_to_node,) = linear(width, width, bias=False)
        self.attention, self.attention_bias = linear(1, width)
        self.pooled, self.pooled_bias = linear(width, width)
        (self.global_self,) = linear(width, width, bias=False)

    @property
    def weights(self) -> LayerWeights:
        """Its parameters."""
        return LayerWeights(*(getattr(self, name) for name in LayerWeights._fields))

    def forward(
        self, node: Tensor, glob: Tensor, edge: Tensor, links: BatchConnectivity
    ) -> tuple[Tensor, Tensor]:
        """Embeddings of nodes (M, H) and of graphs (B, H) after the last layer; edge: (kinds of edges, H_edge)."""
        return message_passing(node, glob, edge, links, self.weights)


class GraphNetwork(RenamedParameters):
    """Embeds graphs: features FC, then layers of message passing. A kind's FC is a row that is looked up."""

    renamed: ClassVar[Mapping[str, str]] = {
        "kind": "node_kind_embedding",
        "feature": "node_encoder",
        "edge": "edge_kind_embedding",
        "glob": "global_encoder",
    }

    def __init__(
        self,
        node_kinds: int,
        features: int,
        edge_kinds: int,
        globals_: int,
        width: int = 32,
        edge_width: int = 3,
        layers: int = 4,
    ) -> None:
        super().__init__()
        self.node_kind_embedding = nn.Embedding(node_kinds, width)
        self.node_encoder = nn.Linear(features, width)
        self.edge_kind_embedding = nn.Embedding(edge_kinds, edge_width)
        self.global_encoder = nn.Linear(globals_, width)
        self.layers = MessagePassing(width, edge_width, layers)

    def forward(self, batch: GraphBatch) -> tuple[Tensor, Tensor]:
        """Embeddings of nodes (M, H) and of graphs (B, H)."""
        node = leaky_relu(
            self.node_kind_embedding(batch.node_kind) + self.node_encoder(batch.node_features)
        )
        edge = leaky_relu(self.edge_kind_embedding.weight)
        glob = leaky_relu(self.global_encoder(batch.global_features))
        found: tuple[Tensor, Tensor] = self.layers(node, glob, edge, batch.connectivity)
        return found


NUM_RULE_CATEGORIES = 3
"""Kinds of rules that mark the node they would rewrite: of structure, insertion, orientation."""


class RuleQNetwork(RenamedParameters):
    """Q: a value for every rule of a grammar, from the observation of `ClutterGeneration`.

    Edges carry messages both ways; the ways are different kinds. The values are read from the global node, as in the paper, and
    from the nodes that are marked as what the next rules would rewrite: 0 where there is none.
    """

    renamed: ClassVar[Mapping[str, str]] = {
        "network": "encoder",
        "joined": "hidden_layer",
        "value": "q_head",
    }

    def __init__(self, node_kinds: int, edge_kinds: int, rules: int, width: int = 32) -> None:
        super().__init__()
        self._edge_kinds = edge_kinds
        self.encoder = GraphNetwork(node_kinds, 4 + 3, 2 * edge_kinds, 1, width)
        self.hidden_layer = nn.Linear((1 + NUM_RULE_CATEGORIES) * width, 2 * width)
        self.q_head = nn.Linear(2 * width, rules)

    def make_batch(self, observation: Mapping[str, NDArray[Any]]) -> GraphBatch:
        """The network's input: arrays as in `ClutterGeneration`, with a first axis of graphs."""
        weight = self.q_head.weight
        kinds, edges = (
            observation["node_kind"],
            (observation["edge_links"], observation["edge_kind"]),
        )
        graph, number, kind, *joined = pack_graphs(kinds, *edges, self._edge_kinds)
        feature = np.concatenate(
            [observation["node_flags"][graph, number], observation["position"][graph, number]],
            axis=1,
        )
        features = (
            torch.from_numpy(array).to(weight)
            for array in (feature, observation["remaining_nodes"])
        )
        links = BatchConnectivity(
            *(torch.from_numpy(array).to(weight.device) for array in (graph, *joined))
        )
        return GraphBatch(
            torch.from_numpy(kind).to(weight.device), next(features), links, next(features)
        )

    def forward(self, observation: Mapping[str, NDArray[Any]]) -> Tensor:
        """(B, rules)."""
        batch = self.make_batch(observation)
        node, glob = self.encoder(batch)
        row, mark = batch.node_features[:, 1 : 1 + NUM_RULE_CATEGORIES].nonzero(as_tuple=True)
        marked = node.new_zeros(len(glob) * NUM_RULE_CATEGORIES, node.shape[1])
        marked = marked.index_copy(
            0, batch.connectivity.node_graph[row] * NUM_RULE_CATEGORIES + mark, node[row]
        ).view(len(glob), -1)
        values: Tensor = self.q_head(
            leaky_relu(self.hidden_layer(torch.cat([glob, marked], dim=1)))
        )
        return values
