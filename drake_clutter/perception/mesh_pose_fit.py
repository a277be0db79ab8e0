"""Rendering of meshes as points, and the fit of their poses to segments of a depth image.

Candidates stand on each side that the class may rest on, in uniform yaws about the guessed center.
They are ranked by the distances of the measured points, aligned by ICP, and refined by a search
that compares rendered with measured depth as for boxes and cylinders.
"""

import itertools
import math
from collections.abc import Callable
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from drake_clutter.catalog import ObjectClass, RestOrientation
from drake_clutter.cell.camera import Camera
from drake_clutter.perception.pose_score import (
    CENTER_PRIOR_WEIGHT,
    DEPTH_TOLERANCE,
    FLOOR_PENALTY,
    MAX_FLOOR_PENETRATION,
    SegmentView,
)
from drake_clutter.seeding import item_rng

Floats = NDArray[np.float64]

POINT_SPACING = 0.0012
"""Mean spacing of the points that represent a mesh [m]; half a pixel of the default camera."""
MAX_MODEL_POINTS = 60_000
"""Largest number of points that represent a mesh."""
NUM_YAWS = 24
"""Number of yaws of the candidates on each resting side."""
NUM_ALIGNED = 2
"""Number of the best candidates on each resting side that are aligned by ICP."""
MIN_TILT_GAIN = 0.02
"""By how much a tilted pose must be better than one at rest."""
MAX_POINT_DISTANCE = 0.02
"""Larger distances of a measured point from the mesh count as this [m]."""
STEPS = (0.004, 0.002, 0.001)
"""Steps of the search, of positions and of the surface by rotations [m]."""

Align = Callable[[Floats, Floats], tuple[Floats, Floats]]
"""Returns R_TO and p_TO after ICP from given ones."""


class RenderedMesh(NamedTuple):
    """Depth image of a mesh in the smallest window that contains it.

    Attributes:
        top: First row.
        left: First column.
        depth: Depth [m]; infinite where the mesh is not. Shape (rows, columns).
    """

    top: int
    left: int
    depth: NDArray[np.float32]


@lru_cache(maxsize=64)
def surface_points(object_class: ObjectClass) -> Floats:
    """Return uniformly distributed points of a mesh's surface in O [m]. Shape (N, 3)."""
    a, b, c = (object_class.surface_triangles[:, k] for k in range(3))
    areas = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2
    count = min(MAX_MODEL_POINTS, math.ceil(areas.sum() / POINT_SPACING**2))
    # Stratified along the triangles, so that no part is left out by chance.
    position = (np.arange(count) + 0.5) / count * areas.sum()
    triangle = np.minimum(np.searchsorted(np.cumsum(areas), position), len(areas) - 1)
    u, v = item_rng(0, count).random((2, count))
    u, v = np.where(u + v > 1, 1 - u, u), np.where(u + v > 1, 1 - v, v)
    return np.asarray(a[triangle] + u[:, None] * (b - a)[triangle] + v[:, None] * (c - a)[triangle])


def render_mesh(
    object_class: ObjectClass, R_TO: Floats, p_TO: Floats, camera: Camera
) -> RenderedMesh:
    """Return the depth image of a mesh at a pose."""
    pixels, depth = camera.project_with_depth(surface_points(object_class) @ R_TO.T + p_TO)
    column, row = np.rint(pixels).astype(np.int64).T
    within = (
        (row >= 0)
        & (row < camera.height)
        & (column >= 0)
        & (column < camera.width)
        & (depth > 0.05)
    )
    if not within.any():
        return RenderedMesh(0, 0, np.empty((0, 0), np.float32))
    row, column, depth = row[within], column[within], depth[within]
    top, left = int(row.min()), int(column.min())
    image = np.full((int(row.max()) - top + 1, int(column.max()) - left + 1), np.inf, np.float32)
    np.minimum.at(image, (row - top, column - left), depth.astype(np.float32))
    return RenderedMesh(top, left, image)


def mesh_consistency(
    object_class: ObjectClass, R_TO: Floats, p_TO: Floats, view: SegmentView, camera: Camera
) -> float:
    """Return how consistent a pose is with a segment, from 0 to 1; see `pose_consistency`."""
    rendered = render_mesh(object_class, R_TO, p_TO, camera)
    rows, columns = rendered.depth.shape
    top, bottom, left, right = view.window
    top, left = min(top, rendered.top), min(left, rendered.left)
    bottom = max(bottom, rendered.top + rows)
    right = max(right, rendered.left + columns)
    expected = np.full((bottom - top, right - left), np.inf, np.float32)
    row, column = rendered.top - top, rendered.left - left
    expected[row : row + rows, column : column + columns] = rendered.depth
    measured = view.depth[top:bottom, left:right]
    in_segment = view.mask[top:bottom, left:right]
    is_expected = np.isfinite(expected)
    is_measured = (measured > 0.05) & (measured < 50.0)
    with np.errstate(invalid="ignore"):
        difference = measured - expected
    error = np.square(np.minimum(np.abs(difference) / DEPTH_TOLERANCE, 1.0))
    compared = is_expected & is_measured & in_segment
    unmeasured = is_expected & ~is_measured
    outside = is_expected & is_measured & ~in_segment
    support = (1.0 - error[compared]).sum() + 0.5 * np.count_nonzero(unmeasured & in_segment)
    contradiction = (
        error[compared].sum()
        + np.count_nonzero(in_segment & ~is_expected)
        + 0.5 * np.count_nonzero(unmeasured & ~in_segment)
        + 0.5 * np.count_nonzero(outside & (difference > -DEPTH_TOLERANCE))
        + 0.5 * np.count_nonzero(outside & (difference > DEPTH_TOLERANCE))
    )
    return float(support / (support + contradiction)) if support > 0 else 0.0


