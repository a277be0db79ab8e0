"""Layers of message passing, twice: composed of PyTorch's operations, and compiled for the CPU with their gradient.

The networks are so small that on a CPU most of the time of the composed ones goes into calling PyTorch, and they hold the
interpreter meanwhile. The compiled ones are a single call, and let other threads go on.
"""

from typing import Any, NamedTuple

import numpy as np
import scipy.linalg.cython_blas  # noqa: F401, of which compiled products are made; to be there when its threads are limited
import torch
from numba import njit
from threadpoolctl import threadpool_limits
from torch import Tensor
from torch.nn.functional import leaky_relu

NEGATIVE_SLOPE = 0.01
"""Of LeakyReLU below 0."""


def limit_operations_to_one_thread() -> None:
    """For the rest of the process: operations this small lose by being shared out, and more so when threads work side by side."""
    torch.set_num_threads(1)
    threadpool_limits(1)


class LayerWeights(NamedTuple):
    """Tensors or arrays of L layers, behind each other: (L, H, H) where nothing else is said.

    Attributes:
        sender, sender_bias (L, H), edge (L, H, H_edge): of the messages.
        node, node_bias (L, H), max_message, global_to_node: of the update of the nodes.
        attention: (L, 1, H), attention_bias (L, 1).
        pooled, pooled_bias (L, H), global_self: of the update of the global node, from what is pooled and from itself.
    """

    sender: Any
    sender_bias: Any
    edge: Any
    node: Any
    node_bias: Any
    max_message: Any
    global_to_node: Any
    attention: Any
    attention_bias: Any
    pooled: Any
    pooled_bias: Any
    global_self: Any


class _Kept(NamedTuple):
    """What the gradient needs of each layer, arrays.

    Attributes:
        most, winner: (L, M, H) the maximum of the messages, and the edge that it came by.
        update, update_glob: (L, M, H) and (L, B, H) what LeakyReLU was applied to.
        share: (L, M) attention. pooled: (L, B, H).
    """

    most: Any
    winner: Any
    update: Any
    share: Any
    pooled: Any
    update_glob: Any


class BatchConnectivity(NamedTuple):
    """How the nodes of a batch hang together, tensors or arrays.

    Attributes:
        node_graph: (M,) the graph that a node belongs to.
        senders, receivers: (Z,) the nodes that an edge joins. kind: (Z,) number of its kind.
    """

    node_graph: Any
    senders: Any
    receivers: Any
    edge_kind: Any


def message_passing(
    node: Tensor, glob: Tensor, edge: Tensor, connectivity: BatchConnectivity, weights: LayerWeights
) -> tuple[Tensor, Tensor]:
    """Layer after layer: messages FC(sender, edge), their maximum by receiver, 0 where there is none, update FC(node, global,
    maximum) + skip; then the global node, FC(nodes pooled by attention, global) + skip. FC: a linear layer and LeakyReLU.

    Args:
        node: (M, H). glob: (B, H). edge: (kinds of edges, H_edge).

    Returns:
        (M, H) and (B, H). Of equal messages on the CPU the first gets the gradient.
    """
    if node.device.type == "cpu":
        found: tuple[Tensor, Tensor] = _MessagePassing.apply(
            node, glob, edge, *connectivity, *weights
        )  # type: ignore[no-untyped-call]
        return found
    return message_passing_reference(node, glob, edge, connectivity, weights)


