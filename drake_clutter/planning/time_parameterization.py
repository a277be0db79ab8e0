"""Time parameterization: from joint-space waypoints to feasible trajectories.

Frames: B is the robot's base, F is the flange, Cm is the load's center of mass.
"""

import math
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from pydrake.math import BsplineBasis, KnotVectorType, RigidTransform
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import MultibodyForces, SpatialInertia, UnitInertia
from pydrake.systems.framework import Context
from pydrake.trajectories import (
    BsplineTrajectory,
    PathParameterizedTrajectory,
    PiecewisePolynomial,
    Trajectory,
)

from drake_clutter.cell.gripper import Payload
from drake_clutter.cell.work_cell import WorkCell
from drake_clutter.planning.toppra import solve_toppra
from drake_clutter.robots.robot_model import RobotModel, load_robot
from drake_clutter.robots.robot_plant import add_robot

Floats = NDArray[np.float64]

LIMIT_FRACTION = 0.97
"""Fraction of the joint limits that is used. Limits are imposed at grid points; a trajectory may
exceed them slightly in between."""
MAX_JOINT_STEP = 0.08
"""Largest change of a joint between neighboring waypoints of a path [rad]; it also bounds the
rotation of the gripper between neighboring poses."""
SMOOTHING_TIME = 0.1
"""Width of the moving average of `smooth_time_scaling` [s]: the period at which 0.5 kg oscillates
on the bellows of the default suction cup (2000 N/m)."""
_SPLINE_ORDER = 4
"""Order of the B-splines: cubic, so that accelerations are continuous."""
_NUM_GRID_POINTS = 300
"""Points of a path at which limits are imposed."""


@lru_cache(maxsize=64)
def _cached_dynamics_plant(
    cell: WorkCell, mass: float, p_FCm: tuple[float, float, float]
) -> MultibodyPlant:
    plant = MultibodyPlant(0.0)
    robot = add_robot(plant, load_robot(cell.robot), visuals=False)
    (tool,) = Parser(plant).AddModelsFromString(cell.gripper.model_sdf(compliant=False), "sdf")
    flange = plant.GetFrameByName(cell.robot.tool_frame, robot)
    plant.WeldFrames(flange, plant.GetFrameByName("body", tool))
    if mass:
        inertia = SpatialInertia(mass, np.zeros(3), UnitInertia.SolidSphere(0.05))
        load = plant.AddRigidBody("load", robot, inertia)
        plant.WeldFrames(flange, load.body_frame(), RigidTransform(list(p_FCm)))
    plant.Finalize()
    return plant


def dynamics_plant(cell: WorkCell, payload: Payload) -> MultibodyPlant:
    """Return a plant of arm, rigid gripper and load alone."""
    return _cached_dynamics_plant(cell, payload.mass, payload.p_FCm)


def min_travel_time(displacements: Floats, robot: RobotModel) -> Floats:
    """Return the minimum time of joint displacements from rest to rest [s].

    Only limits of velocity and acceleration count (trapezoidal velocity profile); the slowest
    joint determines the time.

    Args:
        displacements: Changes of the joint positions. Shape (..., n).
        robot: Robot with the limits.

    Returns:
        Times [s]. Shape (...).
    """
    distance = np.abs(displacements)
    speed = robot.velocity_limits
    acceleration = robot.acceleration_limits
    is_triangular = distance < speed**2 / acceleration
    triangular = 2 * np.sqrt(distance / acceleration)
    trapezoidal = distance / speed + speed / acceleration
    return np.asarray(np.where(is_triangular, triangular, trapezoidal).max(axis=-1))


def linear_joint_path(start: Floats, end: Floats) -> Floats:
    """Return a straight line in joint space with steps of at most `MAX_JOINT_STEP`.

    Args:
        start: First configuration. Shape (n,).
        end: Last configuration. Shape (n,).

    Returns:
        Waypoints. Shape (m, n).
    """
    count = max(2, math.ceil(np.abs(end - start).max() / MAX_JOINT_STEP) + 1)
    return np.linspace(start, end, count)


def bspline_path(waypoints: Floats) -> BsplineTrajectory:
    """Return a cubic B-spline that has the waypoints as control points.

    The path starts at the first and ends at the last waypoint, and blends the corners.

    Args:
        waypoints: Configurations. Shape (m, n).
    """
    is_distinct = np.concatenate([[True], np.abs(np.diff(waypoints, axis=0)).max(axis=1) > 1e-9])
    points = waypoints[is_distinct]
    while len(points) < _SPLINE_ORDER - 2:
        points = np.insert(points, 1, (points[0] + points[1]) / 2, axis=0)
    # Control points at a third of the first and last step. Without them the derivative by the path
    # parameter would be three times as large at the ends as elsewhere.
    points = np.insert(
        points,
        [1, len(points) - 1],
        [(2 * points[0] + points[1]) / 3, (2 * points[-1] + points[-2]) / 3],
        axis=0,
    )
    basis = BsplineBasis(_SPLINE_ORDER, len(points), KnotVectorType.kClampedUniform, 0.0, 1.0)
    return BsplineTrajectory(basis, points.T)


