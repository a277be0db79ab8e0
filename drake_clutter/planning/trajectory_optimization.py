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
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from pydrake.math import BsplineBasis, KnotVectorType
from pydrake.solvers import ClarabelSolver, MathematicalProgram, SolverOptions
from pydrake.trajectories import BsplineTrajectory, Trajectory
from scipy import sparse
from scipy.linalg import null_space

from drake_clutter.planning.cubic_spline import CubicSpline, clamped_knots
from drake_clutter.robots.robot_model import RobotModel

Floats = NDArray[np.float64]

NUM_CONTROL_POINTS = 28
"""Control points of the spline."""
TRUST_REGION_RADII = (0.8, 0.4, 0.2)
"""Largest change of a control point in each subproblem [rad]."""
LINEARIZED_TILT_RADII = (0.4, 0.2, 0.1, 0.05, 0.03)
"""Trust region radii where the tool is kept vertical by a linearized constraint [rad]."""
REPAIR_FACTORS = (0.5, 0.25)
"""Trust region radii of the repairs of a trajectory, as fractions of the last radius."""
NUM_COLLISION_SAMPLES = 50
"""Points of the spline at which distances and tool speeds are imposed; tool accelerations at every
second one."""
CONVERGENCE_TOLERANCE = 0.02
"""Change of the control points [rad], and relative change of the duration, at convergence."""
INFLUENCE_DISTANCE = 0.06
"""Distances above this are ignored [m]."""
MIN_AXIAL_TRAVEL = (0.0, 0.002)
"""Distances of the first free control points from the grasp and the place pose, on the axis of the
tool there, if it holds nothing [m]: it leaves an object along its axis."""
ENDPOINT_FRACTION = 0.15
"""Fraction of the path at either end where distances below the required ones are not increased: the
fixed endpoints leave no freedom there."""
NUM_FIXED_CONTROL_POINTS = 3
"""Equal control points at either end: they give zero velocity and acceleration there."""
_SPLINE_ORDER = 4
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
_RANK_TOLERANCE = 1e-9
"""Relative size of singular values of equality constraints that count as zero."""
_SOLVER_OPTIONS = SolverOptions()
"""Tolerances of the subproblems [rad]: those of the limits and distances are larger."""
for _name in ("tol_gap_abs", "tol_gap_rel", "tol_feas"):
    _SOLVER_OPTIONS.SetOption(ClarabelSolver.id(), _name, 1e-5)
_MIN_DURATION = 0.05
"""Lower bound of the duration [s]; keeps the subproblems well conditioned."""
_BASIS = BsplineBasis(_SPLINE_ORDER, NUM_CONTROL_POINTS, KnotVectorType.kClampedUniform, 0.0, 1.0)
_BASIS_SPLINE = BsplineTrajectory(_BASIS, np.eye(NUM_CONTROL_POINTS))
"""Spline whose values are the basis functions."""
_SAMPLE_PARAMETERS = np.linspace(0.0, 1.0, NUM_COLLISION_SAMPLES + 2)[1:-1]
"""Parameters s of the samples. Shape (NUM_COLLISION_SAMPLES,)."""
_VALUE_WEIGHTS = _BASIS_SPLINE.vector_values(_SAMPLE_PARAMETERS).T
"""Maps control points to values at the samples. Shape (NUM_COLLISION_SAMPLES, 28)."""
_DERIVATIVE_WEIGHTS = _BASIS_SPLINE.MakeDerivative(1).vector_values(_SAMPLE_PARAMETERS).T
"""Maps control points to derivatives at the samples. Shape (NUM_COLLISION_SAMPLES, 28)."""
_SECOND_DERIVATIVE_WEIGHTS = _BASIS_SPLINE.MakeDerivative(2).vector_values(_SAMPLE_PARAMETERS).T
"""Maps control points to second derivatives at the samples. Shape (NUM_COLLISION_SAMPLES, 28)."""


@lru_cache(maxsize=16)
def _derivative_matrix(order: int, num_joints: int) -> sparse.csr_matrix:
    """Return the matrix from all control points to the control points of a derivative.

    Args:
        order: Order of the derivative.
        num_joints: Number of joints, n.

    Returns:
        Sparse matrix; control points are flattened row by row. Shape ((28 - order) n, 28 n).
    """
    one_joint = np.array(_BASIS_SPLINE.MakeDerivative(order).control_points())[..., 0]
    return sparse.csr_matrix(np.kron(one_joint, np.eye(num_joints)))


@dataclass(frozen=True)
class LinearizedDistances:
    """First-order models of signed distances at configurations of a path.

    Attributes:
        rows: Indices of the configurations. Shape (k,).
        gradients: Derivatives by the joint positions [m/rad]. Shape (k, n).
        slack: Distances minus required distances [m]. Shape (k,).
    """

    rows: NDArray[np.int64]
    gradients: Floats
    slack: Floats


