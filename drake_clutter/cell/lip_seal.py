"""Surface under the lip of a suction cup: its distance, tilt and deviation from a plane.

Frames: T is the support; G is the cup, its origin at the center of the lip, z out of the tool, into
the object; O is the object.
"""

import math
from collections.abc import Iterator
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform, RotationMatrix
from scipy.spatial import ConvexHull

from drake_clutter.catalog import ObjectClass, Shape

Floats = NDArray[np.float64]

MAX_GRASP_TILT = math.radians(45)
"""Largest tilt of a surface on which grasps are sampled [rad]."""
_LEVEL_TILT = math.radians(2)
"""A cup points down on a surface with a smaller tilt, which the bellows follow [rad]."""
_NUM_LIP_POINTS = 24
"""Number of points around the lip at which the surface is sampled."""
_RAY_STANDOFF = 0.05
"""Distance above the lip at which rays to the surface start [m], so that edges that rise above
the lip are seen."""
_FACING_ROTATION = RotationMatrix(np.diag([1.0, -1.0, -1.0]))
"""R_NG of a cup that points away from a viewer N; R_TG of one that points down."""
_MIN_HORIZONTAL_PART = 1e-6
"""Smallest horizontal part of a unit vector that is not vertical."""


def grid_points(lower: Floats, upper: Floats, target: Floats, spacing: float) -> Floats:
    """Return grid points of a rectangle, the closest to a target first.

    Args:
        lower: Lower corner [m]. Shape (2,).
        upper: Upper corner [m]. Shape (2,).
        target: Position of the target [m]. Shape (2,).
        spacing: Grid spacing [m].

    Returns:
        Points. Shape (m, 2).
    """
    steps = [np.arange(0, (hi - lo) / 2, spacing) for lo, hi in zip(lower, upper, strict=True)]
    x, y = np.meshgrid(*(np.concatenate([-s[:0:-1], s]) for s in steps), indexing="ij")
    center = (lower + upper) / 2
    points = center + np.column_stack([x.ravel(), y.ravel()])
    distances = np.round(np.linalg.norm(points - target, axis=1), 6)
    return np.asarray(points[np.argsort(distances, kind="stable")])


@lru_cache(maxsize=256)
def piece_half_spaces(object_class: ObjectClass) -> tuple[Floats, ...]:
    """Return rows (n, d) of n . p + d <= 0 inside of each convex piece. Shapes (F, 4)."""
    return tuple(np.asarray(ConvexHull(piece).equations) for piece in object_class.convex_pieces)


def _ring_points(diameter: float) -> Floats:
    """Return points of a circle in the plane of the lip [m]. Shape (24, 3)."""
    angle = np.arange(_NUM_LIP_POINTS) * (2 * np.pi / _NUM_LIP_POINTS)
    unit = np.column_stack([np.cos(angle), np.sin(angle), np.zeros(_NUM_LIP_POINTS)])
    return np.asarray(unit * diameter / 2)


def piece_depths(object_class: ObjectClass, X_OG: RigidTransform, points: Floats) -> Floats:
    """Return the depth of the convex pieces below points of the lip.

    Args:
        object_class: Class of the object.
        X_OG: Pose of the gripper in the object.
        points: Points in G [m]. Shape (n, 3).

    Returns:
        Distances along z of G [m]; infinite where no surface is below. Shape (n,).
    """
    R_OG = X_OG.rotation().matrix()
    starts = (points - np.array([0.0, 0.0, _RAY_STANDOFF])) @ R_OG.T + X_OG.translation()
    direction = R_OG[:, 2]
    depth = np.full(len(points), np.inf)
    # Intersect each ray with the half-spaces of each convex piece.
    for half_spaces in piece_half_spaces(object_class):
        slope = half_spaces[:, :3] @ direction
        offset = starts @ half_spaces[:, :3].T + half_spaces[:, 3]
        with np.errstate(divide="ignore", invalid="ignore"):
            crossing = -offset / slope
        entry = np.where(slope < -1e-9, crossing, -np.inf).max(axis=1)
        leaving = np.where(slope > 1e-9, crossing, np.inf).min(axis=1)
        misses = (offset[:, np.abs(slope) <= 1e-9] > 0).any(axis=1)
        depth = np.where((entry <= leaving) & ~misses, np.minimum(depth, entry), depth)
    return depth - _RAY_STANDOFF


