"""The graph that an explorer's network sees: objects with pose and class, and how they lie to each other.

The same arrays hold the privileged graph of all objects as they are, and the graph of K_t as it was seen: what differs is which
objects are given. Everything in it follows from their poses and classes, and from what is in view.
"""

from collections.abc import Collection, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drake_clutter.scenes.interfaces import Move, Observation
from drake_clutter.scenes.scene import TRAY, SceneObject

ExplorationObservation = dict[str, NDArray[Any]]

NODE_FEATURES = (
    *("x", "y", "z"),
    *("qw", "qx", "qy", "qz"),
    *("extent_x", "extent_y", "extent_z"),
    *("in_view", "visible_fraction", "is_covered", "support_gap", "pick_count"),
)
"""Of a node: position and extents of its axis-aligned box in `_LENGTH`; quaternion; whether it is in view; of its box seen from
above, the share that is seen; whether another object of the graph is above it; how far below it, in `_LENGTH`, the next object of
the graph or the tray is, so that something else must carry it; how often it was picked, in `_MANY_PICKS`."""
EDGE_KINDS = (
    "supports",
    "is_below",
    "is_beside",
    "is_apart_from",
    "tray_supports",
    "tray_is_below",
)
"""Of the edge from the lower to the upper of two objects, or from the tray to an object: the upper rests on the lower, is above
it without touching it, is beside it, or is further away."""
GLOBAL_FEATURES = ("num_moves",)
"""Of the graph, in `_MANY_MOVES`."""

RENAMED_ARRAYS: Mapping[str, str] = {
    "feature": "node_features",
    "edge": "edge_links",
    "glob": "global_features",
    "allowed": "action_mask",
}
"""Current name of an array of the observation by its name in version 0.1."""
RENAMED_FEATURES: Mapping[str, str] = {
    "seen_share": "visible_fraction",
    "covered": "is_covered",
    "unexplained_height": "support_gap",
    "times_picked": "pick_count",
    "carries": "supports",
    "tray_carries": "tray_supports",
}
"""Current name of a node feature or kind of edges by its name in version 0.1."""

FEATURE_BOUND = 10.0
"""That no number of the graph exceeds."""
_LENGTH, _MANY_PICKS, _MANY_MOVES = 0.35, 3.0, 20.0
_OVERLAP = 0.003
"""m, by which two outlines overlap at least, seen from above, for one object to be above the other."""
_TOUCHING = 0.006
"""m between two heights that count as the same."""
_BESIDE = 0.03
"""m between the outlines of objects that are beside each other."""
_ANGLE = np.radians(np.arange(0, 180, 30))
_DIRECTIONS = np.column_stack([np.cos(_ANGLE), np.sin(_ANGLE)])
"""(D, 2) in which outlines are compared; boxes as the grammar lays them have their sides across some of them."""


def _overlaps(objects: Sequence[SceneObject]) -> NDArray[np.float64]:
    """(n, n) m, by which two outlines overlap seen from above; negative: the gap between them."""
    along = np.array(
        [[(p := o.corners_T[:, :2] @ _DIRECTIONS.T).min(axis=0), p.max(axis=0)] for o in objects]
    )
    lower, upper = along[:, 0], along[:, 1]
    overlap = np.minimum(upper[:, None], upper[None]) - np.maximum(lower[:, None], lower[None])
    return np.asarray(overlap.min(axis=2))