@dataclass(frozen=True)
class TrajectoryOptimizationProblem:
    """Input of one trajectory optimization.

    Attributes:
        initial_trajectory: Collision-free, time-parameterized initial guess.
        robot: Robot with its joint limits.
        departure_distances: Least distances from the start of the first free control points, which
            are on the axis of the tool there [m]; empty if it may move in any direction.
        arrival_distances: Likewise from the end, for the last free control points [m].
        keep_tool_vertical: Whether the tool axis stays vertical.
        max_tool_speed: Largest speed of the tool [m/s]; infinite without a limit.
        max_tool_acceleration: Largest acceleration of the tool along each axis [m/s^2].
        nearby_distances: Returns all distances below the influence distance, from joint positions
            of shape (m, n) and the path parameters s in [0, 1] of shape (m,).
        column_distances: Returns the distances from the columns below a carried object, like
            `nearby_distances`, from joint positions of shape (m, n); they are also imposed at the
            ends of the path, but for its parts on the axes. None without an object.
        tool_jacobians: Returns the spatial Jacobians of the tool, angular rows first, shape
            (m, 6, n), from joint positions of shape (m, n).
        tool_axis: Returns the z axes of the tool in T, shape (m, 3), from joint positions of shape
            (m, n).
    """

    initial_trajectory: Trajectory
    robot: RobotModel
    departure_distances: tuple[float, ...]
    arrival_distances: tuple[float, ...]
    keep_tool_vertical: bool
    max_tool_speed: float
    max_tool_acceleration: float
    nearby_distances: Callable[[Floats, Floats], LinearizedDistances]
    column_distances: Callable[[Floats], LinearizedDistances] | None
    tool_jacobians: Callable[[Floats], Floats]
    tool_axis: Callable[[Floats], Floats]


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
    duration = initial_duration * (1.0 if problem.keep_tool_vertical else _EXPECTED_GAIN)
    is_exact = not problem.keep_tool_vertical or problem.robot.vertical_tool_rows is not None
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
        derivatives = _derivative_matrix(order, robot.num_joints) @ points.ravel()
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
    if (
        problem.keep_tool_vertical
        or math.isfinite(problem.max_tool_speed)
        or math.isfinite(problem.max_tool_acceleration)
    ):
        return False
    nearby = problem.nearby_distances(_VALUE_WEIGHTS @ points, _SAMPLE_PARAMETERS)
    s = _SAMPLE_PARAMETERS[nearby.rows]
    is_free = np.minimum(s, 1 - s) >= ENDPOINT_FRACTION
    return bool((nearby.slack[is_free] > -_MAX_DISTANCE_ERROR).all())


def _fit_control_points(trajectory: Trajectory) -> Floats:
    """Return the control points of the least-squares fit to a trajectory. Shape (28, n)."""
    num_fixed = NUM_FIXED_CONTROL_POINTS
    s = np.linspace(0.0, 1.0, 120)
    q = trajectory.vector_values(s * trajectory.end_time()).T
    B = _BASIS_SPLINE.vector_values(s).T
    points = np.empty((NUM_CONTROL_POINTS, q.shape[1]))
    points[:num_fixed] = q[0]
    points[-num_fixed:] = q[-1]
    fixed = [*range(num_fixed), *range(NUM_CONTROL_POINTS - num_fixed, NUM_CONTROL_POINTS)]
    points[num_fixed:-num_fixed] = np.linalg.lstsq(
        B[:, num_fixed:-num_fixed], q - B[:, fixed] @ points[fixed], rcond=None
    )[0]
    return points


class _ControlPointSubspaces:
    """Affine subspaces of the control points in which equality constraints hold.

    The control points are p = p_0 + N y. Most variables are eliminated by this: the solver takes
    half the time that it takes with equality constraints.
    """

    def __init__(self, points: Floats) -> None:
        """Start with all control points free but the fixed ones.

        Args:
            points: Previous control points. Shape (28, n).
        """
        self._points = points.copy()
        n = points.shape[1]
        num_free = NUM_CONTROL_POINTS - 2 * NUM_FIXED_CONTROL_POINTS
        fixed = [np.zeros((n, 0))] * NUM_FIXED_CONTROL_POINTS
        self._bases = [*fixed, *([np.eye(n)] * num_free), *fixed]

    def constrain(self, indices: Sequence[int], A: Floats, b: Floats) -> None:
        """Add A q = b for free control points that have no constraint yet.

        Args:
            indices: Indices of the control points.
            A: Coefficients. Shape (m, n).
            b: Right-hand side. Shape (m,).
        """
        basis, inverse = null_space(A, rcond=_RANK_TOLERANCE), np.linalg.pinv(A)
        for index in indices:
            q = self._points[index]
            q += inverse @ (b - A @ q)
            self._bases[index] = basis

    @property
    def offset(self) -> Floats:
        """Offset p_0, flattened row by row. Shape (28 n,)."""
        return self._points.ravel()

    @property
    def basis(self) -> sparse.csr_matrix:
        """Basis N. Shape (28 n, k)."""
        rows, columns = np.cumsum([(0, 0), *(basis.shape for basis in self._bases)], axis=0).T
        basis = np.zeros((rows[-1], columns[-1]))
        for k, of_point in enumerate(self._bases):
            basis[rows[k] : rows[k + 1], columns[k] : columns[k + 1]] = of_point
        return sparse.csr_matrix(basis)