def message_passing_reference(
    node: Tensor, glob: Tensor, edge: Tensor, connectivity: BatchConnectivity, weights: LayerWeights
) -> tuple[Tensor, Tensor]:
    """See `message_passing`; equal messages share the gradient."""
    for layer in map(LayerWeights._make, zip(*weights, strict=True)):
        sent = node @ layer.sender.t() + layer.sender_bias
        message = leaky_relu(
            sent[connectivity.senders] + (edge @ layer.edge.t())[connectivity.edge_kind],
            NEGATIVE_SLOPE,
        )
        receiver = connectivity.receivers[:, None].expand_as(message)
        most = torch.zeros_like(sent).scatter_reduce(
            0, receiver, message, "amax", include_self=False
        )
        update = (
            node @ layer.node.t()
            + layer.node_bias
            + most @ layer.max_message.t()
            + (glob @ layer.global_to_node.t())[connectivity.node_graph]
        )
        node = leaky_relu(update, NEGATIVE_SLOPE) + node
        logit = (node @ layer.attention.t() + layer.attention_bias).squeeze(1)
        largest = logit.new_full((len(glob),), -torch.inf).scatter_reduce(
            0, connectivity.node_graph, logit.detach(), "amax"
        )
        share = (logit - largest[connectivity.node_graph]).exp()[:, None]
        total = share.new_zeros(len(glob), 1).index_add(0, connectivity.node_graph, share)
        pooled = torch.zeros_like(glob).index_add(0, connectivity.node_graph, share * node) / total
        update = pooled @ layer.pooled.t() + layer.pooled_bias + glob @ layer.global_self.t()
        glob = leaky_relu(update, NEGATIVE_SLOPE) + glob
    return node, glob


@njit(cache=True, nogil=True)
def _slope(array):  # type: ignore[no-untyped-def]
    """NEGATIVE_SLOPE as a number of the array's precision: one of double precision would have loops computed in that."""
    return np.full(1, NEGATIVE_SLOPE, array.dtype)[0]


@njit(cache=True, nogil=True)
def _maximum(sent, from_edge, sender, receiver, kind, most, winner):  # type: ignore[no-untyped-def]
    slope = _slope(sent)
    most[:] = -np.inf
    winner[:] = -1
    for z in range(len(sender)):
        source, edge = sent[sender[z]], from_edge[kind[z]]
        best, who = most[receiver[z]], winner[receiver[z]]
        for h in range(sent.shape[1]):
            value = source[h] + edge[h]
            message = max(value, value * slope)
            better = message > best[h]
            best[h] = message if better else best[h]
            who[h] = z if better else who[h]
    for m in range(len(most)):
        if winner[m, 0] < 0:
            most[m] = 0


@njit(cache=True, nogil=True)
def _pooled(node, logit, graph, pooled, weight):  # type: ignore[no-untyped-def]
    count = len(pooled)
    pooled[:] = 0
    most, total = np.full(count, -np.inf, node.dtype), np.zeros(count, node.dtype)
    for m in range(len(node)):
        most[graph[m]] = max(most[graph[m]], logit[m])
    for m in range(len(node)):
        weight[m] = np.exp(logit[m] - most[graph[m]])
        total[graph[m]] += weight[m]
    for m in range(len(node)):
        w = weight[m] / total[graph[m]]
        weight[m] = w
        a, b = pooled[graph[m]], node[m]
        for h in range(node.shape[1]):
            a[h] += w * b[h]


@njit(cache=True, nogil=True)
def _layer(k, node, glob, edge, links, w, kept, out, out_glob):  # type: ignore[no-untyped-def]
    slope, most, update, update_glob, pooled = (
        _slope(node),
        kept.most[k],
        kept.update[k],
        kept.update_glob[k],
        kept.pooled[k],
    )
    sent, from_edge = np.dot(node, w.sender[k].T) + w.sender_bias[k], np.dot(edge, w.edge[k].T)
    _maximum(sent, from_edge, links.senders, links.receivers, links.edge_kind, most, kept.winner[k])
    from_node, from_most, from_glob = (
        np.dot(node, w.node[k].T),
        np.dot(most, w.max_message[k].T),
        np.dot(glob, w.global_to_node[k].T),
    )
    bias = w.node_bias[k]
    for m in range(len(node)):
        a, b, c, d, e, f = (
            from_node[m],
            from_most[m],
            from_glob[links.node_graph[m]],
            node[m],
            update[m],
            out[m],
        )
        for h in range(node.shape[1]):
            value = a[h] + bias[h] + b[h] + c[h]
            e[h] = value
            f[h] = max(value, value * slope) + d[h]
    logit = np.dot(out, w.attention[k].T)[:, 0] + w.attention_bias[k, 0]
    _pooled(out, logit, links.node_graph, pooled, kept.share[k])
    update_glob[:] = (
        np.dot(pooled, w.pooled[k].T) + w.pooled_bias[k] + np.dot(glob, w.global_self[k].T)
    )
    out_glob[:] = np.maximum(update_glob, update_glob * slope) + glob


