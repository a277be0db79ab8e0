"""From joint angles along a way to a trajectory that respects the arm's limits."""

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
"""Share of the limits that is used: between the points at which they are imposed a trajectory may exceed them a little."""
MAX_JOINT_STEP = 0.08
"""rad, that a joint turns at most from one point of a way to the next."""
_SPLINE_ORDER = 4
SMOOTHING_TIME = 0.1
"""s, see `softened`."""
_NUM_GRID_POINTS = 300
"""Points of a path at which the limits are imposed."""


@lru_cache(maxsize=64)
def _cached_dynamics_plant(
    cell: WorkCell, mass: float, p_GCm: tuple[float, float, float]
) -> MultibodyPlant:
    plant = MultibodyPlant(0.0)
    robot = add_robot(plant, load_robot(cell.robot), visuals=False)
    (tool,) = Parser(plant).AddModelsFromString(cell.gripper.model_sdf(compliant=False), "sdf")
    flange = plant.GetFrameByName(cell.robot.tool_frame, robot)
    plant.WeldFrames(flange, plant.GetFrameByName("body", tool))
    if mass:
        inertia = SpatialInertia(mass, np.zeros(3), UnitInertia.SolidSphere(0.05))
        load = plant.AddRigidBody("load", robot, inertia)
        frame = plant.GetFrameByName("cup", tool)
        plant.WeldFrames(frame, load.body_frame(), RigidTransform(list(p_GCm)))
    plant.Finalize()
    return plant


def dynamics_plant(cell: WorkCell, payload: Payload) -> MultibodyPlant:
    """Return the arm with a rigid gripper and the load, without surroundings."""
    return _cached_dynamics_plant(cell, payload.mass, payload.p_GCm)


def min_travel_time(displacements: Floats, robot: RobotModel) -> Floats:
    """Return in which time (...) [s] joints turn so far, from rest to rest.

    Args:
        displacements: Shape (..., n).
        robot: Its limits of velocity and acceleration alone.
    """
    far, speed, acceleration = (
        np.abs(displacements),
        robot.velocity_limits,
        robot.acceleration_limits,
    )
    reaches_no_cruise = far < speed**2 / acceleration
    triangle, trapezoid = 2 * np.sqrt(far / acceleration), far / speed + speed / acceleration
    return np.asarray(np.where(reaches_no_cruise, triangle, trapezoid).max(axis=-1))


def linear_joint_path(start: Floats, end: Floats) -> Floats:
    """(m, n) rad, from one configuration to another, `SPACING` apart at most."""
    steps = max(2, math.ceil(np.abs(end - start).max() / MAX_JOINT_STEP) + 1)
    return np.linspace(start, end, steps)


def bspline_path(waypoints: Floats) -> BsplineTrajectory:
    """A twice differentiable path of which the points (m, n) of a way are the control points: it cuts the corners."""
    distinct = np.concatenate([[True], np.abs(np.diff(waypoints, axis=0)).max(axis=1) > 1e-9])
    points = waypoints[distinct]
    while len(points) < _SPLINE_ORDER - 2:
        points = np.insert(points, 1, (points[0] + points[1]) / 2, axis=0)
    # A third of the first and last step away, else the path parameter would run three times as fast at the ends.
    points = np.insert(
        points,
        [1, len(points) - 1],
        [(2 * points[0] + points[1]) / 3, (2 * points[-1] + points[-2]) / 3],
        axis=0,
    )
    basis = BsplineBasis(_SPLINE_ORDER, len(points), KnotVectorType.kClampedUniform, 0.0, 1.0)
    return BsplineTrajectory(basis, points.T)


def sample_path(path: Trajectory, spacing: float = MAX_JOINT_STEP / 2) -> Floats:
    """(m, n) rad along a trajectory, about `spacing` apart."""
    coarse = path.vector_values(np.linspace(path.start_time(), path.end_time(), 60)).T
    count = max(20, math.ceil(np.abs(np.diff(coarse, axis=0)).max(axis=1).sum() / spacing))
    return np.asarray(path.vector_values(np.linspace(path.start_time(), path.end_time(), count)).T)


