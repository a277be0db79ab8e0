"""Reachability maps of the arm in its empty cell.

Frames: T is the support, G is the first tool of the gripper. The cell has all its fixtures, and no
objects.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drake_clutter.cell.work_cell import WorkCell
from drake_clutter.planning.pick_place_planner import PickPlacePlanner
from drake_clutter.planning.planner_config import PlannerConfig
from drake_clutter.planning.tool_kinematics import downward_pose

Floats = NDArray[np.float64]

NUM_YAWS = 12
"""Yaw angles at each grid point: every 30 degrees, as the planner samples them by default."""
WALL_MARGIN = 0.05
"""Distance of the grid from the walls of the support [m]; grasps closer to a wall are rare."""
_BASE_MAP_HEIGHTS = (0.05, 0.25, 0.45)
"""Heights of the map that scores a base position [m]: tops of flat objects to high stacks."""
_BASE_MAP_SPACING = 0.15
"""Grid spacing of the map that scores a base position [m]."""


@dataclass(frozen=True)
class ReachabilityResult:
    """Reachability of gripper poses.

    Attributes:
        num_solutions: Number of collision-free inverse kinematics solutions. Shape (m,).
        manipulability: Largest manipulability of these [m^3]; 0 without a solution. Shape (m,).
        q: Joint positions with that manipulability; NaN without a solution. Shape (m, n).
        blocking_bodies: Names of the colliding pair where all solutions are in collision, else "".
    """

    num_solutions: NDArray[np.int64]
    manipulability: Floats
    q: Floats
    blocking_bodies: tuple[str, ...]


class ReachabilityAnalysis:
    """Reachability analysis of the arm of a work cell."""

    def __init__(self, cell: WorkCell) -> None:
        """Build the collision model of the empty cell.

        Args:
            cell: Work cell.

        Raises:
            InputError: The robot's model cannot be used.
        """
        self._cell = cell
        self._planner = PickPlacePlanner(cell, PlannerConfig())
        self._tool = next(iter(self._planner.tools.values()))
        self._collision_model = self._planner.collision_model(())
        self._min_distance = self._planner.config.min_distance

    def analyze_poses(self, X_TG: Floats) -> ReachabilityResult:
        """Return the reachability of poses.

        Args:
            X_TG: Poses of the first tool. Shape (m, 4, 4).
        """
        robot = self._planner.robot
        q = self._tool.solve_ik(X_TG)
        manipulability = np.nan_to_num(robot.manipulability(q), nan=-1.0)
        num_solutions = np.zeros(len(q), int)
        best_manipulability = np.zeros(len(q))
        best_q = np.full((len(q), robot.num_joints), np.nan)
        blocking_bodies = [""] * len(q)
        for k in range(len(q)):
            for solution in np.argsort(-manipulability[k]):
                if manipulability[k, solution] < 0:
                    break
                q_solution = robot.unwrap(q[k, solution], robot.home)
                pairs = self._collision_model.distances_below(q_solution, self._min_distance)
                if pairs:
                    nearest = min(pairs, key=lambda pair: pair.distance)
                    blocking_bodies[k] = blocking_bodies[k] or " and ".join(nearest.pair)
                    continue
                if num_solutions[k] == 0:
                    best_manipulability[k] = manipulability[k, solution]
                    best_q[k] = q_solution
                num_solutions[k] += 1
        return ReachabilityResult(
            num_solutions,
            best_manipulability,
            best_q,
            tuple(
                "" if count else bodies
                for count, bodies in zip(num_solutions, blocking_bodies, strict=True)
            ),
        )

    def compute_map(self, heights: Sequence[float], spacing: float) -> "ReachabilityMap":
        """Return the reachability of downward gripper poses on a grid over the support.

        Args:
            heights: Heights of G above the floor of the support [m].
            spacing: Grid spacing along x and y [m].
        """
        half_size = self._cell.support.half_size
        ends = np.maximum(half_size - WALL_MARGIN, half_size / 2).tolist()
        x_grid, y_grid = (
            np.linspace(-end, end, max(2, round(2 * end / spacing) + 1)) for end in ends
        )
        shape = len(heights), len(x_grid), len(y_grid)
        reachable_fraction = np.zeros(shape)
        manipulability = np.zeros(shape)
        yaws = np.arange(NUM_YAWS) * (2 * np.pi / NUM_YAWS)
        for k, height in enumerate(heights):
            for i, x in enumerate(x_grid):
                for j, y in enumerate(y_grid):
                    p_TG = np.array([x, y, height])
                    result = self.analyze_poses(
                        np.array([downward_pose(yaw, p_TG) for yaw in yaws])
                    )
                    reachable_fraction[k, i, j] = np.mean(result.num_solutions > 0)
                    manipulability[k, i, j] = result.manipulability.max()
        return ReachabilityMap(tuple(heights), x_grid, y_grid, reachable_fraction, manipulability)


@dataclass(frozen=True)
class ReachabilityMap:
    """Reachability of downward gripper poses on a grid.

    Attributes:
        heights: Heights of G above the floor of the support [m].
        x: Grid coordinates along x of T [m]. Shape (n_x,).
        y: Grid coordinates along y of T [m]. Shape (n_y,).
        reachable_fraction: Fraction of the yaw angles that are reachable without collision.
            Shape (n_heights, n_x, n_y).
        manipulability: Largest manipulability over the yaw angles [m^3]. Shape
            (n_heights, n_x, n_y).
    """

    heights: tuple[float, ...]
    x: Floats
    y: Floats
    reachable_fraction: Floats
    manipulability: Floats


def score_base_positions(
    cell: WorkCell, positions: Sequence[tuple[float, float]]
) -> list[tuple[float, float]]:
    """Return mean reachable fraction and mean manipulability [m^3] of base positions.

    A base that overlaps the support scores (0, 0).

    Args:
        cell: Work cell, which gives height and orientation of the base.
        positions: Positions x and y of the base in T [m].
    """
    scores = []
    for x, y in positions:
        base = cell.robot.base.model_copy(
            update={"translation": (x, y, cell.robot.base.translation[2])}
        )
        moved_cell = cell.model_copy(update={"robot": cell.robot.model_copy(update={"base": base})})
        if moved_cell.pedestal_overlaps_support:
            scores.append((0.0, 0.0))
            continue
        analysis = ReachabilityAnalysis(moved_cell)
        reachability = analysis.compute_map(_BASE_MAP_HEIGHTS, _BASE_MAP_SPACING)
        scores.append(
            (
                float(reachability.reachable_fraction.mean()),
                float(reachability.manipulability.mean()),
            )
        )
    return scores
