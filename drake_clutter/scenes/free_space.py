"""Free space that the camera sees, on a grid of cells over the support.

A cell is free up to a height if the camera sees through points above it, 20 mm apart.
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from drake_clutter.cell.camera import Camera
from drake_clutter.cell.pinhole import MIN_DEPTH, point_to_camera, project
from drake_clutter.cell.support import Support
from drake_clutter.compilation import njit
from drake_clutter.scenes.interfaces import Observation

CELL_SIZE = 0.005
"""Side of the grid cells on the support in which placements are searched [m]."""
DEPTH_TOLERANCE = 0.004
"""Largest difference of depths that count as equal [m]."""
_HEIGHT_STEP = 0.020
"""Distance between the heights at which the space above a cell is checked [m]."""
_SCORE_TOLERANCE = 1e-9
"""Largest difference of scores that count as equal."""


@dataclass(frozen=True)
class Grid:
    """Square cells over the support's floor.

    Attributes:
        x: Their centers along x [m]. Shape (n,).
        y: Their centers along y [m]. Shape (m,).
    """

    x: NDArray[np.float64]
    y: NDArray[np.float64]

    @staticmethod
    @lru_cache(maxsize=16)
    def over(support: Support) -> "Grid":
        """Return the grid of a support."""
        counts = [int(side / CELL_SIZE) for side in support.size]
        x, y = (
            np.asarray((np.arange(count) - (count - 1) / 2) * CELL_SIZE, float) for count in counts
        )
        return Grid(x, y)

    def centers(self, cells: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return the centers of cells (k, 2) [m]. Shape (k, 2)."""
        return np.column_stack([self.x[cells[:, 0]], self.y[cells[:, 1]]])

    def points(self, height: float) -> NDArray[np.float64]:
        """Return the centers of all cells at a height, x varying slowest [m].

        Shape (n * m, 3).
        """
        x, y = np.meshgrid(self.x, self.y, indexing="ij")
        return np.column_stack([x.ravel(), y.ravel(), np.full(x.size, height)])


def project_to_pixels(
    camera: Camera, p_T: NDArray[np.float64]
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64]]:
    """Return row, column and depth [m] of the pixels on which points (N, 3) [m] fall.

    Outside of the image the depth is NaN, and the pixel is arbitrary.
    """
    pixels, depth = camera.project_with_depth(p_T)
    columns, rows = np.rint(pixels).astype(np.int64).T
    within = (
        (rows >= 0)
        & (rows < camera.height)
        & (columns >= 0)
        & (columns < camera.width)
        & (depth > MIN_DEPTH)
    )
    return rows * within, columns * within, np.where(within, depth, np.nan)


