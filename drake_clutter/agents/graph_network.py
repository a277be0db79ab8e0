"""Graph networks with a global attention node, and the Q-network over the rules of a grammar.

The architecture is that of Janisch et al., "Symbolic Relational Deep Reinforcement Learning based
on Graph Neural Networks", 2020, as they use it for BlockWorld. The nodes and edges of all graphs of
a batch are packed into one list each, so nothing is computed for padding.

Symbols in shapes: B graphs, M nodes and Z directed edges in a batch; H the width of an embedding.
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
    """A batch of packed graphs.

    Attributes:
        node_kind: Kind of each node, from 0 on. Shape (M,).
        node_features: Other features of each node. Shape (M, number of features).
        connectivity: Edges, and the graph of each node.
        global_features: Features of the graphs. Shape (B, number of global features).
    """

    node_kind: Tensor
    node_features: Tensor
    connectivity: BatchConnectivity
    global_features: Tensor


class MessagePassing(RenamedParameters):
    """Message-passing layers; see `message_passing`.

    A linear layer of concatenated inputs is computed as a sum of one linear layer per input, so
    that inputs shared by many nodes are multiplied once.
    """

    renamed: ClassVar[Mapping[str, str]] = {
        "maximum": "max_message",
        "glob": "global_to_node",
        "old": "global_self",
    }

    def __init__(self, width: int, edge_width: int, layers: int) -> None:
        """Initialize the layers as PyTorch initializes `nn.Linear`.

        Args:
            width: Width H of the nodes' embeddings.
            edge_width: Width of the edges' embeddings.
            layers: Number of layers.
        """
        super().__init__()

        def linear(outputs: int, inputs: int, bias: bool = True) -> list[nn.Parameter]:
            """Return the parameters of one linear layer for each message-passing layer."""
            parameters = [[*nn.Linear(inputs, outputs, bias).parameters()] for _ in range(layers)]
            return [
                nn.Parameter(torch.stack(weights).detach())
                for weights in zip(*parameters, strict=True)
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
        """Parameters of the layers."""
        return LayerWeights(*(getattr(self, name) for name in LayerWeights._fields))

    def forward(
        self, node: Tensor, glob: Tensor, edge: Tensor, connectivity: BatchConnectivity
    ) -> tuple[Tensor, Tensor]:
        """Return the embeddings of nodes (M, H) and of global nodes (B, H) after the last layer.

        Args:
            node: Embeddings of the nodes. Shape (M, H).
            glob: Embeddings of the global nodes. Shape (B, H).
            edge: Embeddings of the kinds of edges. Shape (number of kinds, edge_width).
            connectivity: The edges.
        """
        return message_passing(node, glob, edge, connectivity, self.weights)


class GraphNetwork(RenamedParameters):
    """Encoder of graphs: input layers for nodes, edges and global features, then message passing.

    Kinds of nodes and edges are embedded by lookup, which equals a linear layer of a one-hot input.
    """

    renamed: ClassVar[Mapping[str, str]] = {
        "kind": "node_kind_embedding",
        "feature": "node_encoder",
        "edge": "edge_kind_embedding",
        "glob": "global_encoder",
    }

    def __init__(
        self,
        num_node_kinds: int,
        num_node_features: int,
        num_edge_kinds: int,
        num_global_features: int,
        width: int = 32,
        edge_width: int = 3,
        layers: int = 4,
    ) -> None:
        """Create a network.

        Args:
            num_node_kinds: Number of kinds of nodes.
            num_node_features: Number of other features of a node.
            num_edge_kinds: Number of kinds of directed edges.
            num_global_features: Number of features of a graph.
            width: Width H of the nodes' embeddings.
            edge_width: Width of the edges' embeddings.
            layers: Number of message-passing layers.
        """
        super().__init__()
        self.node_kind_embedding = nn.Embedding(num_node_kinds, width)
        self.node_encoder = nn.Linear(num_node_features, width)
        self.edge_kind_embedding = nn.Embedding(num_edge_kinds, edge_width)
        self.global_encoder = nn.Linear(num_global_features, width)
        self.layers = MessagePassing(width, edge_width, layers)

    def forward(
        self,
        batch: GraphBatch,
        node_offset: Tensor | None = None,
        global_offset: Tensor | None = None,
    ) -> tuple[Tensor, Tensor]:
        """Return embeddings of the nodes (M, H) and of the graphs (B, H).

        Args:
            batch: The graphs.
            node_offset: What is added to the encoded nodes; None for nothing. Shape (M, H).
            global_offset: What is added to the encoded global features; None for nothing. Shape
                (B, H).
        """
        node = self.node_kind_embedding(batch.node_kind) + self.node_encoder(batch.node_features)
        node = leaky_relu(node if node_offset is None else node + node_offset)
        edge = leaky_relu(self.edge_kind_embedding.weight)
        glob = self.global_encoder(batch.global_features)
        glob = leaky_relu(glob if global_offset is None else glob + global_offset)
        embeddings: tuple[Tensor, Tensor] = self.layers(node, glob, edge, batch.connectivity)
        return embeddings


NUM_RULE_CATEGORIES = 3
"""Number of categories of rules, each of which marks the node that it would rewrite.

