"""Search for a home configuration: beside the camera's view, clear of the cell, close to the work.

Frames: T is the support, G is a tool of the gripper, C is a camera.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drake_clutter.cell.gripper import Payload
from drake_clutter.cell.work_cell import WorkCell
from drake_clutter.planning.arm_dynamics import arm_dynamics
from drake_clutter.planning.collision_model import VIEW, CollisionModel, SignedDistance
from drake_clutter.planning.planner_config import PlannerConfig
from drake_clutter.planning.time_parameterization import linear_joint_path, min_travel_time
from drake_clutter.planning.tool_kinematics import ToolKinematics, downward_pose
from drake_clutter.robots.robot_model import load_robot

Floats = NDArray[np.float64]

CLEARANCE = 0.02
"""Smallest distance of the arm at a found home from the cell and from the camera's view [m]."""
VIEW_HEIGHT = 0.3
"""Height above the support's floor up to which the camera sees it past the arm at home [m]."""
LIMIT_MARGIN = math.radians(5.0)
"""Smallest distance of a found home from the joint limits [rad]."""
NUM_SAMPLES = 2**14
"""Number of configurations that are considered."""
MAX_CONNECTIONS = 40
"""Number of configurations from which ways to the work are checked, the closest ones first."""
NUM_COMPARED = 5
"""Number of homes with ways to all of the work that are compared by ways to other solutions."""
_WORK_HEIGHTS = (0.10, 0.35)
"""Heights of the work above the floor of the support [m]."""
_WORK_YAWS = (0.0, math.pi / 2)


@dataclass(frozen=True)
class Home:
    """A home configuration.

    Attributes:
        q: Joint positions [rad or m].
        is_given: Whether it is that of the cell file.
        obstacle: What the home of the cell file collides with or hides from the camera, where it is
            replaced; else "".
    """

    q: tuple[float, ...]
    is_given: bool
    obstacle: str = ""


def view_corners(cell: WorkCell) -> Floats:
    """Return the corners of the volume between the first camera and the support. Shape (9, 3)."""
    x, y = cell.support.half_size
    box = [(i, j, z) for i in (-x, x) for j in (-y, y) for z in (0.0, VIEW_HEIGHT)]
    return np.array([*box, cell.camera.X_TC.translation()])


