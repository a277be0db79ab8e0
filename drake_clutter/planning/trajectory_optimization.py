"""Minimum-time trajectory optimization by sequential convex programming.

A cubic B-spline in joint space is optimized for minimum duration T under limits of velocity,
acceleration and jerk of the joints, speed and acceleration of the tool, and under signed-distance
constraints. Signed distances
are linear in the joint positions for small steps, and so in the control points of the spline. Each
convex subproblem linearizes them at the previous solution, and a trust region bounds the change of
the control points (Schulman et al. 2014, "Motion planning with sequential convex optimization and
convex collision checking").

The variables are the control points over the parameter s in [0, 1], and T^2. The limits are linear
in these: q'' is bounded by a_max T^2, q' by v_max T and q''' by j_max T^3. The square root T of
T^2 is replaced by its tangent at the previous solution, which is slightly larger until convergence,
and T^3 likewise by its tangent, which is slightly smaller.

The result is not guaranteed to satisfy the constraints between samples. The caller checks it for
collisions and scales it to the limits.
"""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydrake.solvers import ClarabelSolver, MathematicalProgram, SolverOptions
from pydrake.trajectories import Trajectory

from drake_clutter.planning.cubic_spline import CubicSpline, clamped_knots
from drake_clutter.planning.spline_program import (
    BASIS_SPLINE,
    DERIVATIVE_WEIGHTS,
    NUM_COLLISION_SAMPLES,
    NUM_CONTROL_POINTS,
    NUM_FIXED_CONTROL_POINTS,
    SAMPLE_PARAMETERS,
    SECOND_DERIVATIVE_WEIGHTS,
    SPLINE_ORDER,
    VALUE_WEIGHTS,
    ControlPointSubspaces,
    LinearConstraints,
    LinearizedDistances,
    derivative_matrix,
    directional_matrix,
)
from drake_clutter.robots.robot_model import RobotModel

Floats = NDArray[np.float64]

TRUST_REGION_RADII = (0.8, 0.4, 0.2)
"""Largest change of a control point in each subproblem [rad]."""
LINEARIZED_TILT_RADII = (0.4, 0.2, 0.1, 0.05, 0.03)
"""Trust region radii where the tool is kept vertical by a linearized constraint [rad]."""
REPAIR_FACTORS = (0.5, 0.25)
"""Trust region radii of the repairs of a trajectory, as fractions of the last radius."""
CONVERGENCE_TOLERANCE = 0.02
"""Change of the control points [rad], and relative change of the duration, at convergence."""
INFLUENCE_DISTANCE = 0.06
"""Distances above this are ignored [m]."""
MIN_AXIAL_TRAVEL = (0.0, 0.002)
"""Distances of the first free control points from the grasp and the place pose, on the axis of the
tool there, if it holds nothing [m]: it leaves an object along its axis."""
TOOL_AXIS = np.array([0.0, 0.0, 1.0])
"""Axis of the tool in its own frame. Shape (3,)."""
ENDPOINT_FRACTION = 0.15
"""Fraction of the path at either end where distances below the required ones are not increased: the
fixed endpoints leave no freedom there."""
_SMOOTHNESS_WEIGHT = 1e-4
"""Weight of the squared accelerations relative to T^2. It selects the smoothest of the trajectories
with nearly minimal duration."""
_EXPECTED_GAIN = 0.78
"""Typical ratio of the optimized to the initial duration: the tangents of the first subproblem are
those at this duration."""
_MAX_TANGENT_CHANGE = 0.25
"""Relative change of the duration up to which the tangents change its optimum by less than 1 %."""
_MAX_DISTANCE_ERROR = 0.001
"""Shortfall of distances [m] that is less than the margin which the caller adds to them."""
_SOLVER_OPTIONS = SolverOptions()
"""Tolerances of the subproblems [rad]: those of the limits and distances are larger."""
for _name in ("tol_gap_abs", "tol_gap_rel", "tol_feas"):
    _SOLVER_OPTIONS.SetOption(ClarabelSolver.id(), _name, 1e-5)
