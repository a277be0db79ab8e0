"""Graph observation of an exploration policy: objects with pose and class, and their relations.

The same arrays represent the privileged graph of all objects and the graph of K_t, the objects that
have been in view; only the given objects differ. All features follow from the objects' poses and
classes and from the latest observation.
"""

from collections.abc import Collection, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drake_clutter.scenes.interfaces import Move, Observation
from drake_clutter.scenes.scene import TRAY, SceneObject
from drake_clutter.tasks.environment_interface import index_type
from drake_clutter.tasks.search_target import SearchTarget

ExplorationObservation = dict[str, NDArray[Any]]
"""Arrays of `build_exploration_graph` by name."""

NODE_FEATURES = (
    *("x", "y", "z"),
    *("qw", "qx", "qy", "qz"),
    *("extent_x", "extent_y", "extent_z"),
    *("in_view", "visible_fraction", "is_covered", "support_gap", "pick_count"),
)
"""Features of a node.

- `x`, `y`, `z`: Position of the object, in units of `_LENGTH_SCALE`.
- `qw`, `qx`, `qy`, `qz`: Quaternion of the object.
- `extent_x`, `extent_y`, `extent_z`: Extents of its axis-aligned bounding box, in units of
  `_LENGTH_SCALE`.
- `in_view`: Whether the object is in view.
- `visible_fraction`: Visible fraction of the bounding box, seen from above.
- `is_covered`: Whether another object of the graph is above it.
- `support_gap`: Gap to the next lower object of the graph or the tray, in units of `_LENGTH_SCALE`.
  A positive gap shows that an unknown object supports it.
- `pick_count`: Number of times the object was picked, in units of `_PICK_COUNT_SCALE`.
"""
EDGE_KINDS = (
    "supports",
    "is_below",
    "is_beside",
    "is_apart_from",
    "tray_supports",
    "tray_is_below",
)
"""Kinds of the edge from the lower to the upper one of two objects, or from the tray to an object.

The upper object rests on the lower one, is above it without contact, is beside it, or is farther
away; an object rests on the tray, or is above it without contact.
"""
GLOBAL_FEATURES = ("num_moves",)
"""Features of the graph: the number of moves so far, in units of `_NUM_MOVES_SCALE`."""

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
"""Upper bound of the absolute values of all features."""
_LENGTH_SCALE = 0.35
"""Length that is represented by 1 [m]: half the side of the default tray."""
_PICK_COUNT_SCALE = 3.0
"""Number of picks that is represented by 1."""
_NUM_MOVES_SCALE = 20.0
"""Number of moves that is represented by 1: the maximum of an episode in training."""
_MIN_OVERLAP = 0.003
"""Smallest overlap, seen from above, of an object that is above another one [m]."""
_HEIGHT_TOLERANCE = 0.006
"""Largest difference of heights that are considered equal [m]."""
_MAX_BESIDE_GAP = 0.03
"""Largest gap between objects that are beside each other [m]."""
_ANGLES = np.radians(np.arange(0, 180, 30))
_DIRECTIONS = np.column_stack([np.cos(_ANGLES), np.sin(_ANGLES)])
"""Horizontal directions along which outlines are compared. Shape (6, 2).

They contain the normals of the sides of boxes in the orientations that the grammar generates.
"""


def _horizontal_overlaps(objects: Sequence[SceneObject]) -> NDArray[np.float64]:
    """Return by how much the objects' outlines overlap pairwise, seen from above [m].

    Negative values are gaps. Outlines are compared along `_DIRECTIONS`.

    Args:
        objects: n objects.

    Returns:
        Overlaps. Shape (n, n).
    """
    intervals = []
    for o in objects:
        projections = o.corners_T[:, :2] @ _DIRECTIONS.T
        intervals.append([projections.min(axis=0), projections.max(axis=0)])
    lower = np.array(intervals)[:, 0]
    upper = np.array(intervals)[:, 1]
    overlap = np.minimum(upper[:, None], upper[None]) - np.maximum(lower[:, None], lower[None])
    return np.asarray(overlap.min(axis=2))


