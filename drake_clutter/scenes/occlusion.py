"""Conservative occlusion volumes for planning under partial observability.

They are boxes over the space behind or below known objects, and over depth points that belong to no
known object. A planner without ground truth must treat them as solid.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import label, maximum_filter, minimum_filter

from drake_clutter.cell.camera import pixel_grid
from drake_clutter.scenes.interfaces import Observation
from drake_clutter.scenes.scene import SceneObject

_MIN_HIDDEN_HEIGHT = 0.012
"""Smallest free height in which an object can be hidden [m].

Depth points no higher than this above the floor are sensor noise.
"""
_SHADOW_GAP = 0.003
"""Gap between an object and the box below it [m].

Drake's distance queries are unreliable where faces just touch.
"""
_SURFACE_TOLERANCE = 0.008
"""Depth points this close to a known object count as its surface [m]."""
_MIN_POINTS = 12
"""Fewest unidentified depth points that form a box; fewer are noise at edges."""
_EDGE_WINDOW = 25
"""Side of the window around a pixel without arm and rim [px].

Near their edges, the depth images of a stereo camera have holes.
"""
_TOP_QUANTILE = 0.98
"""Quantile of the heights of unidentified points at which a box ends.

Higher points are outliers.
"""
_PIXEL_STRIDE = 2
"""Stride of the evaluated pixels, in both directions [px]."""
_COLUMN_SIZE = 0.02
"""Side of the vertical columns into which the space behind objects is cut [m]."""
_HEIGHT_RESOLUTION = 0.01
"""Resolution of the columns' heights [m]."""
_BOX_HEIGHT_STEP = 0.03
"""Largest difference of the heights of columns that form one box [m]."""


@dataclass(frozen=True)
class OccludedBox:
    """An upright box on the support's floor that may contain hidden objects.

    Attributes:
        center: Center in T [m]. Shape (3,).
        size: Extents along the axes of the box [m]. Shape (3,).
        yaw: Rotation about T's z axis [rad].
    """

    center: tuple[float, float, float]
    size: tuple[float, float, float]
    yaw: float

    @property
    def top_height(self) -> float:
        """Height of the top above the support's floor [m]."""
        return self.size[2]

    @staticmethod
    def below_points(points_T: NDArray[np.floating], top: float) -> "OccludedBox":
        """Return the box up to a height with the smallest base around points.

        Args:
            points_T: Points, of which only x and y are used [m]. Shape (N, 2) or (N, 3).
            top: Height of the box [m].
        """
        from trimesh.bounds import oriented_bounds_2D  # imported late: it takes long

        bounds = oriented_bounds_2D(points_T[:, :2])  # type: ignore[no-untyped-call]
        to_center, (length, width) = bounds
        x, y = np.linalg.inv(to_center)[:2, 2]
        yaw = -math.atan2(to_center[1, 0], to_center[0, 0])
        return OccludedBox((float(x), float(y), top / 2), (float(length), float(width), top), yaw)


def occluded_boxes(
    known_objects: Sequence[SceneObject], observation: Observation, empty_depth: NDArray[np.float32]
) -> tuple[OccludedBox, ...]:
    """Return boxes over occluded space and over unidentified depth points.

    Args:
        known_objects: Objects seen so far (K_t), at their current poses.
        observation: Latest observation.
        empty_depth: Depth image of the cell with an empty support and the arm at home [m].
            Shape (height, width).
    """
    lower = [float(o.bounds_T[0][2]) for o in known_objects]
    shadows = [
        OccludedBox.below_points(o.corners_T, z - _SHADOW_GAP)
        for o, z in zip(known_objects, lower, strict=True)
        if z > _MIN_HIDDEN_HEIGHT
    ]
    behind = [] if observation.camera.is_vertical else _boxes_behind(known_objects, observation)
    return (*shadows, *behind, *_unidentified_boxes(known_objects, observation, empty_depth))


