"""Message passing over clutter graphs with a global attention node (Janisch et al., "Symbolic relational deep reinforcement
learning based on graph neural networks", the network of their BlockWorld experiments; SPEC section 3).

The graphs of a batch lie behind each other in one list of nodes and one of edges: nothing is computed for padding.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn.functional import leaky_relu

from drake_clutter.agents.graph_kernels import attention_pooled, message_maximum, pack, updated


class GraphBatch(NamedTuple):
    """B graphs with M nodes and Z edges in all.

    Attributes:
        kind: (M,) number of a node's kind. feature: (M, F) what else is known of it.
        graph: (M,) the graph that it belongs to.
        sender, receiver: (Z,) the nodes that an edge joins. edge_kind: (Z,) number of its kind.
        glob: (B, G) features of the whole graph.
    """

    kind: Tensor
    feature: Tensor
    graph: Tensor
    sender: Tensor
    receiver: Tensor
    edge_kind: Tensor
    glob: Tensor


class MessagePassing(nn.Module):
    """One layer: messages FC(sender, edge), their maximum by receiver, update FC(node, global, maximum) + skip; then the global
    node, FC(nodes pooled by attention, global) + skip. FC: a linear layer and LeakyReLU.

    A linear layer of several inputs is the sum of one of each: what many nodes share is multiplied once.
    """

    def __init__(self, width: int, edge_width: int) -> None:
        super().__init__()
        self.message_sender = nn.Linear(width, width)
        self.message_edge = nn.Linear(edge_width, width, bias=False)
        self.update_node = nn.Linear(width, width)
        self.update_maximum = nn.Linear(width, width, bias=False)
        self.update_global = nn.Linear(width, width, bias=False)
        self.attention = nn.Linear(width, 1)
        self.global_pooled = nn.Linear(width, width)
        self.global_global = nn.Linear(width, width, bias=False)

    def forward(self, node: Tensor, glob: Tensor, edge: Tensor, batch: GraphBatch) -> tuple[Tensor, Tensor]:
        """Embeddings of nodes (M, H) and of graphs (B, H) after the layer; edge: (kinds of edges, H_edge)."""
        most = message_maximum(self.message_sender(node), self.message_edge(edge), batch.sender, batch.receiver, batch.edge_kind)
        update = torch.addmm(self.update_node(node), most, self.update_maximum.weight.t())
        node = updated(update, self.update_global(glob), batch.graph, node)
        pooled = attention_pooled(node, self.attention(node).squeeze(1), batch.graph, len(glob))
        return node, leaky_relu(self.global_pooled(pooled) + self.global_global(glob)) + glob


class GraphNetwork(nn.Module):
    """Embeds graphs: features FC, then layers of message passing. A kind's FC is a row that is looked up."""

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
        self.kind = nn.Embedding(node_kinds, width)
        self.feature = nn.Linear(features, width)
        self.edge = nn.Embedding(edge_kinds, edge_width)
        self.glob = nn.Linear(globals_, width)
        self.layers = nn.ModuleList(MessagePassing(width, edge_width) for _ in range(layers))

    def forward(self, batch: GraphBatch) -> tuple[Tensor, Tensor]:
        """Embeddings of nodes (M, H) and of graphs (B, H)."""
        node = leaky_relu(self.kind(batch.kind) + self.feature(batch.feature))
        edge = leaky_relu(self.edge.weight)
        glob = leaky_relu(self.glob(batch.glob))
        for layer in self.layers:
            node, glob = layer(node, glob, edge, batch)
        return node, glob


MARKS = 3
"""Kinds of rules that mark the node they would rewrite: of structure, insertion, orientation."""


class RuleValues(nn.Module):
    """Q: a value for every rule of a grammar, from the observation of `ClutterGeneration`.

    Edges carry messages both ways; the ways are different kinds. The values are read from the global node, as in the paper, and
    from the nodes that are marked as what the next rules would rewrite: 0 where there is none.
    """

    def __init__(self, node_kinds: int, edge_kinds: int, rules: int, width: int = 32) -> None:
        super().__init__()
        self._edge_kinds = edge_kinds
        self.network = GraphNetwork(node_kinds, 4 + 3, 2 * edge_kinds, 1, width)
        self.joined = nn.Linear((1 + MARKS) * width, 2 * width)
        self.value = nn.Linear(2 * width, rules)

    def batch(self, observation: Mapping[str, NDArray[Any]]) -> GraphBatch:
        """The network's input: arrays as in `ClutterGeneration`, with a first axis of graphs."""
        weight = self.value.weight
        kinds, edges = observation["node_kind"], (observation["edge"], observation["edge_kind"])
        graph, number, kind, sender, receiver, edge_kind = map(torch.from_numpy, pack(kinds, *edges, self._edge_kinds))
        at = (graph.numpy(), number.numpy())
        feature = np.concatenate([observation["node_flags"][at], observation["position"][at]], axis=1)
        features = (torch.from_numpy(array).to(weight.dtype) for array in (feature, observation["remaining"]))
        arrays = (kind, next(features), graph, sender, receiver, edge_kind, next(features))
        return GraphBatch(*(array.to(weight.device) for array in arrays))

    def forward(self, observation: Mapping[str, NDArray[Any]]) -> Tensor:
        """(B, rules)."""
        batch = self.batch(observation)
        node, glob = self.network(batch)
        row, mark = batch.feature[:, 1 : 1 + MARKS].nonzero(as_tuple=True)
        marked = node.new_zeros(len(glob) * MARKS, node.shape[1])
        marked = marked.index_copy(0, batch.graph[row] * MARKS + mark, node[row]).view(len(glob), -1)
        values: Tensor = self.value(leaky_relu(self.joined(torch.cat([glob, marked], dim=1))))
        return values
