"""Space into which the camera has not seen: for a planner that knows only K_t, it is full."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import label, maximum_filter, minimum_filter
from trimesh.bounds import oriented_bounds_2D

from drake_clutter.cell.camera import pixel_grid
from drake_clutter.scenes.interfaces import Observation
from drake_clutter.scenes.scene import SceneObject

_MIN_HIDDEN_HEIGHT = 0.012
"""m; nothing lies hidden under less, and what is no higher above the tray is noise."""
_SHADOW_GAP = 0.003
"""m, between an object and its shadow: where faces just touch, Drake's distances fail by rounding."""
_SURFACE_TOLERANCE = 0.008
"""m, from a known object; what is seen there is taken for its surface."""
_MIN_POINTS = 12
"""Of the pixels looked at, for something that nobody has told the name of; fewer are noise at edges."""
_EDGE_WINDOW = 25
"""Pixels; what is seen so near to the arm, or to the rim, may be a shadow of it that a depth camera cannot see into."""
_TOP_QUANTILE = 0.98
"""Quantile of the heights of what is seen of something nameless: single pixels beyond are noise."""
_PIXEL_STRIDE = 2
"""Pixels, each way, of which one is looked at."""
_COLUMN_SIZE, _HEIGHT_RESOLUTION, _BOX_HEIGHT_STEP = 0.02, 0.01, 0.03
"""m, side of the columns into which the space behind objects is cut, how fine their heights are, and
by how much the heights of one block differ."""


@dataclass(frozen=True)
class OccludedBox:
    """An upright block on the tray's floor that may be full.

    Attributes:
        center: (3,) m, in T. size: (3,) m. yaw: rad, about T's vertical.
    """

    center: tuple[float, float, float]
    size: tuple[float, float, float]
    yaw: float

    @property
    def top_height(self) -> float:
        """m above the tray's floor."""
        return self.size[2]

    @staticmethod
    def below_points(points_T: NDArray[np.floating], top: float) -> "OccludedBox":
        """From the floor up to `top`, m, on the least rectangle around points (N, 2 or more) m."""
        to_middle, (length, width) = oriented_bounds_2D(points_T[:, :2])  # type: ignore[no-untyped-call]
        x, y = np.linalg.inv(to_middle)[:2, 2]
        yaw = -math.atan2(to_middle[1, 0], to_middle[0, 0])
        return OccludedBox((float(x), float(y), top / 2), (float(length), float(width), top), yaw)


