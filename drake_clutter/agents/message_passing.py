"""Message-passing layers of a graph network, as a PyTorch reference and compiled for the CPU.

For networks this small, PyTorch spends most of the CPU time on dispatching operations, and holds
Python's global interpreter lock meanwhile. The compiled layers are a single call that releases the
lock; their gradient is written out below.

Symbols in shapes: B graphs, M nodes and Z directed edges in a batch; L layers; H the width of a
node's embedding.
"""

from typing import Any, NamedTuple

import numpy as np
import scipy.linalg.cython_blas  # noqa: F401, numba's BLAS; loaded before its threads are limited
import torch
from threadpoolctl import threadpool_limits
from torch import Tensor
from torch.nn.functional import leaky_relu

from drake_clutter.compilation import njit

NEGATIVE_SLOPE = 0.01
"""Slope of LeakyReLU for negative inputs; PyTorch's default."""


def limit_operations_to_one_thread() -> None:
    """Compute every PyTorch and BLAS operation of this process in one thread.

    Operations on networks this small take longer when they are split among threads.
    """
    torch.set_num_threads(1)
    threadpool_limits(1)


class LayerWeights(NamedTuple):
    """Weights of L layers as tensors or arrays, stacked along the first axis.

    Attributes:
        sender: Message from the sending node. Shape (L, H, H).
        sender_bias: Bias of the message. Shape (L, H).
        edge: Message from the edge's embedding. Shape (L, H, H_edge).
        node: Node update from the node itself. Shape (L, H, H).
        node_bias: Bias of the node update. Shape (L, H).
        max_message: Node update from the maximum of the incoming messages. Shape (L, H, H).
        global_to_node: Node update from the global node. Shape (L, H, H).
        attention: Attention logit of a node. Shape (L, 1, H).
        attention_bias: Bias of the attention logit. Shape (L, 1).
        pooled: Global update from the attention-pooled nodes. Shape (L, H, H).
        pooled_bias: Bias of the global update. Shape (L, H).
        global_self: Global update from the global node itself. Shape (L, H, H).
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


class _Activations(NamedTuple):
    """Activations of the forward pass that the backward pass needs, as arrays.

    Attributes:
        max_message: Maximum of the messages that a node receives. Shape (L, M, H).
        argmax_edge: Edge that carried the maximum, -1 for a node without edges. Shape (L, M, H).
        node_preactivation: Node update before LeakyReLU. Shape (L, M, H).
        attention: Attention weight of a node within its graph. Shape (L, M).
        pooled: Attention-pooled nodes of each graph. Shape (L, B, H).
        global_preactivation: Global update before LeakyReLU. Shape (L, B, H).
    """

    max_message: Any
    argmax_edge: Any
    node_preactivation: Any
    attention: Any
    pooled: Any
    global_preactivation: Any


class BatchConnectivity(NamedTuple):
    """Edges of a batch of graphs whose nodes are numbered consecutively, as tensors or arrays.

    Attributes:
        node_graph: Index of the graph that a node belongs to. Shape (M,).
        senders: Node that an edge leaves. Shape (Z,).
        receivers: Node that an edge enters. Shape (Z,).
        edge_kind: Kind of an edge, from 0 on. Shape (Z,).
    """

    node_graph: Any
    senders: Any
    receivers: Any
    edge_kind: Any


def message_passing(
    node: Tensor, glob: Tensor, edge: Tensor, connectivity: BatchConnectivity, weights: LayerWeights
) -> tuple[Tensor, Tensor]:
    """Apply message-passing layers with a global attention node (Janisch et al. 2020).

    With FC a linear layer followed by LeakyReLU, each layer computes

        message = FC(sender, edge)
        node   <- node + FC(node, global, max over incoming messages; 0 without any)
        global <- global + FC(nodes pooled by attention, global)

    On the CPU the compiled layers are used; among equal messages, the first gets the gradient.

    Args:
        node: Embeddings of the nodes. Shape (M, H).
        glob: Embeddings of the global nodes. Shape (B, H).
        edge: Embeddings of the kinds of edges. Shape (number of kinds, H_edge).
        connectivity: The edges.
        weights: The layers' weights.

    Returns:
        Embeddings of the nodes (M, H) and of the global nodes (B, H) after the last layer.
    """
    if node.device.type == "cpu":
        embeddings: tuple[Tensor, Tensor] = _MessagePassing.apply(  # type: ignore[no-untyped-call]
            node, glob, edge, *connectivity, *weights
        )
        return embeddings
    return message_passing_reference(node, glob, edge, connectivity, weights)


def message_passing_reference(
    node: Tensor, glob: Tensor, edge: Tensor, connectivity: BatchConnectivity, weights: LayerWeights
) -> tuple[Tensor, Tensor]:
    """Apply the layers of `message_passing` with PyTorch operations, on any device.

    Equal messages share the gradient.
    """
    node_graph = connectivity.node_graph
    for layer in map(LayerWeights._make, zip(*weights, strict=True)):
        from_sender = node @ layer.sender.t() + layer.sender_bias
        from_edge = edge @ layer.edge.t()
        message = leaky_relu(
            from_sender[connectivity.senders] + from_edge[connectivity.edge_kind], NEGATIVE_SLOPE
        )
        receiver = connectivity.receivers[:, None].expand_as(message)
        max_message = torch.zeros_like(from_sender).scatter_reduce(
            0, receiver, message, "amax", include_self=False
        )
        update = (
            node @ layer.node.t()
            + layer.node_bias
            + max_message @ layer.max_message.t()
            + (glob @ layer.global_to_node.t())[node_graph]
        )
        node = leaky_relu(update, NEGATIVE_SLOPE) + node
        logit = (node @ layer.attention.t() + layer.attention_bias).squeeze(1)
        max_logit = logit.new_full((len(glob),), -torch.inf).scatter_reduce(
            0, node_graph, logit.detach(), "amax"
        )
        weight = (logit - max_logit[node_graph]).exp()[:, None]
        total = weight.new_zeros(len(glob), 1).index_add(0, node_graph, weight)
        pooled = torch.zeros_like(glob).index_add(0, node_graph, weight * node) / total
        update = pooled @ layer.pooled.t() + layer.pooled_bias + glob @ layer.global_self.t()
        glob = leaky_relu(update, NEGATIVE_SLOPE) + glob
    return node, glob


@njit(cache=True, nogil=True)
def _slope(array):  # type: ignore[no-untyped-def]
    """Return `NEGATIVE_SLOPE` in an array's precision.

    A factor of double precision would make numba compute the loops in double precision.
    """
    return np.full(1, NEGATIVE_SLOPE, array.dtype)[0]


@njit(cache=True, nogil=True)
def _max_messages(from_sender, from_edge, senders, receivers, edge_kind, max_message, argmax_edge):  # type: ignore[no-untyped-def]
    """Write the maximum of each node's incoming messages, and the edge that carried it."""
    slope = _slope(from_sender)
    max_message[:] = -np.inf
    argmax_edge[:] = -1
    for z in range(len(senders)):
        sender_part = from_sender[senders[z]]
        edge_part = from_edge[edge_kind[z]]
        best = max_message[receivers[z]]
        best_edge = argmax_edge[receivers[z]]
        for h in range(from_sender.shape[1]):
            value = sender_part[h] + edge_part[h]
            message = max(value, value * slope)
            is_better = message > best[h]
            best[h] = message if is_better else best[h]
            best_edge[h] = z if is_better else best_edge[h]
    for m in range(len(max_message)):
        if argmax_edge[m, 0] < 0:
            max_message[m] = 0


