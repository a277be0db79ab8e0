"""Free placements of a picked object that the camera can verify."""

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from typing import NamedTuple
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

from drake_clutter.catalog import ObjectClass
from drake_clutter.cell.support import Support
from drake_clutter.config import ExplorationConfig, PlacementConfig
from drake_clutter.scenes import free_space
from drake_clutter.scenes.free_space import (
    CELL_SIZE,
    DEPTH_TOLERANCE,
    Grid,
    is_observed_free,
    levels_above,
)
from drake_clutter.scenes.geometry import objects_resting_on
from drake_clutter.scenes.interfaces import Detection, Move, Observation, PickPlaceCommand
from drake_clutter.scenes.release_orientation import (
    OrientedObject,
    orient_object,
    resting_quaternion,
    yaw_steps,
)
from drake_clutter.scenes.scene import TRAY, Pose, SceneObject
from drake_clutter.stability import equilibrium, load_check
from drake_clutter.stability.shape_table import MAX_LEVEL_DIFFERENCE, ShapeTable

_EQUAL_DISTANCE = 1e-9
"""Largest difference of distances that count as equal [m]."""
_DISTANCE_WEIGHT = 1.0
"""Score of a placement on the support for its distance from the center [1/m].

The rest of the score is the touching fraction of the border, see `free_space.best_fits`.
"""


@lru_cache(maxsize=1024)
def _balanced_offsets(
    carrier_class: ObjectClass,
    carrier_quaternion: tuple[float, float, float, float],
    picked_class: ObjectClass,
    picked_quaternion: tuple[float, float, float, float],
    margin: float,
    max_offset_fraction: float,
) -> tuple[tuple[float, NDArray[np.int64]], ...]:
    """Return where an object balances on one that is not convex, as on its rim or in it.

    Args:
        carrier_class: Class of the object below.
        carrier_quaternion: Quaternion of its R_TO.
        picked_class: Class of the object above.
        picked_quaternion: Quaternion of its R_TO.
        margin: Width by which the contact is shrunk [m].
        max_offset_fraction: Largest offset of the centers of mass, relative to half the carrier's
            width.

    Returns:
        For each height at which the carrier has level faces, the highest first: the height over its
        origin [m], and offsets of the centers of mass in cells, the nearest first. Shapes (n, 2).
    """
    rows = _SHAPES.find_rows(
        [
            SceneObject("carrier", carrier_class, Pose((0.0, 0.0, 0.0), carrier_quaternion)),
            SceneObject("picked", picked_class, Pose((0.0, 0.0, 0.0), picked_quaternion)),
        ]
    )
    table = _SHAPES.arrays.table
    carrier, picked = table[rows[0]], table[rows[1]]
    parts = table[carrier["first_part"] : carrier["last_part"]]
    heights = np.sort(parts["top_z"][parts["top_count"] > 2])[::-1]
    half_width = (carrier["upper"] - carrier["lower"])[:2].min() / 2
    reach = max_offset_fraction * half_width / CELL_SIZE
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
        balanced = equilibrium.balanced_positions(table, rows[0], rows[1], p_T, margin)
        if balanced.any():
            levels.append((float(heights[0]), offsets[balanced]))
        heights = heights[heights < heights[0] - MAX_LEVEL_DIFFERENCE]
    return tuple(levels)


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
    grid = Grid.over(observation.support)
    points = grid.points(top + DEPTH_TOLERANCE)
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


_SHAPES = ShapeTable()
"""Oriented shapes of the objects of all observations."""


class _ObservedSpace:
    """What searches for placements derive from an observation, each once.

    Attributes:
        placements: Results of earlier searches. Action filters and commands search for the same
            placements.
    """

    def __init__(self) -> None:
        self.placements: dict[tuple[Move, ExplorationConfig], FreePlacements | None] = {}
        self._free = dict[tuple[float, ...], NDArray[np.bool_]]()
        self._contacts: NDArray[np.int64] | None = None

    def free_floor(
        self, observation: Observation, levels: NDArray[np.float64]
    ) -> NDArray[np.bool_]:
        """Return the cells of the support that are free at some levels. Shape (n, m)."""
        heights = tuple(levels.tolist())
        for k, height in enumerate(heights):
            if heights[: k + 1] not in self._free:
                below = self._free[heights[:k]] if k else None
                self._free[heights[: k + 1]] = free_space.free_cells(observation, height, below)
        return self._free[heights]

    def contacts(self, rows: NDArray[np.int64], p_T: NDArray[np.float64]) -> NDArray[np.int64]:
        """Return the contacts between all detected objects, see `load_check.known_contacts`."""
        if self._contacts is None:
            self._contacts = load_check.known_contacts(_SHAPES.arrays.table, rows, p_T)
        return self._contacts


_OBSERVED_SPACES: WeakKeyDictionary[Observation, _ObservedSpace] = WeakKeyDictionary()