class _LinearConstraints:
    """Linear inequalities of the control points p, flattened row by row, and T^2."""

    def __init__(self) -> None:
        self._A_points = list[sparse.csr_matrix]()
        self._A_square = list[Floats]()
        self._b = list[Floats]()

    def add(self, A_points: sparse.csr_matrix, A_square: Floats, b: Floats) -> None:
        """Add A_points p + A_square T^2 <= b.

        Args:
            A_points: Coefficients of p. Shape (m, 28 n).
            A_square: Coefficients of T^2. Shape (m,).
            b: Upper bounds. Shape (m,).
        """
        self._A_points.append(A_points)
        self._A_square.append(A_square)
        self._b.append(b)

    def add_two_sided(
        self, A_points: sparse.csr_matrix, bound: Floats, b: Floats | None = None
    ) -> None:
        """Add -bound T^2 - b <= A_points p <= bound T^2 + b.

        Args:
            A_points: Coefficients of p. Shape (m, 28 n).
            bound: Coefficients of T^2. Shape (m,).
            b: Constant bounds; None for 0. Shape (m,).
        """
        for sign in (1, -1):
            self.add(sign * A_points, -bound, np.zeros_like(bound) if b is None else b)

    def add_distances(self, distances: LinearizedDistances, q: Floats) -> None:
        """Add that distances at samples of the spline are not below the required ones.

        Args:
            distances: Distances, linearized at the previous solution.
            q: Samples of that solution. Shape (NUM_COLLISION_SAMPLES, n).
        """
        index, gradients = distances.rows, distances.gradients
        if not len(index):
            return
        self.add(
            _directional_matrix(-_VALUE_WEIGHTS[index], gradients),
            np.zeros(len(index)),
            distances.slack - (gradients * q[index]).sum(axis=1),
        )

    def add_to(
        self, prog: MathematicalProgram, subspaces: _ControlPointSubspaces, x: NDArray[np.object_]
    ) -> None:
        """Add the constraints to a program with the variables x = (y, T^2)."""
        A_points = sparse.vstack(self._A_points, format="csr")
        A_y = A_points @ subspaces.basis
        b = np.concatenate(self._b) - A_points @ subspaces.offset
        # Rows of fixed control points alone hold at any solution, but for rounding.
        is_kept = np.diff(A_y.indptr) > 0
        A_square = sparse.csr_matrix(np.concatenate(self._A_square)[is_kept, None])
        A = sparse.hstack([A_y[is_kept], A_square], format="csc")
        prog.AddLinearConstraint(A, np.full(A.shape[0], -np.inf), b[is_kept], x)


def _directional_matrix(weights: Floats, directions: Floats) -> sparse.csr_matrix:
    """Return the matrix from control points to components of spline values.

    Args:
        weights: Weights of the control points in each value. Shape (m, 28).
        directions: Direction of each component. Shape (m, n).

    Returns:
        Sparse matrix. Shape (m, 28 n).
    """
    return sparse.csr_matrix(
        (weights[:, :, None] * directions[:, None, :]).reshape(len(weights), -1)
    )


def _is_axial(problem: TrajectoryOptimizationProblem) -> NDArray[np.bool_]:
    """Return which samples are on the axes of the tool at the ends. Shape (m,)."""
    num_spans = NUM_CONTROL_POINTS - _SPLINE_ORDER + 1
    spans = _SAMPLE_PARAMETERS * num_spans
    num_start, num_end = len(problem.departure_distances), len(problem.arrival_distances)
    return np.asarray((spans < num_start) | (num_spans - spans < num_end))