_MIN_DURATION = 0.05
"""Lower bound of the duration [s]; keeps the subproblems well conditioned."""


@dataclass(frozen=True)
class TrajectoryOptimizationProblem:
    """Input of one trajectory optimization.

    Attributes:
        initial_trajectory: Collision-free, time-parameterized initial guess.
        robot: Robot with its joint limits.
        departure_distances: Least distances from the start of the first free control points, on a
            straight line from there [m]; empty if the tool may move in any direction.
        arrival_distances: Likewise from the end, for the last free control points [m].
        departure_directions: Directions of these lines in T, at the start and at the end. Shapes
            (3,).
        level_axis: Axis in the tool that keeps pointing down; None if the tool may tilt. Shape
            (3,).
        max_tool_speed: Largest speed of the tool [m/s]; infinite without a limit.
        max_tool_acceleration: Largest acceleration of the tool along each axis [m/s^2].
        nearby_distances: Returns all distances below the influence distance, from joint positions
            of shape (m, n) and the path parameters s in [0, 1] of shape (m,).
        column_distances: Returns the distances from the columns below a carried object, like
            `nearby_distances`, from joint positions of shape (m, n); they are also imposed at the
            ends of the path, but for its parts on the axes. None without an object.
        tool_jacobians: Returns the spatial Jacobians of the tool, angular rows first, shape
            (m, 6, n), from joint positions of shape (m, n).
        tool_rotations: Returns the orientations of the tool in T, shape (m, 3, 3), from joint
            positions of shape (m, n).
    """

    initial_trajectory: Trajectory
    robot: RobotModel
    departure_distances: tuple[float, ...]
    arrival_distances: tuple[float, ...]
    departure_directions: tuple[Floats, Floats]
    level_axis: Floats | None
    max_tool_speed: float
    max_tool_acceleration: float
    nearby_distances: Callable[[Floats, Floats], LinearizedDistances]
    column_distances: Callable[[Floats], LinearizedDistances] | None
    tool_jacobians: Callable[[Floats], Floats]
    tool_rotations: Callable[[Floats], Floats]

    @property
    def holds_load(self) -> bool:
        """Whether the tool holds an object."""
        return math.isfinite(self.max_tool_acceleration)

    @property
    def level_rows(self) -> Floats | None:
        """Rows that keep the tool level exactly, see `RobotModel.vertical_tool_rows`."""
        is_vertical = self.level_axis is not None and np.array_equal(self.level_axis, TOOL_AXIS)
        return self.robot.vertical_tool_rows if is_vertical else None


def optimize_trajectory(problem: TrajectoryOptimizationProblem) -> Iterator[CubicSpline]:
    """Yield faster trajectories than the initial one.

    The first is the solution of the optimization. Each of the others repairs the one before it: the
    constraints are linearized there, in a smaller trust region.

    Args:
        problem: Trajectory optimization problem.
    """
    initial_duration = problem.initial_trajectory.end_time()
    points = _fit_control_points(problem.initial_trajectory)
    # The path of a held object has no tangents of the tool's limits at another duration.
    duration = initial_duration * (1.0 if problem.holds_load else _EXPECTED_GAIN)
    is_exact = problem.level_axis is None or problem.level_rows is not None
    radii = TRUST_REGION_RADII if is_exact else LINEARIZED_TILT_RADII
    repair_radii = [factor * radii[-1] for factor in REPAIR_FACTORS]
    has_converged = False
    for radius in (*radii, *repair_radii):
        if has_converged and radius in radii:
            continue
        solution = _solve_subproblem(problem, points, duration, radius)
        if solution is None:
            return
        new_points, new_duration = solution
        change = np.abs(new_points - points).max()
        time_change = abs(new_duration - duration) / duration
        is_close = change < 0.99 * radius and time_change < _MAX_TANGENT_CHANGE
        points, duration = solution
        has_converged = bool(
            max(change, time_change) < CONVERGENCE_TOLERANCE
            or (is_close and _is_nearly_optimal(problem, points))
        )
        if has_converged or radius <= radii[-1]:
            shortest = _shortest_duration(points, problem.robot)
            if shortest < initial_duration:
                yield CubicSpline(shortest * clamped_knots(NUM_CONTROL_POINTS), points)