def resting_rotations(object_class: ObjectClass) -> Floats:
    """Return rotations R_TO with each axis up on which the class may rest. Shape (n, 3, 3)."""
    axis_by_rest = {RestOrientation.FLAT: 0, RestOrientation.SIDE: 1, RestOrientation.UPRIGHT: 2}
    rest = object_class.only_rest
    axes = range(3) if rest is None else [axis_by_rest[rest]]
    rotations = []
    for axis, sign in itertools.product(axes, (1.0, -1.0)):
        if rest is RestOrientation.UPRIGHT and sign < 0:
            continue
        R_OT = np.zeros((3, 3))
        R_OT[axis, 2] = sign
        R_OT[(axis + 1) % 3, 0] = 1.0
        R_OT[(axis + 2) % 3, 1] = sign
        rotations.append(R_OT.T)
    return np.array(rotations)


def _yaw_rotation(angle: float) -> Floats:
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def _lay_level(R_TO: Floats) -> Floats:
    """Return an orientation whose most vertical axis is exactly vertical, with the same yaw."""
    axis = int(np.abs(R_TO[2]).argmax())
    sign = math.copysign(1.0, R_TO[2, axis])
    first, second = (axis + 1) % 3, (axis + 2) % 3
    yaw = math.atan2(R_TO[1, first], R_TO[0, first])
    level = np.zeros((3, 3))
    level[2, axis] = sign
    level[:, first] = [math.cos(yaw), math.sin(yaw), 0.0]
    level[:, second] = np.cross(level[:, axis], level[:, first])
    return level


def fit_mesh(
    object_class: ObjectClass, points: Floats, view: SegmentView, camera: Camera, align: Align
) -> tuple[Floats, Floats, float]:
    """Return the best pose of a mesh for a segment.

    Args:
        object_class: Class of the object, a mesh.
        points: Measured points of the segment in T [m]. Shape (N, 3).
        view: The segment in the image.
        camera: Camera of the image.
        align: ICP of the points to the mesh.

    Returns:
        R_TO, shape (3, 3), p_TO [m], shape (3,), and the consistency, see `mesh_consistency`.
    """

    def objective(R: Floats, p: Floats) -> float:
        lowest = p[2] + float((object_class.corners @ R[2]).min())
        offset = p - view.p_TO_guess
        cost: float = CENTER_PRIOR_WEIGHT * float(offset @ offset) / 1e-4
        cost += float(FLOOR_PENALTY * max(0.0, -lowest - MAX_FLOOR_PENETRATION))
        return mesh_consistency(object_class, R, p, view, camera) - cost

    tree = _surface_tree(object_class)
    highest = float(np.quantile(points[:, 2], 0.98))
    level, tilted = [], []
    for R_rest in resting_rotations(object_class):
        starts = []
        for k in range(NUM_YAWS):
            R = _yaw_rotation(2 * math.pi * k / NUM_YAWS) @ R_rest
            top = float((object_class.corners @ R[2]).max())
            for z in (float(view.p_TO_guess[2]), highest - top):
                p = np.array([*view.p_TO_guess[:2], z])
                distances = tree.query((points - p) @ R)[0]
                starts.append((float(np.minimum(distances, MAX_POINT_DISTANCE).mean()), R, p))
        starts.sort(key=lambda start: start[0])
        for _, R, p in starts[:NUM_ALIGNED]:
            aligned_R, aligned_p = align(R, p)
            tilted.append((aligned_R, aligned_p))
            level += [(R, p), (_lay_level(aligned_R), aligned_p)]
    results = []
    for poses in (level, tilted):
        value, R, p = max(((objective(R, p), R, p) for R, p in poses), key=lambda c: c[0])
        for step in STEPS:
            for coordinate, sign in itertools.product(range(4), (1.0, -1.0)):
                shift = sign * step * np.eye(3)[coordinate] if coordinate < 3 else np.zeros(3)
                turn = sign * step / (max(object_class.size) / 2) if coordinate == 3 else 0.0
                new_R, new_p = _yaw_rotation(turn) @ R, p + shift
                new_value = objective(new_R, new_p)
                if new_value > value:
                    value, R, p = new_value, new_R, new_p
        results.append((value, R, p))
    (level_value, *_), (tilted_value, *_) = results
    _, R, p = results[int(tilted_value > level_value + MIN_TILT_GAIN)]
    return R, p, mesh_consistency(object_class, R, p, view, camera)


@lru_cache(maxsize=64)
def _surface_tree(object_class: ObjectClass) -> Any:
    return cKDTree(surface_points(object_class)[::8])
