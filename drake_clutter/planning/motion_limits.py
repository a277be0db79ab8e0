"""Limits of motions: check of a trajectory, and uniform scaling until all of them hold.

Frames: T is the support, B is the robot's base, F is the flange, G is a tool, Cm is the load's
center of mass; C is a point that is fixed in F.
"""

import math
from dataclasses import dataclass
from enum import Enum

import numpy as np
from numpy.typing import NDArray

from drake_clutter.cell.gripper import Payload
from drake_clutter.cell.payload_limits import payload_wrench
from drake_clutter.cell.work_cell import WorkCell
from drake_clutter.compilation import njit
from drake_clutter.planning.arm_dynamics import arm_dynamics
from drake_clutter.planning.cubic_spline import CubicSpline, MotionSamples
from drake_clutter.robots.chain_dynamics import ChainDynamics
from drake_clutter.robots.robot_model import RobotModel, load_robot

Floats = NDArray[np.float64]

CHECK_PERIOD = 0.002
"""Period at which the limits of a trajectory are checked [s]: the cycle of a UR controller."""
LIMIT_TOLERANCE = 0.001
"""Largest fraction by which a checked trajectory exceeds a limit: a scaled trajectory is sampled at
other points than those from which its scale was found."""
_MAX_SCALINGS = 3
"""Largest number of scalings, each of which is checked again."""


class LimitKind(Enum):
    """Limited quantities of a motion."""

    POSITION = "position"
    VELOCITY = "velocity"
    ACCELERATION = "acceleration"
    JERK = "jerk"
    TORQUE = "torque"
    LOAD = "acceleration of the load"
    TOOL_SPEED = "tool speed"


_TIME_ORDERS = {
    LimitKind.POSITION: 0,
    LimitKind.VELOCITY: 1,
    LimitKind.ACCELERATION: 2,
    LimitKind.JERK: 3,
    LimitKind.TORQUE: 2,
    LimitKind.LOAD: 2,
    LimitKind.TOOL_SPEED: 1,
}
"""Power of the time scale by which each kind decreases, in the order of `LimitKind`; the torque
without that of gravity."""


@dataclass(frozen=True)
class LimitViolation:
    """Limit that a motion exceeds at any speed.

    Attributes:
        kind: Exceeded limit.
        joint: Name of the joint; empty for limits of the tool.
        ratio: Ratio to the limit; infinite if gravity alone exceeds a torque limit.
    """

    kind: LimitKind
    joint: str
    ratio: float

    def __str__(self) -> str:
        return f"{self.kind.value} of {self.joint}" if self.joint else self.kind.value