def _shortest_duration(points: Floats, robot: RobotModel) -> float:
    """Return the shortest duration of a spline within the limits of the joints [s].

    Args:
        points: Control points. Shape (28, n).
        robot: Robot with the limits.
    """
    limits = (robot.velocity_limits, robot.acceleration_limits, robot.jerk_limits)
    durations = list[float]()
    for order, limit in enumerate(limits, start=1):
        derivatives = derivative_matrix(order, robot.num_joints) @ points.ravel()
        ratio = float(np.abs(derivatives.reshape(-1, robot.num_joints) / limit).max())
        durations.append(ratio ** (1.0 / order))
    return max(durations)


def _is_nearly_optimal(problem: TrajectoryOptimizationProblem, points: Floats) -> bool:
    """Return whether another subproblem would hardly change the duration.

    Joint limits are linear but for the tangents of T. Without limits of the tool, a solution that
    keeps the distances is thus nearly optimal.

    Args:
        problem: Trajectory optimization problem.
        points: Solution of a subproblem. Shape (28, n).
    """
    if problem.holds_load or math.isfinite(problem.max_tool_speed):
        return False
    nearby = problem.nearby_distances(VALUE_WEIGHTS @ points, SAMPLE_PARAMETERS)
    s = SAMPLE_PARAMETERS[nearby.rows]
    is_free = np.minimum(s, 1 - s) >= ENDPOINT_FRACTION
    return bool((nearby.slack[is_free] > -_MAX_DISTANCE_ERROR).all())


def _fit_control_points(trajectory: Trajectory) -> Floats:
    """Return the control points of the least-squares fit to a trajectory. Shape (28, n)."""
    num_fixed = NUM_FIXED_CONTROL_POINTS
    s = np.linspace(0.0, 1.0, 120)
    q = trajectory.vector_values(s * trajectory.end_time()).T
    B = BASIS_SPLINE.vector_values(s).T
    points = np.empty((NUM_CONTROL_POINTS, q.shape[1]))
    points[:num_fixed] = q[0]
    points[-num_fixed:] = q[-1]
    fixed = [*range(num_fixed), *range(NUM_CONTROL_POINTS - num_fixed, NUM_CONTROL_POINTS)]
    points[num_fixed:-num_fixed] = np.linalg.lstsq(
        B[:, num_fixed:-num_fixed], q - B[:, fixed] @ points[fixed], rcond=None
    )[0]
    return points


def _is_axial(problem: TrajectoryOptimizationProblem) -> NDArray[np.bool_]:
    """Return which samples are on the axes of the tool at the ends. Shape (m,)."""
    num_spans = NUM_CONTROL_POINTS - SPLINE_ORDER + 1
    spans = SAMPLE_PARAMETERS * num_spans
    num_start, num_end = len(problem.departure_distances), len(problem.arrival_distances)
    return np.asarray((spans < num_start) | (num_spans - spans < num_end))