def sample_path(path: Trajectory, spacing: float = MAX_JOINT_STEP / 2) -> Floats:
    """Return configurations at uniform parameters, about `spacing` apart.

    Args:
        path: Path or trajectory in joint space.
        spacing: Mean distance, as the largest change of a joint [rad].

    Returns:
        Configurations. Shape (m, n).
    """
    coarse = path.vector_values(np.linspace(path.start_time(), path.end_time(), 60)).T
    count = max(20, math.ceil(np.abs(np.diff(coarse, axis=0)).max(axis=1).sum() / spacing))
    return np.asarray(path.vector_values(np.linspace(path.start_time(), path.end_time(), count)).T)


def parameterize_time_optimal(
    path: Trajectory, cell: WorkCell, payload: Payload
) -> Trajectory | None:
    """Return the time-optimal trajectory along a path from rest to rest.

    Limits: joint velocity, acceleration and torque, and the acceleration at which the gripper
    holds the payload. With a payload, `smooth_time_scaling` is applied.

    Args:
        path: Path in joint space.
        cell: Work cell with robot and gripper.
        payload: Load of the gripper.

    Returns:
        The trajectory, or None if the limits cannot be satisfied.
    """
    plant = dynamics_plant(cell, payload)
    robot = load_robot(cell.robot)
    torque_limits = LIMIT_FRACTION * robot.torque_limits
    grid = np.linspace(path.start_time(), path.end_time(), _NUM_GRID_POINTS)
    derivative = path.MakeDerivative(1)
    q = path.vector_values(grid).T
    dq_ds = derivative.vector_values(grid).T
    d2q_ds2 = derivative.MakeDerivative(1).vector_values(grid).T
    with np.errstate(divide="ignore"):
        speed_ratios = LIMIT_FRACTION * robot.velocity_limits / np.abs(dq_ds)
        max_squared_speeds = (speed_ratios**2).min(axis=1)
    # Rows (a, b, lower, upper) of lower <= a u + b x <= upper, see `toppra`.
    limits = np.broadcast_to(LIMIT_FRACTION * robot.acceleration_limits, dq_ds.shape)
    rows = [(dq_ds, d2q_ds2, -limits, limits)]
    if math.isfinite(payload.max_acceleration):
        p_BCm = (robot.forward_kinematics(q) @ np.array([*payload.p_FCm, 1.0]))[:, :3]
        limits = np.full(p_BCm.shape, payload.max_axis_acceleration)
        dp_ds = np.gradient(p_BCm, grid, axis=0, edge_order=2)
        rows.append((dp_ds, np.gradient(dp_ds, grid, axis=0, edge_order=2), -limits, limits))

    def solve() -> Trajectory | None:
        a, b, lower, upper = (np.hstack(column) for column in zip(*rows, strict=True))
        x = solve_toppra(grid[1] - grid[0], a, b, lower, upper, max_squared_speeds)
        speed = np.sqrt(x)
        if not (speed[1:-1] > 0).all():
            return None
        times = np.concatenate([[0.0], np.cumsum(2 * np.diff(grid) / (speed[1:] + speed[:-1]))])
        scaling = PiecewisePolynomial.CubicHermite(times, grid[None], speed[None])
        return PathParameterizedTrajectory(
            path, smooth_time_scaling(scaling) if payload.mass else scaling
        )

    # Torque limits are rarely active and dominate the computation time: without them first.
    trajectory = solve()
    if trajectory is None:
        return None
    torques = inverse_dynamics(plant, *sample_motion(trajectory, 40))
    if (np.abs(torques) <= torque_limits).all():
        return trajectory
    rest = np.zeros_like(q)
    gravity = inverse_dynamics(plant, q, rest, rest)
    if (np.abs(gravity) > torque_limits).any():
        return None
    rows.append(
        (
            inverse_dynamics(plant, q, rest, dq_ds) - gravity,
            inverse_dynamics(plant, q, dq_ds, d2q_ds2) - gravity,
            -torque_limits - gravity,
            torque_limits - gravity,
        )
    )
    return solve()