@njit(cache=True, nogil=True)
def _pool_by_attention(node, logit, node_graph, pooled, attention):  # type: ignore[no-untyped-def]
    """Write each graph's pooled nodes and each node's attention weight, a softmax per graph."""
    num_graphs = len(pooled)
    pooled[:] = 0
    max_logit = np.full(num_graphs, -np.inf, node.dtype)
    total = np.zeros(num_graphs, node.dtype)
    for m in range(len(node)):
        max_logit[node_graph[m]] = max(max_logit[node_graph[m]], logit[m])
    for m in range(len(node)):
        attention[m] = np.exp(logit[m] - max_logit[node_graph[m]])
        total[node_graph[m]] += attention[m]
    for m in range(len(node)):
        weight = attention[m] / total[node_graph[m]]
        attention[m] = weight
        graph_pooled = pooled[node_graph[m]]
        embedding = node[m]
        for h in range(node.shape[1]):
            graph_pooled[h] += weight * embedding[h]


@njit(cache=True, nogil=True)
def _layer(k, node, glob, edge, connectivity, weights, saved, node_out, glob_out):  # type: ignore[no-untyped-def]
    """Compute layer k: write its outputs, and save its activations."""
    slope = _slope(node)
    max_message = saved.max_message[k]
    node_preactivation = saved.node_preactivation[k]
    global_preactivation = saved.global_preactivation[k]
    pooled = saved.pooled[k]
    from_sender = np.dot(node, weights.sender[k].T) + weights.sender_bias[k]
    from_edge = np.dot(edge, weights.edge[k].T)
    _max_messages(
        from_sender,
        from_edge,
        connectivity.senders,
        connectivity.receivers,
        connectivity.edge_kind,
        max_message,
        saved.argmax_edge[k],
    )
    from_node = np.dot(node, weights.node[k].T)
    from_message = np.dot(max_message, weights.max_message[k].T)
    from_global = np.dot(glob, weights.global_to_node[k].T)
    bias = weights.node_bias[k]
    for m in range(len(node)):
        node_part = from_node[m]
        message_part = from_message[m]
        global_part = from_global[connectivity.node_graph[m]]
        skip = node[m]
        preactivation = node_preactivation[m]
        out = node_out[m]
        for h in range(node.shape[1]):
            value = node_part[h] + bias[h] + message_part[h] + global_part[h]
            preactivation[h] = value
            out[h] = max(value, value * slope) + skip[h]
    logit = np.dot(node_out, weights.attention[k].T)[:, 0] + weights.attention_bias[k, 0]
    _pool_by_attention(node_out, logit, connectivity.node_graph, pooled, saved.attention[k])
    global_preactivation[:] = (
        np.dot(pooled, weights.pooled[k].T)
        + weights.pooled_bias[k]
        + np.dot(glob, weights.global_self[k].T)
    )
    glob_out[:] = np.maximum(global_preactivation, global_preactivation * slope) + glob