def _limit_constraints(
    problem: TrajectoryOptimizationProblem, points: Floats, duration: float
) -> LinearConstraints:
    """Return limits and distance constraints, linearized at a spline.

    Args:
        problem: Trajectory optimization problem.
        points: Control points. Shape (28, n).
        duration: Duration T [s].
    """
    constraints = LinearConstraints()
    q = VALUE_WEIGHTS @ points
    robot = problem.robot
    n = robot.num_joints
    speeds = np.tile(robot.velocity_limits, NUM_CONTROL_POINTS - 1)
    accelerations = np.tile(robot.acceleration_limits, NUM_CONTROL_POINTS - 2)
    # T is at most the tangent of sqrt(T^2): T^2 / (2 T_previous) + T_previous / 2.
    constraints.add_two_sided(
        derivative_matrix(1, n), speeds / (2 * duration), speeds * duration / 2
    )
    constraints.add_two_sided(derivative_matrix(2, n), accelerations)
    if np.isfinite(robot.jerk_limits).all():
        # T^3 is at least the tangent of (T^2)^1.5: 1.5 T_previous T^2 - T_previous^3 / 2.
        jerks = np.tile(robot.jerk_limits, NUM_CONTROL_POINTS - 3)
        constraints.add_two_sided(
            derivative_matrix(3, n), 1.5 * duration * jerks, -jerks * duration**3 / 2
        )
    nearby = problem.nearby_distances(q, SAMPLE_PARAMETERS)
    if len(nearby.rows):
        index, gradients = nearby.rows, nearby.gradients
        is_near_end = np.minimum(SAMPLE_PARAMETERS, 1 - SAMPLE_PARAMETERS) < ENDPOINT_FRACTION
        slack = np.where(is_near_end[index], np.maximum(nearby.slack, 0.0), nearby.slack)
        constraints.add_distances(LinearizedDistances(index, gradients, slack), q)
    if problem.column_distances is not None:
        columns = problem.column_distances(q)
        is_kept = ~_is_axial(problem)[columns.rows]
        kept = LinearizedDistances(
            columns.rows[is_kept], columns.gradients[is_kept], columns.slack[is_kept]
        )
        constraints.add_distances(kept, q)
    if math.isfinite(problem.max_tool_speed):
        J = problem.tool_jacobians(q)[:, 3:]
        velocities = (J @ (DERIVATIVE_WEIGHTS @ points)[:, :, None])[:, :, 0]
        directions = velocities / np.maximum(np.linalg.norm(velocities, axis=1), 1e-9)[:, None]
        speed = np.full(len(q), problem.max_tool_speed)
        constraints.add(
            directional_matrix(DERIVATIVE_WEIGHTS, (directions[:, None] @ J)[:, 0]),
            -speed / (2 * duration),
            speed * duration / 2,
        )
    if math.isfinite(problem.max_tool_acceleration):
        index = np.repeat(np.arange(0, NUM_COLLISION_SAMPLES, 2), 3)
        J = problem.tool_jacobians(q[::2])[:, 3:].reshape(-1, n)
        constraints.add_two_sided(
            directional_matrix(SECOND_DERIVATIVE_WEIGHTS[index], J),
            np.full(len(index), problem.max_tool_acceleration),
        )
    return constraints


def _add_level_constraints(
    problem: TrajectoryOptimizationProblem,
    level_axis: Floats,
    points: Floats,
    subspaces: ControlPointSubspaces,
) -> None:
    """Add the constraint that an axis of the tool keeps pointing down.

    It is exact for robots with `vertical_tool_rows` and a vertical tool. Else it is linearized at
    the previous control points, except for those at the ends that are fixed or on a straight line.

    Args:
        problem: Trajectory optimization problem.
        level_axis: The axis in the tool. Shape (3,).
        points: Previous control points. Shape (28, n).
        subspaces: Subspaces to which the constraint is added.
    """
    rows = problem.level_rows
    start = NUM_FIXED_CONTROL_POINTS + len(problem.departure_distances)
    end = NUM_CONTROL_POINTS - NUM_FIXED_CONTROL_POINTS - len(problem.arrival_distances)
    if rows is not None:
        subspaces.constrain(range(start, end), rows, rows @ points[0])
        return
    axes = problem.tool_rotations(points) @ level_axis
    jacobians = problem.tool_jacobians(points)
    for k in range(start, end):
        (x, y, z), J_rotation = axes[k], jacobians[k, :3]
        # Derivatives of x and y of the axis in T: the first two rows of w x axis.
        tilts = np.array(
            [z * J_rotation[1] - y * J_rotation[2], x * J_rotation[2] - z * J_rotation[0]]
        )
        subspaces.constrain([k], tilts, tilts @ points[k] - [x, y])


def _basis_with(axis: Floats) -> Floats:
    """Return a rotation matrix whose last row is a unit vector. Shapes (3, 3), (3,)."""
    first = np.cross((0.0, 1.0, 0.0) if abs(axis[1]) < 0.9 else (1.0, 0.0, 0.0), axis)
    first /= np.linalg.norm(first)
    return np.array([first, np.cross(axis, first), axis])


