"""Collision-free motions of the arm without an object between two configurations."""

import itertools
import math
from collections.abc import Callable, Iterator, Sequence

import numpy as np
from numpy.typing import NDArray
from pydrake.trajectories import Trajectory

from drake_clutter.cell.gripper import Payload
from drake_clutter.cell.work_cell import WorkCell
from drake_clutter.planning.collision_model import CollisionModel, SignedDistance
from drake_clutter.planning.motion_limits import LimitViolation, MotionLimits
from drake_clutter.planning.motion_plan import stay_at
from drake_clutter.planning.pick_place_plan import (
    FailureLog,
    PlanningFailure,
    PlanningFailureReason,
)
from drake_clutter.planning.planner_config import PlannerConfig
from drake_clutter.planning.state_check import JOINT_TOLERANCE
from drake_clutter.planning.time_parameterization import (
    MAX_JOINT_STEP,
    bspline_path,
    linear_joint_path,
    min_travel_time,
    parameterize_time_optimal,
    sample_path,
)
from drake_clutter.planning.tool_kinematics import ToolKinematics

Floats = NDArray[np.float64]

MAX_EXTENSIONS = 2000
"""Largest number of attempts to extend a tree; then no path is found."""
TREE_STEP = 0.4
"""Largest distance of a configuration to its parent in a tree [rad]."""
_NUM_SHORTCUTS = 100
"""Attempts to shorten a path by a straight line between two of its points."""
_SAMPLING_MARGIN = math.pi / 2
"""Distance by which sampled joint positions lie beyond those of start and goal [rad]."""


class TransferPlanner:
    """Plan motions of the arm in joint space, in the poses that a collision model has.

    Straight lines come first, then RRT-Connect (Kuffner and LaValle 2000, "RRT-Connect: An
    efficient approach to single-query path planning") with shortcuts. The random numbers have a
    fixed seed.
    """

    def __init__(
        self, cell: WorkCell, config: PlannerConfig, tool: ToolKinematics, model: CollisionModel
    ) -> None:
        """Prepare the planner.

        Args:
            cell: Work cell.
            config: Parameters of the planner.
            tool: Kinematics of the tool that retracts on the way.
            model: Collision model with the objects at their poses.
        """
        self._config = config
        self._tool = tool
        self._model = model
        self._robot = tool.robot
        self._limits = MotionLimits(cell, Payload())

    def plan(self, q_start: Floats, goals: Sequence[Floats]) -> Trajectory | PlanningFailure:
        """Return a trajectory to one of several configurations, or why there is none.

        An arm that is there stays at rest for `DWELL_TIME`.

        Args:
            q_start: Joint positions at the start. Shape (n,).
            goals: Joint positions, any of which is a goal. Shapes (n,).
        """
        if any(np.abs(q - q_start).max() < JOINT_TOLERANCE for q in goals):
            return stay_at(q_start)
        failures = FailureLog()
        reason = PlanningFailureReason.IN_COLLISION
        free = list[Floats]()
        for q_goal in sorted(goals, key=lambda q: self._travel_time(q - q_start)):
            if (closest := self._find_collision(q_goal[None])) is not None:
                names = " and ".join(closest.pair)
                failures.record(1, reason, f"at the goal: {names}", closest.distance)
            else:
                free.append(q_goal)
        if not goals:
            failures.record(0, PlanningFailureReason.UNREACHABLE, "the goal")
        for search in (self._straight_paths, self.tree_paths):
            for q_goal in free:
                for waypoints in search(q_start, q_goal):
                    path = bspline_path(waypoints)
                    closest = self._find_collision(sample_path(path))
                    if closest is not None:
                        names = " and ".join(closest.pair)
                        failures.record(2, reason, f"move: {names}", closest.distance)
                        continue
                    trajectory = parameterize_time_optimal(path, self._limits)
                    if not isinstance(trajectory, LimitViolation):
                        return trajectory.to_trajectory()
                    failures.record(
                        3,
                        PlanningFailureReason.TRAJECTORY_INFEASIBLE,
                        f"move: {trajectory}",
                        trajectory.ratio,
                    )
        return failures.furthest

    def _travel_time(self, displacement: Floats) -> float:
        return float(min_travel_time(displacement, self._robot))

    def _find_collision(self, path: Floats) -> SignedDistance | None:
        """Return the smallest distance along a path if it is too small. Shape (m, n)."""
        found = self._model.distances_along(path, self._config.min_distance)
        if not len(found.distances):
            return None
        return self._model.signed_distance(found, int(found.distances.argmin()))

    def _is_free(self, q: Floats, q_end: Floats) -> bool:
        """Return whether a straight line in joint space is free of collisions. Shapes (n,)."""
        count = max(2, math.ceil(np.abs(q_end - q).max() / (MAX_JOINT_STEP / 2)) + 1)
        return self._find_collision(np.linspace(q, q_end, count)) is None

    def _straight_paths(self, q_start: Floats, q_goal: Floats) -> Iterator[Floats]:
        """Yield the candidate paths that need no search. Shapes (m, n)."""
        yield from self._tool.paths_between(q_start, q_goal)
        for path in self._tool.paths_between(q_goal, q_start)[1:]:
            yield path[::-1]

    def tree_paths(self, q_start: Floats, q_goal: Floats) -> Iterator[Floats]:
        """Yield the path of RRT-Connect if it finds one. Shape (m, n)."""
        rng = np.random.default_rng(0)
        lower, upper = self._robot.position_limits.T
        low = np.maximum(np.minimum(q_start, q_goal) - _SAMPLING_MARGIN, lower)
        high = np.minimum(np.maximum(q_start, q_goal) + _SAMPLING_MARGIN, upper)
        corners = connect_trees(
            q_start, q_goal, self._is_free, lambda: rng.uniform(low, high), MAX_EXTENSIONS
        )
        if corners is None:
            return
        corners = shorten_path(corners, self._is_free, rng)
        # The spline cuts corners: points on both sides keep it close to the checked lines.
        lines = [linear_joint_path(*ends) for ends in itertools.pairwise(corners)]
        yield np.vstack([lines[0], *(line[1:] for line in lines[1:])])