@njit(cache=True, nogil=True)
def _forward(nodes, globs, edge, links, weights, kept):  # type: ignore[no-untyped-def]
    """All layers; `nodes` (L + 1, M, H) and `globs` (L + 1, B, H) hold what goes into each, and what comes out of the last."""
    for k in range(len(nodes) - 1):
        _layer(k, nodes[k], globs[k], edge, links, weights, kept, nodes[k + 1], globs[k + 1])


@njit(cache=True, nogil=True)
def _columns(array):  # type: ignore[no-untyped-def]
    total = np.zeros(array.shape[1], array.dtype)
    for row in array:
        total += row
    return total


@njit(cache=True, nogil=True)
def _layer_gradient(k, to_out, to_out_glob, node, glob, edge, links, w, kept, out, to_w):  # type: ignore[no-untyped-def]
    """What is called `to_x` is the gradient of x."""
    width, slope, most, winner, pooled = (
        node.shape[1],
        _slope(node),
        kept.most[k],
        kept.winner[k],
        kept.pooled[k],
    )
    to_update_glob = np.where(kept.update_glob[k] > 0, to_out_glob, to_out_glob * slope)
    to_pooled = np.dot(to_update_glob, w.pooled[k])
    to_node, to_logit = np.empty_like(node), np.empty((len(node), 1), node.dtype)
    to_update, from_glob = np.empty_like(node), np.zeros_like(glob)
    of_attention = w.attention[k, 0]
    for m in range(len(node)):
        share, a, b, c = (
            kept.share[k, m],
            to_pooled[links.node_graph[m]],
            out[m],
            pooled[links.node_graph[m]],
        )
        to_share = share * 0
        for h in range(width):
            to_share += a[h] * (b[h] - c[h])
        logit = share * to_share
        to_logit[m, 0] = logit
        b, c, d, e, f = (
            to_out[m],
            to_node[m],
            to_update[m],
            kept.update[k, m],
            from_glob[links.node_graph[m]],
        )
        for h in range(width):
            value = b[h] + share * a[h] + logit * of_attention[h]
            c[h] = value  # by the skip connection
            value *= 1 if e[h] > 0 else slope
            d[h] = value
            f[h] += value
    to_most = np.dot(to_update, w.max_message[k])
    to_sent, to_from_edge = np.zeros_like(node), np.zeros((len(edge), width), node.dtype)
    for m in range(len(node)):
        for h in range(width):
            z = winner[m, h]
            if z >= 0:
                value = to_most[m, h] if most[m, h] > 0 else to_most[m, h] * slope
                to_sent[links.senders[z], h] += value
                to_from_edge[links.edge_kind[z], h] += value
    to_node += np.dot(to_update, w.node[k])
    to_node += np.dot(to_sent, w.sender[k])
    to_glob = (
        to_out_glob
        + np.dot(to_update_glob, w.global_self[k])
        + np.dot(from_glob, w.global_to_node[k])
    )
    to_w.sender[k], to_w.sender_bias[k] = np.dot(to_sent.T, node), _columns(to_sent)
    to_w.edge[k] = np.dot(to_from_edge.T, edge)
    to_w.node[k], to_w.node_bias[k] = np.dot(to_update.T, node), _columns(to_update)
    to_w.max_message[k] = np.dot(to_update.T, most)
    to_w.global_to_node[k] = np.dot(from_glob.T, glob)
    to_w.attention[k], to_w.attention_bias[k] = np.dot(to_logit.T, out), _columns(to_logit)
    to_w.pooled[k], to_w.pooled_bias[k] = np.dot(to_update_glob.T, pooled), _columns(to_update_glob)
    to_w.global_self[k] = np.dot(to_update_glob.T, glob)
    return to_node, to_glob, np.dot(to_from_edge, w.edge[k])


