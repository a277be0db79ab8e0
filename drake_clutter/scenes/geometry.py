"""Penetration and contact of convex objects, and rigid motions."""

from collections.abc import Sequence
from itertools import combinations

import networkx as nx
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

from drake_clutter.catalog import ObjectClass
from drake_clutter.scenes.scene import Pose, SceneObject

MAX_PENETRATION = 0.001
"""Deepest penetration of two objects in a valid scene file [m].

Settled objects overlap by about 0.01 mm.
"""

_MIN_CROSS_LENGTH = 1e-9
"""Shortest cross product of two unit vectors along edges that is a separating axis."""
_ARC_TOLERANCE = 1e-6
"""Tolerance of the test whether a direction is on an edge's arc of normals."""
_MAX_EDGE_PAIRS = 1_000_000
"""Number of pairs of edges that are tested at once, which bounds the memory."""


class _Polytope:
    """A convex piece, reduced to what the separating-axis test needs.

    Attributes:
        corners: Corners [m]. Shape (V, 3).
        normals: Directions of the face normals, without repeats. Shape (F, 3).
        edges: Directions of the edges. Shape (E, 3).
        arc_centers: Unit vectors halfway between the normals of the two faces at each edge. Shape
            (E, 3).
        arc_cosines: Cosine of the angle between them and these normals. Shape (E,).
    """

    def __init__(self, corners: NDArray[np.float64]) -> None:
        hull = ConvexHull(corners)
        self.corners = corners[hull.vertices]
        self.normals = _distinct_directions(hull.equations[:, :3])
        # An edge joins two triangles of different planes; the other edges only divide a face.
        triangle = np.repeat(np.arange(len(hull.simplices)), 3)
        neighbor = hull.neighbors.reshape(-1)
        normals = hull.equations[:, :3]
        is_edge = (neighbor > triangle) & (
            np.abs(normals[triangle] - normals[neighbor]).max(axis=1) > 1e-6
        )
        # The neighbor k of a triangle is opposite to its corner k.
        ends = hull.simplices[:, [[1, 2], [0, 2], [0, 1]]].reshape(-1, 2)[is_edge]
        self.edges = _unit(corners[ends[:, 1]] - corners[ends[:, 0]])
        self.arc_centers = _unit(normals[triangle[is_edge]] + normals[neighbor[is_edge]])
        self.arc_cosines = (self.arc_centers * normals[triangle[is_edge]]).sum(axis=1)