def connect_trees(
    q_start: Floats,
    q_goal: Floats,
    is_free: Callable[[Floats, Floats], bool],
    sample: Callable[[], Floats],
    max_extensions: int,
) -> list[Floats] | None:
    """Return the corners of a path that RRT-Connect finds, or None.

    Args:
        q_start: First configuration. Shape (n,).
        q_goal: Last configuration. Shape (n,).
        is_free: Whether a straight line between two configurations is free.
        sample: Draws a configuration.
        max_extensions: Largest number of attempts to extend a tree.
    """
    trees = (_Tree(q_start), _Tree(q_goal))
    num_extensions = 0
    while num_extensions < max_extensions:
        growing, other = trees
        trees = (other, growing)
        reached = growing.extend(sample(), is_free)
        num_extensions += 1
        if reached is None:
            continue
        target = growing.q[reached]
        while num_extensions < max_extensions:
            met = other.extend(target, is_free)
            num_extensions += 1
            if met is None:
                break
            if np.array_equal(other.q[met], target):
                branches = [growing.branch(reached), other.branch(met)]
                first, second = branches if growing.q[0] is q_start else branches[::-1]
                return [*first[::-1], *second[1:]]
    return None


class _Tree:
    """Tree of configurations that are joined by free straight lines."""

    def __init__(self, root: Floats) -> None:
        self.q = [root]
        self._parents = [-1]

    def extend(self, target: Floats, is_free: Callable[[Floats, Floats], bool]) -> int | None:
        """Add a configuration in the direction of a target, and return its index if it is free."""
        nearest = int(np.linalg.norm(np.array(self.q) - target, axis=1).argmin())
        q = self.q[nearest]
        distance = float(np.abs(target - q).max())
        if distance == 0.0:
            return nearest
        end = target if distance <= TREE_STEP else q + (target - q) * (TREE_STEP / distance)
        if not is_free(q, end):
            return None
        self.q.append(end)
        self._parents.append(nearest)
        return len(self.q) - 1

    def branch(self, index: int) -> list[Floats]:
        """Return the configurations from one to the root."""
        configurations = []
        while index >= 0:
            configurations.append(self.q[index])
            index = self._parents[index]
        return configurations


def shorten_path(
    corners: Sequence[Floats],
    is_free: Callable[[Floats, Floats], bool],
    rng: np.random.Generator,
) -> list[Floats]:
    """Return a path that replaces parts of another one by straight lines.

    Args:
        corners: Corners of the path. Shapes (n,).
        is_free: Whether a straight line between two configurations is free.
        rng: Draws the points that are joined.
    """
    path = [*corners]
    for _ in range(_NUM_SHORTCUTS):
        if len(path) < 3:
            break
        first, last = sorted(rng.choice(len(path), 2, replace=False).tolist())
        if last - first > 1 and is_free(path[first], path[last]):
            path = [*path[: first + 1], *path[last:]]
    return path
