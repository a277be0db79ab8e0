"""Limits of motions: check of a trajectory, and uniform scaling until all of them hold.

Frames: B is the robot's base, F is the flange, Cm is the load's center of mass; C is a point that
is fixed in F.
"""

import math
from dataclasses import dataclass
from enum import Enum

import numpy as np
from numpy.typing import NDArray
from pydrake.math import BsplineBasis
from pydrake.trajectories import BsplineTrajectory
from scipy.interpolate import BSpline

from drake_clutter.cell.gripper import Payload
from drake_clutter.cell.work_cell import WorkCell
from drake_clutter.planning.arm_dynamics import arm_dynamics
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
    LimitKind.VELOCITY: 1,
    LimitKind.TOOL_SPEED: 1,
    LimitKind.ACCELERATION: 2,
    LimitKind.LOAD: 2,
    LimitKind.TORQUE: 2,
    LimitKind.JERK: 3,
}
"""Power of the time scale by which each kind decreases; the torque without that of gravity."""


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


@dataclass(frozen=True)
class MotionSamples:
    """Samples of a motion.

    Attributes:
        q: Positions [rad]. Shape (m, n).
        v: Velocities [rad/s]. Shape (m, n).
        a: Accelerations [rad/s^2]. Shape (m, n).
        jerk: Jerks [rad/s^3]. Shape (m, n).
    """

    q: Floats
    v: Floats
    a: Floats
    jerk: Floats


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

    def __init__(self, cell: WorkCell, payload: Payload, max_tool_speed: float = math.inf) -> None:
        """Collect the limits.

        Args:
            cell: Work cell with robot and gripper.
            payload: Load of the gripper.
            max_tool_speed: Largest speed of the origin of any tool, if it is below that of the work
                cell [m/s].
        """
        self.robot = load_robot(cell.robot)
        self.payload = payload
        self.max_tool_speed = min(max_tool_speed, cell.robot.tool_speed or math.inf)
        self.dynamics = arm_dynamics(cell, payload)
        tools = [tool.X_FG.translation() for tool in cell.gripper.tools.values()]
        self.p_FC = np.array([payload.p_FCm, *tools])

    def ratios(self, motion: MotionSamples) -> dict[LimitKind, Floats]:
        """Return the ratios of a motion to its limits.

        Args:
            motion: Samples of the motion.

        Returns:
            Ratios; a limit is exceeded above 1. The ratio of a torque is that of its part without
            gravity to what gravity leaves of the limit; it is infinite if gravity leaves nothing.
            Shapes (m, n) for limits of joints, (m, 1) of the load, (m, k) of the tools.
        """
        robot = self.robot
        lower, upper = robot.position_limits.T
        q, v, a = motion.q, motion.v, motion.a
        moved = self.dynamics.motion(q, v, a, self.p_FC)
        gravity, dynamic = moved.gravity_torques, moved.dynamic_torques
        reserve = robot.torque_limits - np.sign(dynamic) * gravity
        is_held = np.abs(gravity) < robot.torque_limits
        return {
            LimitKind.POSITION: np.abs(2 * q - lower - upper) / (upper - lower),
            LimitKind.VELOCITY: np.abs(v) / robot.velocity_limits,
            LimitKind.ACCELERATION: np.abs(a) / robot.acceleration_limits,
            LimitKind.JERK: np.abs(motion.jerk) / robot.jerk_limits,
            LimitKind.TORQUE: np.where(is_held, np.abs(dynamic) / reserve, np.inf),
            LimitKind.LOAD: _norms(moved.accelerations[:, :1]) / self.payload.max_acceleration,
            LimitKind.TOOL_SPEED: _norms(moved.velocities[:, 1:]) / self.max_tool_speed,
        }

    def find_violation(self, ratios: dict[LimitKind, Floats]) -> LimitViolation | None:
        """Return the limit that is exceeded most by more than `LIMIT_TOLERANCE`, if any."""
        kind = max(ratios, key=lambda kind: ratios[kind].max())
        ratio = float(ratios[kind].max())
        if ratio <= 1 + LIMIT_TOLERANCE:
            return None
        joint = int(ratios[kind].max(axis=0).argmax())
        is_tool = kind in (LimitKind.LOAD, LimitKind.TOOL_SPEED)
        return LimitViolation(kind, "" if is_tool else self.robot.joint_names[joint], ratio)


def _norms(vectors: Floats) -> Floats:
    """Return the lengths, shape (m, k), of vectors of shape (m, k, 3)."""
    return np.asarray(np.sqrt((vectors**2).sum(axis=-1)))


def time_scales(ratios: dict[LimitKind, Floats]) -> Floats:
    """Return the time scale at each sample that brings all ratios to at most 1.

    Args:
        ratios: Result of `MotionLimits.ratios`. Limits that do not depend on time are ignored.

    Returns:
        Factors by which the motion has to be slowed down; below 1 where it may be faster. Shape
        (m,).
    """
    scales = [ratios[kind].max(axis=1) ** (1 / order) for kind, order in _TIME_ORDERS.items()]
    return np.asarray(np.max(scales, axis=0))


def sample_spline(trajectory: BsplineTrajectory, period: float = CHECK_PERIOD) -> MotionSamples:
    """Return samples of a cubic B-spline over time, including both ends.

    Args:
        trajectory: Joint positions over time.
        period: Largest time between two samples [s].
    """
    end_time = trajectory.end_time()
    times = np.linspace(0.0, end_time, math.ceil(end_time / period) + 1)
    spline = to_scipy(trajectory)
    # The jerk is constant between two knots: the last sample takes that of the last interval.
    within = np.minimum(times, end_time * (1 - 1e-9))
    return MotionSamples(spline(times), spline(times, 1), spline(times, 2), spline(within, 3))


def to_scipy(trajectory: BsplineTrajectory) -> BSpline:
    """Return a B-spline of Drake as one of SciPy, which evaluates all samples in one call."""
    basis = trajectory.basis()
    return BSpline(
        np.array(basis.knots()),
        np.hstack(trajectory.control_points()).T,
        basis.degree(),
    )


def scale_time(trajectory: BsplineTrajectory, scale: float) -> BsplineTrajectory:
    """Return a trajectory whose duration is multiplied by a factor."""
    basis = trajectory.basis()
    knots = scale * np.array(basis.knots())
    return BsplineTrajectory(BsplineBasis(basis.order(), knots), trajectory.control_points())


def scale_to_limits(
    trajectory: BsplineTrajectory, limits: MotionLimits
) -> BsplineTrajectory | LimitViolation:
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
        scale = float(time_scales(ratios).max())
        if violation.kind is LimitKind.POSITION or not math.isfinite(scale):
            break
        trajectory = scale_time(trajectory, max(scale, 1.0))
    return violation