def _boxes_behind(
    known_objects: Sequence[SceneObject], observation: Observation
) -> list[OccludedBox]:
    """Return boxes over the space behind known objects, for a tilted camera.

    The space is cut into vertical columns. Space closer to an object than the surface tolerance is
    left out, as nothing fits in between.
    """
    p_TC = observation.camera.X_TC.translation()
    top = max((o.top_height for o in known_objects), default=0.0)
    x, y = (
        np.arange(-count, count + 1) * (_COLUMN_SIZE / 2)
        for count in (int(side / _COLUMN_SIZE) for side in observation.support.size)
    )
    z = np.arange(_MIN_HIDDEN_HEIGHT, top, _HEIGHT_RESOLUTION)
    # Odd indices are the centers of the columns, even ones their corners.
    p_TP = np.stack(np.meshgrid(x, y, z, indexing="ij"), axis=-1)
    is_hidden = np.zeros(p_TP.shape[:3], bool)
    is_at_object = np.zeros(p_TP.shape[:3], bool)
    for o in known_objects:
        half = np.asarray(o.object_class.size) / 2
        R = o.X_TO.rotation
        p_OP = (p_TP - o.X_TO.p) @ R
        p_OC = (p_TC - o.X_TO.p) @ R
        # Slab test: where the ray from the camera (0) to the point (1) is inside the object's box.
        ray = np.where(np.abs(p_OP - p_OC) > 1e-12, p_OP - p_OC, 1e-12)
        ray_center = -p_OC / ray
        half_span = half / np.abs(ray)
        enters = (ray_center - half_span).max(axis=-1)
        leaves = (ray_center + half_span).min(axis=-1)
        is_hidden |= (enters < leaves) & (enters < 1)
        near = half + _COLUMN_SIZE / 2 + _SURFACE_TOLERANCE
        is_at_object |= (np.abs(p_OP) < near).all(axis=-1)
    is_occluded = maximum_filter(is_hidden, (3, 3, 1))[1::2, 1::2] & ~is_at_object[1::2, 1::2]
    cell_tops = np.minimum(z + _HEIGHT_RESOLUTION, top)
    heights = np.where(is_occluded, cell_tops, 0.0).max(axis=2, initial=0.0)
    boxes = []
    y = y[1::2]
    for row, x_center in zip(heights, x[1::2], strict=True):
        ends = np.flatnonzero(np.diff(np.ceil(row / _BOX_HEIGHT_STEP), prepend=0, append=0))
        for begin, end in pairwise(ends.tolist()):
            if row[begin] > 0:
                height = float(row[begin:end].max())
                y_center = (y[begin] + y[end - 1]) / 2
                size = (_COLUMN_SIZE, _COLUMN_SIZE * (end - begin), height)
                center = (float(x_center), float(y_center), height / 2)
                boxes.append(OccludedBox(center, size, 0.0))
    return boxes


def objects_below_unidentified_points(
    known_objects: Sequence[SceneObject], observation: Observation, empty_depth: NDArray[np.float32]
) -> frozenset[str]:
    """Return the names of known objects on which an unidentified object may lie.

    These have depth points right above them that belong to no known object.

    Args:
        known_objects: See `occluded_boxes`.
        observation: See `occluded_boxes`.
        empty_depth: See `occluded_boxes`.
    """
    p_TP, _ = _unidentified_points(known_objects, observation, empty_depth)
    names = set[str]()
    for o in known_objects:
        p_OP = (p_TP - o.X_TO.p) @ o.X_TO.rotation
        horizontal_axes = np.arange(3) != np.abs(o.X_TO.rotation[2]).argmax()
        is_within = np.abs(p_OP) < np.asarray(o.object_class.size) / 2
        is_higher = p_TP[:, 2] > o.top_height + _MIN_HIDDEN_HEIGHT
        is_above = is_within[:, horizontal_axes].all(axis=1) & is_higher
        if is_above.sum() >= _MIN_POINTS:
            names.add(o.name)
    return frozenset(names)


