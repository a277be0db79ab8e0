"""Free placements of a picked object that the camera can verify."""

from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import distance_transform_edt
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from drake_clutter.catalog import ObjectClass, RestOrientation, Shape
from drake_clutter.cell.camera import Camera
from drake_clutter.cell.pinhole import MIN_DEPTH, point_to_camera, project
from drake_clutter.cell.support import Support
from drake_clutter.compilation import njit
from drake_clutter.config import ExplorationConfig
from drake_clutter.scenes.geometry import objects_resting_on
from drake_clutter.scenes.interfaces import Detection, Move, Observation, PickPlaceCommand
from drake_clutter.scenes.scene import TRAY, Pose, SceneObject
from drake_clutter.stability import equilibrium
from drake_clutter.stability.shape_table import MAX_LEVEL_DIFFERENCE, ShapeTable

CELL_SIZE = 0.005
"""Side of the grid cells on the support in which placements are searched [m]."""
_DEPTH_TOLERANCE = 0.004
"""Largest difference of depths that count as equal [m]."""
_HEIGHT_STEP = 0.020
"""Distance between the heights at which the space above a cell is checked [m]."""
_EDGE_MARGIN = 0.005
"""Smallest distance of a center of mass from the carrying face's edge [m]."""
_MAX_OFFSET_FRACTION = 0.25
"""Largest offset of the centers of mass on an object that is not convex, relative to its width.

Farther off, an object would hang on one side of a rim.
"""
_MAX_RESTING_TILT = np.radians(5.0)
"""An object that is tilted by less counts as resting, and keeps its orientation [rad]."""
_YAWS = (0.0, np.pi / 2)
"""Rotations of the picked object that are tried, in this order [rad]."""


