"""Time parameterization: unwrapping, blended corners, and limits at dense samples."""

import math

import numpy as np
import pytest
from conftest import DEFAULT_CELL, cell_with, rng
from numpy.typing import NDArray
from pydrake.multibody.optimization import Toppra
from pydrake.trajectories import BsplineTrajectory, Trajectory
from scipy.optimize import linprog

from drake_clutter.cell.gripper import Payload
from drake_clutter.cell.work_cell import WorkCell
from drake_clutter.planning.arm_dynamics import arm_dynamics, dynamics_plant
from drake_clutter.planning.cubic_spline import CubicSpline, clamped_knots, uniform_spline
from drake_clutter.planning.motion_limits import (
    LimitKind,
    LimitViolation,
    MotionLimits,
    scale_to_limits,
)
from drake_clutter.planning.time_parameterization import (
    SMOOTHING_TIME,
    bspline_path,
    linear_joint_path,
    parameterize_time_optimal,
    path_speed_problem,
    sample_path,
)
from drake_clutter.planning.toppra import solve_toppra
from drake_clutter.robots.robot_model import load_robot

ARM = DEFAULT_CELL
ROBOT = load_robot(ARM.robot)
HOME = ROBOT.home


def unwrapped(q: float, reference: float) -> float:
    """Return the equivalent that all joints have but the elbow, whose range is one full turn."""
    found = ROBOT.unwrap(np.full(6, q), np.full(6, reference))
    assert found[2] == q
    others = np.delete(found, 2)
    assert (others == others[0]).all()
    return float(others[0])


def test_positions_are_unwrapped_to_the_nearest_equivalent() -> None:
    assert unwrapped(3.0, -3.0) == pytest.approx(3.0 - 2 * math.pi)
    assert unwrapped(3.0, 6.2) == pytest.approx(3.0)
    assert unwrapped(-3.0, 6.2) == pytest.approx(2 * math.pi - 3.0)
    assert unwrapped(1.0, 6.2) == pytest.approx(1.0), (
        "an equivalent outside of the joint's range is not taken"
    )


def test_a_bspline_path_keeps_its_ends_and_blends_corners() -> None:
    corner = HOME + np.array([0.5, 0.0, 0.0, 0.0, 0.0, 0.0])
    end = corner + np.array([0.0, 0.4, 0.0, 0.0, 0.0, 0.0])
    points = sample_path(
        bspline_path(
            np.vstack([linear_joint_path(HOME, corner), linear_joint_path(corner, end)[1:]])
        )
    )
    assert points[0] == pytest.approx(HOME)
    assert points[-1] == pytest.approx(end)
    aside = np.abs(points[:, 0] - corner[0]) + np.abs(points[:, 1] - corner[1])
    assert 0.005 < aside.min() < 0.08


def test_splines_equal_those_of_drake() -> None:
    generator = rng(3)
    points = generator.uniform(-1.0, 1.0, (9, 6))
    for spline in (CubicSpline(0.7 * clamped_knots(9), points), uniform_spline(points, 0.005)):
        trajectory = spline.to_trajectory()
        times = np.linspace(spline.start_time, spline.end_time, 101)
        samples = spline.sample(times)
        for order, found in enumerate((samples.q, samples.v, samples.a, samples.jerk)):
            expected = trajectory.MakeDerivative(order).vector_values(times).T
            assert found == pytest.approx(expected, rel=1e-9, abs=1e-9)
        assert (spline.values(times) == samples.q).all()
        copied = CubicSpline.from_trajectory(trajectory)
        assert (copied.knots == spline.knots).all()
        assert (copied.points == points).all()