def _unit(vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return unit vectors along vectors (N, 3)."""
    return np.asarray(vectors / np.linalg.norm(vectors, axis=1, keepdims=True))


def _distinct_directions(vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return unit vectors along directions (N, 3), without repeated or opposite ones."""
    unit = _unit(vectors)
    first = np.argmax(np.abs(unit) > 1e-6, axis=1)
    unit = unit * np.sign(unit[np.arange(len(unit)), first])[:, None]
    _, index = np.unique(np.round(unit, 6), axis=0, return_index=True)
    return np.asarray(unit[np.sort(index)])


def _edge_axes(
    a: _Polytope, b: _Polytope, R_a: NDArray[np.float64], R_b: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the cross products of edges that are normals of faces of the Minkowski difference.

    Two edges of polytopes A and B form a face of A - B if the arcs of outward normals of A's edge
    and of inward normals of B's edge cross (Gregorius 2013, "The separating axis test between
    convex polyhedra").

    Args:
        a: The polytope A.
        b: The polytope B.
        R_a: Rotation of A. Shape (3, 3).
        R_b: Rotation of B. Shape (3, 3).

    Returns:
        Unit vectors. Shape (n, 3).
    """
    edges_a = a.edges @ R_a.T
    edges_b = b.edges @ R_b.T
    across_a = np.cross(a.arc_centers @ R_a.T, edges_a)
    across_b = np.cross(edges_b, b.arc_centers @ R_b.T)
    group = max(1, _MAX_EDGE_PAIRS // len(edges_b))
    axes = []
    for start in range(0, len(edges_a), group):
        part = slice(start, start + group)
        # The cross product of the edges times the centers of the arcs.
        along_a = across_a[part] @ edges_b.T
        along_b = edges_a[part] @ across_b.T
        length = np.sqrt(np.maximum(1 - (edges_a[part] @ edges_b.T) ** 2, 0))
        crossing = (
            (along_a * along_b <= 0)
            & (np.abs(along_a) >= (a.arc_cosines[part, None] - _ARC_TOLERANCE) * length)
            & (np.abs(along_b) >= (b.arc_cosines - _ARC_TOLERANCE) * length)
        )
        i, j = np.nonzero(crossing)
        axes.append(np.cross(edges_a[part][i], edges_b[j]))
    crosses = np.vstack(axes)
    lengths = np.linalg.norm(crosses, axis=1)
    return np.asarray(
        crosses[lengths > _MIN_CROSS_LENGTH] / lengths[lengths > _MIN_CROSS_LENGTH, None]
    )


_polytopes: dict[ObjectClass, tuple[_Polytope, ...]] = {}


def _pieces(object_class: ObjectClass) -> tuple[_Polytope, ...]:
    """Return the polytopes of a class's convex pieces, which are cached."""
    if object_class not in _polytopes:
        _polytopes[object_class] = tuple(_Polytope(piece) for piece in object_class.convex_pieces)
    return _polytopes[object_class]


def _piece_penetration(
    a: _Polytope, b: _Polytope, first: SceneObject, second: SceneObject
) -> float:
    """Return the penetration depth of two pieces by the separating-axis test [m].

    It is the smallest overlap along the normals of the faces of the Minkowski difference; a
    negative value is a gap.
    """
    R_a = first.X_TO.rotation
    R_b = second.X_TO.rotation
    axes = np.vstack([a.normals @ R_a.T, b.normals @ R_b.T, _edge_axes(a, b, R_a, R_b)])
    extent_a = first.X_TO.apply(a.corners) @ axes.T
    extent_b = second.X_TO.apply(b.corners) @ axes.T
    overlap = np.minimum(extent_a.max(0) - extent_b.min(0), extent_b.max(0) - extent_a.min(0))
    return float(overlap.min())


def _piece_gaps(first: SceneObject, second: SceneObject) -> NDArray[np.float64]:
    """Return the gaps between the bounding boxes of the pieces of two objects [m].

    A negative gap is an overlap. Shape (pieces of the first, pieces of the second).
    """
    bounds = []
    for o in (first, second):
        corners = [o.X_TO.apply(piece.corners) for piece in _pieces(o.object_class)]
        bounds.append(
            (np.array([c.min(0) for c in corners]), np.array([c.max(0) for c in corners]))
        )
    (lower_a, upper_a), (lower_b, upper_b) = bounds
    return np.asarray(
        np.maximum(lower_a[:, None] - upper_b, lower_b - upper_a[:, None]).max(axis=2)
    )


def penetration_depth(first: SceneObject, second: SceneObject) -> float:
    """Return the smallest translation that separates two objects [m].

    It is zero or negative for objects that do not penetrate each other. A cylinder is represented
    by an inscribed prism of 32 sides, so the depth of a curved contact is too small by up to 0.5 %
    of the radius. Of objects of several convex pieces, it is the largest depth of two pieces.
    """
    lower_a, upper_a = first.bounds_T
    lower_b, upper_b = second.bounds_T
    gap = float(np.maximum(lower_a - upper_b, lower_b - upper_a).max())
    if gap >= 0:
        return -gap
    gaps = _piece_gaps(first, second)
    if gaps.min() >= 0:
        return -float(gaps.min())
    pieces_a = _pieces(first.object_class)
    pieces_b = _pieces(second.object_class)
    return max(
        _piece_penetration(pieces_a[i], pieces_b[j], first, second)
        for i, j in np.argwhere(gaps < 0)
    )


def max_penetration(objects: Sequence[SceneObject]) -> tuple[float, str, str]:
    """Return the deepest penetration of any two objects [m], and their names.

    For fewer than two objects it is (-inf, "", "").
    """
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
    """Return the objects in groups that cannot touch each other.

    Args:
        objects: Objects of a scene.
        margin: Objects whose axis-aligned boxes are at most this far apart share a group [m].
    """
    adjacency = nx.Graph()
    adjacency.add_nodes_from(range(len(objects)))
    for i, j in combinations(range(len(objects)), 2):
        (lower_a, upper_a), (lower_b, upper_b) = objects[i].bounds_T, objects[j].bounds_T
        if np.maximum(lower_a - upper_b, lower_b - upper_a).max() <= margin:
            adjacency.add_edge(i, j)
    return [[objects[i] for i in sorted(group)] for group in nx.connected_components(adjacency)]


def pairs_within(
    first: Sequence[SceneObject], second: Sequence[SceneObject], distance: float
) -> list[tuple[SceneObject, SceneObject]]:
    """Return the pairs of two sets of objects that are at most a distance apart [m].

    Distances are those of `penetration_depth`.
    """
    if not first or not second:
        return []
    (lower_a, upper_a), (lower_b, upper_b) = (
        np.array([o.bounds_T for o in objects]).swapaxes(0, 1) for objects in (first, second)
    )
    gaps = np.maximum(lower_a[:, None] - upper_b, lower_b - upper_a[:, None]).max(axis=2)
    near = [(first[i], second[j]) for i, j in np.argwhere(gaps <= distance).tolist()]
    return [(a, b) for a, b in near if penetration_depth(a, b) >= -distance]


def find_piles(objects: Sequence[SceneObject], margin: float) -> list[list[SceneObject]]:
    """Return the objects in piles that do not touch each other.

    Piles are smaller than the groups of `group_touching_objects` and take longer to find.

    Args:
        objects: Objects of a scene.
        margin: Objects that are at most this far apart share a pile [m].
    """
    piles = nx.Graph()
    piles.add_nodes_from(range(len(objects)))
    for k, o in enumerate(objects):
        near = {other.name for _, other in pairs_within([o], objects[:k], margin)}
        piles.add_edges_from((k, i) for i in range(k) if objects[i].name in near)
    return [[objects[i] for i in sorted(pile)] for pile in nx.connected_components(piles)]


def transport_pose(X_TA: Pose, X_TA_new: Pose, X_TO: Pose) -> Pose:
    """Return the pose of an object O that moves rigidly with a frame A.

    Args:
        X_TA: Pose of A before the motion.
        X_TA_new: Pose of A after the motion.
        X_TO: Pose of the object before the motion.
    """
    R = X_TA_new.rotation @ X_TA.rotation.T
    return Pose.from_rotation(R @ X_TO.rotation, X_TA_new.p + R @ (np.asarray(X_TO.p) - X_TA.p))


def objects_resting_on(
    carrier: SceneObject, objects: Sequence[SceneObject], margin: float = 0.004
) -> tuple[str, ...]:
    """Return the names of the objects that stand or lean on an object.

    The bottom of their bounding boxes is at the top of the object's, and the boxes overlap seen
    from above. What begins above the bottom of an object that is not convex, such as a bowl, and
    touches it rests on it, too.

    Args:
        carrier: The object that may carry others.
        objects: Objects of the scene.
        margin: Largest difference of the heights, and smallest overlap that counts [m].
    """
    names = []
    for other in objects:
        if other is carrier:
            continue
        (lower, upper), (other_lower, other_upper) = carrier.bounds_T, other.bounds_T
        overlap = np.minimum(upper, other_upper)[:2] - np.maximum(lower, other_lower)[:2]
        is_on_top = abs(other_lower[2] - upper[2]) < margin
        if not is_on_top and len(carrier.object_class.convex_pieces) > 1:
            is_within = lower[2] + margin < other_lower[2] < upper[2]
            is_on_top = is_within and penetration_depth(carrier, other) > -margin
        if overlap.min() > margin and is_on_top:
            names.append(other.name)
    return tuple(names)