@dataclass(frozen=True)
class _Grid:
    """Square cells over the support's floor.

    Attributes:
        x: Their centers along x [m]. Shape (n,).
        y: Their centers along y [m]. Shape (m,).
    """

    x: NDArray[np.float64]
    y: NDArray[np.float64]

    @staticmethod
    @lru_cache(maxsize=16)
    def over(support: Support) -> "_Grid":
        """Return the grid of a support."""
        counts = [int(side / CELL_SIZE) for side in support.size]
        x, y = (
            np.asarray((np.arange(count) - (count - 1) / 2) * CELL_SIZE, float) for count in counts
        )
        return _Grid(x, y)

    def centers(self, cells: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return the centers of cells (k, 2) [m]. Shape (k, 2)."""
        return np.column_stack([self.x[cells[:, 0]], self.y[cells[:, 1]]])

    def points(self, height: float) -> NDArray[np.float64]:
        """Return the centers of all cells at a height, x varying slowest [m].

        Shape (n * m, 3).
        """
        x, y = np.meshgrid(self.x, self.y, indexing="ij")
        return np.column_stack([x.ravel(), y.ravel(), np.full(x.size, height)])


def _project_to_pixels(
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
    rows, columns, depth = _project_to_pixels(observation.camera, p_T)
    return np.asarray(observation.depth[rows, columns] >= depth)


class _OrientedObject(NamedTuple):
    """A picked object in the orientation in which it is placed.

    Attributes:
        quaternion: Quaternion of R_TO; unchanged if the object is not rotated.
        lowest: Height of its lowest point relative to its origin (negative) [m].
        height: Height of the object [m].
        center_of_mass: Horizontal position of the center of mass relative to the origin [m]. Shape
            (2,).
        footprint: Grid cells relative to that of its center of mass that must be free, the
            outermost first. Shape (k, 2).
    """

    quaternion: tuple[float, float, float, float]
    lowest: float
    height: float
    center_of_mass: NDArray[np.float64]
    footprint: NDArray[np.int64]


def resting_quaternion(
    object_class: ObjectClass, quaternion: tuple[float, float, float, float]
) -> tuple[float, float, float, float]:
    """Return the orientation at rest that is closest to an orientation.

    An object that is nearly at rest keeps its orientation, and so does a mesh, whose faces are not
    known here. A can is put upright, a marker on its side.

    Args:
        object_class: Class of the object.
        quaternion: Quaternion of R_TO.
    """
    R_TO = Pose((0.0, 0.0, 0.0), quaternion).rotation
    if object_class.shape is Shape.MESH:
        return quaternion
    is_upright = abs(R_TO[2, 2]) > np.cos(np.pi / 4)
    if object_class.only_rest is not None:
        is_upright = object_class.only_rest is RestOrientation.UPRIGHT
    if object_class.shape is Shape.CYLINDER and not is_upright:
        level = R_TO[:, 2] * [1.0, 1.0, 0.0]
        turn = _rotation_between(R_TO[:, 2], level)
    else:
        is_can = object_class.shape is Shape.CYLINDER
        axis = 2 if is_can else int(np.argmax(np.abs(R_TO[2])))
        turn = _rotation_between(R_TO[:, axis], [0.0, 0.0, np.sign(R_TO[2, axis])])
    if turn.magnitude() < _MAX_RESTING_TILT:
        return quaternion
    return Pose.from_rotation(turn.as_matrix() @ R_TO, (0.0, 0.0, 0.0)).quaternion


def _rotation_between(start: ArrayLike, end: ArrayLike) -> Rotation:
    """Return the smallest rotation that turns a direction (3,) into another one (3,)."""
    a, b = (np.asarray(v, float) / np.linalg.norm(v) for v in (start, end))
    axis = np.cross(a, b)
    sine = float(np.linalg.norm(axis))
    angle = np.arctan2(sine, a @ b)
    return Rotation.from_rotvec(axis * (angle / sine) if sine > 0 else np.zeros(3))


@lru_cache(maxsize=4096)
def _orient_object(
    object_class: ObjectClass,
    quaternion: tuple[float, float, float, float],
    yaw: float,
    clearance: float,
) -> _OrientedObject:
    """Return an object rotated about the vertical, with its footprint and clearance."""
    cosine, sine = np.cos(yaw), np.sin(yaw)
    R_TO = (
        np.array([[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1]])
        @ Pose((0.0, 0.0, 0.0), quaternion).rotation
    )
    center_of_mass = R_TO @ object_class.center_of_mass
    corners = object_class.corners @ R_TO.T - [*center_of_mass[:2], 0.0]
    reach = int(np.ceil((np.abs(corners[:, :2]).max() + clearance) / CELL_SIZE))
    offsets = np.arange(-reach, reach + 1)
    x, y = np.meshgrid(offsets, offsets, indexing="ij")
    lines = ConvexHull(corners[:, :2]).equations
    outside = (lines[:, :2] @ np.vstack([x.ravel(), y.ravel()]) * CELL_SIZE + lines[:, 2:]).max(
        axis=0
    )
    # Half a cell more, so that no part of the footprint lies in a cell that is not checked.
    covered = np.column_stack([x.ravel(), y.ravel()])[outside <= clearance + CELL_SIZE / 2]
    outermost_first = np.argsort(-np.abs(covered).max(axis=1), kind="stable")
    oriented = quaternion if yaw == 0 else Pose.from_rotation(R_TO, (0.0, 0.0, 0.0)).quaternion
    return _OrientedObject(
        oriented,
        float(corners[:, 2].min()),
        float(np.ptp(corners[:, 2])),
        center_of_mass[:2],
        covered[outermost_first],
    )


@lru_cache(maxsize=16)
def _tray_candidates(support: Support) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return the cells of the support with costs, the outermost first.

    Returns:
        Cells, shape (n, 2), and their negative distances from the center [m], shape (n,).
    """
    grid = _Grid.over(support)
    cells = np.argwhere(np.ones((len(grid.x), len(grid.y)), bool))
    cost = -np.abs(grid.centers(cells)).max(axis=1)
    order = np.argsort(cost, kind="stable")
    return cells[order], cost[order]


def _top_candidates(
    observation: Observation, target: Detection
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return the cells on an object's visible top with costs, the central ones first.

    Returns:
        Cells, shape (n, 2), and their distances from the center [m], shape (n,).
    """
    grid = _Grid.over(observation.support)
    corners = target.X_TO.apply(target.object_class.corners)
    floor = float(corners[:, 2].max())
    # One more cell all around: a pixel of the top's edge may lie in a cell with its center outside.
    axes = (grid.x, grid.y)
    lower = corners[:, :2].min(axis=0)
    upper = corners[:, :2].max(axis=0)
    x0, y0 = (
        max(int(np.searchsorted(axis, low)) - 1, 0) for axis, low in zip(axes, lower, strict=True)
    )
    x1, y1 = (int(np.searchsorted(axis, high)) + 1 for axis, high in zip(axes, upper, strict=True))
    x, y = np.meshgrid(grid.x[x0:x1], grid.y[y0:y1], indexing="ij")
    p_T = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, floor)])
    rows, columns, depth = _project_to_pixels(observation.camera, p_T)
    at_top = np.abs(observation.depth[rows, columns] - depth) < _DEPTH_TOLERANCE
    is_top = (at_top & target.mask[rows, columns]).reshape(x.shape)
    if not is_top.any():
        return np.empty((0, 2), np.int64), np.empty(0)
    first = np.array([x0, y0])
    center = grid.centers(np.argwhere(is_top) + first).mean(axis=0)
    inside = distance_transform_edt(np.pad(is_top, 1))[1:-1, 1:-1] * CELL_SIZE > _EDGE_MARGIN
    cells = np.argwhere(inside) + first
    cost = np.linalg.norm(grid.centers(cells) - center, axis=1)
    order = np.argsort(cost, kind="stable")
    return cells[order], cost[order]


class _Candidates(NamedTuple):
    """Cells over which the center of mass of a picked object may come to lie.

    Attributes:
        floor: Height on which the object is put [m].
        cells: Cells, the best first. Shape (n, 2).
        cost: Their costs, which do not decrease. Shape (n,).
    """

    floor: float
    cells: NDArray[np.int64]
    cost: NDArray[np.float64]


@lru_cache(maxsize=1024)
def _balanced_offsets(
    carrier_class: ObjectClass,
    carrier_quaternion: tuple[float, float, float, float],
    picked_class: ObjectClass,
    picked_quaternion: tuple[float, float, float, float],
) -> tuple[tuple[float, NDArray[np.int64]], ...]:
    """Return where an object balances on one that is not convex, as on its rim or in it.

    Returns:
        For each height at which the carrier has level faces, the highest first: the height over its
        origin [m], and offsets of the centers of mass in cells, the nearest first. Shapes (n, 2).
    """
    shapes = ShapeTable()
    rows = shapes.find_rows(
        [
            SceneObject("carrier", carrier_class, Pose((0.0, 0.0, 0.0), carrier_quaternion)),
            SceneObject("picked", picked_class, Pose((0.0, 0.0, 0.0), picked_quaternion)),
        ]
    )
    table = shapes.arrays.table
    carrier, picked = table[rows[0]], table[rows[1]]
    parts = table[carrier["first_part"] : carrier["last_part"]]
    heights = np.sort(parts["top_z"][parts["top_count"] > 2])[::-1]
    reach = _MAX_OFFSET_FRACTION * (carrier["upper"] - carrier["lower"])[:2].min() / CELL_SIZE
    axis = np.arange(-int(reach), int(reach) + 1)
    offsets = np.stack(np.meshgrid(axis, axis, indexing="ij"), axis=-1).reshape(-1, 2)
    distance = np.linalg.norm(offsets, axis=1)
    order = np.argsort(distance, kind="stable")
    offsets = offsets[order[distance[order] <= reach]]
    levels = []
    while len(heights):
        p_T = np.column_stack(
            [
                offsets * CELL_SIZE + (carrier["com"] - picked["com"])[:2],
                np.full(len(offsets), heights[0] - picked["bottom_z"]),
            ]
        )
        balanced = equilibrium.balanced_positions(table, rows[0], rows[1], p_T, _EDGE_MARGIN)
        if balanced.any():
            levels.append((float(heights[0]), offsets[balanced]))
        heights = heights[heights < heights[0] - MAX_LEVEL_DIFFERENCE]
    return tuple(levels)


def _candidates_on_pieces(
    observation: Observation,
    carrier: Detection,
    picked_class: ObjectClass,
    picked_quaternion: tuple[float, float, float, float],
) -> list[_Candidates]:
    """Return the cells at which a picked object balances on one that is not convex."""
    grid = _Grid.over(observation.support)
    p_Tcm = carrier.X_TO.apply(carrier.object_class.center_of_mass[None])[0]
    center = np.array([np.abs(grid.x - p_Tcm[0]).argmin(), np.abs(grid.y - p_Tcm[1]).argmin()])
    levels = _balanced_offsets(
        carrier.object_class, carrier.X_TO.quaternion, picked_class, picked_quaternion
    )
    return [
        _Candidates(
            carrier.X_TO.translation[2] + height,
            center + offsets,
            np.linalg.norm(offsets, axis=1) * CELL_SIZE,
        )
        for height, offsets in levels
    ]


@njit(cache=True)
def _first_free_cells(depth, camera, x, y, levels, footprint, cells, cost):  # type: ignore[no-untyped-def]
    """Return the first cells above which the footprint is free, all of equal cost.

    Args:
        depth: Depth image [m]. Shape (height, width).
        camera: `Pinhole` of the camera.
        x: Centers of the grid's cells along x [m]. Shape (n,).
        y: Centers of the grid's cells along y [m]. Shape (m,).
        levels: Heights that must be free [m].
        footprint: Cells relative to that of the center of mass. Shape (k, 2).
        cells: Candidates, ordered by cost. Shape (c, 2).
        cost: Costs of the candidates. Shape (c,).

    Returns:
        Indices of the candidates.
    """
    height, width = depth.shape
    n, m = len(x), len(y)
    state = np.zeros((n, m), np.int8)  # 0: not checked yet, 1: free, 2: not free
    fitting = np.empty(len(cells), np.int64)
    count = 0
    for position in range(len(cells)):
        if count and cost[position] > cost[fitting[0]] + 1e-9:
            break
        fits = True
        for k in range(len(footprint)):
            i, j = cells[position, 0] + footprint[k, 0], cells[position, 1] + footprint[k, 1]
            if i < 0 or j < 0 or i >= n or j >= m:
                fits = False
                break
            if state[i, j] == 0:
                state[i, j] = 1
                for level in levels:
                    p_x, p_y, point_depth = point_to_camera(camera, x[i], y[j], level)
                    is_free = False
                    if point_depth > MIN_DEPTH:
                        u, v = project(camera, p_x, p_y, point_depth)
                        column, row = int(np.rint(u)), int(np.rint(v))
                        is_free = (
                            0 <= row < height
                            and 0 <= column < width
                            and depth[row, column] >= point_depth
                        )
                    if not is_free:
                        state[i, j] = 2
                        break
            if state[i, j] == 2:
                fits = False
                break
        if fits:
            fitting[count] = position
            count += 1
    return fitting[:count]


def top_height(detection: Detection) -> float:
    """Return the height of a detected object's highest point [m]."""
    return float(detection.X_TO.apply(detection.object_class.corners)[:, 2].max())


def has_clear_top(observation: Observation, detection: Detection) -> bool:
    """Return whether the camera sees the space right above an object's whole top.

    An object that is not convex holds no other detected object, either.
    """
    if len(detection.object_class.convex_pieces) > 1:
        objects = [SceneObject(d.name, d.object_class, d.X_TO) for d in observation.detections]
        carrier = SceneObject(detection.name, detection.object_class, detection.X_TO)
        if objects_resting_on(carrier, [o for o in objects if o.name != detection.name]):
            return False
    corners = detection.X_TO.apply(detection.object_class.corners)
    top = float(corners[:, 2].max())
    grid = _Grid.over(observation.support)
    points = grid.points(top + _DEPTH_TOLERANCE)
    lines = ConvexHull(corners[:, :2]).equations
    over = (lines[:, :2] @ points[:, :2].T + lines[:, 2:]).max(axis=0) < 0
    return bool(is_observed_free(observation, points[over]).mean() > 0.98) if over.any() else True


class FreePlacements(NamedTuple):
    """Equally good poses at which a picked object can be released.

    Attributes:
        translations: p_TO [m]. Shape (n, 3), n > 0.
        quaternion: Quaternion of R_TO, the same for all poses.
    """

    translations: NDArray[np.float64]
    quaternion: tuple[float, float, float, float]


_PlacementCache = dict[tuple[Move, ExplorationConfig], FreePlacements | None]
_FREE_PLACEMENTS: WeakKeyDictionary[Observation, _PlacementCache] = WeakKeyDictionary()
"""Results of earlier searches, by observation.

Action filters and commands search for the same placements.
"""


def find_free_placements(
    observation: Observation,
    move: Move,
    config: ExplorationConfig,
) -> FreePlacements | None:
    """Return the equally good placements for a move, or None if none is known.

    The object keeps its orientation, or is rotated by a quarter turn about the vertical if only
    that fits; a tilted one is put down flat, see `resting_quaternion`. A placement is free where
    the camera sees through the space that the object will occupy, with its clearance. Shadows and
    the space where the picked object still stands are not free. On the support, the placements
    farthest from the center are returned: there the object occludes least and leaves the most room.
    On an object, the placements nearest to the center of the visible part of its top are returned;
    the center of mass is over that top. On an object that is not convex, they are those nearest to
    its center of mass where the picked object balances on level faces of its pieces: across the rim
    of a cup, or on its floor.

    Args:
        observation: Observation before the pick.
        move: What to pick and where to put it.
        config: Clearance and release height.

    Raises:
        KeyError: The move names an object that is not in view.
    """
    cached = _FREE_PLACEMENTS.setdefault(observation, {})
    if (move, config) not in cached:
        cached[move, config] = _search_placements(observation, move, config)
    return cached[move, config]


def _search_placements(
    observation: Observation,
    move: Move,
    config: ExplorationConfig,
) -> FreePlacements | None:
    """Return the placements for a move, see `find_free_placements`."""
    picked = observation[move.pick]
    grid = _Grid.over(observation.support)
    camera = observation.camera.pinhole
    target = None if move.place == TRAY else observation[move.place]
    if target is None:
        surfaces = [_Candidates(0.0, *_tray_candidates(observation.support))]
    elif len(target.object_class.convex_pieces) == 1:
        surfaces = [_Candidates(top_height(target), *_top_candidates(observation, target))]
    quaternion = resting_quaternion(picked.object_class, picked.X_TO.quaternion)
    for yaw in _YAWS:
        oriented = _orient_object(picked.object_class, quaternion, yaw, config.clearance)
        if target is not None and len(target.object_class.convex_pieces) > 1:
            surfaces = _candidates_on_pieces(
                observation, target, picked.object_class, oriented.quaternion
            )
        for floor, cells, cost in surfaces:
            height = oriented.height + config.release_height
            levels = floor + _DEPTH_TOLERANCE + np.arange(0, height, _HEIGHT_STEP)
            if not observation.camera.is_vertical:
                # A tilted camera may see the space below the topmost level but not the level.
                levels = np.append(levels, floor + oriented.height + config.release_height)
            arguments = (grid.x, grid.y, levels, oriented.footprint, cells, cost)
            best = _first_free_cells(observation.depth, camera, *arguments)
            if len(best):
                # Order by cell, so that a random choice does not depend on the sorting by cost.
                best = best[np.lexsort(cells[best].T[::-1])]
                z = np.full(len(best), floor + config.release_height - oriented.lowest)
                xy = grid.centers(cells[best]) - oriented.center_of_mass
                translations = np.column_stack([xy, z])
                return FreePlacements(translations, oriented.quaternion)
    return None


def resolve_placement(
    move: Move, observation: Observation, config: ExplorationConfig, rng: np.random.Generator
) -> PickPlaceCommand | None:
    """Return the command for a move, or None if no placement is known to be free.

    Args:
        move: What to pick and where to put it.
        observation: Observation before the pick.
        config: Clearance and release height.
        rng: Draws one of several equally good placements.

    Raises:
        KeyError: The move names an object that is not in view.
        ValueError: The move puts an object on itself.
    """
    if move.place == move.pick:
        raise ValueError(f"move {move}: expected another object, or {TRAY}, as the place")
    placements = find_free_placements(observation, move, config)
    if placements is None:
        return None
    x, y, z = placements.translations[rng.integers(len(placements.translations))].tolist()
    X_TO_place = Pose((x, y, z), placements.quaternion)
    return PickPlaceCommand(move, observation[move.pick].X_TO, X_TO_place)
