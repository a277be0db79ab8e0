"""Reachability of poses of the tool in a work cell without objects.

Frames: T is the support, G is the first tool of the gripper.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drake_clutter.cell.work_cell import WorkCell
from drake_clutter.feasibility.margins import scaled_jacobians
from drake_clutter.planning.collision_model import CollisionModel
from drake_clutter.planning.planner_config import PlannerConfig
from drake_clutter.planning.tool_kinematics import ToolKinematics, downward_pose
from drake_clutter.robots.robot_model import load_robot

Floats = NDArray[np.float64]

NUM_DIRECTIONS = 12
"""Number of yaws of a vertical tool, and of directions in which a tool is tilted."""
TILTS_DEG = (0.0, 30.0, 60.0, 90.0)
"""Angles of the tool from straight down in a map [deg]; 90 is horizontal."""
WALL_MARGIN = 0.05
"""Distance of the grid from the walls of the support [m]; grasps closer to a wall are rare."""


@dataclass(frozen=True)
class PoseReachability:
    """Reachability of poses of the tool.

    Attributes:
        num_solutions: Number of inverse kinematics solutions. Shape (m,).
        q: The collision-free solution farthest from singularities; NaN without one. Shape (m, n).
        singular_value: Its smallest singular value, see `MoveMargins`; 0 without one. Shape (m,).
        obstacles: What the arm collides with in its best solution, where all collide; else "".
    """

    num_solutions: NDArray[np.int64]
    q: Floats
    singular_value: Floats
    obstacles: tuple[str, ...]

    @property
    def is_reachable(self) -> NDArray[np.bool_]:
        """Whether there is a collision-free solution. Shape (m,)."""
        return np.isfinite(self.q[:, 0])


@dataclass(frozen=True)
class ReachabilityMap:
    """Reachability of tool poses on a grid over the support.

    Attributes:
        tilts_deg: Angles of the tool from straight down [deg].
        heights: Heights of G above the floor of the support [m].
        x: Grid coordinates along x of T [m]. Shape (n_x,).
        y: Grid coordinates along y of T [m]. Shape (n_y,).
        reachable_fraction: Fraction of the directions that are reachable without collision. Shape
            (n_tilts, n_heights, n_x, n_y).
        singular_value: Largest over the directions, see `MoveMargins`. Same shape.
    """

    tilts_deg: tuple[float, ...]
    heights: tuple[float, ...]
    x: Floats
    y: Floats
    reachable_fraction: Floats
    singular_value: Floats


def tilted_pose(tilt: float, direction: float, p_TG: Floats) -> Floats:
    """Return X_TG of a tool that points down and to a side. Shape (4, 4).

    Args:
        tilt: Angle from straight down [rad].
        direction: Yaw of the side to which it points; the yaw of a vertical tool [rad].
        p_TG: Position [m]. Shape (3,).
    """
    X = downward_pose(direction, p_TG)
    c, s = math.cos(tilt), math.sin(tilt)
    # A turn about the tool's y axis takes its z axis from straight down towards its x axis.
    X[:3, :3] = X[:3, :3] @ np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])
    return X


class ReachabilityAnalysis:
    """Reachability analysis of the arm in its cell with all fixtures and no objects."""

    def __init__(self, cell: WorkCell) -> None:
        """Build the collision model of the empty cell.

        Args:
            cell: Work cell.

        Raises:
            InputError: The robot's model cannot be used.
        """
        self._cell = cell
        self._robot = load_robot(cell.robot)
        self._tool = ToolKinematics(cell, next(iter(cell.gripper.tools)))
        self._collision_model = CollisionModel(cell, ())

    def analyze_poses(self, X_TG: Floats) -> PoseReachability:
        """Return the reachability of poses.

        Args:
            X_TG: Poses of the first tool. Shape (m, 4, 4).
        """
        robot = self._robot
        q = robot.unwrap(self._tool.solve_ik(X_TG), robot.home)
        is_solution = np.isfinite(q[..., 0])
        singular_values = np.zeros(is_solution.shape)
        J = scaled_jacobians(robot, q[is_solution])
        if len(J):
            singular_values[is_solution] = np.linalg.svd(J, compute_uv=False)[:, -1]
        order = np.argsort(-singular_values, axis=1, kind="stable")
        best_q = np.full((len(q), robot.num_joints), np.nan)
        best_value = np.zeros(len(q))
        obstacles = [""] * len(q)
        pending = np.flatnonzero(is_solution.any(axis=1))
        # The best solution of every pose is checked first, then the next of those that collide.
        for column in range(q.shape[1]):
            pending = pending[is_solution[pending, order[pending, column]]]
            if not len(pending):
                break
            solutions = order[pending, column]
            found = self._find_obstacles(q[pending, solutions])
            is_clear = np.array([not text for text in found])
            clear = pending[is_clear]
            best_q[clear] = q[clear, solutions[is_clear]]
            best_value[clear] = singular_values[clear, solutions[is_clear]]
            for k, text in zip(pending.tolist(), found, strict=True):
                obstacles[k] = (obstacles[k] or text) if text else ""
            pending = pending[~is_clear]
        return PoseReachability(is_solution.sum(axis=1), best_q, best_value, tuple(obstacles))

    def _find_obstacles(self, q: Floats) -> list[str]:
        """Return the closest bodies that are closer than the planner allows, or "", at each q."""
        found = self._collision_model.distances_along(q, PlannerConfig().min_distance)
        names = [""] * len(q)
        # The closest pair of each configuration is the last that is written.
        for k in np.argsort(-found.distances, kind="stable").tolist():
            pair = self._collision_model.signed_distance(found, k).pair
            names[found.rows[k]] = " and ".join(pair)
        return names

    def compute_map(
        self, tilts_deg: Sequence[float], heights: Sequence[float], spacing: float
    ) -> ReachabilityMap:
        """Return the reachability of tool poses on a grid over the support.

        Args:
            tilts_deg: Angles of the tool from straight down [deg].
            heights: Heights of G above the floor of the support [m].
            spacing: Grid spacing along x and y [m].
        """
        half_size = self._cell.support.half_size
        ends = np.maximum(half_size - WALL_MARGIN, half_size / 2).tolist()
        x, y = (np.linspace(-end, end, max(2, round(2 * end / spacing) + 1)) for end in ends)
        directions = np.arange(NUM_DIRECTIONS) * (2 * math.pi / NUM_DIRECTIONS)
        points = [np.array([i, j, z]) for z in heights for i in x for j in y]
        fractions, values = [], []
        for tilt in np.radians(tilts_deg).tolist():
            poses = [tilted_pose(tilt, d, p_TG) for p_TG in points for d in directions]
            found = self.analyze_poses(np.array(poses))
            fractions.append(found.is_reachable.reshape(-1, NUM_DIRECTIONS).mean(axis=1))
            values.append(found.singular_value.reshape(-1, NUM_DIRECTIONS).max(axis=1))
        shape = len(tilts_deg), len(heights), len(x), len(y)
        return ReachabilityMap(
            tuple(tilts_deg),
            tuple(heights),
            x,
            y,
            np.array(fractions).reshape(shape),
            np.array(values).reshape(shape),
        )
