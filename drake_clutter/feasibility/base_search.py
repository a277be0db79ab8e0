"""Search for the best base of an arm: all of a grid by a map, the best of them by the planner.

Frames: T is the support, B is the robot's base.
"""

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drake_clutter.cell.work_cell import WorkCell
from drake_clutter.feasibility.arm_clearance import ObstacleTops
from drake_clutter.feasibility.inverse_reachability import InverseReachabilityMap
from drake_clutter.feasibility.move_poses import find_move_poses
from drake_clutter.feasibility.move_study import LegalMove
from drake_clutter.feasibility.setups import Sweep
from drake_clutter.files import input_error
from drake_clutter.planning.pick_place_planner import PickPlacePlanner
from drake_clutter.planning.planner_config import PlannerConfig
from drake_clutter.scenes.scene import Scene
from drake_clutter.validation import load_config_as

Floats = NDArray[np.float64]

MAX_BASES = 50_000
"""Largest number of bases in a search."""
NUM_FINALISTS = 5
"""Number of bases that are studied by the planner after a search."""
SHARE_TOLERANCE = 0.01
"""Bases whose share is lower by at most this count as equal to the best."""
_BASE_FIELDS = tuple(f"robot.base.{axis}" for axis in ("x", "y", "z", "yaw"))


@dataclass(frozen=True, eq=False)
class BaseGrid:
    """Bases that a search compares, for one robot with its tool.

    Attributes:
        cell: Work cell whose base is replaced.
        settings: Settings that make this cell from the first one, such as `gripper.extension=0.2`.
        bases: x, y, z [m] and yaw [rad] of the bases. Shape (m, 4).
    """

    cell: WorkCell
    settings: tuple[str, ...]
    bases: Floats

    def settings_of(self, index: int) -> tuple[str, ...]:
        """Return the settings that make the cell with one of the bases from the first cell."""
        x, y, z, yaw = self.bases[index].tolist()
        values = (x, y, z, math.degrees(yaw))
        names = zip(_BASE_FIELDS, values, strict=True)
        return (*self.settings, *(f"{name}={value:.6g}" for name, value in names))


def make_base_grids(cell: WorkCell, searches: Sequence[Sweep]) -> tuple[BaseGrid, ...]:
    """Return the bases of a search; those that stand in the support are left out.

    Args:
        cell: Work cell.
        searches: Fields and their values. Each combination of fields that are not of the base
            gives one grid.

    Raises:
        InputError: There are too many bases, none, or a field or a value is not allowed.
    """
    if any(cell.robot.base.rpy_deg[:2]):
        raise input_error("--search", "the base is tilted; expected an upright one")
    count = math.prod(len(search.values) for search in searches)
    if count > MAX_BASES:
        raise input_error("--search", f"{count} bases; expected at most {MAX_BASES}")
    values = {search.field: search.values for search in searches}
    x, y, z = cell.robot.base.translation
    present = dict(zip(_BASE_FIELDS, (x, y, z, cell.robot.base.rpy_deg[2]), strict=True))
    axes = [values.pop(name, (value,)) for name, value in present.items()]
    bases = np.array([*itertools.product(*axes)])
    grids = []
    for others in itertools.product(*values.values()):
        settings = tuple(f"{n}={value:g}" for n, value in zip(values, others, strict=True))
        grid = BaseGrid(load_config_as(cell, settings=settings), settings, bases)
        grids.append(_without_overlaps(grid))
    if not sum(len(grid.bases) for grid in grids):
        raise input_error("--search", "all bases stand in the support; expected some beside it")
    return tuple(grids)