def build_exploration_graph(
    objects: Sequence[SceneObject],
    observation: Observation,
    history: Sequence[Move],
    node_kind_ids: Mapping[str, int],
    invalid_moves: Collection[Move] = (),
    max_nodes: int = 0,
) -> ExplorationObservation:
    """The graph as arrays; node 0 is the tray, node k the k-th object.

    Args:
        objects: n of them.
        observation: what is in view; those in view must be among the objects.
        history: the episode's moves so far.
        node_kind_ids: of the kinds of nodes, from 1 on: the tray's and the classes', by name.
        invalid_moves: moves that may not be made.
        max_nodes: N, that there is room for; 0: as many as there are.

    Returns:
        node_kind (N,), 0 is padding; feature (N, `FEATURES`); edge (N (N - 1) / 2, 2) lower and upper; edge_kind, number in
        `EDGE_KINDS` from 1 on, 0 is padding; glob (`GLOBALS`,); allowed (N, N), which moves may be made: to pick a row's
        node and put it onto a column's. It follows from what is in view, and from what has failed.
    """
    count, room = len(objects), max_nodes or len(objects) + 1
    seen = {detection.name: detection for detection in observation.detections}
    kind, feature = np.zeros(room, np.int8), np.zeros((room, len(NODE_FEATURES)), np.float32)
    allowed = np.zeros((room, room), np.int8)
    kind[0] = node_kind_ids[TRAY]
    edge, edge_kind = (
        np.zeros((room * (room - 1) // 2, 2), np.int16),
        np.zeros(room * (room - 1) // 2, np.int8),
    )
    if count:
        bounds = np.array([o.bounds_T for o in objects])
        low, high = bounds[:, 0, 2], bounds[:, 1, 2]
        overlap = _overlaps(objects)
        above = (overlap > _OVERLAP) & (low[None] > high[:, None] - _TOUCHING)  # [lower, upper]
        np.fill_diagonal(above, False)
        floor = np.where(above, high[:, None], 0.0).max(axis=0)
        tops = np.column_stack([bounds[:, :, :2].mean(axis=1), high])
        pixel = observation.camera.depth(tops) / observation.camera.focal_length
        for k, o in enumerate(objects):
            extent = bounds[k, 1] - bounds[k, 0]
            detection = seen.get(o.name)
            share = 0.0
            if detection is not None:
                share = min(
                    1.0,
                    np.count_nonzero(detection.mask) * pixel[k] ** 2 / float(extent[0] * extent[1]),
                )
            picks = sum(move.pick == o.name for move in history)
            kind[k + 1] = node_kind_ids[o.object_class.name]
            # Of a rotation's two, always the same, also when a component that should be 0 is a little off.
            sign = 1 if next((q for q in o.X_TO.quaternion if abs(q) > 0.01), 1) > 0 else -1
            feature[k + 1] = (
                *(o.X_TO.p / _LENGTH),
                *(sign * q for q in o.X_TO.quaternion),
                *(extent / _LENGTH),
                detection is not None,
                share,
                above[k].any(),
                max(0.0, low[k] - floor[k] - _TOUCHING) / _LENGTH,
                min(FEATURE_BOUND, picks / _MANY_PICKS),
            )
        # From the lower to the upper; of equally low ones, in an order that does not depend on theirs.
        order = np.lexsort((bounds[:, 0, 1], bounds[:, 0, 0], low))
        a, b = np.triu_indices(count, 1)
        lower, upper = order[a], order[b]
        over, gap = above[lower, upper], -overlap[lower, upper]
        rests = over & (np.abs(low[upper] - high[lower]) < _TOUCHING)
        pairs = len(a)
        edge[:pairs, 0], edge[:pairs, 1] = lower + 1, upper + 1
        edge_kind[:pairs] = np.where(rests, 1, np.where(over, 2, np.where(gap < _BESIDE, 3, 4)))
        edge[pairs : pairs + count, 1] = np.arange(1, count + 1)
        edge_kind[pairs : pairs + count] = np.where(low < _TOUCHING, 5, 6)
        in_view = np.flatnonzero(feature[:, NODE_FEATURES.index("in_view")])
        allowed[in_view[:, None], in_view] = allowed[in_view, 0] = 1
        np.fill_diagonal(allowed, 0)
        node = {TRAY: 0} | {o.name: k for k, o in enumerate(objects, start=1)}
        for move in invalid_moves:
            allowed[node[move.pick], node[move.place]] = 0
    glob = np.array([min(FEATURE_BOUND, len(history) / _MANY_MOVES)], np.float32)
    return {
        "node_kind": kind,
        "node_features": feature,
        "edge_links": edge,
        "edge_kind": edge_kind,
        "global_features": glob,
        "action_mask": allowed,
    }