def is_observed_free(observation: Observation, p_T: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return whether the camera sees past points, so that they are known to be free.

    Args:
        observation: Latest observation.
        p_T: Points in T [m]. Shape (N, 3).

    Returns:
        One bool for each point. Shape (N,).
    """
    rows, columns, depth = project_to_pixels(observation.camera, p_T)
    return np.asarray(observation.depth[rows, columns] >= depth)


class Footprint(NamedTuple):
    """Grid cells that must be free for an object, relative to that of its center of mass.

    Attributes:
        rows: Offset along x of a row of cells, and its first and last offset along y. The ends of
            the object come first, since they decide soonest that it does not fit. Shape (r, 3).
        border: The rows of the cells within `BORDER_WIDTH` of the footprint, and of itself. Shape
            (s, 3).
    """

    rows: NDArray[np.int64]
    border: NDArray[np.int64]


BORDER_WIDTH = 2 * CELL_SIZE
"""Width around a footprint in which taken cells count as touching it [m]."""


@njit(cache=True)
def _rows_within(sides, distance):  # type: ignore[no-untyped-def]
    """Return the rows of cells whose centers are within a distance of a convex polygon.

    Corners are not rounded off.

    Args:
        sides: Outward unit normal of each side, and minus its distance from the origin [m]. Shape
            (k, 3).
        distance: The distance [m].

    Returns:
        See `Footprint.rows`. Shape (r, 3).
    """
    reach = 0.0
    for k in range(len(sides)):
        reach = max(reach, distance - sides[k, 2])
    count = int(np.ceil(2 * reach / CELL_SIZE)) + 1
    rows = np.empty((2 * count + 1, 3), np.int64)
    n = 0
    for i in range(-count, count + 1):
        first, last = -float(count), float(count)
        for k in range(len(sides)):
            room = (distance - sides[k, 2]) / CELL_SIZE - sides[k, 0] * i + 1e-9
            if abs(sides[k, 1]) < 1e-9:
                if room < 0:
                    first, last = 1.0, 0.0
            elif sides[k, 1] > 0:
                last = min(last, np.floor(room / sides[k, 1]))
            else:
                first = max(first, np.ceil(room / sides[k, 1]))
        if first <= last:
            rows[n, 0], rows[n, 1], rows[n, 2] = i, int(first), int(last)
            n += 1
    ordered = np.empty((n, 3), np.int64)
    for k in range(n):  # from both ends inwards
        ordered[k] = rows[k // 2] if k % 2 == 0 else rows[n - 1 - k // 2]
    return ordered


def make_footprint(sides: NDArray[np.float64], clearance: float) -> Footprint:
    """Return the footprint of an object.

    Args:
        sides: Sides of its outline about its center of mass, see `_rows_within`. Shape (k, 3).
        clearance: Distance to keep from anything else [m].
    """
    # Half a cell more, so that no part of the outline lies in a cell that is not checked.
    distance = clearance + CELL_SIZE / 2
    return Footprint(_rows_within(sides, distance), _rows_within(sides, distance + BORDER_WIDTH))


@njit(cache=True)
def occluding_pixel(depth, camera, x, y, z):  # type: ignore[no-untyped-def]
    """Return the row and column of the pixel whose surface hides a point from the camera.

    Args:
        depth: Depth image [m]. Shape (height, width).
        camera: `Pinhole` of the camera.
        x: Position of the point in T [m].
        y: Position of the point in T [m].
        z: Position of the point in T [m].

    Returns:
        Row and column; -1 and -1 if the point is in view or out of the image.
    """
    p_x, p_y, point_depth = point_to_camera(camera, x, y, z)
    if point_depth <= MIN_DEPTH:
        return -1, -1
    u, v = project(camera, p_x, p_y, point_depth)
    column, row = int(np.rint(u)), int(np.rint(v))
    height, width = depth.shape
    if not (0 <= row < height and 0 <= column < width):
        return -1, -1
    if depth[row, column] < point_depth - DEPTH_TOLERANCE:
        return row, column
    return -1, -1


@njit(cache=True)
def _is_free(depth, camera, x, y, levels):  # type: ignore[no-untyped-def]
    """Return whether the camera sees through points at several heights above a cell."""
    height, width = depth.shape
    for level in levels:
        p_x, p_y, point_depth = point_to_camera(camera, x, y, level)
        if point_depth <= MIN_DEPTH:
            return False
        u, v = project(camera, p_x, p_y, point_depth)
        column, row = int(np.rint(u)), int(np.rint(v))
        if not (0 <= row < height and 0 <= column < width and depth[row, column] >= point_depth):
            return False
    return True


def levels_above(floor: float, height: float, camera: Camera) -> NDArray[np.float64]:
    """Return the heights at which a camera must see through the space of an object [m].

    Args:
        floor: Height of the object's lowest point [m].
        height: Height of the object above it [m].
        camera: The camera.
    """
    levels = floor + DEPTH_TOLERANCE + np.arange(0, height, _HEIGHT_STEP)
    if not camera.is_vertical:
        # A tilted camera may see the space below the topmost level but not the level.
        levels = np.append(levels, floor + height)
    return levels


@lru_cache(maxsize=64)
def _pixels_of_cells(
    camera: Camera, support: Support, level: float
) -> tuple[NDArray[np.int32], NDArray[np.float64]]:
    """Return the pixels on which the centers of a support's cells fall at a height.

    Args:
        camera: The camera.
        support: The support.
        level: The height [m].

    Returns:
        Flat indices of the pixels, and depths, which are infinite outside of the image [m]. Shapes
        (n, m).
    """
    grid = Grid.over(support)
    rows, columns, depth = project_to_pixels(camera, grid.points(level))
    shape = (len(grid.x), len(grid.y))
    pixels = (rows * camera.width + columns).astype(np.int32).reshape(shape)
    return pixels, np.where(np.isnan(depth), np.inf, depth).reshape(shape)


@njit(cache=True)
def _seen_through(depth, pixels, cell_depth, free):  # type: ignore[no-untyped-def]
    """Return which free cells the camera sees past, see `_pixels_of_cells`."""
    result = np.empty_like(free)
    for i in range(free.shape[0]):
        for j in range(free.shape[1]):
            result[i, j] = free[i, j] and depth[pixels[i, j]] >= cell_depth[i, j]
    return result


def free_cells(
    observation: Observation, level: float, free: NDArray[np.bool_] | None
) -> NDArray[np.bool_]:
    """Return which cells of the support are free at a height, too.

    Args:
        observation: The observation.
        level: The height [m].
        free: Cells that are free at other heights; None for all. Shape (n, m).
    """
    pixels, cell_depth = _pixels_of_cells(observation.camera, observation.support, level)
    if free is None:
        free = np.ones(pixels.shape, np.bool_)
    return np.asarray(_seen_through(observation.depth.reshape(-1), pixels, cell_depth, free))


@njit(cache=True)
def next_free_cell(depth, camera, x, y, levels, rows, cells, start, state):  # type: ignore[no-untyped-def]
    """Return the index of the next cell above which a footprint is free.

    Args:
        depth: Depth image [m]. Shape (height, width).
        camera: `Pinhole` of the camera.
        x: Centers of the grid's cells along x [m]. Shape (n,).
        y: Centers of the grid's cells along y [m]. Shape (m,).
        levels: Heights that must be free [m].
        rows: See `Footprint`. Shape (r, 3).
        cells: Candidates. Shape (c, 2).
        start: Index of the first candidate to check.
        state: What is known of each cell: 0 for nothing, 1 for free, 2 for not free; it is updated.
            Shape (n, m).

    Returns:
        The index; c if there is no further one.
    """
    n, m = len(x), len(y)
    for position in range(start, len(cells)):
        fits = True
        for k in range(len(rows)):
            i = cells[position, 0] + rows[k, 0]
            first, last = cells[position, 1] + rows[k, 1], cells[position, 1] + rows[k, 2]
            if i < 0 or first < 0 or i >= n or last >= m:
                fits = False
                break
            for j in range(first, last + 1):
                if state[i, j] == 0:
                    state[i, j] = 1 if _is_free(depth, camera, x[i], y[j], levels) else 2
                if state[i, j] == 2:
                    fits = False
                    break
            if not fits:
                break
        if fits:
            return position
    return len(cells)


@njit(cache=True)
def visible_top_cells(depth, mask, camera, x, y, floor, center, outline):  # type: ignore[no-untyped-def]
    """Return the cells within an outline at which the camera sees an object's top.

    Args:
        depth: Depth image [m]. Shape (height, width).
        mask: Pixels of the object. Shape (height, width).
        camera: `Pinhole` of the camera.
        x: Centers of the grid's cells along x [m]. Shape (n,).
        y: Centers of the grid's cells along y [m]. Shape (m,).
        floor: Height of the top [m].
        center: Point from which the cells are ordered, the nearest first [m]. Shape (2,).
        outline: Corners of the convex outline relative to that point, counter-clockwise [m]. Shape
            (k, 2), k > 2.

    Returns:
        Cells. Shape (c, 2).
    """
    height, width = depth.shape
    reach = 0.0
    for k in range(len(outline)):
        reach = max(reach, np.hypot(outline[k, 0], outline[k, 1]))
    size = int(2 * reach / CELL_SIZE) + 3
    cells = np.empty((size * size, 2), np.int64)
    distance = np.empty(size * size)
    count = 0
    for i in range(
        max(0, np.searchsorted(x, center[0] - reach)),
        min(len(x), np.searchsorted(x, center[0] + reach)),
    ):
        for j in range(
            max(0, np.searchsorted(y, center[1] - reach)),
            min(len(y), np.searchsorted(y, center[1] + reach)),
        ):
            right, back = x[i] - center[0], y[j] - center[1]
            inside = True
            for k in range(len(outline)):
                after = (k + 1) % len(outline)
                ex = outline[after, 0] - outline[k, 0]
                ey = outline[after, 1] - outline[k, 1]
                if ex * (back - outline[k, 1]) - ey * (right - outline[k, 0]) < 0:
                    inside = False
                    break
            if not inside:
                continue
            p_x, p_y, point_depth = point_to_camera(camera, x[i], y[j], floor)
            if point_depth <= MIN_DEPTH:
                continue
            u, v = project(camera, p_x, p_y, point_depth)
            column, row = int(np.rint(u)), int(np.rint(v))
            if (
                0 <= row < height
                and 0 <= column < width
                and mask[row, column]
                and abs(depth[row, column] - point_depth) < DEPTH_TOLERANCE
            ):
                cells[count, 0], cells[count, 1] = i, j
                distance[count] = np.hypot(right, back)
                count += 1
    return cells[np.argsort(distance[:count], kind="mergesort")]


@njit(cache=True)
def _count_taken(taken_before, i, first, last):  # type: ignore[no-untyped-def]
    """Return how many cells of a row are taken; those beyond the grid are."""
    n, m = taken_before.shape[0], taken_before.shape[1] - 1
    length = last + 1 - first
    if i < 0 or i >= n:
        return length
    begin, end = max(first, 0), min(last, m - 1) + 1
    return length - (end - begin) + taken_before[i, end] - taken_before[i, begin]


@njit(cache=True)
def best_fits(free, rows, border, distance, distance_weight, best):  # type: ignore[no-untyped-def]
    """Return the cells at which a footprint fits and touches most, all of equal score.

    The score is the fraction of the border's cells that are taken, plus a weight times a distance.

    Args:
        free: Cells that are free; those beyond the grid are taken. Shape (n, m).
        rows: See `Footprint`. Shape (r, 3).
        border: See `Footprint`. Shape (s, 3).
        distance: Distance of each cell from the center [m]. Shape (n, m).
        distance_weight: Weight of the distance [1/m].
        best: Score that must be exceeded.

    Returns:
        Cells, in order, shape (k, 2), and their score; no cell if none exceeds `best`.
    """
    n, m = free.shape
    taken_before = np.zeros((n, m + 1), np.int16)
    next_taken = np.full((n, m + 1), m, np.int16)
    for i in range(n):
        for j in range(m):
            taken_before[i, j + 1] = taken_before[i, j] + (not free[i, j])
            next_taken[i, m - 1 - j] = next_taken[i, m - j] if free[i, m - 1 - j] else m - 1 - j
    own = 0
    low, high = 0, 0  # offsets along x
    left, right = 0, 0  # offsets along y
    for k in range(len(rows)):
        own += rows[k, 2] - rows[k, 1] + 1
        low, high = min(low, rows[k, 0]), max(high, rows[k, 0])
        left, right = min(left, rows[k, 1]), max(right, rows[k, 2])
    total = -own
    for k in range(len(border)):
        total += border[k, 2] - border[k, 1] + 1
    cells = np.empty((n * m, 2), np.int64)
    count = 0
    for i in range(-low, n - high):
        j = -left
        while j < m - right:
            step = m  # Number of further cells with the same answer.
            fits = True
            for k in range(len(rows)):
                taken = next_taken[i + rows[k, 0], j + rows[k, 1]]
                if taken <= j + rows[k, 2]:
                    fits = False
                    step = taken - rows[k, 1] + 1 - j
                    break
                step = min(step, taken - j - rows[k, 2])
            if not fits:
                j += step
                continue
            for position in range(j, min(j + step, m - right)):
                touching = 0
                for k in range(len(border)):
                    touching += _count_taken(
                        taken_before,
                        i + border[k, 0],
                        position + border[k, 1],
                        position + border[k, 2],
                    )
                score = touching / total + distance_weight * distance[i, position]
                if score > best + _SCORE_TOLERANCE:
                    best, count = score, 0
                elif count == 0 or score < best - _SCORE_TOLERANCE:
                    continue
                cells[count, 0], cells[count, 1] = i, position
                count += 1
            j += step
    return cells[:count], best