def _add_departure_constraints(
    problem: TrajectoryOptimizationProblem,
    points: Floats,
    subspaces: ControlPointSubspaces,
    constraints: LinearConstraints,
) -> None:
    """Add the constraint that the tool moves on straight lines at the start and at the end.

    Args:
        problem: Trajectory optimization problem.
        points: Previous control points. Shape (28, n).
        subspaces: Subspaces to which equality constraints are added.
        constraints: Constraints to which inequalities are added.
    """
    for heights, end, inwards, away in (
        (problem.departure_distances, 0, 1, problem.departure_directions[0]),
        (
            problem.arrival_distances,
            NUM_CONTROL_POINTS - 1,
            -1,
            problem.departure_directions[1],
        ),
    ):
        if not heights:
            continue
        q = points[end]
        (J,) = problem.tool_jacobians(q[None])
        J = np.vstack([J[:3], _basis_with(away) @ J[3:]])
        indices = end + inwards * (NUM_FIXED_CONTROL_POINTS + np.arange(len(heights)))
        subspaces.constrain(indices.tolist(), J[:5], J[:5] @ q)
        constraints.add(
            directional_matrix(-np.eye(NUM_CONTROL_POINTS)[indices], J[5:]),
            np.zeros(len(heights)),
            -J[5] @ q - np.array(heights),
        )


def _solve_subproblem(
    problem: TrajectoryOptimizationProblem,
    points: Floats,
    duration: float,
    trust_region_radius: float,
) -> tuple[Floats, float] | None:
    """Solve the convex subproblem at a spline.

    Args:
        problem: Trajectory optimization problem.
        points: Previous control points. Shape (28, n).
        duration: Previous duration [s].
        trust_region_radius: Largest change of a control point [rad].

    Returns:
        New control points, shape (28, n), and duration [s]; None if the subproblem is infeasible.
    """
    n = problem.robot.num_joints
    subspaces = ControlPointSubspaces(points)
    constraints = _limit_constraints(problem, points, duration)
    _add_departure_constraints(problem, points, subspaces, constraints)
    if problem.level_axis is not None:
        _add_level_constraints(problem, problem.level_axis, points, subspaces)
    N, p_0 = subspaces.basis, subspaces.offset
    prog = MathematicalProgram()
    x = prog.NewContinuousVariables(N.shape[1] + 1)
    constraints.add_to(prog, subspaces, x)
    lower, upper = np.tile(problem.robot.position_limits.T, NUM_CONTROL_POINTS)
    lower = np.maximum(points.ravel() - trust_region_radius, lower) - p_0
    upper = np.minimum(points.ravel() + trust_region_radius, upper) - p_0
    is_free = np.diff(N.indptr) > 0
    prog.AddLinearConstraint(N[is_free].tocsc(), lower[is_free], upper[is_free], x[:-1])
    prog.AddBoundingBoxConstraint(_MIN_DURATION**2, (2 * duration + 0.1) ** 2, x[-1:])
    prog.AddLinearCost([1 / duration**2], 0.0, x[-1:])
    limits = np.tile(problem.robot.acceleration_limits, NUM_CONTROL_POINTS - 2) * duration**2
    # Accelerations of y and of p_0, relative to the limits.
    D = derivative_matrix(2, n)
    of_y, of_offset = (D @ N).toarray() / limits[:, None], (D @ p_0) / limits
    prog.AddQuadraticCost(
        2 * _SMOOTHNESS_WEIGHT * of_y.T @ of_y,
        2 * _SMOOTHNESS_WEIGHT * of_y.T @ of_offset,
        x[:-1],
        is_convex=True,
    )
    result = ClarabelSolver().Solve(prog, None, _SOLVER_OPTIONS)
    if not result.is_success():
        return None
    solution = result.GetSolution(x)
    return (p_0 + N @ solution[:-1]).reshape(points.shape), math.sqrt(solution[-1])
