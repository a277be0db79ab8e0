"""Space that the camera does not see, and what fits in there."""

from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from drake_clutter.belief.known_supports import REST_ORIENTATIONS, resting_heights
from drake_clutter.catalog import ObjectClass, Shape
from drake_clutter.compilation import njit
from drake_clutter.grammar.orientation import resting_rotation
from drake_clutter.scenes.free_space import CELL_SIZE, Grid, occluding_pixel
from drake_clutter.scenes.interfaces import Observation
from drake_clutter.scenes.release_orientation import orient_object, yaw_steps
from drake_clutter.scenes.scene import Pose, SceneObject

_HEIGHT_STEP = 0.005
"""Distance between the heights at which a column of space is checked [m]."""


class HiddenColumns(NamedTuple):
    """Unseen space above the floor, in columns over the cells of a `Grid`.

    Attributes:
        height: Height up to which the camera sees nothing of a column and no known object is in it
            [m]. Shape (n, m).
        is_covered: Whether a known object is above the column's space. Shape (n, m).
    """

    height: NDArray[np.float64]
    is_covered: NDArray[np.bool_]


@njit(cache=True)
def _known_at(x, y, z, centers, rotations, halves, cylinders):  # type: ignore[no-untyped-def]
    """Return whether a point is in a known object."""
    for k in range(len(centers)):
        dx, dy, dz = x - centers[k, 0], y - centers[k, 1], z - centers[k, 2]
        R = rotations[k]
        a = abs(R[0, 0] * dx + R[1, 0] * dy + R[2, 0] * dz)
        b = abs(R[0, 1] * dx + R[1, 1] * dy + R[2, 1] * dz)
        c = abs(R[0, 2] * dx + R[1, 2] * dy + R[2, 2] * dz)
        if c > halves[k, 2]:
            continue
        if cylinders[k]:
            if a * a + b * b < halves[k, 0] * halves[k, 0]:
                return True
        elif a < halves[k, 0] and b < halves[k, 1]:
            return True
    return False


@njit(cache=True)
def _hidden_columns(depth, camera, x, y, top, bodies, heights, is_covered):  # type: ignore[no-untyped-def]
    """Fill the heights of hidden columns, see `HiddenColumns`.

    Args:
        depth: Depth image [m]. Shape (H, W).
        camera: `Pinhole` of the camera.
        x: Centers of the cells along x [m]. Shape (n,).
        y: Centers of the cells along y [m]. Shape (m,).
        top: Height of the highest known object [m].
        bodies: Centers, rotations, half sizes and whether each is a cylinder, of known objects.
        heights: Output [m]. Shape (n, m).
        is_covered: Output. Shape (n, m).
    """
    centers, rotations, halves, cylinders = bodies
    for i in range(len(x)):
        for j in range(len(y)):
            z = _HEIGHT_STEP / 2
            while z < top:
                row, _ = occluding_pixel(depth, camera, x[i], y[j], z)
                if row < 0:
                    break
                if _known_at(x[i], y[j], z, centers, rotations, halves, cylinders):
                    break
                z += _HEIGHT_STEP
            heights[i, j] = z - _HEIGHT_STEP / 2
            if heights[i, j] == 0.0:
                continue
            while z < top and not is_covered[i, j]:
                is_covered[i, j] = _known_at(x[i], y[j], z, centers, rotations, halves, cylinders)
                z += _HEIGHT_STEP


def find_hidden_columns(known: Sequence[SceneObject], observation: Observation) -> HiddenColumns:
    """Return the unseen space above the floor that no known object fills.

    A mesh fills its bounding box.

    Args:
        known: Known objects at their poses.
        observation: Latest observation.
    """
    grid = Grid.over(observation.support)
    heights = np.zeros((len(grid.x), len(grid.y)))
    is_covered = np.zeros(heights.shape, bool)
    if known:
        bodies = (
            np.array([o.X_TO.translation for o in known]),
            np.array([o.X_TO.rotation for o in known]),
            np.array([o.object_class.size for o in known]) / 2,
            np.array([o.object_class.shape is Shape.CYLINDER for o in known]),
        )
        _hidden_columns(
            np.ascontiguousarray(observation.depth, np.float32),
            observation.camera.pinhole,
            grid.x,
            grid.y,
            max(o.top_height for o in known),
            bodies,
            heights,
            is_covered,
        )
    return HiddenColumns(heights, is_covered)


