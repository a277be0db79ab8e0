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

from drake_clutter.agents.message_passing import LayerWeights, Links, message_passing, pack


class GraphBatch(NamedTuple):
    """B graphs with M nodes and Z edges in all.

    Attributes:
        kind: (M,) number of a node's kind. feature: (M, F) what else is known of it.
        links: how the nodes hang together.
        glob: (B, G) features of the whole graph.
    """

    kind: Tensor
    feature: Tensor
    links: Links
    glob: Tensor


class MessagePassing(nn.Module):
    """The layers, see `message_passing`.

    A linear layer of several inputs is the sum of one of each: what many nodes share is multiplied once.
    """

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
        (self.maximum,) = linear(width, width, bias=False)
        (self.glob,) = linear(width, width, bias=False)
        self.attention, self.attention_bias = linear(1, width)
        self.pooled, self.pooled_bias = linear(width, width)
        (self.old,) = linear(width, width, bias=False)

    @property
    def weights(self) -> LayerWeights:
        """Its parameters."""
        return LayerWeights(*(getattr(self, name) for name in LayerWeights._fields))

    def forward(
        self, node: Tensor, glob: Tensor, edge: Tensor, links: Links
    ) -> tuple[Tensor, Tensor]:
        """Embeddings of nodes (M, H) and of graphs (B, H) after the last layer; edge: (kinds of edges, H_edge)."""
        return message_passing(node, glob, edge, links, self.weights)


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
        self.layers = MessagePassing(width, edge_width, layers)

    def forward(self, batch: GraphBatch) -> tuple[Tensor, Tensor]:
        """Embeddings of nodes (M, H) and of graphs (B, H)."""
        node = leaky_relu(self.kind(batch.kind) + self.feature(batch.feature))
        edge = leaky_relu(self.edge.weight)
        glob = leaky_relu(self.glob(batch.glob))
        found: tuple[Tensor, Tensor] = self.layers(node, glob, edge, batch.links)
        return found


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
        graph, number, kind, *joined = pack(kinds, *edges, self._edge_kinds)
        feature = np.concatenate(
            [observation["node_flags"][graph, number], observation["position"][graph, number]],
            axis=1,
        )
        features = (
            torch.from_numpy(array).to(weight) for array in (feature, observation["remaining"])
        )
        links = Links(*(torch.from_numpy(array).to(weight.device) for array in (graph, *joined)))
        return GraphBatch(
            torch.from_numpy(kind).to(weight.device), next(features), links, next(features)
        )

    def forward(self, observation: Mapping[str, NDArray[Any]]) -> Tensor:
        """(B, rules)."""
        batch = self.batch(observation)
        node, glob = self.network(batch)
        row, mark = batch.feature[:, 1 : 1 + MARKS].nonzero(as_tuple=True)
        marked = node.new_zeros(len(glob) * MARKS, node.shape[1])
        marked = marked.index_copy(0, batch.links.graph[row] * MARKS + mark, node[row]).view(
            len(glob), -1
        )
        values: Tensor = self.value(leaky_relu(self.joined(torch.cat([glob, marked], dim=1))))
        return values