def occluded_boxes(
    known_objects: Sequence[SceneObject], observation: Observation, empty_depth: NDArray[np.float32]
) -> tuple[OccludedBox, ...]:
    """What lies in the shadow of known objects, and under what is seen but belongs to none of them.

    Args:
        known_objects: K_t, where they are now.
        observation: the latest.
        empty_depth: (height, width) m, the depth that the camera shows of the cell with nothing on the tray, the arm at home.
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
    """What a camera that looks at an angle cannot see behind known objects.

    What is so near to them that nothing has room in between is left out.
    """
    p_TC, top = (
        observation.camera.X_TC.translation(),
        max((o.top_height for o in known_objects), default=0.0),
    )
    x, y = (
        np.arange(-count, count + 1) * (_COLUMN_SIZE / 2)
        for count in (int(side / _COLUMN_SIZE) for side in observation.support.size)
    )
    z = np.arange(_MIN_HIDDEN_HEIGHT, top, _HEIGHT_RESOLUTION)
    p_TP = np.stack(
        np.meshgrid(x, y, z, indexing="ij"), axis=-1
    )  # corners of the columns, and in between their middles
    shadow, own = np.zeros(p_TP.shape[:3], bool), np.zeros(p_TP.shape[:3], bool)
    for o in known_objects:
        half, R = np.asarray(o.object_class.size) / 2, o.X_TO.rotation
        p_OP, p_OC = (p_TP - o.X_TO.p) @ R, (p_TC - o.X_TO.p) @ R
        ray = np.where(np.abs(p_OP - p_OC) > 1e-12, p_OP - p_OC, 1e-12)
        ray_center, half_span = -p_OC / ray, half / np.abs(ray)
        enters, leaves = (
            (ray_center - half_span).max(axis=-1),
            (ray_center + half_span).min(axis=-1),
        )
        shadow |= (enters < leaves) & (enters < 1)
        own |= (np.abs(p_OP) < half + _COLUMN_SIZE / 2 + _SURFACE_TOLERANCE).all(axis=-1)
    full = maximum_filter(shadow, (3, 3, 1))[1::2, 1::2] & ~own[1::2, 1::2]
    heights = np.where(full, np.minimum(z + _HEIGHT_RESOLUTION, top), 0.0).max(axis=2, initial=0.0)
    x, y = x[1::2], y[1::2]
    blocks = []
    for row, across in zip(heights, x, strict=True):
        ends = np.flatnonzero(np.diff(np.ceil(row / _BOX_HEIGHT_STEP), prepend=0, append=0))
        for begin, end in pairwise(ends.tolist()):
            if row[begin] > 0:
                height, along = float(row[begin:end].max()), (y[begin] + y[end - 1]) / 2
                size = (_COLUMN_SIZE, _COLUMN_SIZE * (end - begin), height)
                blocks.append(OccludedBox((float(across), float(along), height / 2), size, 0.0))
    return blocks


def objects_below_unidentified_points(
    known_objects: Sequence[SceneObject], observation: Observation, empty_depth: NDArray[np.float32]
) -> frozenset[str]:
    """The names of known objects right above which something is seen that belongs to none of them: it may lie on them.

    Arguments: as of `occluded_boxes`.
    """
    p_TP, _ = _unidentified_points(known_objects, observation, empty_depth)
    found = set[str]()
    for o in known_objects:
        p_OP = (p_TP - o.X_TO.p) @ o.X_TO.rotation
        level = np.arange(3) != np.abs(o.X_TO.rotation[2]).argmax()
        over = (np.abs(p_OP) < np.asarray(o.object_class.size) / 2)[:, level].all(axis=1) & (
            p_TP[:, 2] > o.top_height + _MIN_HIDDEN_HEIGHT
        )
        if over.sum() >= _MIN_POINTS:
            found.add(o.name)
    return frozenset(found)


def _unidentified_boxes(
    known_objects: Sequence[SceneObject], observation: Observation, empty_depth: NDArray[np.float32]
) -> list[OccludedBox]:
    p_TP, part = _unidentified_points(known_objects, observation, empty_depth)
    blocks = []
    for k in np.unique(part):
        points = p_TP[part == k]
        if len(points) >= _MIN_POINTS and np.ptp(points[:, :2], axis=0).min() > 0:
            top = float(np.quantile(points[:, 2], _TOP_QUANTILE))
            if not observation.camera.is_vertical:
                points = np.vstack([points, _project_to_floor(points, observation)])
            blocks.append(OccludedBox.below_points(points, top))
    return blocks


def _project_to_floor(p_TP: NDArray[np.float64], observation: Observation) -> NDArray[np.float64]:
    """Return where rays through points over the support (N, 3) meet its floor or leave it [m]. Shape (N, 3)."""
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
    """p_TP (N, 3) m of what is seen and belongs to nothing known, and (N,) the number of the patch of the image it is in."""
    camera = observation.camera
    plane = np.where(np.isfinite(camera.floor_depth), camera.floor_depth, 0)
    z, floor = (
        observation.depth[::_PIXEL_STRIDE, ::_PIXEL_STRIDE],
        (minimum_filter(empty_depth - plane, _EDGE_WINDOW) + plane)[
            ::_PIXEL_STRIDE, ::_PIXEL_STRIDE
        ],
    )
    pixels = _PIXEL_STRIDE * pixel_grid(z.shape)
    measured = (
        np.isfinite(z) & (z > 0) & np.isfinite(floor)
    )  # where nothing can be measured, a detector may have filled holes
    z = np.where(measured, z, np.nan)
    x, y, height = np.moveaxis(camera.backproject(pixels, z), -1, 0)
    half_x, half_y = observation.support.half_size
    left = measured & (z < floor - _MIN_HIDDEN_HEIGHT) & (np.abs(x) < half_x) & (np.abs(y) < half_y)
    for o in known_objects:
        where = np.nonzero(left)
        p_TP = np.column_stack([x[where], y[where], height[where]])
        p_OP = (p_TP - o.X_TO.p) @ o.X_TO.rotation
        own = (np.abs(p_OP) < np.asarray(o.object_class.size) / 2 + _SURFACE_TOLERANCE).all(axis=1)
        left[where[0][own], where[1][own]] = False
    part, _ = label(left)
    return np.column_stack([x[left], y[left], height[left]]), part[left]
