"""The three steps of message passing that are no matrix products: composed of PyTorch's operations, and compiled for the CPU with
their gradients. Composed, they take most of an update's time there.
"""

from typing import Any

import numpy as np
import torch
from numba import njit
from torch import Tensor
from torch.nn.functional import leaky_relu

SLOPE = 0.01
"""Of LeakyReLU below 0."""


@njit(cache=True)
def _maximum(sent, from_edge, sender, receiver, kind, most, winner):  # type: ignore[no-untyped-def]
    most[:] = -np.inf
    winner[:] = -1
    for z in range(len(sender)):
        source, edge = sent[sender[z]], from_edge[kind[z]]
        best, who = most[receiver[z]], winner[receiver[z]]
        for h in range(sent.shape[1]):
            value = source[h] + edge[h]
            message = value if value > 0 else value * SLOPE
            better = message > best[h]
            best[h] = message if better else best[h]
            who[h] = z if better else who[h]
    for m in range(len(most)):
        if winner[m, 0] < 0:
            most[m] = 0


@njit(cache=True)
def _maximum_gradient(gradient, most, winner, sender, kind, to_sent, to_edge):  # type: ignore[no-untyped-def]
    for m in range(len(most)):
        for h in range(most.shape[1]):
            z = winner[m, h]
            if z >= 0:
                d = gradient[m, h] if most[m, h] > 0 else gradient[m, h] * SLOPE
                to_sent[sender[z], h] += d
                to_edge[kind[z], h] += d


class _MessageMaximum(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, sent: Tensor, from_edge: Tensor, sender: Tensor, receiver: Tensor, kind: Tensor) -> Tensor:
        most, winner = torch.empty_like(sent), torch.empty(sent.shape, dtype=torch.int32)
        edges = (sender.numpy(), receiver.numpy(), kind.numpy())
        _maximum(sent.detach().numpy(), from_edge.detach().numpy(), *edges, most.numpy(), winner.numpy())
        ctx.save_for_backward(most, winner, sender, kind, from_edge)
        return most

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        most, winner, sender, kind, from_edge = ctx.saved_tensors
        to_sent, to_edge = torch.zeros_like(most), torch.zeros_like(from_edge)
        arrays = (gradient.contiguous(), most, winner, sender, kind, to_sent, to_edge)
        _maximum_gradient(*(array.numpy() for array in arrays))
        return to_sent, to_edge, None, None, None


def message_maximum(sent: Tensor, from_edge: Tensor, sender: Tensor, receiver: Tensor, kind: Tensor) -> Tensor:
    """The maximum of the messages LeakyReLU(sent[sender] + from_edge[kind]) to each node, 0 for a node that gets none.

    Args:
        sent: (M, H).
        from_edge: (kinds of edges, H).
        sender, receiver, kind: (Z,).

    Returns:
        (M, H). Of equal messages on the CPU the first gets the gradient.
    """
    if sent.device.type == "cpu":
        most: Tensor = _MessageMaximum.apply(sent, from_edge, sender, receiver, kind)  # type: ignore[no-untyped-call]
        return most
    return composed_maximum(sent, from_edge, sender, receiver, kind)


def composed_maximum(sent: Tensor, from_edge: Tensor, sender: Tensor, receiver: Tensor, kind: Tensor) -> Tensor:
    """See `message_maximum`; equal messages share the gradient."""
    message = leaky_relu(sent[sender] + from_edge[kind], SLOPE)
    return torch.zeros_like(sent).scatter_reduce(0, receiver[:, None].expand_as(message), message, "amax", include_self=False)


@njit(cache=True)
def _updated(update, of_graph, graph, node, out):  # type: ignore[no-untyped-def]
    for m in range(len(node)):
        a, b, c, d = update[m], of_graph[graph[m]], node[m], out[m]
        for h in range(node.shape[1]):
            value = a[h] + b[h]
            a[h] = value
            d[h] = (value if value > 0 else value * SLOPE) + c[h]


@njit(cache=True)
def _updated_gradient(gradient, update, graph, to_update, to_graph):  # type: ignore[no-untyped-def]
    for m in range(len(update)):
        a, b, c, d = gradient[m], update[m], to_update[m], to_graph[graph[m]]
        for h in range(update.shape[1]):
            value = a[h] if b[h] > 0 else a[h] * SLOPE
            c[h] = value
            d[h] += value