class MotionLimits:
    """Limits of the motions of an arm with a load.

    Attributes:
        robot: Robot with the limits of its joints.
        payload: Load of the gripper.
        max_tool_speed: Largest speed of the origin of any tool [m/s]; infinite without a limit.
        dynamics: Dynamics of arm, gripper and load.
        p_FC: Center of mass of the load, then the origins of the tools [m]. Shape (k, 3).
    """

    robot: RobotModel
    payload: Payload
    max_tool_speed: float
    dynamics: ChainDynamics
    p_FC: Floats

    def __init__(
        self,
        cell: WorkCell,
        payload: Payload,
        max_tool_speed: float = math.inf,
        tilted_tool: str = "",
    ) -> None:
        """Collect the limits.

        Args:
            cell: Work cell with robot and gripper.
            payload: Load of the gripper.
            max_tool_speed: Largest speed of the origin of any tool, if it is below that of the work
                cell [m/s].
            tilted_tool: Tool that holds the load and does not point down all the time: it has to
                bear the load with gravity in its true direction, too. "" for any other motion.
        """
        self.robot = load_robot(cell.robot)
        self.payload = payload
        self.max_tool_speed = min(max_tool_speed, cell.robot.tool_speed or math.inf)
        self.dynamics = arm_dynamics(cell, payload)
        tools = [tool.X_FG.translation() for tool in cell.gripper.tools.values()]
        self.p_FC = np.array([payload.p_FCm, *tools])
        self._tilted_load = TiltedLoad(cell, payload, tilted_tool) if tilted_tool else None
        n = self.robot.num_joints
        widths = {LimitKind.LOAD: 1, LimitKind.TOOL_SPEED: len(tools)}
        counts = [widths.get(kind, n) for kind in LimitKind]
        self._kinds: NDArray[np.object_] = np.repeat([*LimitKind], counts)
        self._time_orders = np.array([_TIME_ORDERS[kind] for kind in self._kinds])

    def ratios(self, motion: MotionSamples) -> "LimitRatios":
        """Return the ratios of a motion to its limits.

        Args:
            motion: Samples of the motion.
        """
        robot = self.robot
        moved = self.dynamics.motion(motion.q, motion.v, motion.a, self.p_FC)
        values = np.empty((len(motion.q), len(self._kinds)))
        _calc_ratios(
            motion.q,
            motion.v,
            motion.a,
            motion.jerk,
            moved.gravity_torques,
            moved.dynamic_torques,
            moved.velocities,
            moved.accelerations,
            robot.position_limits,
            robot.velocity_limits,
            robot.acceleration_limits,
            robot.jerk_limits,
            robot.torque_limits,
            self.payload.max_acceleration,
            self.max_tool_speed,
            values,
        )
        if self._tilted_load is not None:
            R_BF = robot.forward_kinematics(motion.q)[:, :3, :3]
            ratios = self._tilted_load.ratios(R_BF, moved.accelerations[:, 0])
            column = int(np.flatnonzero(self._kinds == LimitKind.LOAD)[0])
            values[:, column] = np.maximum(values[:, column], ratios)
        return LimitRatios(values, self._kinds, self._time_orders)

    def find_violation(self, ratios: "LimitRatios") -> LimitViolation | None:
        """Return the limit that is exceeded most by more than `LIMIT_TOLERANCE`, if any."""
        largest = ratios.values.max(axis=0)
        column = int(largest.argmax())
        ratio = float(largest[column])
        if ratio <= 1 + LIMIT_TOLERANCE:
            return None
        kind = ratios.kinds[column]
        is_tool = kind in (LimitKind.LOAD, LimitKind.TOOL_SPEED)
        joint = column % self.robot.num_joints
        return LimitViolation(kind, "" if is_tool else self.robot.joint_names[joint], ratio)


class TiltedLoad:
    """Load of a tool, with gravity in its true direction."""

    def __init__(self, cell: WorkCell, payload: Payload, tool: str) -> None:
        """Take the load.

        Args:
            cell: Work cell with robot and gripper.
            payload: The load.
            tool: Name of the tool that holds it.
        """
        self._gripper, self._tool = cell.gripper, tool
        X_FG = cell.gripper.tools[tool].X_FG
        self._R_FG = X_FG.rotation().matrix()
        self._mass = payload.mass
        self._p_GCm = X_FG.inverse() @ np.array(payload.p_FCm)
        self._down_B = -load_robot(cell.robot).X_TB.rotation().matrix()[2]

    def ratios(self, R_BF: Floats, accelerations: Floats) -> Floats:
        """Return the ratios of the load of a motion to what gravity leaves of the capacity.

        Args:
            R_BF: Orientations of the flange. Shape (m, 3, 3).
            accelerations: Accelerations of the center of mass in B [m/s^2]. Shape (m, 3).

        Returns:
            Ratios; infinite where the tool does not hold the object at rest. Shape (m,).
        """
        R_BG = R_BF @ self._R_FG
        down_G = self._down_B @ R_BG
        moving = np.einsum("mi,mij->mj", accelerations, R_BG)
        at_rest, in_motion = (
            self._gripper.safety
            * self._gripper.load_ratio(
                self._tool, *payload_wrench(self._mass, self._p_GCm, down_G, acceleration)
            )
            for acceleration in (np.zeros_like(moving), moving)
        )
        reserve = 1 - at_rest
        is_held = reserve > 0
        ratios = np.full(len(at_rest), np.inf)
        ratios[is_held] = (in_motion - at_rest)[is_held] / reserve[is_held]
        return ratios


