"""Geometry of convex pieces: how deep two objects penetrate, which touch, which rest on one; and of motions."""

from collections.abc import Sequence
from itertools import combinations

import networkx as nx
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

from drake_clutter.catalog import ObjectClass
from drake_clutter.scenes.scene import Pose, SceneObject

MAX_PENETRATION = 0.001
"""m; a scene whose objects penetrate deeper is refused. Settled objects rest within about 0.01 mm of each other."""

_PARALLEL = 1e-9


class _Polytope:
    """Corners (V, 3), face normals (F, 3) and edge directions (E, 3) of a convex piece; directions without repeats."""

    def __init__(self, corners: NDArray[np.float64]) -> None:
        hull = ConvexHull(corners)
        self.corners = corners[hull.vertices]
        self.normals = _distinct_directions(hull.equations[:, :3])
        # An edge of the hull joins two triangles of different planes; the others only cut a face.
        edges = []
        for triangle, neighbours in enumerate(hull.neighbors):
            for opposite, neighbour in enumerate(neighbours):
                bends = (
                    np.abs(hull.equations[triangle, :3] - hull.equations[neighbour, :3]).max()
                    > 1e-6
                )
                if neighbour > triangle and bends:
                    start, end = np.delete(hull.simplices[triangle], opposite)
                    edges.append(corners[end] - corners[start])
        self.edges = _distinct_directions(np.asarray(edges))


def _distinct_directions(vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    unit = vectors / np.linalg.norm(vectors, axis=1, keepdims=True)
    first = np.argmax(np.abs(unit) > 1e-6, axis=1)
    unit = unit * np.sign(unit[np.arange(len(unit)), first])[:, None]
    _, index = np.unique(np.round(unit, 6), axis=0, return_index=True)
    return np.asarray(unit[np.sort(index)])


_polytopes: dict[ObjectClass, tuple[_Polytope, ...]] = {}


def _pieces(object_class: ObjectClass) -> tuple[_Polytope, ...]:
    if object_class not in _polytopes:
        _polytopes[object_class] = tuple(_Polytope(piece) for piece in object_class.convex_pieces)
    return _polytopes[object_class]


def _piece_penetration(
    a: _Polytope, b: _Polytope, first: SceneObject, second: SceneObject
) -> float:
    """Separating-axis test: the least overlap over all face normals and pairs of edges; negative is a gap."""
    R_a, R_b = first.X_TO.rotation, second.X_TO.rotation
    edges_a, edges_b = a.edges @ R_a.T, b.edges @ R_b.T
    crosses = np.cross(edges_a[:, None], edges_b[None]).reshape(-1, 3)
    lengths = np.linalg.norm(crosses, axis=1)
    crosses = crosses[lengths > _PARALLEL] / lengths[lengths > _PARALLEL, None]
    axes = np.vstack([a.normals @ R_a.T, b.normals @ R_b.T, crosses])
    spread_a, spread_b = first.X_TO.apply(a.corners) @ axes.T, second.X_TO.apply(b.corners) @ axes.T
    overlap = np.minimum(spread_a.max(0) - spread_b.min(0), spread_b.max(0) - spread_a.min(0))
    return float(overlap.min())


def penetration_depth(first: SceneObject, second: SceneObject) -> float:
    """How deep two objects penetrate, m: the least translation that parts them; negative or zero when they do not.

    A cylinder is judged as the 32-sided prism inscribed in it, so the depth of a curved contact reads up to 0.5 % of the
    radius too small.
    """
    lower_a, upper_a = first.bounds_T
    lower_b, upper_b = second.bounds_T
    gap = float(np.maximum(lower_a - upper_b, lower_b - upper_a).max())
    if gap >= 0:
        return -gap
    return max(
        _piece_penetration(a, b, first, second)
        for a in _pieces(first.object_class)
        for b in _pieces(second.object_class)
    )


def max_penetration(objects: Sequence[SceneObject]) -> tuple[float, str, str]:
    """The deepest penetration of any two objects, m, and their names; (-inf, "", "") for fewer than two objects."""
    deepest = (-np.inf, "", "")
    for first, second in combinations(objects, 2):
        deepest = max(
            deepest,
            (penetration_depth(first, second), first.name, second.name),
            key=lambda item: item[0],
        )
    return deepest


def group_touching_objects(
    objects: Sequence[SceneObject], margin: float
) -> list[list[SceneObject]]:
    """The objects in groups that cannot touch each other: their axis-aligned boxes are more than `margin` (m) apart."""
    adjacency = nx.Graph()
    adjacency.add_nodes_from(range(len(objects)))
    for i, j in combinations(range(len(objects)), 2):
        (lower_a, upper_a), (lower_b, upper_b) = objects[i].bounds_T, objects[j].bounds_T
        if np.maximum(lower_a - upper_b, lower_b - upper_a).max() <= margin:
            adjacency.add_edge(i, j)
    return [[objects[i] for i in sorted(group)] for group in nx.connected_components(adjacency)]


def transport_pose(X_TA: Pose, X_TA_new: Pose, X_TO: Pose) -> Pose:
    """Where an object O is after a motion that took a frame A, fixed to it, from one pose to another."""
    R = X_TA_new.rotation @ X_TA.rotation.T
    return Pose.from_rotation(R @ X_TO.rotation, X_TA_new.p + R @ (np.asarray(X_TO.p) - X_TA.p))


def objects_resting_on(
    picked: SceneObject, objects: Sequence[SceneObject], margin: float = 0.004
) -> tuple[str, ...]:
    """The names of the objects that stand or lean on the picked one: they touch it and reach over it."""
    names = []
    for other in objects:
        if other is picked:
            continue
        (lower, upper), (other_lower, other_upper) = picked.bounds_T, other.bounds_T
        overlap = np.minimum(upper, other_upper)[:2] - np.maximum(lower, other_lower)[:2]
        if overlap.min() > margin and abs(other_lower[2] - upper[2]) < margin:
            names.append(other.name)
    return tuple(names)