class HomeSearch:
    """Finds the home configuration of a work cell."""

    def __init__(self, cell: WorkCell) -> None:
        """Build the collision model of the empty cell with the camera's view.

        Args:
            cell: Work cell.

        Raises:
            InputError: The robot's model cannot be used.
        """
        self._robot = load_robot(cell.robot)
        self._cell = cell
        self._tool = ToolKinematics(cell, next(iter(cell.gripper.tools)))
        self._collision_model = CollisionModel(cell, (), view=view_corners(cell))

    def find_obstacle(self, q: Floats) -> SignedDistance | None:
        """Return what is closest to the arm, if it is closer than the planner allows.

        Args:
            q: Joint positions. Shape (n,).
        """
        pairs = self._collision_model.distances_below(q, PlannerConfig().min_distance)
        return min(pairs, key=lambda pair: pair.distance, default=None)

    def find_home(self, *, keep: bool) -> Home | str:
        """Return a home, or the reason why there is none.

        Candidates are spread evenly over the joint ranges. The closest to the work in time is
        returned that is clear of cell and view, holds the arm within half the torque limits, and
        from which the arm reaches the space above the work on straight lines in joint space. Of the
        first few, it is the one with such lines to the most inverse kinematics solutions.

        Args:
            keep: Whether the home of the cell is returned if it keeps the planner's distance.
        """
        given = self._robot.home
        obstacle = self.find_obstacle(given)
        if keep and obstacle is None:
            return Home(tuple(given.tolist()), is_given=True)
        blocking = "" if obstacle is None else " and ".join(obstacle.pair)
        work, alternatives, collision = self._work_configurations()
        if not len(work):
            if collision is None:
                return "no part of the support is in reach"
            return f"in collision wherever the support is in reach: {' and '.join(collision.pair)}"
        candidates = self._candidates()
        times = min_travel_time(candidates[:, None] - work[None], self._robot).mean(axis=1)
        best: list[Floats] = []
        most = 1
        for k in np.argsort(times, kind="stable")[:MAX_CONNECTIONS].tolist():
            connected = self._count_connected(candidates[k], work)
            if connected > most:
                best, most = [], connected
            if connected == most:
                best.append(candidates[k])
            if most == len(work) and len(best) == NUM_COMPARED:
                break
        if not best:
            return "no configuration clears the cell and the camera's view"
        home = max(best, key=lambda q: self._count_connected(q, alternatives))
        return Home(tuple(home.round(6).tolist()), is_given=False, obstacle=blocking)

    def _count_connected(self, home: Floats, work: Floats) -> int:
        return sum(self._is_connected(home, q) for q in work)

    def _work_configurations(self) -> tuple[Floats, Floats, SignedDistance | None]:
        """Return configurations of a downward tool above the support.

        Returns:
            For each position the solution closest to the middle of the joint ranges that is clear
            of the cell, shape (k, n); the clear solutions of other branches, which objects in the
            way of the first call for, shape (m, n); and a collision of a solution that is not
            clear, if there is one.
        """
        x, y = 0.6 * self._cell.support.half_size
        middle = self._robot.position_limits.mean(axis=1)
        found, others = [], []
        collision = None
        for px, py in ((0.0, 0.0), (-x, -y), (-x, y), (x, -y), (x, y)):
            for pz in _WORK_HEIGHTS:
                poses = [downward_pose(yaw, np.array([px, py, pz])) for yaw in _WORK_YAWS]
                q = self._tool.solve_ik(np.array(poses)).reshape(-1, self._robot.num_joints)
                q = self._robot.unwrap(q[np.isfinite(q[:, 0])], middle)
                q = q[np.argsort(np.abs(q - middle).max(axis=1), kind="stable")]
                collisions = [self._find_collision(row) for row in q]
                clear = [row for row, pair in zip(q, collisions, strict=True) if pair is None]
                if collision is None:
                    collision = next((distance for distance in collisions if distance), None)
                found += clear[:1]
                others += clear[1:]
        shape = -1, self._robot.num_joints
        return np.array(found).reshape(shape), np.array(others).reshape(shape), collision

    def _find_collision(self, q: Floats) -> SignedDistance | None:
        """Return the closest bodies but the camera's view, if the planner does not allow it."""
        pairs = self._collision_model.distances_below(q, PlannerConfig().min_distance)
        return min(
            (pair for pair in pairs if VIEW not in pair.pair),
            key=lambda pair: pair.distance,
            default=None,
        )

    def _candidates(self) -> Floats:
        """Return clear configurations within joint and half the torque limits. Shape (m, n)."""
        robot = self._robot
        lower, upper = robot.position_limits.T
        # A turn is enough where a joint can make several.
        middle, half = (lower + upper) / 2, np.minimum((upper - lower) / 2, math.pi)
        from scipy.stats import qmc  # imported late: it takes long

        unit = qmc.Sobol(robot.num_joints, rng=0).random(NUM_SAMPLES)
        q = middle + (half - LIMIT_MARGIN) * (2 * unit - 1)
        rest = np.zeros_like(q)
        moved = arm_dynamics(self._cell, Payload()).motion(q, rest, rest, np.zeros((1, 3)))
        q = q[(np.abs(moved.gravity_torques) < robot.torque_limits / 2).all(axis=1)]
        found = self._collision_model.distances_along(q, CLEARANCE)
        is_to_arm = self._collision_model.is_to_arm(found)
        is_close = ~is_to_arm | (found.distances < PlannerConfig().min_distance)
        is_clear = np.ones(len(q), bool)
        is_clear[found.rows[is_close]] = False
        return np.asarray(q[is_clear])

    def _is_connected(self, home: Floats, q: Floats) -> bool:
        """Return whether a straight line in joint space is clear of the cell."""
        path = linear_joint_path(home, self._robot.unwrap(q, home))
        threshold = PlannerConfig().min_distance
        found = self._collision_model.distances_along(path, threshold)
        pairs = {
            self._collision_model.signed_distance(found, k).pair for k in range(len(found.rows))
        }
        return all(VIEW in pair for pair in pairs)