def limit_ratios(
    trajectory: Trajectory, payload: Payload, cell: WorkCell = ARM
) -> dict[str, float]:
    """Return the largest ratio to each limit at 500 Hz."""
    robot = load_robot(cell.robot)
    times = np.linspace(0.0, trajectory.end_time(), math.ceil(500 * trajectory.end_time()) + 1)
    q, v, a, jerk = (trajectory.MakeDerivative(order).vector_values(times).T for order in range(4))
    lower, upper = robot.position_limits.T
    torque = arm_dynamics(cell, payload).inverse_dynamics(q, v, a)
    X_FL = np.eye(4)
    X_FL[:3, 3] = payload.p_FCm
    X_BF = robot.forward_kinematics(q)
    p_BL = (X_BF @ X_FL)[:, :3, 3]
    tools = [tool.X_FG.GetAsMatrix4() for tool in cell.gripper.tools.values()]
    p_BG = np.array([(X_BF @ X_FG)[:, :3, 3] for X_FG in tools])
    step = times[1] - times[0]
    of_load = np.linalg.norm(np.diff(p_BL, 2, axis=0), axis=1) / step**2
    of_tool = np.linalg.norm(np.diff(p_BG, axis=1), axis=2) / step
    pairs = {
        "position": (2 * q - lower - upper) / (upper - lower),
        "speed": v / robot.velocity_limits,
        "acceleration": a / robot.acceleration_limits,
        "jerk": jerk / robot.jerk_limits,
        "torque": torque / robot.torque_limits,
        "load": of_load / payload.max_acceleration,
        "tool speed": of_tool / (cell.robot.tool_speed or math.inf),
    }
    return {name: float(np.abs(share).max()) for name, share in pairs.items()}


def corner_path(generator: np.random.Generator) -> CubicSpline:
    """Return a path with a corner."""
    via, end = (HOME + generator.uniform(-0.8, 0.8, 6) for _ in range(2))
    return bspline_path(np.vstack([linear_joint_path(HOME, via), linear_joint_path(via, end)[1:]]))


def parameterize(path: CubicSpline, payload: Payload, cell: WorkCell = ARM) -> BsplineTrajectory:
    trajectory = parameterize_time_optimal(path, MotionLimits(cell, payload))
    assert isinstance(trajectory, CubicSpline), str(trajectory)
    return trajectory.to_trajectory()


LOADED = Payload(0.5, (0.0, 0.0, 0.3223), 1.5)
SLOW_TOOL = cell_with("robot.tool_speed=0.25")
WEAK = cell_with("robot.limits.torque=[30, 50, 55, 6, 1.6, 0.1]")


@pytest.mark.parametrize(
    ("cell", "payload", "active"),
    [
        (ARM, Payload(), ""),
        (ARM, LOADED, "load"),
        (SLOW_TOOL, Payload(), "tool speed"),
        (WEAK, Payload(), "torque"),
    ],
)
def test_trajectories_satisfy_the_limits(cell: WorkCell, payload: Payload, active: str) -> None:
    generator = rng(0)
    for _ in range(2):
        path = corner_path(generator)
        trajectory = parameterize(path, payload, cell)
        ratios = limit_ratios(trajectory, payload, cell)
        assert max(ratios.values()) < 1.002, ratios
        assert not active or ratios[active] > 0.7, ratios
        for time, s in ((0.0, 0.0), (trajectory.end_time(), 1.0)):
            (q,) = path.values(np.array([s]))
            assert trajectory.value(time).ravel() == pytest.approx(q, abs=1e-12)
            for order in (1, 2):
                assert np.abs(trajectory.EvalDerivative(time, order)).max() < 1e-9
        # The trajectory follows the path.
        on_path = path.values(np.linspace(0.0, 1.0, 2000))
        for q in trajectory.vector_values(np.linspace(0.0, trajectory.end_time(), 50)).T:
            assert np.abs(on_path - q).max(axis=1).min() < 2e-3


def test_limits_that_no_speed_satisfies_are_named() -> None:
    path = corner_path(rng(0))
    weak = cell_with("robot.limits.torque=[330, 25, 150, 56, 56, 56]")
    violation = parameterize_time_optimal(path, MotionLimits(weak, Payload()))
    assert isinstance(violation, LimitViolation)
    assert (violation.kind, violation.joint) == (LimitKind.TORQUE, ROBOT.joint_names[1])
    assert str(violation) == f"torque of {ROBOT.joint_names[1]}"

    beyond = np.array([HOME, HOME + 0.5, np.where(np.arange(6) == 2, 6.6, HOME)])
    violation = parameterize_time_optimal(bspline_path(beyond), MotionLimits(ARM, Payload()))
    assert isinstance(violation, LimitViolation)
    assert (violation.kind, violation.joint) == (LimitKind.POSITION, ROBOT.joint_names[2])
    assert violation.ratio == pytest.approx(6.6 / math.pi)