def find_free_placements(
    observation: Observation,
    move: Move,
    config: ExplorationConfig,
) -> FreePlacements | None:
    """Return the equally good placements for a move, or None if none is known.

    A placement is free where the camera sees through the space that the object will occupy, with
    its clearance. Shadows and the space where the picked object still stands are not free. The
    object keeps its orientation or is rotated by a quarter turn about the vertical; if neither
    fits, by another multiple of 15 degrees. A tilted object is put down flat, see
    `resting_quaternion`.

    On the support, the placements that touch most of what is taken, and are far from the center,
    are returned: the free area stays whole.

    On an object, the placement nearest to its center of mass is returned at which the detected
    objects carry the picked one with the margins of `PlacementConfig`. There is none on a lying
    cylinder. On an object that is not convex, the picked object balances on level faces of its
    pieces: across the rim of a cup, or on its floor.

    Args:
        observation: Observation before the pick.
        move: What to pick and where to put it.
        config: Clearance, release height and margins.

    Raises:
        KeyError: The move names an object that is not in view.
    """
    space = _OBSERVED_SPACES.setdefault(observation, _ObservedSpace())
    if (move, config) not in space.placements:
        picked = observation[move.pick]
        if move.place != TRAY:
            observation[move.place]  # Raises an error if it is not in view.
        quaternion = resting_quaternion(picked.object_class, picked.X_TO.quaternion)
        placements = None
        for yaws in yaw_steps(picked.object_class, quaternion):
            turned = [
                orient_object(picked.object_class, quaternion, yaw, config.clearance)
                for yaw in yaws
            ]
            placements = (
                _search_support(observation, space, turned, config)
                if move.place == TRAY
                else _search_top(observation, space, move, turned, config)
            )
            if placements is not None:
                break
        space.placements[move, config] = placements
    return space.placements[move, config]


@lru_cache(maxsize=16)
def _distance_from_center(support: Support) -> NDArray[np.float64]:
    """Return the larger distance of each cell from the support's axes [m]. Shape (n, m)."""
    grid = Grid.over(support)
    return np.maximum(np.abs(grid.x)[:, None], np.abs(grid.y))


def _search_support(
    observation: Observation,
    space: _ObservedSpace,
    turned: Sequence[OrientedObject],
    config: ExplorationConfig,
) -> FreePlacements | None:
    """Return the best placements on the support; of equally good yaws, the first.

    Args:
        observation: Observation before the pick.
        space: What is known of its space.
        turned: The picked object at the yaws to be tried.
        config: Release height.
    """
    grid = Grid.over(observation.support)
    levels = levels_above(0.0, turned[0].height + config.release_height, observation.camera)
    free = space.free_floor(observation, levels)
    distance = _distance_from_center(observation.support)
    best_score = -math.inf
    best = None
    for oriented in turned:
        cells, score = free_space.best_fits(
            free,
            oriented.footprint.rows,
            oriented.footprint.border,
            distance,
            _DISTANCE_WEIGHT,
            best_score,
        )
        if len(cells):
            best, best_score = (oriented, cells), score
    if best is None:
        return None
    oriented, cells = best
    xy = grid.centers(cells) - oriented.center_of_mass
    return _placements(oriented, xy, config.release_height)


def _placements(oriented: OrientedObject, xy: NDArray[np.float64], height: float) -> FreePlacements:
    """Return the placements of an object at some positions.

    Args:
        oriented: The object.
        xy: Positions of its origin [m]. Shape (n, 2).
        height: Height of its lowest point [m].
    """
    z = np.full(len(xy), height - oriented.lowest)
    return FreePlacements(np.column_stack([xy, z]), oriented.quaternion)