@njit(cache=True, nogil=True)
def _forward(nodes, globs, edge, connectivity, weights, saved):  # type: ignore[no-untyped-def]
    """Compute all layers.

    Args:
        nodes: Inputs of each layer, and the output of the last. Shape (L + 1, M, H).
        globs: The same of the global nodes. Shape (L + 1, B, H).
        edge: See `message_passing`.
        connectivity: See `message_passing`.
        weights: See `message_passing`.
        saved: Where the activations are written.
    """
    for k in range(len(nodes) - 1):
        _layer(
            k, nodes[k], globs[k], edge, connectivity, weights, saved, nodes[k + 1], globs[k + 1]
        )


@njit(cache=True, nogil=True)
def _sum_rows(array):  # type: ignore[no-untyped-def]
    total = np.zeros(array.shape[1], array.dtype)
    for row in array:
        total += row
    return total


@njit(cache=True, nogil=True)
def _layer_gradient(  # type: ignore[no-untyped-def]
    k,
    grad_node_out,
    grad_glob_out,
    node,
    glob,
    edge,
    connectivity,
    weights,
    saved,
    node_out,
    grad_weights,
):
    """Return the gradients of layer k's nodes, global nodes and edge embeddings.

    `grad_x` is the gradient of the loss with respect to x. Those of the layer's weights are written
    to `grad_weights`.
    """
    width = node.shape[1]
    slope = _slope(node)
    max_message = saved.max_message[k]
    argmax_edge = saved.argmax_edge[k]
    pooled = saved.pooled[k]
    grad_global_update = np.where(
        saved.global_preactivation[k] > 0, grad_glob_out, grad_glob_out * slope
    )
    grad_pooled = np.dot(grad_global_update, weights.pooled[k])
    grad_node = np.empty_like(node)
    grad_logit = np.empty((len(node), 1), node.dtype)
    grad_node_update = np.empty_like(node)
    grad_from_global = np.zeros_like(glob)
    attention_weights = weights.attention[k, 0]
    for m in range(len(node)):
        graph = connectivity.node_graph[m]
        attention = saved.attention[k, m]
        grad_graph_pooled = grad_pooled[graph]
        embedding = node_out[m]
        graph_pooled = pooled[graph]
        grad_attention = attention * 0
        for h in range(width):
            grad_attention += grad_graph_pooled[h] * (embedding[h] - graph_pooled[h])
        grad_node_logit = attention * grad_attention
        grad_logit[m, 0] = grad_node_logit
        grad_out = grad_node_out[m]
        grad_skip = grad_node[m]
        grad_update = grad_node_update[m]
        preactivation = saved.node_preactivation[k, m]
        grad_graph = grad_from_global[graph]
        for h in range(width):
            value = (
                grad_out[h]
                + attention * grad_graph_pooled[h]
                + grad_node_logit * attention_weights[h]
            )
            grad_skip[h] = value
            value *= 1 if preactivation[h] > 0 else slope
            grad_update[h] = value
            grad_graph[h] += value
    grad_max_message = np.dot(grad_node_update, weights.max_message[k])
    grad_from_sender = np.zeros_like(node)
    grad_from_edge = np.zeros((len(edge), width), node.dtype)
    for m in range(len(node)):
        for h in range(width):
            z = argmax_edge[m, h]
            if z >= 0:
                value = (
                    grad_max_message[m, h]
                    if max_message[m, h] > 0
                    else grad_max_message[m, h] * slope
                )
                grad_from_sender[connectivity.senders[z], h] += value
                grad_from_edge[connectivity.edge_kind[z], h] += value
    grad_node += np.dot(grad_node_update, weights.node[k])
    grad_node += np.dot(grad_from_sender, weights.sender[k])
    grad_glob = (
        grad_glob_out
        + np.dot(grad_global_update, weights.global_self[k])
        + np.dot(grad_from_global, weights.global_to_node[k])
    )
    grad_weights.sender[k] = np.dot(grad_from_sender.T, node)
    grad_weights.sender_bias[k] = _sum_rows(grad_from_sender)
    grad_weights.edge[k] = np.dot(grad_from_edge.T, edge)
    grad_weights.node[k] = np.dot(grad_node_update.T, node)
    grad_weights.node_bias[k] = _sum_rows(grad_node_update)
    grad_weights.max_message[k] = np.dot(grad_node_update.T, max_message)
    grad_weights.global_to_node[k] = np.dot(grad_from_global.T, glob)
    grad_weights.attention[k] = np.dot(grad_logit.T, node_out)
    grad_weights.attention_bias[k] = _sum_rows(grad_logit)
    grad_weights.pooled[k] = np.dot(grad_global_update.T, pooled)
    grad_weights.pooled_bias[k] = _sum_rows(grad_global_update)
    grad_weights.global_self[k] = np.dot(grad_global_update.T, glob)
    return grad_node, grad_glob, np.dot(grad_from_edge, weights.edge[k])