def _limit_constraints(
    problem: TrajectoryOptimizationProblem, points: Floats, duration: float
) -> _LinearConstraints:
    """Return limits and distance constraints, linearized at a spline.

    Args:
        problem: Trajectory optimization problem.
        points: Control points. Shape (28, n).
        duration: Duration T [s].
    """
    constraints = _LinearConstraints()
    q = _VALUE_WEIGHTS @ points
    robot = problem.robot
    n = robot.num_joints
    speeds = np.tile(robot.velocity_limits, NUM_CONTROL_POINTS - 1)
    accelerations = np.tile(robot.acceleration_limits, NUM_CONTROL_POINTS - 2)
    # T is at most the tangent of sqrt(T^2): T^2 / (2 T_previous) + T_previous / 2.
    constraints.add_two_sided(
        _derivative_matrix(1, n), speeds / (2 * duration), speeds * duration / 2
    )
    constraints.add_two_sided(_derivative_matrix(2, n), accelerations)
    if np.isfinite(robot.jerk_limits).all():
        # T^3 is at least the tangent of (T^2)^1.5: 1.5 T_previous T^2 - T_previous^3 / 2.
        jerks = np.tile(robot.jerk_limits, NUM_CONTROL_POINTS - 3)
        constraints.add_two_sided(
            _derivative_matrix(3, n), 1.5 * duration * jerks, -jerks * duration**3 / 2
        )
    nearby = problem.nearby_distances(q, _SAMPLE_PARAMETERS)
    if len(nearby.rows):
        index, gradients = nearby.rows, nearby.gradients
        is_near_end = np.minimum(_SAMPLE_PARAMETERS, 1 - _SAMPLE_PARAMETERS) < ENDPOINT_FRACTION
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
        velocities = (J @ (_DERIVATIVE_WEIGHTS @ points)[:, :, None])[:, :, 0]
        directions = velocities / np.maximum(np.linalg.norm(velocities, axis=1), 1e-9)[:, None]
        speed = np.full(len(q), problem.max_tool_speed)
        constraints.add(
            _directional_matrix(_DERIVATIVE_WEIGHTS, (directions[:, None] @ J)[:, 0]),
            -speed / (2 * duration),
            speed * duration / 2,
        )
    if math.isfinite(problem.max_tool_acceleration):
        index = np.repeat(np.arange(0, NUM_COLLISION_SAMPLES, 2), 3)
        J = problem.tool_jacobians(q[::2])[:, 3:].reshape(-1, n)
        constraints.add_two_sided(
            _directional_matrix(_SECOND_DERIVATIVE_WEIGHTS[index], J),
            np.full(len(index), problem.max_tool_acceleration),
        )
    return constraints


def _add_vertical_tool_constraints(
    problem: TrajectoryOptimizationProblem,
    points: Floats,
    subspaces: _ControlPointSubspaces,
) -> None:
    """Add the constraint that the tool stays vertical.

    It is exact for robots with `vertical_tool_rows`. For other robots it is linearized at the
    previous control points, except for those at the ends that are fixed or on a vertical line.

    Args:
        problem: Trajectory optimization problem.
        points: Previous control points. Shape (28, n).
        subspaces: Subspaces to which the constraint is added.
    """
    rows = problem.robot.vertical_tool_rows
    start = NUM_FIXED_CONTROL_POINTS + len(problem.departure_distances)
    end = NUM_CONTROL_POINTS - NUM_FIXED_CONTROL_POINTS - len(problem.arrival_distances)
    if rows is not None:
        subspaces.constrain(range(start, end), rows, rows @ points[0])
        return
    axes, jacobians = problem.tool_axis(points), problem.tool_jacobians(points)
    for k in range(start, end):
        (x, y, z), J_rotation = axes[k], jacobians[k, :3]
        # Derivatives of x and y of the tool axis: the first two rows of w x axis.
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
    subspaces: _ControlPointSubspaces,
    constraints: _LinearConstraints,
) -> None:
    """Add the constraint that the tool moves along its axis at the start and at the end.

    Args:
        problem: Trajectory optimization problem.
        points: Previous control points. Shape (28, n).
        subspaces: Subspaces to which equality constraints are added.
        constraints: Constraints to which inequalities are added.
    """
    for heights, end, inwards in (
        (problem.departure_distances, 0, 1),
        (problem.arrival_distances, NUM_CONTROL_POINTS - 1, -1),
    ):
        if not heights:
            continue
        q = points[end]
        (J,) = problem.tool_jacobians(q[None])
        away = -problem.tool_axis(q[None])[0]
        J = np.vstack([J[:3], _basis_with(away) @ J[3:]])
        indices = end + inwards * (NUM_FIXED_CONTROL_POINTS + np.arange(len(heights)))
        subspaces.constrain(indices.tolist(), J[:5], J[:5] @ q)
        constraints.add(
            _directional_matrix(-np.eye(NUM_CONTROL_POINTS)[indices], J[5:]),
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
    subspaces = _ControlPointSubspaces(points)
    constraints = _limit_constraints(problem, points, duration)
    _add_departure_constraints(problem, points, subspaces, constraints)
    if problem.keep_tool_vertical:
        _add_vertical_tool_constraints(problem, points, subspaces)
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
    D = _derivative_matrix(2, n)
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
