"""Time parameterization: from joint-space waypoints to feasible trajectories.

Frames: B is the robot's base, F is the flange, G is the gripper, Cm is the load's center of mass.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydrake.trajectories import Trajectory
from scipy.ndimage import maximum_filter1d

from drake_clutter.compilation import njit
from drake_clutter.planning.cubic_spline import (
    SPLINE_ORDER,
    CubicSpline,
    MotionSamples,
    clamped_knots,
    uniform_spline,
)
from drake_clutter.planning.motion_limits import (
    LIMIT_TOLERANCE,
    LimitViolation,
    MotionLimits,
    scale_to_limits,
)
from drake_clutter.planning.toppra import solve_toppra
from drake_clutter.robots.robot_model import RobotModel

Floats = NDArray[np.float64]

MAX_JOINT_STEP = 0.08
"""Largest change of a joint between neighboring waypoints of a path [rad]; it also bounds the
rotation of the gripper between neighboring poses."""
SMOOTHING_TIME = 0.1
"""Width of the moving average of `smooth_time_scaling` [s]. It is the period at which 0.5 kg
oscillates on the bellows of the default suction cup (2000 N/m), and twice the time in which the
jerk limits of the cells of `models/` allow the full acceleration, so that the acceleration may
change its sign at once."""
SPLINE_PERIOD = 0.005
"""Time between the knots of a trajectory [s]. Between its control points, which lie on the path, a
spline passes at a sixth of their second difference: 0.04 mrad at 10 rad/s^2."""
_NUM_GRID_POINTS = 300
"""Points of a path at which limits are imposed."""
_NUM_ROUNDS = 3
"""Largest number of solutions of TOPP-RA with smaller and smaller limits."""
_MAX_SLOWDOWN = 1.25
"""Largest factor by which a round slows a part of the path down."""
_MAX_SQUARED_SPEED = 1e6
"""Upper bound of the squared speed of the path parameter [1/s^2]; keeps paths of no length finite.
"""


def _gradient_weights(grid: Floats) -> Floats:
    """Return the weights of three neighboring values in derivatives of second order.

    They are those of `numpy.gradient`; the outermost derivatives are one-sided.

    Args:
        grid: Parameters. Shape (m,).

    Returns:
        Weights. Shape (m, 3).
    """
    before, after = np.diff(grid)[:-1], np.diff(grid)[1:]
    both = before + after
    inner = [-after / (before * both), (after - before) / (before * after), before / (after * both)]
    a, b = before[0], after[0]
    first = [-(2 * a + b) / (a * (a + b)), (a + b) / (a * b), -a / (b * (a + b))]
    a, b = before[-1], after[-1]
    last = [b / (a * (a + b)), -(b + a) / (a * b), (2 * b + a) / (b * (a + b))]
    return np.vstack([first, np.column_stack(inner), last])


_GRID = np.linspace(0.0, 1.0, _NUM_GRID_POINTS)
"""Parameters of a path at which limits are imposed. Shape (_NUM_GRID_POINTS,)."""
_GRADIENT_WEIGHTS = _gradient_weights(_GRID)
"""See `_gradient_weights`. Shape (_NUM_GRID_POINTS, 3)."""


@njit(cache=True, nogil=True)
def _differentiate(weights, values):  # type: ignore[no-untyped-def]
    """Return derivatives (m, k) of values (m, k), see `_gradient_weights`."""
    m, k = values.shape
    derivatives = np.empty((m, k))
    for i in range(m):
        first = min(max(i - 1, 0), m - 3)
        for j in range(k):
            derivatives[i, j] = (
                weights[i, 0] * values[first, j]
                + weights[i, 1] * values[first + 1, j]
                + weights[i, 2] * values[first + 2, j]
            )
    return derivatives


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


def bspline_path(waypoints: Floats) -> CubicSpline:
    """Return a cubic B-spline that has the waypoints as control points.

    The path starts at the first and ends at the last waypoint, and blends the corners.

    Args:
        waypoints: Configurations. Shape (m, n).
    """
    is_distinct = np.abs(waypoints[1:] - waypoints[:-1]).max(axis=1) > 1e-9
    points = np.vstack([waypoints[:1], waypoints[1:][is_distinct]])
    # Control points at a third of the first and last step. Without them the derivative by the path
    # parameter would be three times as large at the ends as elsewhere.
    second, last_but_one = (2 * points[0] + points[1]) / 3, (2 * points[-1] + points[-2]) / 3
    points = np.vstack([points[:1], second, points[1:-1], last_but_one, points[-1:]])
    return CubicSpline(clamped_knots(len(points)), points)


def sample_path(path: CubicSpline, spacing: float = MAX_JOINT_STEP / 2) -> Floats:
    """Return configurations at uniform parameters, about `spacing` apart.

    Args:
        path: Path or trajectory in joint space.
        spacing: Mean distance, as the largest change of a joint [rad].

    Returns:
        Configurations. Shape (m, n).
    """
    coarse = path.values(np.linspace(path.start_time, path.end_time, 60))
    length = np.abs(coarse[1:] - coarse[:-1]).max(axis=1).sum()
    count = max(20, math.ceil(length / spacing))
    return path.values(np.linspace(path.start_time, path.end_time, count))


def parameterize_time_optimal(
    path: CubicSpline, limits: MotionLimits
) -> CubicSpline | LimitViolation:
    """Return a nearly time-optimal trajectory along a path, at rest with zero acceleration at ends.

    TOPP-RA finds the time-optimal speeds with steps of the acceleration. Their moving average over
    `SMOOTHING_TIME` bounds the jerk, and shifts accelerations along the path: where a limit is
    exceeded then, the next round has smaller limits. The trajectory is a uniform B-spline over
    time whose control points lie on the path, so that it satisfies the limits of velocity,
    acceleration and jerk also between its knots. `scale_to_limits` checks the fastest one.

    Args:
        path: Path in joint space with the parameter s in [0, 1].
        limits: Limits of the motion.

    Returns:
        The trajectory, or the limit that it exceeds at any speed.
    """
    problem = path_speed_problem(path, limits)
    squared_scales = np.ones(_NUM_GRID_POINTS)
    shortest, best = math.inf, path
    for _ in range(_NUM_ROUNDS):
        s = smooth_time_scaling(problem.grid, problem.time_optimal_speeds(squared_scales))
        points = path.values(s)
        scales = limits.ratios(_samples_at_knots(points)).time_scales()
        scale = float(scales.max())
        if not math.isfinite(scale):
            return scale_to_limits(uniform_spline(points, SPLINE_PERIOD), limits)
        scale = max(scale, 1.0)
        if scale * len(points) < shortest:
            shortest, best = scale * len(points), uniform_spline(points, scale * SPLINE_PERIOD)
        if scale <= 1 + LIMIT_TOLERANCE:
            break
        # The smoothing mixes accelerations within half its width on either side.
        width = 1 + round(SMOOTHING_TIME / SPLINE_PERIOD)
        widened = np.minimum(maximum_filter1d(np.maximum(scales, 1.0), width), _MAX_SLOWDOWN)
        squared_scales *= np.interp(problem.grid, s[1:-1], widened) ** 2
    return scale_to_limits(best, limits)


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


@dataclass(frozen=True)
class PathSpeedProblem:
    """Limits of the speed along a path, at grid points of its parameter s.

    Attributes:
        grid: Uniform grid points. Shape (m,).
        a: Coefficients of the acceleration of s in the limited accelerations. Shape (m, rows).
        b: Coefficients of the squared speed of s. Shape (m, rows).
        bounds: Limits of the absolute accelerations. Shape (m, rows).
        max_squared_speeds: Upper bounds of the squared speed of s. Shape (m,).
    """

    grid: Floats
    a: Floats
    b: Floats
    bounds: Floats
    max_squared_speeds: Floats

    def time_optimal_speeds(self, squared_scales: Floats | float = 1.0) -> Floats:
        """Return the time-optimal speeds of s from rest to rest. Shape (m,).

        Args:
            squared_scales: Squared factors by which each point is slowed down. Shape (m,).
        """
        bounds = self.bounds / np.reshape(squared_scales, (-1, 1))
        squared_speeds = solve_toppra(
            self.grid[1] - self.grid[0],
            self.a,
            self.b,
            -bounds,
            bounds,
            self.max_squared_speeds / squared_scales,
        )
        return np.sqrt(squared_speeds)


def path_speed_problem(path: CubicSpline, limits: MotionLimits) -> PathSpeedProblem:
    """Return the limits of the speed along a path, without those of jerk and torque.

    Args:
        path: Path in joint space with the parameter s in [0, 1].
        limits: Limits of the motion.
    """
    robot = limits.robot
    grid = _GRID
    on_path = path.sample(grid)
    q, dq_ds, d2q_ds2 = on_path.q, on_path.v, on_path.a
    X_BF = robot.forward_kinematics(q)
    rows = [(dq_ds, d2q_ds2, robot.acceleration_limits)]
    if math.isfinite(limits.payload.max_acceleration):
        p_BCm = X_BF[:, :3, :3] @ limits.p_FC[0] + X_BF[:, :3, 3]
        dp_ds = _differentiate(_GRADIENT_WEIGHTS, p_BCm)
        d2p_ds2 = _differentiate(_GRADIENT_WEIGHTS, dp_ds)
        rows.append((dp_ds, d2p_ds2, np.full(3, limits.payload.max_axis_acceleration)))
    a, b, bounds = (
        np.hstack([np.broadcast_to(row[k], row[0].shape) for row in rows]) for k in range(3)
    )
    with np.errstate(divide="ignore"):
        max_speeds = (robot.velocity_limits / np.abs(dq_ds)).min(axis=1)
    if math.isfinite(limits.max_tool_speed):
        p_BG = limits.p_FC[1:] @ X_BF[:, :3, :3].transpose(0, 2, 1) + X_BF[:, None, :3, 3]
        dp_ds = np.gradient(p_BG, grid, axis=0, edge_order=2)
        tool_speeds = np.linalg.norm(dp_ds, axis=2).max(axis=1)
        max_speeds = np.minimum(max_speeds, limits.max_tool_speed / np.maximum(tool_speeds, 1e-12))
    with np.errstate(divide="ignore"):
        max_speeds = np.minimum(
            max_speeds, np.cbrt(robot.jerk_limits / np.abs(on_path.jerk)).min(axis=1)
        )
    max_squared_speeds = np.minimum(max_speeds**2, _MAX_SQUARED_SPEED)
    return PathSpeedProblem(grid, a, b, bounds, max_squared_speeds)


def smooth_time_scaling(grid: Floats, speeds: Floats) -> Floats:
    """Return control points of a time scaling, averaged over `SMOOTHING_TIME`.

    They are the control points of a uniform cubic B-spline over time with knots `SPLINE_PERIOD`
    apart. Three equal ones at either end give zero speed and acceleration.

    Args:
        grid: Grid points of the path parameter s. Shape (m,).
        speeds: Speeds of s, zero at the ends, with constant accelerations in between. Shape (m,).

    Returns:
        Values of s. Shape (k,).
    """
    return np.asarray(_average(grid, speeds))


@njit(cache=True, nogil=True)
def _average(grid, speeds):  # type: ignore[no-untyped-def]
    """Return the control points (k,) of `smooth_time_scaling`."""
    times = np.zeros(len(grid))
    for k in range(1, len(grid)):
        times[k] = times[k - 1] + 2 * (grid[k] - grid[k - 1]) / (speeds[k] + speeds[k - 1])
    half_width = SMOOTHING_TIME / 2
    count = math.ceil((times[-1] + SMOOTHING_TIME) / SPLINE_PERIOD) + 2 * SPLINE_ORDER - 3
    centers = (np.arange(count) - (SPLINE_ORDER - 2)) * SPLINE_PERIOD - half_width
    upper, lower = np.empty(count), np.empty(count)
    _integrate(times, grid, speeds, centers + half_width, upper)
    _integrate(times, grid, speeds, centers - half_width, lower)
    for k in range(count):
        s = (upper[k] - lower[k]) / SMOOTHING_TIME
        upper[k] = min(max(s, grid[0]), grid[-1])
    return upper


@njit(cache=True, nogil=True)
def _integrate(times, grid, speeds, ends, integrals):  # type: ignore[no-untyped-def]
    """Write the integrals (k,) of s from 0 to ascending times (k,), see `smooth_time_scaling`.

    s stays at its ends before and after.
    """
    total = 0.0
    m = 0
    for k in range(len(ends)):
        while m < len(times) - 1 and times[m + 1] < ends[k]:
            dt = times[m + 1] - times[m]
            acceleration = (speeds[m + 1] - speeds[m]) / dt
            total += dt * (grid[m] + dt * (speeds[m] / 2 + dt * acceleration / 6))
            m += 1
        if m == len(times) - 1:
            integrals[k] = total + (ends[k] - times[m]) * grid[m]
        else:
            dt = max(ends[k] - times[m], 0.0)
            acceleration = (speeds[m + 1] - speeds[m]) / (times[m + 1] - times[m])
            integrals[k] = total + dt * (grid[m] + dt * (speeds[m] / 2 + dt * acceleration / 6))


def _samples_at_knots(points: Floats) -> MotionSamples:
    """Return the motion of a uniform B-spline at its knots, the jerk of the steeper neighbor.

    Args:
        points: Control points. Shape (k, n).

    Returns:
        Samples of length k - 2.
    """
    shape = len(points) - 2, points.shape[1]
    samples = MotionSamples(*(np.empty(shape) for _ in range(4)))
    _sample_knots(points, samples.q, samples.v, samples.a, samples.jerk)
    return samples


@njit(cache=True, nogil=True)
def _sample_knots(points, q, v, a, jerk):  # type: ignore[no-untyped-def]
    """Write positions, velocities, accelerations and jerks of `_samples_at_knots` (k - 2, n)."""
    m, n = q.shape
    for k in range(m):
        for j in range(n):
            before, here, after = points[k, j], points[k + 1, j], points[k + 2, j]
            q[k, j] = (before + 4 * here + after) / 6
            v[k, j] = (after - before) / (2 * SPLINE_PERIOD)
            a[k, j] = ((after - here) - (here - before)) / SPLINE_PERIOD**2
    for j in range(n):
        left = abs(a[1, j] - a[0, j]) / SPLINE_PERIOD
        for k in range(m):
            right = left if k == m - 1 else abs(a[k + 1, j] - a[k, j]) / SPLINE_PERIOD
            jerk[k, j] = max(left, right)
            left = right
