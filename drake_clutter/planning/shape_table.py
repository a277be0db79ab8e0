"""Collision geometries of a scene as arrays for compiled distances.

Frames: T is the support, J is the frame of a joint with its own motion, z along the axis, S is the
frame of a shape.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydrake.geometry import (
    Box,
    Capsule,
    Convex,
    Cylinder,
    GeometryId,
    Mesh,
    SceneGraphInspector,
    Sphere,
)

from drake_clutter.planning.convex_distance import CoreKind, lowest_points, path_distances
from drake_clutter.robots.serial_chain import SerialChain

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]


@dataclass(frozen=True)
class _Core:
    """Convex core with a radius around it, see `convex_distance`."""

    kind: CoreKind
    size: tuple[float, float, float] = (0.0, 0.0, 0.0)
    radius: float = 0.0
    vertices: Floats | None = None


def _core_of(inspector: SceneGraphInspector, geometry: GeometryId) -> _Core:
    shape = inspector.GetShape(geometry)
    if isinstance(shape, Box):
        x, y, z = shape.size() / 2
        return _Core(CoreKind.BOX, (x, y, z))
    if isinstance(shape, Cylinder):
        return _Core(CoreKind.CYLINDER, (shape.radius(), 0.0, shape.length() / 2))
    if isinstance(shape, Capsule):
        return _Core(CoreKind.SEGMENT, (0.0, 0.0, shape.length() / 2), shape.radius())
    if isinstance(shape, Sphere):
        return _Core(CoreKind.SEGMENT, radius=shape.radius())
    if isinstance(shape, (Convex, Mesh)):  # Drake takes the convex hull of both.
        hull = inspector.GetConvexHull(geometry)
        vertices = np.array([hull.vertex(k) for k in range(hull.num_vertices())])
        return _Core(CoreKind.VERTICES, vertices=vertices)
    return _Core(CoreKind.OTHER)


def hull_corners(inspector: SceneGraphInspector, geometry: GeometryId) -> Floats:
    """Return the corners of a geometry's convex hull in its own frame [m].

    A cylinder is represented by an inscribed prism of 32 sides. Rounded shapes have no corners.

    Returns:
        Corners. Shape (V, 3).
    """
    core = _core_of(inspector, geometry)
    if core.kind is CoreKind.BOX:
        signs = np.stack(np.meshgrid(*[(-1.0, 1.0)] * 3), axis=-1).reshape(-1, 3)
        return np.asarray(signs * core.size)
    if core.kind is CoreKind.CYLINDER:
        angle = np.arange(32) * (np.pi / 16)
        x, y = core.size[0] * np.array([np.cos(angle), np.sin(angle)])
        ends = [np.column_stack([x, y, np.full(32, z)]) for z in (-core.size[2], core.size[2])]
        return np.vstack(ends)
    return np.zeros((0, 3)) if core.vertices is None else core.vertices


@dataclass(frozen=True)
class FoundDistances:
    """Distances below a threshold along a path.

    Attributes:
        rows: Index of the configuration. Shape (k,).
        pairs: Indices of the two shapes. Shape (k, 2).
        distances: Distances [m]; NaN where they are not computed here: cores intersect, or a shape
            is not known. Shape (k,).
        gradients: Derivatives by the joint positions [m/rad]; without rows if not asked for. Shape
            (k, n).
    """

    rows: Integers
    pairs: Integers
    distances: Floats
    gradients: Floats

    def select(self, is_kept: NDArray[np.bool_]) -> "FoundDistances":
        """Return some of the distances.

        Args:
            is_kept: Whether each is kept. Shape (k,).
        """
        gradients = self.gradients[is_kept] if len(self.gradients) else self.gradients
        return FoundDistances(
            self.rows[is_kept], self.pairs[is_kept], self.distances[is_kept], gradients
        )


@dataclass(frozen=True, eq=False)
class MovingCapsules:
    """Round shapes that move with an arm, as capsules.

    A cylinder is represented by the longest capsule of its radius inside, at least a ball.

    Attributes:
        shapes: Indices of the shapes. Shape (c,).
        depths: Number of joints that move each shape. Shape (c,).
        ends: Ends of the axes in J [m]. Shape (c, 2, 3).
        radii: Radii [m]. Shape (c,).
    """

    shapes: Integers
    depths: Integers
    ends: Floats
    radii: Floats


class ShapeTable:
    """Shapes of a scene, some of which move with the joints of an arm."""

    def __init__(
        self,
        inspector: SceneGraphInspector,
        depths: Mapping[GeometryId, int],
        X_TS: Sequence[Floats],
        chain: SerialChain,
        X_TB: Floats,
    ) -> None:
        """Collect the shapes.

        Args:
            inspector: Inspector of the scene graph.
            depths: Number of joints that move each geometry.
            X_TS: Poses of the shapes, those of moving ones at joint positions of zero. Shapes
                (4, 4).
            chain: Kinematic chain of the arm.
            X_TB: Pose of its base. Shape (4, 4).
        """
        cores = [_core_of(inspector, geometry) for geometry in depths]
        self._chain = chain
        self._fixed = chain.fixed.copy()
        self._fixed[0] = X_TB @ chain.fixed[0]
        self._depths = np.array([*depths.values()], np.int64)
        self._X_TS = np.array(X_TS)
        self._X_JS = np.broadcast_to(np.eye(4), self._X_TS.shape).copy()
        X_TJ = X_TB @ chain.joint_frames(np.zeros(chain.num_joints))
        for k in np.flatnonzero(self._depths).tolist():
            self._X_JS[k] = np.linalg.inv(X_TJ[self._depths[k] - 1]) @ self._X_TS[k]
        self._kinds = np.array([int(core.kind) for core in cores], np.int64)
        self._sizes = np.array([core.size for core in cores])
        self._radii = np.array([core.radius for core in cores])
        vertices = [np.zeros((0, 3)) if c.vertices is None else c.vertices for c in cores]
        self._vertices = np.vstack([*vertices, np.zeros((1, 3))])
        self._starts = np.cumsum([0, *(len(points) for points in vertices)])
        self._centers = np.zeros((len(cores), 3))
        self._bounds = np.linalg.norm(self._sizes, axis=1) + self._radii
        for shape, points in enumerate(vertices):
            if len(points):
                center = (points.min(axis=0) + points.max(axis=0)) / 2
                self._centers[shape] = center
                self._bounds[shape] = np.linalg.norm(points - center, axis=1).max()
        self._bounds[self._kinds == int(CoreKind.OTHER)] = np.inf

    def place(self, shape: int, X_TS: Floats) -> None:
        """Set the pose of a shape that does not move with the arm. Shape (4, 4)."""
        self._depths[shape] = 0
        self._X_TS[shape] = X_TS

    def attach(self, shape: int, X_FS: Floats) -> None:
        """Attach a shape to the flange F. Shape (4, 4)."""
        self._depths[shape] = self._chain.num_joints
        self._X_JS[shape] = self._fixed[-1] @ X_FS

    def moving_capsules(self) -> MovingCapsules:
        """Return the round shapes that move with the arm; boxes and hulls are left out."""
        is_cylinder = self._kinds == int(CoreKind.CYLINDER)
        is_round = is_cylinder | (self._kinds == int(CoreKind.SEGMENT))
        shapes = np.flatnonzero((self._depths > 0) & is_round)
        radii = np.where(is_cylinder, self._sizes[:, 0], self._radii)
        halves = np.where(is_cylinder, np.maximum(self._sizes[:, 2] - radii, 0), self._sizes[:, 2])
        X, half = self._X_JS[shapes], halves[shapes, None]
        ends = [X[:, :3, 3] + sign * half * X[:, :3, 2] for sign in (-1, 1)]
        return MovingCapsules(shapes, self._depths[shapes], np.stack(ends, axis=1), radii[shapes])

    def find_distances(
        self, path: Floats, pairs: Integers, max_distance: float, *, with_gradients: bool
    ) -> FoundDistances:
        """Return the distances below a threshold along a path.

        Args:
            path: Joint positions. Shape (m, n).
            pairs: Indices of two shapes. Shape (p, 2).
            max_distance: Threshold [m].
            with_gradients: Whether to compute gradients.
        """
        capacity = len(path) * len(pairs)
        rows, found = np.empty((2, capacity), np.int64)
        distances = np.empty(capacity)
        gradients = np.empty((capacity if with_gradients else 0, path.shape[1]))
        count = path_distances(
            self._fixed,
            self._chain.revolute,
            np.ascontiguousarray(path, float),
            self._depths,
            self._X_JS,
            self._kinds,
            self._sizes,
            self._radii,
            self._centers,
            self._bounds,
            self._vertices,
            self._starts,
            pairs,
            max_distance,
            self._X_TS,
            rows,
            found,
            distances,
            gradients,
        )
        return FoundDistances(
            rows[:count], pairs[found[:count]], distances[:count], gradients[:count]
        )

    def lowest_points(self, q: Floats, shapes: Sequence[int]) -> Floats:
        """Return the height in T of the lowest point of moving shapes [m]. Shape (m,).

        Args:
            q: Joint positions. Shape (m, n).
            shapes: Indices of the shapes.
        """
        return np.asarray(
            lowest_points(
                self._fixed,
                self._chain.revolute,
                np.ascontiguousarray(q, float),
                self._depths,
                self._X_JS,
                self._kinds,
                self._sizes,
                self._radii,
                self._vertices,
                self._starts,
                np.array(shapes, np.int64),
            )
        )