@njit(cache=True, nogil=True)
def _gradient(to_node, to_glob, nodes, globs, edge, links, weights, kept, to_weights):  # type: ignore[no-untyped-def]
    """Gradients of the inputs; those of the weights are written to `to_weights`."""
    to_edge = np.zeros_like(edge)
    for k in range(len(nodes) - 2, -1, -1):
        before = nodes[k], globs[k], edge, links, weights, kept
        to_node, to_glob, more = _layer_gradient(
            k, to_node, to_glob, *before, nodes[k + 1], to_weights
        )
        to_edge += more
    return to_node, to_glob, to_edge


class _MessagePassing(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, node: Tensor, glob: Tensor, edge: Tensor, *links_and_weights: Tensor
    ) -> tuple[Tensor, Tensor]:
        arrays = [tensor.detach().numpy() for tensor in links_and_weights]
        links, weights = (
            BatchConnectivity(*arrays[: len(BatchConnectivity._fields)]),
            LayerWeights(*arrays[len(BatchConnectivity._fields) :]),
        )
        layers, edges = len(weights.sender), edge.detach().numpy()
        of_nodes, of_graphs = (layers, *node.shape), (layers, *glob.shape)
        shapes = (of_nodes, of_nodes, of_nodes, of_nodes[:2], of_graphs, of_graphs)
        kept = _Kept(
            *(
                np.empty(shape, np.int32 if k == 1 else edges.dtype)
                for k, shape in enumerate(shapes)
            )
        )
        nodes, globs = (np.empty((layers + 1, *array.shape), edges.dtype) for array in (node, glob))
        nodes[0], globs[0] = node.detach().numpy(), glob.detach().numpy()
        ctx.arrays = nodes, globs, edges, links, weights, kept
        _forward(*ctx.arrays)
        return torch.from_numpy(nodes[-1]), torch.from_numpy(globs[-1])

    @staticmethod
    def backward(ctx: Any, to_node: Tensor, to_glob: Tensor) -> tuple[Tensor | None, ...]:
        to_weights = LayerWeights(*(np.empty_like(weight) for weight in ctx.arrays[4]))
        given = (
            to_node.contiguous().numpy(),
            to_glob.contiguous().numpy(),
            *ctx.arrays,
            to_weights,
        )
        inputs, of_weights = (
            [torch.from_numpy(array) for array in arrays]
            for arrays in (_gradient(*given), to_weights)
        )
        return *inputs, None, None, None, None, *of_weights


@njit(cache=True, nogil=True)
def pack_graphs(node_kind, edge, edge_kind, edge_kinds):  # type: ignore[no-untyped-def]
    """Padded graphs, B of them, behind each other in one list of nodes and one of edges, which go both ways.

    Args:
        node_kind: (B, N) from 1 on, the nodes first, then zeros.
        edge: (B, E, 2) parent and child.
        edge_kind: (B, E) from 1 on, 0 where there is no edge.
        edge_kinds: their number; backwards, an edge is of the kind that many further on.

    Returns:
        graph, number in its graph, kind (M,); sender, receiver, kind (Z,).
    """
    nodes, edges = 0, 0
    for b in range(len(node_kind)):
        for n in range(node_kind.shape[1]):
            nodes += node_kind[b, n] > 0
        for e in range(edge.shape[1]):
            edges += edge_kind[b, e] > 0
    graph, number, kind = (
        np.empty(nodes, np.int64),
        np.empty(nodes, np.int64),
        np.empty(nodes, np.int64),
    )
    sender, receiver, both = (
        np.empty(2 * edges, np.int64),
        np.empty(2 * edges, np.int64),
        np.empty(2 * edges, np.int64),
    )
    m, z = 0, 0
    for b in range(len(node_kind)):
        first = m
        for n in range(node_kind.shape[1]):
            if node_kind[b, n] > 0:
                graph[m], number[m], kind[m] = b, n, node_kind[b, n] - 1
                m += 1
        for e in range(edge.shape[1]):
            if edge_kind[b, e] > 0:
                parent, child = first + edge[b, e, 0], first + edge[b, e, 1]
                sender[z], receiver[z], both[z] = parent, child, edge_kind[b, e] - 1
                sender[z + 1], receiver[z + 1], both[z + 1] = (
                    child,
                    parent,
                    edge_kind[b, e] - 1 + edge_kinds,
                )
                z += 2
    return graph, number, kind, sender, receiver, both