def _mesh_depths(object_class: ObjectClass, X_OG: RigidTransform, points: Floats) -> Floats:
    """Return the depth of a mesh below points of the lip, see `piece_depths`."""
    triangles = (object_class.surface_triangles - X_OG.translation()) @ X_OG.rotation().matrix()
    near = (triangles[:, :, :2].min(axis=1) <= points[:, :2].max(axis=0)).all(axis=1) & (
        triangles[:, :, :2].max(axis=1) >= points[:, :2].min(axis=0)
    ).all(axis=1)
    a, b, c = (triangles[near, corner] for corner in range(3))
    side_b = b - a
    side_c = c - a
    area = side_b[:, 0] * side_c[:, 1] - side_b[:, 1] * side_c[:, 0]
    arm_x = points[:, 0, None] - a[:, 0]
    arm_y = points[:, 1, None] - a[:, 1]
    with np.errstate(divide="ignore", invalid="ignore"):
        weight_b = (arm_x * side_c[:, 1] - arm_y * side_c[:, 0]) / area
        weight_c = (side_b[:, 0] * arm_y - side_b[:, 1] * arm_x) / area
        depth = a[:, 2] + weight_b * side_b[:, 2] + weight_c * side_c[:, 2]
        inside = (np.minimum(weight_b, weight_c) >= -1e-9) & (weight_b + weight_c <= 1 + 1e-9)
    return np.asarray(np.where(inside, depth, np.inf).min(axis=1, initial=np.inf))


def _contact_depth(object_class: ObjectClass, X_OG: RigidTransform, diameter: float) -> float:
    """Return how far a cup moves along z of G until it touches a convex piece [m]."""
    points = np.vstack([_ring_points(share * diameter) for share in (0.0, 0.5, 1.0)])
    return float(piece_depths(object_class, X_OG, points).min())


def lip_surface_profile(object_class: ObjectClass, X_OG: RigidTransform, diameter: float) -> Floats:
    """Return the distance between lip and surface at points around the lip.

    The surface of a mesh is the mesh itself, as its convex pieces may bulge above a flat face.

    Args:
        object_class: Class of the object.
        X_OG: Pose of the gripper in the object.
        diameter: Diameter of the lip [m].

    Returns:
        Distances along z of G [m]; infinite where no surface is below. Shape (24,).
    """
    depths = _mesh_depths if object_class.shape is Shape.MESH else piece_depths
    return depths(object_class, X_OG, _ring_points(diameter))


def lip_flatness_deviation(
    object_class: ObjectClass, X_OG: RigidTransform, diameter: float
) -> float:
    """Return the deviation of the surface under the lip from a plane [m].

    The plane is a least-squares fit, at any tilt. Curvature, edges and gaps increase the
    deviation; the tilt is that of `profile_tilt`.

    Args:
        object_class: Class of the object.
        X_OG: Pose of the gripper in the object.
        diameter: Diameter of the lip [m].

    Returns:
        Deviation [m]; infinite if a part of the lip has no surface below.
    """
    return profile_deviation(lip_surface_profile(object_class, X_OG, diameter), diameter)


def _slope(profile: Floats, diameter: float) -> Floats:
    """Return the slopes along x and y of G of the plane that fits a profile best. Shape (2,)."""
    # The points are evenly spaced on a circle: the least-squares fit is a Fourier coefficient.
    x, y, _ = _ring_points(diameter).T
    return np.array([profile @ x, profile @ y]) * 8 / (_NUM_LIP_POINTS * diameter**2)


