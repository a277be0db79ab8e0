"""Sides from which an object is grasped, and the way out from below what is above it.

Frames: T is the support.
"""

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from drake_clutter.scenes.scene import SceneObject

Floats = NDArray[np.float64]

NUM_SIDES = 4
"""Number of horizontal directions from which an object is seen: surfaces whose normal differs by up
to 45 deg are grasped."""
CORNER_LENGTH = 0.02
"""Length over which the path of a load changes from horizontal to vertical motion [m]."""


def side_normals(
    scene_object: SceneObject, viewer: Floats
) -> tuple[tuple[float, float, float], ...]:
    """Return the outward normals of the sides of an object in T, the one facing a viewer first.

    They are those of the vertical faces of a box.

    Args:
        scene_object: The object at its pose.
        viewer: Position of the viewer in T [m]. Shape (3,).
    """
    axes = scene_object.X_TO.rotation[:2]
    x, y = axes[:, np.linalg.norm(axes, axis=0).argmax()]
    first = math.atan2(y, x)
    angles = first + np.arange(NUM_SIDES) * (2 * math.pi / NUM_SIDES)
    towards = np.asarray(viewer)[:2] - scene_object.X_TO.p[:2]
    facing = np.cos(angles - math.atan2(towards[1], towards[0]))
    order = np.argsort(-np.round(facing, 6), kind="stable")
    return tuple((math.cos(a), math.sin(a), 0.0) for a in angles[order].tolist())


def distance_from_below(
    corners: Floats, direction: Floats, obstacles: Sequence[Floats], clearance: float
) -> float:
    """Return how far an object moves in a direction until no obstacle is above it [m].

    Obstacles are above it if they are higher than its center. Object and obstacles count as their
    bounding boxes along the direction.

    Args:
        corners: Corners of the object in T [m]. Shape (V, 3).
        direction: Horizontal direction in T. Shape (2,).
        obstacles: Corners of convex obstacles in T [m]. Shapes (V, 3).
        clearance: Horizontal distance to keep from what is above [m].

    Returns:
        Distance with the corner of the path after it; 0 if nothing is above the object.
    """
    along, across = direction / np.linalg.norm(direction)
    axes = np.array([[along, across], [-across, along]])
    center = (corners[:, 2].min() + corners[:, 2].max()) / 2
    lower, upper = _bounds(corners, axes)
    above = [_bounds(obstacle, axes) for obstacle in obstacles if obstacle[:, 2].min() > center]
    distance = 0.0
    for _ in above:
        shift = np.array([distance, 0.0])
        ends = [
            bounds[1][0]
            for bounds in above
            if (bounds[0] - clearance < upper + shift).all()
            and (bounds[1] + clearance > lower + shift).all()
        ]
        if not ends:
            break
        distance = max(ends) + clearance - float(lower[0])
    return distance + CORNER_LENGTH if distance else 0.0


def _bounds(corners: Floats, axes: Floats) -> tuple[Floats, Floats]:
    """Return the least and the greatest horizontal coordinates along axes. Shapes (2,)."""
    projections = corners[:, :2] @ axes.T
    return projections.min(axis=0), projections.max(axis=0)
