"""Kinematics of robot and tool, and paths along poses of the tool.

Frames: T is the support, B is the robot's base, F is its flange, G is the tool. Poses are
arrays, because the compiled kinematics of the robot takes them in batches.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drake_clutter.cell.work_cell import WorkCell
from drake_clutter.planning.time_parameterization import MAX_JOINT_STEP, linear_joint_path
from drake_clutter.robots.robot_model import RobotModel, load_robot
from drake_clutter.robots.serial_chain import SerialChain

Floats = NDArray[np.float64]

DEPARTURE_DISTANCE = 0.02
"""Distance that a tilted tool moves along its axis at the start of a lift [m]."""
RISE_CORNER = 0.006
"""Length over which the path of a load changes from its first rise to horizontal motion [m]."""
_MAX_AXIAL_TILT = math.radians(46)
"""Largest tilt of a tool that a load leaves its place with along the axis of the tool [rad]: grasps
from above have up to 45 deg."""
_CORNER_HEIGHT = 0.02
"""Height over which a path changes from vertical to horizontal motion [m]."""
_MAX_TILT_DIFFERENCE = 1e-3
"""Largest difference of vertical directions in a tool that count as equal: objects at rest are
tilted by less."""
_MAX_POSE_STEP = 0.02
"""Largest distance between neighboring poses of a straight line [m]."""


def invert_pose(X_AB: Floats) -> Floats:
    """Return X_BA of X_AB. Shapes (4, 4)."""
    X_AB = np.ascontiguousarray(X_AB)
    X = np.eye(4)
    X[:3, :3] = X_AB[:3, :3].T
    X[:3, 3] = -X_AB[:3, :3].T @ X_AB[:3, 3]
    return X


def downward_pose(yaw: float, p_TG: Floats) -> Floats:
    """Return X_TG of a gripper that points down. Shape (4, 4).

    Args:
        yaw: Angle about the vertical [rad].
        p_TG: Position [m]. Shape (3,).
    """
    c, s = math.cos(yaw), math.sin(yaw)
    X = np.eye(4)
    X[:3, :3] = np.array([[c, s, 0.0], [s, -c, 0.0], [0.0, 0.0, -1.0]])
    X[:3, 3] = p_TG
    return X


def turn_about_axis(X_TG: Floats, yaw: float) -> Floats:
    """Return a pose turned about the axis of the tool.

    Args:
        X_TG: Pose of the tool. Shape (4, 4).
        yaw: Angle about -z of G, thus about the vertical for a tool that points down [rad].

    Returns:
        Pose. Shape (4, 4).
    """
    c, s = math.cos(yaw), math.sin(yaw)
    rotation = np.array([[c, s, 0.0, 0.0], [-s, c, 0.0, 0.0], [0, 0, 1, 0], [0, 0, 0, 1]])
    return np.asarray(X_TG @ rotation)


def retreat_along_axis(X_TG: Floats, distance: float) -> Floats:
    """Return a pose moved by a distance along -z of G [m]. Shapes (4, 4)."""
    X = X_TG.copy()
    X[:3, 3] -= distance * X_TG[:3, 2]
    return X


def raise_pose(X_TG: Floats, height: float) -> Floats:
    """Return a pose raised by a height [m]. Shapes (4, 4)."""
    X = X_TG.copy()
    X[2, 3] += height
    return X


def _vertical_line(X_TG: Floats, top: float) -> Floats:
    """Return poses from X_TG vertically up to a height [m]. Shape (m, 4, 4).

    The last steps are so short that a cubic B-spline with these poses as control points leaves the
    line no lower than `_CORNER_HEIGHT` below its top: there, it depends on the last three poses.
    """
    bottom = X_TG[2, 3]
    corner = max(bottom, top - _CORNER_HEIGHT)
    below = np.linspace(bottom, corner, math.ceil((corner - bottom) / _MAX_POSE_STEP) + 1)
    heights = np.array([*below, (corner + top) / 2, top])
    X = np.broadcast_to(X_TG, (len(heights), 4, 4)).copy()
    X[:, 2, 3] = heights
    return X


def is_vertical(X_TG: Floats) -> bool:
    """Return whether a tool points down at a pose. Shape (4, 4)."""
    return bool(X_TG[2, 2] < -1 + 1e-6)


def is_sideways(X_TG: Floats) -> bool:
    """Return whether a tool touches a side of an object at a pose. Shape (4, 4)."""
    return bool(X_TG[2, 2] > -math.cos(_MAX_AXIAL_TILT))


def has_same_tilt(X_TG: Floats, X_TG_end: Floats) -> bool:
    """Return whether gravity has the same direction in a tool at two poses. Shapes (4, 4)."""
    if is_vertical(X_TG) and is_vertical(X_TG_end):
        return True
    return bool(np.abs(X_TG[2, :3] - X_TG_end[2, :3]).max() < _MAX_TILT_DIFFERENCE)


def departure_axis(X_TG: Floats) -> Floats:
    """Return the direction in which a load leaves its place in a tool. Shapes (3,), (4, 4).

    A load that is held at a side is lifted: it would drag on what it stands on.
    """
    return np.array([0.0, 0.0, 1.0]) if is_sideways(X_TG) else -X_TG[:3, 2]


@dataclass(frozen=True)
class WayOut:
    """Motion of a tool on a side of an object from below what is above the object.

    Attributes:
        rise: Height by which a load is lifted first [m].
        distance: Distance that the load moves horizontally then [m]; 0 if nothing is above.
        insertion: Distance by which the tool reaches beyond the side of the object [m].
    """

    rise: float = 0.0
    distance: float = 0.0
    insertion: float = 0.0


def _departure(X_TG: Floats, top: float, way_out: WayOut, *, has_load: bool) -> Floats:
    """Return poses from an endpoint up to a height.

    A tool that is tilted moves along -z of G for a short distance first. On a side of an object, it
    moves along -z as far as the way out, and a load rises before it does.

    Args:
        X_TG: Pose at the endpoint. Shape (4, 4).
        top: Height of G at the end [m].
        way_out: Way out of a tool on a side of an object.
        has_load: Whether the tool holds the object.

    Returns:
        Poses. Shape (m, 4, 4).
    """
    if is_vertical(X_TG):
        return _vertical_line(X_TG, top)
    if not is_sideways(X_TG):
        moved_back = retreat_along_axis(X_TG, DEPARTURE_DISTANCE)
        return np.vstack([X_TG[None], _vertical_line(moved_back, max(top, moved_back[2, 3]))])
    parts = list[Floats]()
    end = X_TG
    if not has_load:
        parts.append(
            _translated(
                end, -X_TG[:3, 2], max(way_out.distance, way_out.insertion + DEPARTURE_DISTANCE)
            )
        )
    elif way_out.distance > 0:
        parts.append(_translated(end, np.array([0.0, 0.0, 1.0]), way_out.rise))
        end = parts[-1][-1]
        outwards = -X_TG[:3, 2] * [1.0, 1.0, 0.0]
        parts.append(_translated(end, outwards / np.linalg.norm(outwards), way_out.distance))
    end = parts[-1][-1] if parts else X_TG
    return np.vstack([*parts, _vertical_line(end, max(top, end[2, 3]))])


def _translated(X_TG: Floats, direction: Floats, distance: float) -> Floats:
    """Return poses along a straight line, with short steps at its ends. Shape (m, 4, 4).

    Args:
        X_TG: First pose. Shape (4, 4).
        direction: Direction in T, a unit vector. Shape (3,).
        distance: Length of the line [m].
    """
    corner = min(RISE_CORNER, distance / 2)
    count = math.ceil((distance - 2 * corner) / _MAX_POSE_STEP) + 1
    between = np.linspace(corner, distance - corner, max(count, 2))
    steps = np.array([0.0, corner / 2, *between, distance - corner / 2, distance])
    X = np.broadcast_to(X_TG, (len(steps), 4, 4)).copy()
    X[:, :3, 3] += steps[:, None] * direction
    return X


def _straight_line(X_TG: Floats, X_TG_end: Floats) -> Floats:
    """Return poses on a straight line with a uniform rotation about the vertical.

    Returns:
        Poses from X_TG to X_TG_end. Shape (m, 4, 4).
    """
    rotation = X_TG_end[:3, :3] @ X_TG[:3, :3].T
    angle = math.atan2(rotation[1, 0], rotation[0, 0])
    translation = X_TG_end[:3, 3] - X_TG[:3, 3]
    num_steps = max(
        float(np.linalg.norm(translation)) / _MAX_POSE_STEP, abs(angle) / MAX_JOINT_STEP
    )
    count = max(2, math.ceil(num_steps) + 1)
    X = np.empty((count, 4, 4))
    for k, fraction in enumerate(np.linspace(0.0, 1.0, count)):
        c, s = math.cos(fraction * angle), math.sin(fraction * angle)
        X[k] = X_TG
        X[k, :3, :3] = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]) @ X_TG[:3, :3]
        X[k, :3, 3] += fraction * translation
    return X


@dataclass(frozen=True)
class CarryPath:
    """Joint-space path from the grasp to the place pose over a transfer height.

    Attributes:
        lift: Up from the grasp. Shape (k, n).
        transfer: From the end of `lift` to the end of `reversed_lowering`. Shape (l, n).
        reversed_lowering: Up from the place pose; traversed in reverse. Shape (m, n).
        reversed_approach: Up from the grasp without the object; traversed in reverse. Shape (i, n).
        retreat: Up from the place pose without the object. Shape (j, n).
    """

    lift: Floats
    transfer: Floats
    reversed_lowering: Floats
    reversed_approach: Floats
    retreat: Floats

    @property
    def waypoints(self) -> Floats:
        """Configurations from grasp to place pose without duplicates. Shape (m, n)."""
        return np.vstack([self.lift, self.transfer[1:-1], self.reversed_lowering[::-1]])


class ToolKinematics:
    """Forward and inverse kinematics of a tool of the gripper of a work cell.

    Attributes:
        robot: Robot that carries the gripper.
    """

    def __init__(self, cell: WorkCell, tool: str) -> None:
        """Load the robot.

        Args:
            cell: Work cell with robot and gripper.
            tool: Name of the tool.

        Raises:
            InputError: The robot's model cannot be used.
        """
        self.robot: RobotModel = load_robot(cell.robot)
        X_TB = self.robot.X_TB
        X_FG = cell.gripper.tools[tool].X_FG
        self._X_TB = X_TB.GetAsMatrix4()
        self._X_FG = X_FG.GetAsMatrix4()
        self._X_BT = X_TB.inverse().GetAsMatrix4()
        self._X_GF = X_FG.inverse().GetAsMatrix4()
        chain = self.robot.chain
        fixed = chain.fixed.copy()
        fixed[0] = self._X_TB @ fixed[0]
        fixed[-1] = fixed[-1] @ self._X_FG
        self._chain = SerialChain(fixed, chain.revolute)

    def pose(self, q: Floats) -> Floats:
        """Return X_TG, shape (..., 4, 4), at joint positions of shape (..., n)."""
        return np.asarray(self._X_TB @ self.robot.forward_kinematics(q) @ self._X_FG)

    def axis(self, q: Floats) -> Floats:
        """Return the z axis of G in T, shape (..., 3), at positions of shape (..., n)."""
        return self.pose(q)[..., :3, 2]

    def jacobians(self, q: Floats) -> Floats:
        """Return the spatial Jacobians of G in T, angular rows first. Shape (m, 6, n).

        Args:
            q: Joint positions. Shape (m, n).
        """
        return self._chain.jacobians(q)

    def solve_ik(self, X_TG: Floats) -> Floats:
        """Return all inverse kinematics solutions, see `InverseKinematics.solve`.

        Args:
            X_TG: Poses of the gripper. Shape (..., 4, 4).

        Returns:
            Joint positions; NaN in rows without a solution. Shape (..., K, n).
        """
        return self.robot.ik.solve(self._flange_pose(X_TG))

    def track(self, X_TG: Floats, q_start: Floats) -> Floats | None:
        """Return the continuous joint path along poses, see `InverseKinematics.track`.

        Args:
            X_TG: Closely spaced poses of the gripper. Shape (m, 4, 4).
            q_start: Joint positions at the first pose. Shape (n,).

        Returns:
            Joint positions, shape (m, n), or None if there is no continuous path.
        """
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
        ways_out: tuple[WayOut, WayOut],
    ) -> CarryPath | str:
        """Return a path from a grasp to a place pose.

        A tilted tool first moves along its axis, also at the place pose; on a side of the object,
        it takes its way out. A robot with `vertical_tool_rows` keeps the tilt of a vertical or a
        horizontal tool on a straight line in joint space; any other tilted tool turns on such a
        line. Any other robot moves a tool that keeps its tilt on a straight line; its configuration
        at the place pose results from the path.

        Args:
            X_pick: X_TG at the grasp. Shape (4, 4).
            X_place: X_TG at the place pose. Shape (4, 4).
            transfer_height: Height of G between the two [m].
            q_pick: Joint positions at the grasp. Shape (n,).
            q_place: Joint positions at the place pose; not used without `vertical_tool_rows` if the
                tool keeps its tilt. Shape (n,).
            ways_out: Ways out at the grasp and at the place pose.

        Returns:
            The path, or a description of the part that is out of reach.
        """
        lift = self.lift_path(X_pick, transfer_height, q_pick, ways_out[0], has_load=True)
        if lift is None:
            return "above the grasp"
        above_place = _departure(X_place, transfer_height, ways_out[1], has_load=True)
        if self.robot.vertical_tool_rows is not None or not has_same_tilt(X_pick, X_place):
            reversed_lowering = self.track(above_place, q_place)
            if reversed_lowering is None:
                return "above the place"
            transfer = linear_joint_path(lift[-1], reversed_lowering[-1])
        else:
            X_lifted = _departure(X_pick, transfer_height, ways_out[0], has_load=True)[-1]
            tracked = self.track(_straight_line(X_lifted, above_place[-1]), lift[-1])
            if tracked is None:
                return "between grasp and place"
            lowering = self.track(above_place[::-1], tracked[-1])
            if lowering is None:
                return "above the place"
            transfer, reversed_lowering = tracked, lowering[::-1]
        approach, retreat = (
            self.lift_path(X_TG, transfer_height, path[0], way_out, has_load=False)
            if is_sideways(X_TG)
            else path
            for X_TG, path, way_out in zip(
                (X_pick, X_place), (lift, reversed_lowering), ways_out, strict=True
            )
        )
        if approach is None:
            return "before the grasp"
        if retreat is None:
            return "before the place"
        return CarryPath(lift, transfer, reversed_lowering, approach, retreat)

    def extend_upwards(self, path: Floats, distance: float) -> Floats | None:
        """Return a path with a vertical line of the tool at its end.

        Args:
            path: Configurations. Shape (k, n).
            distance: Length of the line [m].

        Returns:
            Configurations, shape (m, n), or None out of reach.
        """
        if distance == 0.0:
            return path
        X_TG = self.pose(path[-1])
        line = self.track(_vertical_line(X_TG, X_TG[2, 3] + distance), path[-1])
        return None if line is None else np.vstack([path, line[1:]])

    def lift_path(
        self, X_TG: Floats, height: float, q: Floats, way_out: WayOut, *, has_load: bool
    ) -> Floats | None:
        """Return the path from a grasp up to a height; a tilted tool first moves along its axis.

        Args:
            X_TG: Pose of the tool at the grasp. Shape (4, 4).
            height: Height of G at the end [m].
            q: Joint positions at the grasp. Shape (n,).
            way_out: Way out of a tool on a side of the object.
            has_load: Whether the tool holds the object.

        Returns:
            Configurations, shape (m, n), or None out of reach.
        """
        return self.track(_departure(X_TG, height, way_out, has_load=has_load), q)

    def paths_between(self, q: Floats, q_end: Floats) -> list[Floats]:
        """Return candidate paths between two configurations. Shapes (m, n).

        The first is a straight line in joint space. The second first moves the gripper at its
        height to the horizontal position that it has at the end.

        Args:
            q: Joint positions at the start. Shape (n,).
            q_end: Joint positions at the end. Shape (n,).
        """
        X_TG_end = self.pose(q_end)
        X_TG = self.pose(q)
        X_TG[:2, 3] = X_TG_end[:2, 3]
        q_retracted = self.robot.ik.follow(self._flange_pose(X_TG), q)
        direct = linear_joint_path(q, q_end)
        if q_retracted is None:
            return [direct]
        retract = linear_joint_path(q, q_retracted)
        return [direct, np.vstack([retract, linear_joint_path(q_retracted, q_end)[1:]])]