def smooth_time_scaling(time_scaling: Trajectory) -> Trajectory:
    """Return a time scaling averaged over `SMOOTHING_TIME`; its duration increases.

    Accelerations then change continuously. A step of the acceleration would excite an oscillation
    of the load on the elastic cup with twice the static deflection.

    Args:
        time_scaling: Path parameter over time. Shape (1,).
    """
    step = 0.005
    half_width = round(SMOOTHING_TIME / 0.01)
    last = math.ceil(time_scaling.end_time() / step) + 2 * half_width
    times = np.arange(-2 * half_width, last + 1) * step
    values = time_scaling.vector_values(np.clip(times, 0.0, time_scaling.end_time())).ravel()
    width = 2 * half_width + 1
    mean = np.convolve(values, np.full(width, 1 / width), mode="valid")
    zero = np.zeros((1, 1))
    return PiecewisePolynomial.CubicWithContinuousSecondDerivatives(
        np.arange(len(mean)) * step, mean[None], zero, zero
    )


def scale_to_limits(trajectory: Trajectory, cell: WorkCell, payload: Payload) -> Trajectory | None:
    """Return a trajectory slowed down uniformly until it satisfies the limits.

    The limits are those of `parameterize_time_optimal`.

    Args:
        trajectory: Joint positions over time.
        cell: Work cell with robot and gripper.
        payload: Load of the gripper.

    Returns:
        The trajectory, or None if the limits cannot be satisfied at any speed.
    """
    plant = dynamics_plant(cell, payload)
    robot = load_robot(cell.robot)
    end_time = trajectory.end_time()
    count = max(200, math.ceil(end_time / 0.005))
    q, v, a = sample_motion(trajectory, count)
    gravity = inverse_dynamics(plant, q, np.zeros_like(q), np.zeros_like(q))
    dynamic = inverse_dynamics(plant, q, v, a) - gravity
    torque_reserve = LIMIT_FRACTION * robot.torque_limits - np.sign(dynamic) * gravity
    if (torque_reserve <= 0).any():
        return None
    # Accelerations and dynamic torques are inversely proportional to the squared time scale.
    squared_scale = (np.abs(v) / robot.velocity_limits / LIMIT_FRACTION).max() ** 2
    squared_scale = max(
        squared_scale, (np.abs(a) / robot.acceleration_limits / LIMIT_FRACTION).max()
    )
    squared_scale = max(squared_scale, (np.abs(dynamic) / torque_reserve).max())
    if math.isfinite(payload.max_acceleration):
        p_BCm = (robot.forward_kinematics(q) @ np.array([*payload.p_FCm, 1.0]))[:, :3]
        accelerations = np.diff(p_BCm, 2, axis=0) / (end_time / (count - 1)) ** 2
        squared_scale = max(
            squared_scale, np.linalg.norm(accelerations, axis=1).max() / payload.max_acceleration
        )
    scale = max(1.0, math.sqrt(squared_scale))
    return PathParameterizedTrajectory(
        trajectory, PiecewisePolynomial.FirstOrderHold([0.0, scale * end_time], [[0.0, end_time]])
    )


def sample_motion(trajectory: Trajectory, count: int) -> tuple[Floats, Floats, Floats]:
    """Return samples of a trajectory at uniform times, including both ends.

    Args:
        trajectory: Joint positions over time.
        count: Number of samples, m.

    Returns:
        Positions [rad], velocities [rad/s] and accelerations [rad/s^2]. Shapes (m, n).
    """
    times = np.linspace(trajectory.start_time(), trajectory.end_time(), count)
    v, a = (trajectory.MakeDerivative(order).vector_values(times).T for order in (1, 2))
    return trajectory.vector_values(times).T, v, a


@lru_cache(maxsize=64)
def _cached_context(plant: MultibodyPlant) -> Context:
    return plant.CreateDefaultContext()


def inverse_dynamics(plant: MultibodyPlant, q: Floats, v: Floats, a: Floats) -> Floats:
    """Return the joint torques of a motion.

    Args:
        plant: Plant of `dynamics_plant`.
        q: Positions [rad]. Shape (m, n).
        v: Velocities [rad/s]. Shape (m, n).
        a: Accelerations [rad/s^2]. Shape (m, n).

    Returns:
        Torques [N m]. Shape (m, n).
    """
    context = _cached_context(plant)
    forces = MultibodyForces(plant)
    torques = np.empty_like(q)
    for k in range(len(q)):
        plant.SetPositions(context, q[k])
        plant.SetVelocities(context, v[k])
        plant.CalcForceElementsContribution(context, forces)
        torques[k] = plant.CalcInverseDynamics(context, a[k], forces)
    return torques