@dataclass(frozen=True)
class LimitRatios:
    """Ratios of a motion to its limits; a limit is exceeded above 1.

    The ratio of a torque, and of a load in a tilted tool, is that of its part without gravity to
    what gravity leaves of the limit; it is infinite if gravity leaves nothing.

    Attributes:
        values: Ratios. Shape (m, k).
        kinds: Kind of each column: `LimitKind` of each joint, of the load or of each tool. Shape
            (k,).
        time_orders: Power of the time scale by which each column decreases. Shape (k,).
    """

    values: Floats
    kinds: NDArray[np.object_]
    time_orders: NDArray[np.int64]

    def time_scales(self) -> Floats:
        """Return the time scale at each sample that brings all ratios to at most 1.

        Limits that do not depend on time are ignored.

        Returns:
            Factors by which the motion has to be slowed down; below 1 where it may be faster.
            Shape (m,).
        """
        scales = np.empty(len(self.values))
        _calc_time_scales(self.values, self.time_orders, scales)
        return scales


@njit(cache=True, nogil=True)
def _norm(x, y, z):  # type: ignore[no-untyped-def]
    return math.sqrt(x * x + y * y + z * z)


@njit(cache=True, nogil=True)
def _calc_ratios(  # type: ignore[no-untyped-def]
    q,
    v,
    a,
    jerk,
    gravity,
    dynamic,
    velocities,
    accelerations,
    position_limits,
    velocity_limits,
    acceleration_limits,
    jerk_limits,
    torque_limits,
    max_load_acceleration,
    max_tool_speed,
    values,
):
    """Write the ratios, in the order of `LimitKind`, see `MotionLimits`."""
    n = q.shape[1]
    for k in range(len(q)):
        for j in range(n):
            lower, upper = position_limits[j]
            values[k, j] = abs(2 * q[k, j] - lower - upper) / (upper - lower)
            values[k, n + j] = abs(v[k, j]) / velocity_limits[j]
            values[k, 2 * n + j] = abs(a[k, j]) / acceleration_limits[j]
            values[k, 3 * n + j] = abs(jerk[k, j]) / jerk_limits[j]
            torque = np.inf
            if abs(gravity[k, j]) < torque_limits[j]:
                reserve = torque_limits[j] - np.sign(dynamic[k, j]) * gravity[k, j]
                torque = abs(dynamic[k, j]) / reserve
            values[k, 4 * n + j] = torque
        x, y, z = accelerations[k, 0]
        values[k, 5 * n] = _norm(x, y, z) / max_load_acceleration
        for tool in range(1, velocities.shape[1]):
            x, y, z = velocities[k, tool]
            values[k, 5 * n + tool] = _norm(x, y, z) / max_tool_speed


@njit(cache=True, nogil=True)
def _calc_time_scales(values, orders, scales):  # type: ignore[no-untyped-def]
    """Write the time scales (m,) of ratios (m, k)."""
    for k in range(len(values)):
        largest = np.zeros(4)
        for column in range(len(orders)):
            order = orders[column]
            largest[order] = max(largest[order], values[k, column])
        scales[k] = max(largest[1], math.sqrt(largest[2]), largest[3] ** (1 / 3))


def sample_spline(trajectory: CubicSpline, period: float = CHECK_PERIOD) -> MotionSamples:
    """Return samples of a cubic B-spline over time, including both ends.

    Args:
        trajectory: Joint positions over time.
        period: Largest time between two samples [s].
    """
    end_time = trajectory.end_time
    return trajectory.sample(np.linspace(0.0, end_time, math.ceil(end_time / period) + 1))


def scale_to_limits(trajectory: CubicSpline, limits: MotionLimits) -> CubicSpline | LimitViolation:
    """Return a trajectory that satisfies all limits at `CHECK_PERIOD`.

    A trajectory that exceeds a limit is slowed down uniformly, and checked again.

    Args:
        trajectory: Joint positions over time.
        limits: Limits of the motion.

    Returns:
        The trajectory, itself if no limit is exceeded; or the limit that it exceeds at any speed.
    """
    for _ in range(_MAX_SCALINGS + 1):
        ratios = limits.ratios(sample_spline(trajectory))
        violation = limits.find_violation(ratios)
        if violation is None:
            return trajectory
        scale = float(ratios.time_scales().max())
        if violation.kind is LimitKind.POSITION or not math.isfinite(scale):
            break
        trajectory = trajectory.scaled(max(scale, 1.0))
    assert violation is not None
    return violation