def _search_top(
    observation: Observation,
    space: _ObservedSpace,
    move: Move,
    turned: Sequence[OrientedObject],
    config: ExplorationConfig,
) -> FreePlacements | None:
    """Return the placement on an object that is nearest to its center of mass.

    Args:
        observation: Observation before the pick.
        space: What is known of its space.
        move: The move.
        turned: The picked object at the yaws to be tried; of equally near placements, that of the
            first one is returned.
        config: Release height and margins.
    """
    detections = observation.detections
    names = [d.name for d in detections]
    pick, carrier = names.index(move.pick), names.index(move.place)
    objects = [SceneObject(d.name, d.object_class, d.X_TO) for d in detections]
    rows, p_T = _SHAPES.rows_and_positions(objects)
    carrier_shape = _SHAPES.arrays.table[rows[carrier]]
    if carrier_shape["rolls"]:
        return None
    pairs = space.contacts(rows, p_T)
    pairs = pairs[(pairs != pick).all(axis=1)]
    grid = Grid.over(observation.support)
    view = (observation.depth, observation.camera.pinhole, grid.x, grid.y)
    center = (p_T[carrier] + carrier_shape["com"])[:2]
    surfaces: _Surfaces | None = None
    if len(objects[carrier].object_class.convex_pieces) == 1:
        surfaces = _visible_top(observation, detections[carrier], carrier_shape, config.placement)
    margin = config.placement.contact_margin
    best = None
    best_distance = math.inf
    for oriented in turned:
        placed = replace(objects[pick], X_TO=Pose((0.0, 0.0, 0.0), oriented.quaternion))
        for floor, cells in surfaces or _tops_of_pieces(
            grid, objects[carrier], placed, config.placement
        ):
            distance = np.linalg.norm(grid.centers(cells) - center, axis=1)
            nearer = cells[distance < best_distance - _EQUAL_DISTANCE]
            levels = levels_above(
                floor, oriented.height + config.release_height, observation.camera
            )
            footprint = oriented.footprint.rows
            state = np.zeros((len(grid.x), len(grid.y)), np.int8)
            k = free_space.next_free_cell(*view, levels, footprint, nearer, 0, state)
            if k == len(nearer):
                continue
            (placed_row,) = _SHAPES.find_rows([placed])
            table = _SHAPES.arrays.table
            stack = load_check.collect_stack(
                table,
                _SHAPES.find_rows(objects),
                p_T,
                pairs,
                carrier,
                margin,
                config.placement.hidden_support_fraction,
            )
            while k < len(nearer):
                p_cell = grid.centers(nearer[k : k + 1])
                xy = p_cell - oriented.center_of_mass
                p_resting = np.array([*xy[0], floor - oriented.lowest])
                if load_check.is_carried(table, stack, margin, placed_row, p_resting):
                    best_distance = float(np.linalg.norm(p_cell - center))
                    best = _placements(oriented, xy, floor + config.release_height)
                    break
                k = free_space.next_free_cell(*view, levels, footprint, nearer, k + 1, state)
            if k < len(nearer):
                break
    return best


_Surfaces = list[tuple[float, NDArray[np.int64]]]
"""Heights on which an object can be put [m], the best first, each with cells.

The center of mass of the object may come to lie over the cells, shape (n, 2). Those nearest to the
center of mass of the object below come first.
"""


def _visible_top(
    observation: Observation, carrier: Detection, shape: np.void, margins: PlacementConfig
) -> _Surfaces:
    """Return the top of a convex object, as far as it is visible.

    Args:
        observation: Observation before the pick.
        carrier: The object.
        shape: Its shape, of type `SHAPE_DTYPE`.
        margins: Largest offset from its center of mass.
    """
    outline = shape["top"][: shape["top_count"]] - shape["com"][:2]
    if len(outline) < 3:
        return []
    grid = Grid.over(observation.support)
    floor = top_height(carrier)
    cells = free_space.visible_top_cells(
        observation.depth,
        carrier.mask,
        observation.camera.pinhole,
        grid.x,
        grid.y,
        floor,
        carrier.X_TO.p[:2] + shape["com"][:2],
        outline * margins.max_offset_fraction,
    )
    return [(floor, cells)]


def _tops_of_pieces(
    grid: Grid, carrier: SceneObject, placed: SceneObject, margins: PlacementConfig
) -> _Surfaces:
    """Return the surfaces on which an object balances on one that is not convex.

    Args:
        grid: Grid over the support.
        carrier: The object below.
        placed: The object above; only its orientation counts.
        margins: Margin of the contact, and largest offset from the carrier's center of mass.
    """
    p_Tcm = carrier.X_TO.apply(carrier.object_class.center_of_mass[None])[0]
    center = np.array([np.abs(grid.x - p_Tcm[0]).argmin(), np.abs(grid.y - p_Tcm[1]).argmin()])
    levels = _balanced_offsets(
        carrier.object_class,
        carrier.X_TO.quaternion,
        placed.object_class,
        placed.X_TO.quaternion,
        margins.contact_margin,
        margins.max_offset_fraction,
    )
    return [(carrier.X_TO.translation[2] + height, center + offsets) for height, offsets in levels]


def resolve_placement(
    move: Move, observation: Observation, config: ExplorationConfig, rng: np.random.Generator
) -> PickPlaceCommand | None:
    """Return the command for a move, or None if no placement is known to be free.

    A place that is a pose is taken as it is.

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
    X_TO_pick = observation[move.pick].X_TO
    if (X_TO_place := move.place_pose(X_TO_pick)) is not None:
        return PickPlaceCommand(move, X_TO_pick, X_TO_place)
    placements = find_free_placements(observation, move, config)
    if placements is None:
        return None
    x, y, z = placements.translations[rng.integers(len(placements.translations))].tolist()
    X_TO_place = Pose((x, y, z), placements.quaternion)
    return PickPlaceCommand(move, X_TO_pick, X_TO_place)