class _Updated(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, update: Tensor, of_graph: Tensor, graph: Tensor, node: Tensor) -> Tensor:
        before, out = update.detach().clone(), torch.empty_like(node)
        _updated(*(array.detach().numpy() for array in (before, of_graph, graph, node, out)))
        ctx.save_for_backward(before, graph, of_graph)
        return out

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        before, graph, of_graph = ctx.saved_tensors
        gradient = gradient.contiguous()
        to_update, to_graph = torch.empty_like(before), torch.zeros_like(of_graph)
        _updated_gradient(*(array.numpy() for array in (gradient, before, graph, to_update, to_graph)))
        return to_update, to_graph, None, gradient


def updated(update: Tensor, of_graph: Tensor, graph: Tensor, node: Tensor) -> Tensor:
    """LeakyReLU(update + of_graph[graph]) + node.

    Args:
        update, node: (M, H).
        of_graph: (B, H).
        graph: (M,).
    """
    if node.device.type == "cpu":
        out: Tensor = _Updated.apply(update, of_graph, graph, node)  # type: ignore[no-untyped-call]
        return out
    return composed_update(update, of_graph, graph, node)


def composed_update(update: Tensor, of_graph: Tensor, graph: Tensor, node: Tensor) -> Tensor:
    """See `updated`."""
    return leaky_relu(update + of_graph[graph], SLOPE) + node


@njit(cache=True)
def _pooled(node, logit, graph, pooled, weight):  # type: ignore[no-untyped-def]
    count = len(pooled)
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


@njit(cache=True)
def _pooled_gradient(gradient, node, graph, pooled, weight, to_node, to_logit):  # type: ignore[no-untyped-def]
    for m in range(len(node)):
        a, b, c, d = gradient[graph[m]], node[m], pooled[graph[m]], to_node[m]
        w = weight[m]
        slope = w * 0
        for h in range(node.shape[1]):
            d[h] = w * a[h]
            slope += a[h] * (b[h] - c[h])
        to_logit[m] = w * slope


class _Pooled(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, node: Tensor, logit: Tensor, graph: Tensor, graphs: int) -> Tensor:
        pooled, weight = node.new_zeros(graphs, node.shape[1]), torch.empty_like(logit)
        _pooled(*(array.detach().numpy() for array in (node, logit, graph, pooled, weight)))
        ctx.save_for_backward(node, graph, pooled, weight)
        return pooled

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        node, graph, pooled, weight = ctx.saved_tensors
        to_node, to_logit = torch.empty_like(node), torch.empty_like(weight)
        arrays = (gradient.contiguous(), node, graph, pooled, weight, to_node, to_logit)
        _pooled_gradient(*(array.detach().numpy() for array in arrays))
        return to_node, to_logit, None, None


def attention_pooled(node: Tensor, logit: Tensor, graph: Tensor, graphs: int) -> Tensor:
    """(B, H): the mean of each graph's nodes, weighted by the softmax of their logits.

    Args:
        node: (M, H).
        logit: (M,).
        graph: (M,).
        graphs: B.
    """
    if node.device.type == "cpu":
        pooled: Tensor = _Pooled.apply(node, logit, graph, graphs)  # type: ignore[no-untyped-call]
        return pooled
    return composed_pool(node, logit, graph, graphs)


def composed_pool(node: Tensor, logit: Tensor, graph: Tensor, graphs: int) -> Tensor:
    """See `attention_pooled`."""
    most = logit.new_full((graphs,), -torch.inf).scatter_reduce(0, graph, logit.detach(), "amax")
    weight = (logit - most[graph]).exp()[:, None]
    both = torch.cat([weight * node, weight], dim=1)
    summed = both.new_zeros(graphs, both.shape[1]).index_add(0, graph, both)
    return summed[:, :-1] / summed[:, -1:]


@njit(cache=True)
def pack(node_kind, edge, edge_kind, edge_kinds):  # type: ignore[no-untyped-def]
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
    graph, number, kind = np.empty(nodes, np.int64), np.empty(nodes, np.int64), np.empty(nodes, np.int64)
    sender, receiver, both = np.empty(2 * edges, np.int64), np.empty(2 * edges, np.int64), np.empty(2 * edges, np.int64)
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
                sender[z + 1], receiver[z + 1], both[z + 1] = child, parent, edge_kind[b, e] - 1 + edge_kinds
                z += 2
    return graph, number, kind, sender, receiver, both