def parameterize_time_optimal(
    path: Trajectory, cell: WorkCell, payload: Payload
) -> Trajectory | None:
    """The path as fast as velocity, acceleration, torque and the cup's hold allow; None if they do not."""
    plant, robot = dynamics_plant(cell, payload), load_robot(cell.robot)
    torque_limit = LIMIT_FRACTION * robot.torque_limits
    grid = np.linspace(path.start_time(), path.end_time(), _NUM_GRID_POINTS)
    velocity = path.MakeDerivative(1)
    q, slope, curve = (
        path.vector_values(grid).T,
        velocity.vector_values(grid).T,
        velocity.MakeDerivative(1).vector_values(grid).T,
    )
    with np.errstate(divide="ignore"):
        fastest = ((LIMIT_FRACTION * robot.velocity_limits / np.abs(slope)) ** 2).min(axis=1)
    limit = np.broadcast_to(LIMIT_FRACTION * robot.acceleration_limits, slope.shape)
    rows = [(slope, curve, -limit, limit)]
    if math.isfinite(payload.max_acceleration):
        p_BCm = (robot.forward_kinematics(q) @ _p_FCm(cell, payload))[:, :3]
        limit = np.full(p_BCm.shape, payload.max_axis_acceleration)
        of_load = np.gradient(p_BCm, grid, axis=0, edge_order=2)
        rows.append((of_load, np.gradient(of_load, grid, axis=0, edge_order=2), -limit, limit))

    def solve() -> Trajectory | None:
        a, b, lower, upper = (np.hstack(column) for column in zip(*rows, strict=True))
        x = solve_toppra(grid[1] - grid[0], a, b, lower, upper, fastest)
        speed = np.sqrt(x)
        if not (speed[1:-1] > 0).all():
            return None
        times = np.concatenate([[0.0], np.cumsum(2 * np.diff(grid) / (speed[1:] + speed[:-1]))])
        along = PiecewisePolynomial.CubicHermite(times, grid[None], speed[None])
        return PathParameterizedTrajectory(
            path, smooth_time_scaling(along) if payload.mass else along
        )

    trajectory, rest = solve(), np.zeros_like(q)
    if (
        trajectory is None
        or (np.abs(inverse_dynamics(plant, *sample_motion(trajectory, 40))) <= torque_limit).all()
    ):
        return trajectory
    held = inverse_dynamics(
        plant, q, rest, rest
    )  # the torques' limits are rarely needed, and take most of the time
    if (np.abs(held) > torque_limit).any():
        return None
    lower, upper = -torque_limit - held, torque_limit - held
    rows.append(
        (
            inverse_dynamics(plant, q, rest, slope) - held,
            inverse_dynamics(plant, q, slope, curve) - held,
            lower,
            upper,
        )
    )
    return solve()


def smooth_time_scaling(time_scaling: Trajectory) -> Trajectory:
    """A path's parameter over time, averaged over `SWING` s, by which it takes longer.

    Accelerations then rise and fall; one that jumps makes a load swing on the elastic cup, twice as far.
    """
    step, half = 0.005, round(SMOOTHING_TIME / 0.01)
    times = np.arange(-2 * half, math.ceil(time_scaling.end_time() / step) + 2 * half + 1) * step
    values = time_scaling.vector_values(np.clip(times, 0.0, time_scaling.end_time())).ravel()
    mean = np.convolve(values, np.full(2 * half + 1, 1 / (2 * half + 1)), mode="valid")
    rest = np.zeros((1, 1))
    return PiecewisePolynomial.CubicWithContinuousSecondDerivatives(
        np.arange(len(mean)) * step, mean[None], rest, rest
    )


def scale_to_limits(trajectory: Trajectory, cell: WorkCell, payload: Payload) -> Trajectory | None:
    """The same motion, evenly slower until velocity, acceleration, torque and the cup's hold allow it; None if they never do."""
    plant, end = dynamics_plant(cell, payload), trajectory.end_time()
    robot = load_robot(cell.robot)
    count = max(200, math.ceil(end / 0.005))
    q, v, a = sample_motion(trajectory, count)
    held = inverse_dynamics(plant, q, np.zeros_like(q), np.zeros_like(q))
    moving = inverse_dynamics(plant, q, v, a) - held
    room = LIMIT_FRACTION * robot.torque_limits - np.sign(moving) * held
    if (room <= 0).any():
        return None
    square = (np.abs(v) / robot.velocity_limits / LIMIT_FRACTION).max() ** 2
    square = max(square, (np.abs(a) / robot.acceleration_limits / LIMIT_FRACTION).max())
    square = max(square, (np.abs(moving) / room).max())
    if math.isfinite(payload.max_acceleration):
        p_BCm = (robot.forward_kinematics(q) @ _p_FCm(cell, payload))[:, :3]
        of_load = np.diff(p_BCm, 2, axis=0) / (end / (count - 1)) ** 2
        square = max(square, np.linalg.norm(of_load, axis=1).max() / payload.max_acceleration)
    by = max(1.0, math.sqrt(square))
    return PathParameterizedTrajectory(
        trajectory, PiecewisePolynomial.FirstOrderHold([0.0, by * end], [[0.0, end]])
    )


def sample_motion(trajectory: Trajectory, count: int) -> tuple[Floats, Floats, Floats]:
    """q rad, v rad/s and a rad/s^2, (count, n) each, at times equally far apart, both ends among them."""
    times = np.linspace(trajectory.start_time(), trajectory.end_time(), count)
    v, a = (trajectory.MakeDerivative(order).vector_values(times).T for order in (1, 2))
    return trajectory.vector_values(times).T, v, a


def _p_FCm(cell: WorkCell, payload: Payload) -> Floats:
    return np.asarray(cell.gripper.X_FG.GetAsMatrix4() @ np.array([*payload.p_GCm, 1.0]))


@lru_cache(maxsize=64)
def _context(plant: MultibodyPlant) -> Context:
    return plant.CreateDefaultContext()


def inverse_dynamics(plant: MultibodyPlant, q: Floats, v: Floats, a: Floats) -> Floats:
    """(m, n) N m, that motions (m, n) each, take."""
    context, forces, found = _context(plant), MultibodyForces(plant), np.empty_like(q)
    for k in range(len(q)):
        plant.SetPositions(context, q[k])
        plant.SetVelocities(context, v[k])
        plant.CalcForceElementsContribution(context, forces)
        found[k] = plant.CalcInverseDynamics(context, a[k], forces)
    return found
