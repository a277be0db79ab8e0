"""Kinematics of a cell's gripper, and ways of the robot along poses of it.

Frames: T the support; B the robot's base; F its flange; G the gripper. Poses are arrays here, as
the robot's compiled kinematics takes them in batches.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drake_clutter.cell.work_cell import WorkCell
from drake_clutter.planning.time_parameterization import MAX_JOINT_STEP, linear_joint_path
from drake_clutter.robots.robot_model import RobotModel, load_robot

Floats = NDArray[np.float64]

_MAX_POSE_STEP = 0.02
"""Between neighboring poses of a straight line [m]."""


def invert_pose(X_AB: Floats) -> Floats:
    """Return X_BA, (4, 4), of X_AB (4, 4)."""
    X_AB = np.ascontiguousarray(X_AB)
    X = np.eye(4)
    X[:3, :3] = X_AB[:3, :3].T
    X[:3, 3] = -X_AB[:3, :3].T @ X_AB[:3, 3]
    return X


def downward_pose(yaw: float, p_TG: Floats) -> Floats:
    """Return X_TG, (4, 4), of a gripper that points down.

    Args:
        yaw: About the vertical [rad].
        p_TG: [m]. Shape (3,).
    """
    c, s = math.cos(yaw), math.sin(yaw)
    X = np.eye(4)
    X[:3, :3] = np.array([[c, s, 0.0], [s, -c, 0.0], [0.0, 0.0, -1.0]])
    X[:3, 3] = p_TG
    return X


def raise_pose(X_TG: Floats, height: float) -> Floats:
    """Return a pose (4, 4) that is higher by `height` [m]."""
    X = X_TG.copy()
    X[2, 3] += height
    return X


def _vertical_line(X_TG: Floats, top: float) -> Floats:
    """Return poses (m, 4, 4) straight up to a height [m]."""
    heights = np.linspace(
        X_TG[2, 3], top, max(2, math.ceil((top - X_TG[2, 3]) / _MAX_POSE_STEP) + 1)
    )
    X = np.broadcast_to(X_TG, (len(heights), 4, 4)).copy()
    X[:, 2, 3] = heights
    return X


def _straight_line(X_TG: Floats, X_TG_end: Floats) -> Floats:
    """Return poses (m, 4, 4) on a straight line that turn evenly about the vertical."""
    turn = X_TG_end[:3, :3] @ X_TG[:3, :3].T
    angle, shift = math.atan2(turn[1, 0], turn[0, 0]), X_TG_end[:3, 3] - X_TG[:3, 3]
    count = max(
        2,
        math.ceil(max(float(np.linalg.norm(shift)) / _MAX_POSE_STEP, abs(angle) / MAX_JOINT_STEP))
        + 1,
    )
    X = np.empty((count, 4, 4))
    for k, share in enumerate(np.linspace(0.0, 1.0, count)):
        c, s = math.cos(share * angle), math.sin(share * angle)
        X[k] = X_TG
        X[k, :3, :3] = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]) @ X_TG[:3, :3]
        X[k, :3, 3] += share * shift
    return X


@dataclass(frozen=True)
class CarryPath:
    """A way from a grasp over a height to a place.

    Attributes:
        lift: Straight up from the grasp. Shape (k, n).
        transfer: From the end of `lift` to that of `reversed_lowering`. Shape (l, n).
        reversed_lowering: Straight up from the place. Shape (m, n).
    """

    lift: Floats
    transfer: Floats
    reversed_lowering: Floats

    @property
    def waypoints(self) -> Floats:
        """From the grasp to the place, each configuration once."""
        return np.vstack([self.lift, self.transfer[1:-1], self.reversed_lowering[::-1]])


class ToolKinematics:
    """Kinematics of a cell's gripper.

    Attributes:
        robot: That carries it.
    """

    def __init__(self, cell: WorkCell) -> None:
        """Load the robot.

        Raises:
            InputError: The robot's model cannot be used.
        """
        self.robot: RobotModel = load_robot(cell.robot)
        X_TB, X_FG = self.robot.X_TB, cell.gripper.X_FG
        self._X_TB, self._X_FG = X_TB.GetAsMatrix4(), X_FG.GetAsMatrix4()
        self._X_BT, self._X_GF = X_TB.inverse().GetAsMatrix4(), X_FG.inverse().GetAsMatrix4()

    def pose(self, q: Floats) -> Floats:
        """Return X_TG, (..., 4, 4), at joint positions (..., n)."""
        return np.asarray(self._X_TB @ self.robot.forward_kinematics(q) @ self._X_FG)

    def axis(self, q: Floats) -> Floats:
        """Return the gripper's z axis in T, (..., 3), at joint positions (..., n)."""
        return self.pose(q)[..., :3, 2]

    def solve_ik(self, X_TG: Floats) -> Floats:
        """Return joint positions (..., K, n) at poses (..., 4, 4), see `InverseKinematics`."""
        return self.robot.ik.solve(self._flange_pose(X_TG))

    def track(self, X_TG: Floats, q_start: Floats) -> Floats | None:
        """Return the path (m, n) along poses (m, 4, 4), see `InverseKinematics`."""
        return self.robot.ik.track(self._flange_pose(X_TG), q_start)

    def _flange_pose(self, X_TG: Floats) -> Floats:
        return np.asarray(self._X_BT @ X_TG @ self._X_GF)

    def carry_path(
        self,
        X_pick: Floats,
        X_place: Floats,
        transfer_height: float,
        q_pick: Floats,
        q_place: Floats,
    ) -> CarryPath | str:
        """Return a way from a grasp to a place on which the gripper points down.

        A robot with `vertical_tool_rows` keeps it so on a straight line in joint space. Any other
        robot follows a straight line in space, and arrives at the place as that leads it.

        Args:
            X_pick: X_TG at the grasp. Shape (4, 4).
            X_place: X_TG at the place. Shape (4, 4).
            transfer_height: Height of G in between [m].
            q_pick: At the grasp. Shape (n,).
            q_place: At the place, for a robot with `vertical_tool_rows`. Shape (n,).

        Returns:
            The way, or what is out of reach.
        """
        up = self.track(_vertical_line(X_pick, transfer_height), q_pick)
        if up is None:
            return "above the grasp"
        above = _vertical_line(X_place, transfer_height)
        if self.robot.vertical_tool_rows is not None:
            down = self.track(above, q_place)
            if down is None:
                return "above the place"
            return CarryPath(up, linear_joint_path(up[-1], down[-1]), down)
        across = self.track(
            _straight_line(_vertical_line(X_pick, transfer_height)[-1], above[-1]), up[-1]
        )
        if across is None:
            return "between grasp and place"
        lowered = self.track(above[::-1], across[-1])
        return "above the place" if lowered is None else CarryPath(up, across, lowered[::-1])

    def paths_home(self, q: Floats) -> list[Floats]:
        """Return ways home, (m, n) each.

        The first is straight. The second stays at the same height until G is, seen from above,
        where it is at home.
        """
        home = self.robot.home
        X_TG_home, X_TG = self.pose(home), self.pose(q)
        X_TG[:2, 3] = X_TG_home[:2, 3]
        back, direct = self.robot.ik.follow(self._flange_pose(X_TG), q), linear_joint_path(q, home)
        if back is None:
            return [direct]
        return [direct, np.vstack([linear_joint_path(q, back), linear_joint_path(back, home)[1:]])]