@njit(cache=True)
def _fitting_cells(height, rows, required, unseen_fraction):  # type: ignore[no-untyped-def]
    """Return the cells at which an object fits in hidden columns.

    Args:
        height: See `HiddenColumns`. Shape (n, m).
        rows: Cells of the object's footprint, see `Footprint.rows`. Shape (r, 3).
        required: Height of the object [m].
        unseen_fraction: Fraction of the footprint that must be in columns that are high enough.

    Returns:
        Whether the object fits with its center in each cell. Shape (n, m).
    """
    n, m = height.shape
    total = 0
    for k in range(len(rows)):
        total += rows[k, 2] - rows[k, 1] + 1
    allowed = int((1.0 - unseen_fraction) * total + 1e-9)
    fits = np.zeros((n, m), np.bool_)
    for i in range(n):
        for j in range(m):
            missing = 0
            for k in range(len(rows)):
                row, first, last = i + rows[k, 0], j + rows[k, 1], j + rows[k, 2]
                if row < 0 or row >= n or first < 0 or last >= m:
                    missing = total + 1
                for column in range(first, last + 1):
                    if missing > allowed:
                        break
                    missing += height[row, column] < required
                if missing > allowed:
                    break
            fits[i, j] = missing <= allowed
    return fits


class Standing(NamedTuple):
    """A class at rest on the floor, with the cells that it covers.

    Attributes:
        height: Its height [m].
        rows: Cells of its footprint, see `Footprint.rows`. Shape (r, 3).
    """

    height: float
    rows: NDArray[np.int64]


@lru_cache(maxsize=256)
def standing_poses(object_class: ObjectClass) -> tuple[Standing, ...]:
    """Return the orientations at rest and yaws of a class that are tried."""
    poses = []
    for rest, height in resting_heights(object_class).items():
        R_TO = resting_rotation(object_class, REST_ORIENTATIONS[rest])
        quaternion = Pose.from_rotation(R_TO, (0.0, 0.0, 0.0)).quaternion
        for yaws in yaw_steps(object_class, quaternion):
            # Cells whose centers are well within the object: what just fits is not missed.
            poses += [
                Standing(
                    height, orient_object(object_class, quaternion, yaw, -CELL_SIZE).footprint.rows
                )
                for yaw in yaws
            ]
    return tuple(poses)


class HiddenArea(NamedTuple):
    """Area of the positions at which an object would not be seen, the mean over its poses.

    Attributes:
        covered: Positions below known objects [m^2].
        shadow: Positions that are open above, but behind known objects for the camera [m^2].
    """

    covered: float
    shadow: float


class HiddenFit(NamedTuple):
    """Where an object would stand on the floor unseen.

    Attributes:
        height: Height of the object [m].
        cells: Cells at which its center may be. Shape (n, m).
    """

    height: float
    cells: NDArray[np.bool_]


def find_fits(
    object_class: ObjectClass, columns: HiddenColumns, unseen_fraction: float = 1.0
) -> list[HiddenFit]:
    """Return where an object of a class may stand on the floor unseen, in each of its poses.

    Args:
        object_class: The class.
        columns: Unseen space.
        unseen_fraction: Fraction of the object's outline that must be unseen.
    """
    # The height of a column is off by up to half a step.
    return [
        HiddenFit(
            pose.height,
            _fitting_cells(
                columns.height, pose.rows, pose.height - _HEIGHT_STEP / 2, unseen_fraction
            ),
        )
        for pose in standing_poses(object_class)
    ]


def hidden_area(fits: Sequence[HiddenFit], columns: HiddenColumns) -> HiddenArea:
    """Return the mean area over the poses of a class."""
    covered = sum(np.count_nonzero(fit.cells & columns.is_covered) for fit in fits)
    total = sum(np.count_nonzero(fit.cells) for fit in fits)
    cell = CELL_SIZE**2 / len(fits)
    return HiddenArea(covered * cell, (total - covered) * cell)