def count_unidentified_points(
    known_objects: Sequence[SceneObject], observation: Observation, empty_depth: NDArray[np.float32]
) -> int:
    """Return the number of depth points of patches that belong to no known object.

    Patches that are too small to form a box do not count; see `occluded_boxes` for the arguments.
    """
    _, patch = _unidentified_points(known_objects, observation, empty_depth)
    sizes = np.bincount(patch) if len(patch) else np.zeros(0, int)
    return int(sizes[sizes >= _MIN_POINTS].sum())


def _unidentified_boxes(
    known_objects: Sequence[SceneObject], observation: Observation, empty_depth: NDArray[np.float32]
) -> list[OccludedBox]:
    """Return a box for each patch of depth points that belong to no known object."""
    p_TP, patch = _unidentified_points(known_objects, observation, empty_depth)
    boxes = []
    for k in np.unique(patch):
        points = p_TP[patch == k]
        if len(points) >= _MIN_POINTS and np.ptp(points[:, :2], axis=0).min() > 0:
            top = float(np.quantile(points[:, 2], _TOP_QUANTILE))
            if not observation.camera.is_vertical:
                points = np.vstack([points, _project_to_floor(points, observation)])
            boxes.append(OccludedBox.below_points(points, top))
    return boxes


def _project_to_floor(p_TP: NDArray[np.float64], observation: Observation) -> NDArray[np.float64]:
    """Return where camera rays through points meet the floor or leave the support.

    Args:
        p_TP: Points over the support [m]. Shape (N, 3).
        observation: Observation with camera and support.

    Returns:
        End points of the rays in T [m]. Shape (N, 3).
    """
    p_TC = observation.camera.X_TC.translation()
    ray = p_TP - p_TC
    ends = np.copysign([*observation.support.half_size, 0.0], ray)
    ends[:, 2] = np.where(ray[:, 2] < 0, 0.0, np.inf)
    with np.errstate(divide="ignore", invalid="ignore"):
        along = np.nan_to_num((ends - p_TC) / ray, nan=np.inf, posinf=np.inf, neginf=np.inf)
    return np.asarray(p_TC + ray * np.maximum(along.min(axis=1), 1.0)[:, None])


def _unidentified_points(
    known_objects: Sequence[SceneObject], observation: Observation, empty_depth: NDArray[np.float32]
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Return the depth points over the support that belong to no known object.

    Returns:
        p_TP [m], shape (N, 3), and the number of the connected patch of each point, shape (N,).
    """
    camera = observation.camera
    plane = np.where(np.isfinite(camera.floor_depth), camera.floor_depth, 0)
    empty = minimum_filter(empty_depth - plane, _EDGE_WINDOW) + plane
    z = observation.depth[::_PIXEL_STRIDE, ::_PIXEL_STRIDE]
    floor = empty[::_PIXEL_STRIDE, ::_PIXEL_STRIDE]
    pixels = _PIXEL_STRIDE * pixel_grid(z.shape)
    # Pixels without depth in the empty cell are skipped: a detector may have filled them in.
    measured = np.isfinite(z) & (z > 0) & np.isfinite(floor)
    z = np.where(measured, z, np.nan)
    x, y, height = np.moveaxis(camera.backproject(pixels, z), -1, 0)
    half_x, half_y = observation.support.half_size
    is_on_support = (np.abs(x) < half_x) & (np.abs(y) < half_y)
    is_unidentified = measured & (z < floor - _MIN_HIDDEN_HEIGHT) & is_on_support
    for o in known_objects:
        rows, columns = np.nonzero(is_unidentified)
        p_TP = np.column_stack([component[rows, columns] for component in (x, y, height)])
        p_OP = (p_TP - o.X_TO.p) @ o.X_TO.rotation
        half_size = np.asarray(o.object_class.size) / 2 + _SURFACE_TOLERANCE
        is_on_object = (np.abs(p_OP) < half_size).all(axis=1)
        is_unidentified[rows[is_on_object], columns[is_on_object]] = False
    patch, _ = label(is_unidentified)
    p_TP = np.column_stack([component[is_unidentified] for component in (x, y, height)])
    return p_TP, patch[is_unidentified]