def _without_overlaps(grid: BaseGrid) -> BaseGrid:
    """Return a grid without the bases in the support; the yaw then is in radians."""
    robot = grid.cell.robot
    kept = []
    for x, y, z, yaw in grid.bases.tolist():
        rpy = (*robot.base.rpy_deg[:2], yaw)
        base = robot.base.model_copy(update={"translation": (x, y, z), "rpy_deg": rpy})
        moved = grid.cell.model_copy(update={"robot": robot.model_copy(update={"base": base})})
        if not moved.pedestal_overlaps_support:
            kept.append((x, y, z, math.radians(yaw)))
    return BaseGrid(grid.cell, grid.settings, np.array(kept).reshape(-1, 4))


def find_reachable_moves(
    grid: BaseGrid,
    maps: Mapping[str, InverseReachabilityMap],
    scene: Scene,
    moves: Sequence[LegalMove],
) -> list[NDArray[np.bool_] | None]:
    """Return which bases reach each legal move of a scene, by the map.

    Args:
        grid: The bases.
        maps: Inverse reachability of the robot with each tool, by name.
        scene: The scene.
        moves: Its legal moves.

    Returns:
        Whether each base reaches each move, shape (m,); None for a move that is not possible.
    """
    config = PlannerConfig()
    cell = grid.cell.with_support(scene.support)
    planner = PickPlacePlanner(cell, config)
    tops = {
        name: ObstacleTops.from_scene(scene, reachability.arm.radii + config.min_distance)
        for name, reachability in maps.items()
    }
    indices = {o.name: k for k, o in enumerate(scene.objects)}
    found: list[NDArray[np.bool_] | None] = []
    for legal in moves:
        picked = scene[legal.move.pick]
        if legal.command is None or not planner.can_pick(picked, scene.objects):
            found.append(None)
            continue
        is_reachable = np.zeros(len(grid.bases), bool)
        for grasps in planner.graspable_faces(picked):
            for name, reachability in maps.items():
                # The sides are for bases that reach no grasp from above, as in planning.
                pending = np.flatnonzero(~is_reachable)
                of_tool = [grasp for grasp in grasps if grasp.tool == name]
                if not len(pending) or not of_tool:
                    continue
                poses = find_move_poses(
                    picked, indices[picked.name], legal.command.X_TO_place, of_tool, config
                )
                reaches = reachability.find_reachable(
                    poses, grid.bases[pending], cell.table_height, tops[name]
                )
                is_reachable[pending] = reaches[:, 0]
        found.append(is_reachable)
    return found


def select_finalists(grids: Sequence[BaseGrid], shares: Sequence[Floats]) -> list[tuple[int, int]]:
    """Return the bases that the planner compares: of the best ones, some that lie far apart.

    The first is the one with the best neighborhood, the others are each the farthest from those
    that were selected before.

    Args:
        grids: The grids.
        shares: Share of the possible moves that each base reaches, by grid.

    Returns:
        Index of the grid, and of the base in it.
    """
    best = max(float(share.max()) for share in shares if len(share))
    candidates = [
        (k, int(index))
        for k, share in enumerate(shares)
        for index in np.flatnonzero(share >= best - SHARE_TOLERANCE)
    ]
    points = np.array([_features(grids[k].bases[index]) for k, index in candidates])
    everything = np.vstack([_features(grid.bases) for grid in grids])
    share = np.concatenate([*shares])
    # The mean over all bases within 15 cm: a base whose neighbors are as good is a safe choice.
    near = np.linalg.norm(points[:, None] - everything[None], axis=2) < 0.15
    robustness = (near * share).sum(axis=1) / near.sum(axis=1)
    selected = [int(robustness.argmax())]
    while len(selected) < min(NUM_FINALISTS, len(candidates)):
        distances = np.linalg.norm(points[:, None] - points[selected][None], axis=2).min(axis=1)
        if distances.max() == 0.0:
            break
        selected.append(int(distances.argmax()))
    return [candidates[k] for k in selected]


def _features(bases: Floats) -> Floats:
    """Return points whose distance compares bases [m]; a turn by 1 rad counts as 0.2 m."""
    return np.asarray(bases * [1.0, 1.0, 1.0, 0.2])