def profile_tilt(profile: Floats, diameter: float) -> float:
    """Return the angle of the plane that fits a `lip_surface_profile` best [rad]."""
    if not np.isfinite(profile).all():
        return math.nan
    return math.atan(float(np.hypot(*_slope(profile, diameter))))


def profile_deviation(profile: Floats, diameter: float) -> float:
    """Return the deviation of a `lip_surface_profile` from a plane [m]; infinite over an edge."""
    if not np.isfinite(profile).all():
        return math.inf
    return float(np.ptp(profile - _ring_points(diameter)[:, :2] @ _slope(profile, diameter)))


def face_poses(
    object_class: ObjectClass,
    X_TO: RigidTransform,
    normal: Floats,
    diameter: float,
    spacing: float,
) -> Iterator[RigidTransform]:
    """Yield poses of a cup on the surface seen from a side, closest to the center of mass first.

    The cup points against the viewing direction where the surface is nearly perpendicular to it,
    and along the surface's normal elsewhere. Surfaces that face down are left out.

    Args:
        object_class: Class of the object.
        X_TO: Pose of the object.
        normal: Direction from the object to the viewer, in T; up, to see it from above. Shape (3,).
        diameter: Diameter of the lip [m].
        spacing: Distance of neighboring points as they are seen [m].
    """
    R_TN = viewer_rotation(normal)
    R_NO = R_TN.inverse() @ X_TO.rotation()
    corners_N = object_class.corners @ np.ascontiguousarray(R_NO.matrix()).T
    corners_N = corners_N + R_TN.inverse() @ X_TO.translation()
    lower, upper = corners_N.min(axis=0), corners_N.max(axis=0)
    p_NCm = R_TN.inverse() @ (X_TO @ object_class.center_of_mass)
    for x, y in grid_points(lower[:2], upper[:2], p_NCm[:2], spacing):
        p_NG = np.array([x, y, upper[2]])
        X_TG = RigidTransform(R_TN @ _FACING_ROTATION, R_TN @ p_NG)
        X_OG = X_TO.InvertAndCompose(X_TG)
        profile = lip_surface_profile(object_class, X_OG, diameter)
        if np.isfinite(profile).all():
            tilt = profile_tilt(profile, diameter)
            if tilt > MAX_GRASP_TILT:
                continue
            if tilt > _LEVEL_TILT:
                X_TG = X_TG @ _turn_to_slope(_slope(profile, diameter), float(profile.mean()))
                X_OG = X_TO.InvertAndCompose(X_TG)
                if X_TG.rotation().matrix()[2, 2] > math.sin(_LEVEL_TILT):
                    continue
            # The lip advances until it touches a convex piece; those of a mesh may bulge.
            depth = _contact_depth(object_class, X_OG, diameter)
            if math.isfinite(depth):
                X_TG = X_TG @ RigidTransform([0.0, 0.0, depth])
        yield X_TG


def viewer_rotation(normal: Floats) -> RotationMatrix:
    """Return R_TN of the frame of a viewer: z towards it, y up unless it is above."""
    up = np.array([0.0, 0.0, 1.0])
    x = np.cross(up, normal)
    length = float(np.linalg.norm(x))
    if length < _MIN_HORIZONTAL_PART:
        return RotationMatrix()
    x /= length
    return RotationMatrix(np.column_stack([x, np.cross(normal, x), normal]))


def _turn_to_slope(slope: Floats, depth: float) -> RigidTransform:
    """Return the pose in G of a cup along the normal of a plane.

    Args:
        slope: Slopes of the plane along x and y of G. Shape (2,).
        depth: Distance of the plane along z of G [m].
    """
    z = np.array([-slope[0], -slope[1], 1.0])
    z /= np.linalg.norm(z)
    x = np.array([1.0, 0.0, 0.0]) - z[0] * z
    x /= np.linalg.norm(x)
    R = RotationMatrix(np.column_stack([x, np.cross(z, x), z]))
    return RigidTransform(R, [0.0, 0.0, depth])