@pytest.mark.parametrize("payload", [Payload(), LOADED])
def test_a_trajectory_is_scaled_until_one_limit_is_active(payload: Payload) -> None:
    end = HOME + np.array([0.8, -0.4, 0.5, 0.3, 0.0, 0.2])
    points = np.vstack([[HOME] * 3, linear_joint_path(HOME, end), [end] * 3])
    too_fast = CubicSpline(0.3 * clamped_knots(len(points)), points)
    limits = MotionLimits(ARM, payload)
    found = scale_to_limits(too_fast, limits)
    assert isinstance(found, CubicSpline)
    assert 0.99 < max(limit_ratios(found.to_trajectory(), payload).values()) < 1.002
    middle, last = found.values(found.end_time * np.array([0.5, 1.0]))
    assert last == pytest.approx(end)
    assert middle == pytest.approx(too_fast.values(np.array([0.15]))[0])
    assert scale_to_limits(found, limits) is found, "as it is, if the limits hold"


def test_time_optimal_durations_equal_those_of_drakes_toppra() -> None:
    generator = rng(1)
    unlimited_jerk = cell_with("robot.limits.jerk=null")
    for _ in range(3):
        path = corner_path(generator)
        drake_path = path.to_trajectory()
        toppra = Toppra(drake_path, dynamics_plant(ARM, Payload()), np.linspace(0.0, 1.0, 300))
        toppra.AddJointVelocityLimit(-ROBOT.velocity_limits, ROBOT.velocity_limits)
        toppra.AddJointAccelerationLimit(-ROBOT.acceleration_limits, ROBOT.acceleration_limits)
        problem = path_speed_problem(path, MotionLimits(unlimited_jerk, Payload()))
        speeds = problem.time_optimal_speeds()
        duration = (2 * np.diff(problem.grid) / (speeds[1:] + speeds[:-1])).sum()
        assert duration == pytest.approx(toppra.SolvePathParameterization().end_time(), rel=0.01)


@pytest.mark.parametrize("seed", range(6))
def test_path_speeds_are_the_largest_that_satisfy_limits_at_both_ends_of_each_step(
    seed: int,
) -> None:
    """Compare with linear programming: the largest sum of squared speeds x from rest to rest.

    The acceleration of a step is that of x. The first limit is one of x alone.
    """
    generator = rng(seed)
    count, step = 12, 0.1
    a = generator.uniform(0.2, 1.0, (count, 3)) * generator.choice([-1.0, 1.0], (count, 3))
    a[:, 0] = 0.0
    b = generator.uniform(-1.0, 1.0, (count, 3))
    lower, upper = -generator.uniform(0.5, 1.5, (count, 3)), generator.uniform(0.5, 1.5, (count, 3))
    largest = generator.uniform(0.5, 2.0, count)
    x = solve_toppra(step, a, b, lower, upper, largest)
    rows, bounds = list[NDArray[np.float64]](), list[float]()
    for i in range(count - 1):
        for point in (i, i + 1):
            for k in range(3):
                row = np.zeros(count)
                row[i] -= a[point, k] / (2 * step)
                row[i + 1] += a[point, k] / (2 * step)
                row[point] += b[point, k]
                rows += [row, -row]
                bounds += [upper[point, k], -lower[point, k]]
    assert (np.array(rows) @ x <= np.array(bounds) + 1e-9).all()
    limits = [(0.0, float(value)) for value in largest]
    limits[0] = limits[-1] = (0.0, 0.0)
    optimum = linprog(-np.ones(count), np.array(rows), bounds, bounds=limits)
    assert x == pytest.approx(optimum.x, abs=1e-6)


def test_a_joint_moves_nearly_as_fast_as_its_limits_allow() -> None:
    """Compare with the time-optimal motion of one joint under the same limits.

    Its duration is d / v + v / a + a / j if velocity and acceleration reach their limits.
    """
    waypoints = linear_joint_path(HOME, HOME + np.array([2.5, 0.0, 0.0, 0.0, 0.0, 0.0]))
    trajectory = parameterize(bspline_path(waypoints), Payload())
    v, a, j = (
        limits[0]
        for limits in (ROBOT.velocity_limits, ROBOT.acceleration_limits, ROBOT.jerk_limits)
    )
    optimum = 2.5 / v + v / a + a / j
    assert optimum < trajectory.end_time() < optimum + SMOOTHING_TIME