@njit(cache=True, nogil=True)
def _backward(grad_node, grad_glob, nodes, globs, edge, connectivity, weights, saved, grad_weights):  # type: ignore[no-untyped-def]
    """Return the gradients of the inputs; write those of the weights to `grad_weights`."""
    grad_edge = np.zeros_like(edge)
    for k in range(len(nodes) - 2, -1, -1):
        inputs = nodes[k], globs[k], edge, connectivity, weights, saved
        grad_node, grad_glob, grad_layer_edge = _layer_gradient(
            k, grad_node, grad_glob, *inputs, nodes[k + 1], grad_weights
        )
        grad_edge += grad_layer_edge
    return grad_node, grad_glob, grad_edge


class _MessagePassing(torch.autograd.Function):
    """Connects the compiled layers to PyTorch's automatic differentiation."""

    @staticmethod
    def forward(
        ctx: Any, node: Tensor, glob: Tensor, edge: Tensor, *connectivity_and_weights: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Return the embeddings after the last layer; see `message_passing`."""
        arrays = [tensor.detach().numpy() for tensor in connectivity_and_weights]
        num_connectivity = len(BatchConnectivity._fields)
        connectivity = BatchConnectivity(*arrays[:num_connectivity])
        weights = LayerWeights(*arrays[num_connectivity:])
        edges = edge.detach().numpy()
        layers = len(weights.sender)
        dtype = edges.dtype
        node_shape = (layers, *node.shape)
        graph_shape = (layers, *glob.shape)
        saved = _Activations(
            max_message=np.empty(node_shape, dtype),
            argmax_edge=np.empty(node_shape, np.int32),
            node_preactivation=np.empty(node_shape, dtype),
            attention=np.empty(node_shape[:2], dtype),
            pooled=np.empty(graph_shape, dtype),
            global_preactivation=np.empty(graph_shape, dtype),
        )
        nodes = np.empty((layers + 1, *node.shape), dtype)
        globs = np.empty((layers + 1, *glob.shape), dtype)
        nodes[0] = node.detach().numpy()
        globs[0] = glob.detach().numpy()
        ctx.weights = weights
        ctx.arrays = nodes, globs, edges, connectivity, weights, saved
        _forward(*ctx.arrays)
        return torch.from_numpy(nodes[-1]), torch.from_numpy(globs[-1])

    @staticmethod
    def backward(ctx: Any, grad_node: Tensor, grad_glob: Tensor) -> tuple[Tensor | None, ...]:
        """Return the gradients of the arguments of `forward`; connectivity has none."""
        grad_weights = LayerWeights(*(np.empty_like(weight) for weight in ctx.weights))
        arguments = (
            grad_node.contiguous().numpy(),
            grad_glob.contiguous().numpy(),
            *ctx.arrays,
            grad_weights,
        )
        grad_inputs = _backward(*arguments)
        return (
            *(torch.from_numpy(array) for array in grad_inputs),
            *(None for _ in BatchConnectivity._fields),
            *(torch.from_numpy(array) for array in grad_weights),
        )


@njit(cache=True, nogil=True)
def pack_graphs(node_kind, edge_links, edge_kind, num_edge_kinds):  # type: ignore[no-untyped-def]
    """Pack padded graphs into one list of nodes and one list of directed edges.

    Every edge is turned into two directed ones; the kind of the reverse edge is
    `num_edge_kinds` higher.

    Args:
        node_kind: Kinds of the nodes from 1 on, then zeros as padding. Shape (B, N).
        edge_links: Parent and child of each edge, numbered within their graph. Shape (B, E, 2).
        edge_kind: Kinds of the edges from 1 on; 0 where there is no edge. Shape (B, E).
        num_edge_kinds: Number of kinds of edges.

    Returns:
        Graph, index within its graph and kind of each node, (M,) each; sender, receiver and kind
        of each directed edge, (Z,) each. Kinds count from 0 on.
    """
    num_nodes = 0
    num_edges = 0
    for b in range(len(node_kind)):
        for n in range(node_kind.shape[1]):
            num_nodes += node_kind[b, n] > 0
        for e in range(edge_links.shape[1]):
            num_edges += edge_kind[b, e] > 0
    node_graph = np.empty(num_nodes, np.int64)
    node_index = np.empty(num_nodes, np.int64)
    packed_node_kind = np.empty(num_nodes, np.int64)
    senders = np.empty(2 * num_edges, np.int64)
    receivers = np.empty(2 * num_edges, np.int64)
    packed_edge_kind = np.empty(2 * num_edges, np.int64)
    m = 0
    z = 0
    for b in range(len(node_kind)):
        first = m
        for n in range(node_kind.shape[1]):
            if node_kind[b, n] > 0:
                node_graph[m] = b
                node_index[m] = n
                packed_node_kind[m] = node_kind[b, n] - 1
                m += 1
        for e in range(edge_links.shape[1]):
            if edge_kind[b, e] > 0:
                parent = first + edge_links[b, e, 0]
                child = first + edge_links[b, e, 1]
                kind = edge_kind[b, e] - 1
                senders[z] = parent
                receivers[z] = child
                packed_edge_kind[z] = kind
                senders[z + 1] = child
                receivers[z + 1] = parent
                packed_edge_kind[z + 1] = kind + num_edge_kinds
                z += 2
    return node_graph, node_index, packed_node_kind, senders, receivers, packed_edge_kind