The categories are rules of structure, of insertion and of orientation.
"""


class RuleQNetwork(RenamedParameters):
    """Q-network with one action value for each rule of a grammar.

    Its input is the observation of `ClutterGeneration`. Every edge is followed in both directions,
    as two kinds of edges. The values are computed from the global node, as in Kumar et al. 2022,
    and from the nodes that the next rule of each category would rewrite; zeros stand for a category
    without such a node.
    """

    renamed: ClassVar[Mapping[str, str]] = {
        "network": "encoder",
        "joined": "hidden_layer",
        "value": "q_head",
    }

    def __init__(
        self, num_node_kinds: int, num_edge_kinds: int, num_rules: int, width: int = 32
    ) -> None:
        """Create a network.

        Args:
            num_node_kinds: Number of kinds of nodes of the grammar.
            num_edge_kinds: Number of kinds of edges of the grammar.
            num_rules: Number of rules of the grammar.
            width: Width H of the embeddings.
        """
        super().__init__()
        self._num_edge_kinds = num_edge_kinds
        self.encoder = GraphNetwork(num_node_kinds, 4 + 3, 2 * num_edge_kinds, 1, width)
        self.hidden_layer = nn.Linear((1 + NUM_RULE_CATEGORIES) * width, 2 * width)
        self.q_head = nn.Linear(2 * width, num_rules)

    def make_batch(self, observation: Mapping[str, NDArray[Any]]) -> GraphBatch:
        """Return the input of the encoder.

        Args:
            observation: Arrays of `ClutterGeneration`, stacked along a first axis of length B.
        """
        weight = self.q_head.weight
        graph, index, kind, *edges = pack_graphs(
            observation["node_kind"],
            observation["edge_links"],
            observation["edge_kind"],
            self._num_edge_kinds,
        )
        features = np.concatenate(
            [observation["node_flags"][graph, index], observation["position"][graph, index]],
            axis=1,
        )
        connectivity = BatchConnectivity(
            *(torch.from_numpy(array).to(weight.device) for array in (graph, *edges))
        )
        return GraphBatch(
            node_kind=torch.from_numpy(kind).to(weight.device),
            node_features=torch.from_numpy(features).to(weight),
            connectivity=connectivity,
            global_features=torch.from_numpy(observation["remaining_nodes"]).to(weight),
        )

    def forward(self, observation: Mapping[str, NDArray[Any]]) -> Tensor:
        """Return the action values of all rules. Shape (B, number of rules)."""
        batch = self.make_batch(observation)
        node, glob = self.encoder(batch)
        # Columns 1, 2, ... of the flags mark what the next rule of each category would rewrite.
        marks = batch.node_features[:, 1 : 1 + NUM_RULE_CATEGORIES]
        row, category = marks.nonzero(as_tuple=True)
        slot = batch.connectivity.node_graph[row] * NUM_RULE_CATEGORIES + category
        marked = node.new_zeros(len(glob) * NUM_RULE_CATEGORIES, node.shape[1])
        marked = marked.index_copy(0, slot, node[row]).view(len(glob), -1)
        hidden = leaky_relu(self.hidden_layer(torch.cat([glob, marked], dim=1)))
        values: Tensor = self.q_head(hidden)
        return values