def build_exploration_graph(
    objects: Sequence[SceneObject],
    observation: Observation,
    history: Sequence[Move],
    node_kind_ids: Mapping[str, int],
    invalid_moves: Collection[Move] = (),
    max_nodes: int = 0,
    target: SearchTarget | None = None,
) -> ExplorationObservation:
    """Return the graph of some objects as arrays; node 0 is the tray, node k the k-th object.

    Args:
        objects: n objects, among them all objects in view.
        observation: Latest observation.
        history: Moves of the episode so far.
        node_kind_ids: Numbers of the kinds of nodes, the tray and the classes, from 1 on.
        invalid_moves: Moves that are masked.
        max_nodes: Number N of nodes of the arrays; 0 for n + 1.
        target: What the episode looks for; None for all objects.

    Returns:
        node_kind: Numbers of the kinds of the nodes; 0 is padding. Shape (N,).
        node_features: See `NODE_FEATURES`. Shape (N, number of features).
        edge_links: Lower and upper node of each edge. Shape (N (N - 1) / 2, 2).
        edge_kind: Position in `EDGE_KINDS` from 1 on; 0 is padding. Shape (N (N - 1) / 2,).
        global_features: See `GLOBAL_FEATURES`. Shape (1,).
        action_mask: Whether the row's node may be placed on the column's node: both are in view, or
            the latter is the tray, and the move is not invalid. Shape (N, N).
        target_kind: With a target, the number of its class. Shape (1,).
        is_target: With a target, whether the node is one of its objects. Shape (N,).
    """
    count = len(objects)
    num_nodes = max_nodes or count + 1
    num_edges = num_nodes * (num_nodes - 1) // 2
    node_kind = np.zeros(num_nodes, index_type(len(node_kind_ids)))
    node_features = np.zeros((num_nodes, len(NODE_FEATURES)), np.float32)
    edge_links = np.zeros((num_edges, 2), np.int16)
    edge_kind = np.zeros(num_edges, np.int8)
    action_mask = np.zeros((num_nodes, num_nodes), np.int8)
    node_kind[0] = node_kind_ids[TRAY]
    if count:
        bounds = np.array([o.bounds_T for o in objects])
        bottom = bounds[:, 0, 2]
        top = bounds[:, 1, 2]
        overlap = _horizontal_overlaps(objects)
        is_above = (overlap > _MIN_OVERLAP) & (bottom[None] > top[:, None] - _HEIGHT_TOLERANCE)
        np.fill_diagonal(is_above, False)  # is_above[lower, upper]
        node_kind[1 : count + 1] = [node_kind_ids[o.object_class.name] for o in objects]
        node_features[1 : count + 1] = _object_features(
            objects, observation, history, bounds, is_above
        )
        # Edges lead from the lower to the upper object; objects of equal height are ordered by
        # position, so that the graph does not depend on the order of the objects.
        order = np.lexsort((bounds[:, 0, 1], bounds[:, 0, 0], bottom))
        first, second = np.triu_indices(count, 1)
        lower = order[first]
        upper = order[second]
        upper_is_above = is_above[lower, upper]
        gap = -overlap[lower, upper]
        is_supported = upper_is_above & (np.abs(bottom[upper] - top[lower]) < _HEIGHT_TOLERANCE)
        pairs = len(first)
        edge_links[:pairs, 0] = lower + 1
        edge_links[:pairs, 1] = upper + 1
        edge_kind[:pairs] = np.where(
            is_supported, 1, np.where(upper_is_above, 2, np.where(gap < _MAX_BESIDE_GAP, 3, 4))
        )
        edge_links[pairs : pairs + count, 1] = np.arange(1, count + 1)
        edge_kind[pairs : pairs + count] = np.where(bottom < _HEIGHT_TOLERANCE, 5, 6)
        in_view = np.flatnonzero(node_features[:, NODE_FEATURES.index("in_view")])
        action_mask[in_view[:, None], in_view] = 1
        action_mask[in_view, 0] = 1
        np.fill_diagonal(action_mask, 0)
        node = {TRAY: 0} | {o.name: k for k, o in enumerate(objects, start=1)}
        for move in invalid_moves:
            action_mask[node[move.pick], node[move.place]] = 0
    num_moves = min(FEATURE_BOUND, len(history) / _NUM_MOVES_SCALE)
    graph = {
        "node_kind": node_kind,
        "node_features": node_features,
        "edge_links": edge_links,
        "edge_kind": edge_kind,
        "global_features": np.array([num_moves], np.float32),
        "action_mask": action_mask,
    }
    if target is not None:
        is_target = np.zeros(num_nodes, np.int8)
        is_target[1 : count + 1] = [o.name in target.names for o in objects]
        kind = node_kind_ids[target.object_class.name]
        graph |= {"target_kind": np.array([kind], node_kind.dtype), "is_target": is_target}
    return graph


def _object_features(
    objects: Sequence[SceneObject],
    observation: Observation,
    history: Sequence[Move],
    bounds: NDArray[np.float64],
    is_above: NDArray[np.bool_],
) -> NDArray[np.float32]:
    """Return the `NODE_FEATURES` of n objects. Shape (n, number of features).

    Args:
        objects: The objects.
        observation: Latest observation.
        history: Moves of the episode so far.
        bounds: Corners of the objects' bounding boxes [m]. Shape (n, 2, 3).
        is_above: Whether the column's object is above the row's. Shape (n, n).
    """
    detections = {detection.name: detection for detection in observation.detections}
    bottom = bounds[:, 0, 2]
    top = bounds[:, 1, 2]
    floor = np.where(is_above, top[:, None], 0.0).max(axis=0)
    top_centers = np.column_stack([bounds[:, :, :2].mean(axis=1), top])
    camera = observation.camera
    pixel_size = camera.depth(top_centers) / camera.focal_length
    features = np.zeros((len(objects), len(NODE_FEATURES)), np.float32)
    for k, o in enumerate(objects):
        extent = bounds[k, 1] - bounds[k, 0]
        detection = detections.get(o.name)
        visible_fraction = 0.0
        if detection is not None:
            visible_area = np.count_nonzero(detection.mask) * pixel_size[k] ** 2
            visible_fraction = min(1.0, visible_area / float(extent[0] * extent[1]))
        pick_count = sum(move.pick == o.name for move in history)
        # q and -q are the same rotation. The sign is that of the first component that is clearly
        # not zero, so that it does not depend on rounding.
        quaternion = o.X_TO.quaternion
        sign = 1 if next((q for q in quaternion if abs(q) > 0.01), 1) > 0 else -1
        features[k] = (
            *(o.X_TO.p / _LENGTH_SCALE),
            *(sign * q for q in quaternion),
            *(extent / _LENGTH_SCALE),
            detection is not None,
            visible_fraction,
            is_above[k].any(),
            max(0.0, bottom[k] - floor[k] - _HEIGHT_TOLERANCE) / _LENGTH_SCALE,
            min(FEATURE_BOUND, pick_count / _PICK_COUNT_SCALE),
        )
    return features
