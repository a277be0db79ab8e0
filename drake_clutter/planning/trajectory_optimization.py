"""Shorter ways than the sure one, by trajectory optimisation.

A cubic spline over joint angles is made as quick as the joints' limits and the cup's hold allow, while it keeps clear of
everything. Distances are linear in the joint angles for a small step, and so in the spline's control points: each round takes
them at the last round's spline, and moves no control point by more than a step (as in Schulman et al. 2014, "Motion planning with
sequential convex optimization and convex collision checking"). So are the limits of speed and acceleration, in the control points
and the square of the duration T: over a parameter that goes from 0 to 1, q'' is bounded by a T^2, and q' by v T. Of T the tangent
to the root of T^2 is taken, which is a little more, until the rounds settle. The result is a proposal: who asks checks it, and
slows it down to its limits.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from pydrake.math import BsplineBasis, KnotVectorType
from pydrake.solvers import ClarabelSolver, MathematicalProgram
from pydrake.trajectories import BsplineTrajectory, Trajectory
from scipy import sparse

from drake_clutter.planning.time_parameterization import LIMIT_FRACTION
from drake_clutter.robots.robot_model import RobotModel

Floats = NDArray[np.float64]

NUM_CONTROL_POINTS = 28
TRUST_REGION_RADII = (0.8, 0.4, 0.2)
"""rad, by which a control point may move in each round."""
LINEARIZED_TILT_RADII = (0.4, 0.2, 0.1, 0.05, 0.03)
"""The same, where a tool stays vertical to first order only."""
NUM_COLLISION_SAMPLES = 50
"""Points of a spline at which distances are taken, and at every second of them how the cup is accelerated."""
CONVERGENCE_TOLERANCE = 0.02
"""rad; a round that moves no control point further, and changes the duration by no larger a share, is the last."""
MIN_VERTICAL_TRAVEL = 0.002
"""m, that the cup moves straight up from a grasp, and straight down to a place."""
ENDPOINT_FRACTION = 0.15
"""Share of a way at either end, where it may stay as close as it is: there the ends leave it no choice."""
_SPLINE_ORDER = 4
_SMOOTHNESS_WEIGHT = 1e-4
"""Weight of the squared accelerations beside T^2: of ways that are as quick it takes the smoothest."""
_BASIS = BsplineBasis(_SPLINE_ORDER, NUM_CONTROL_POINTS, KnotVectorType.kClampedUniform, 0.0, 1.0)
_BASIS_SPLINE = BsplineTrajectory(_BASIS, np.eye(NUM_CONTROL_POINTS))
_SAMPLE_PARAMETERS = np.linspace(0.0, 1.0, NUM_COLLISION_SAMPLES + 2)[1:-1]
_VALUE_WEIGHTS = _BASIS_SPLINE.vector_values(_SAMPLE_PARAMETERS).T
_SECOND_DERIVATIVE_WEIGHTS = _BASIS_SPLINE.MakeDerivative(2).vector_values(_SAMPLE_PARAMETERS).T
"""(LOOKED_AT, 28) each: from control points to the spline's values and second derivatives."""


@lru_cache(maxsize=16)
def _derivative_matrix(order: int, joints: int) -> sparse.csr_matrix:
    """From all control points, row by row, to those of a derivative, ((28 - order) n, 28 n)."""
    of_one = np.array(_BASIS_SPLINE.MakeDerivative(order).control_points())[..., 0]
    return sparse.csr_matrix(np.kron(of_one, np.eye(joints)))


@dataclass(frozen=True)
class LinearizedDistance:
    """A distance, to first order.

    Attributes:
        gradient: (n,) m/rad.
        slack: m, by which it is larger than it must be.
    """

    gradient: Floats
    slack: float


@dataclass(frozen=True)
class TrajectoryOptimizationProblem:
    """What is to be shortened.

    Attributes:
        initial_trajectory: The way that is known, timed.
        robot: Its limits, and how its joints keep a tool vertical.
        upright: Whether it begins, and ends, straight above a face.
        keep_tool_vertical: Whether the cup keeps pointing down, for the sake of what hangs on it.
        max_tool_acceleration: Greatest of the cup along each axis [m/s^2].
        nearby_distances: What is near, at joint positions (n,) and a share of the way in 0 to 1.
        tool_jacobian: Of the cup at joint positions (n,), turning first. Shape (6, n).
        tool_axis: Of the cup, z in T, at joint positions (n,). Shape (3,).
    """

    initial_trajectory: Trajectory
    robot: RobotModel
    upright: tuple[bool, bool]
    keep_tool_vertical: bool
    max_tool_acceleration: float
    nearby_distances: Callable[[Floats, float], list[LinearizedDistance]]
    tool_jacobian: Callable[[Floats], Floats]
    tool_axis: Callable[[Floats], Floats]

    @property
    def num_fixed_control_points(self) -> int:
        """Control points that are one at either end: two, and it is at rest there; three, and what it carries is not jerked."""
        return 3 if self.keep_tool_vertical else 2


def optimize_trajectory(problem: TrajectoryOptimizationProblem) -> BsplineTrajectory | None:
    """A quicker way, and how it is run through; None if none was found."""
    points = _fit_control_points(problem.initial_trajectory, problem.num_fixed_control_points)
    duration = problem.initial_trajectory.end_time()
    exact = not problem.keep_tool_vertical or problem.robot.vertical_tool_rows is not None
    for step in TRUST_REGION_RADII if exact else LINEARIZED_TILT_RADII:
        found = _solve_subproblem(problem, points, duration, step)
        if found is None:
            break
        settled = (
            np.abs(found[0] - points).max() < CONVERGENCE_TOLERANCE
            and abs(found[1] - duration) < CONVERGENCE_TOLERANCE * duration
        )
        points, duration = found
        if settled:
            break
    if duration >= problem.initial_trajectory.end_time():
        return None
    return BsplineTrajectory(
        BsplineBasis(_SPLINE_ORDER, duration * np.array(_BASIS.knots())), points.T
    )


def _fit_control_points(trajectory: Trajectory, num_fixed: int) -> Floats:
    """Control points (28, n) of the spline that is nearest to a timed way; `num_fixed` at either end are one."""
    s = np.linspace(0.0, 1.0, 120)
    q = trajectory.vector_values(s * trajectory.end_time()).T
    B = _BASIS_SPLINE.vector_values(s).T
    points = np.empty((NUM_CONTROL_POINTS, q.shape[1]))
    points[:num_fixed], points[-num_fixed:] = q[0], q[-1]
    at_ends = [*range(num_fixed), *range(NUM_CONTROL_POINTS - num_fixed, NUM_CONTROL_POINTS)]
    points[num_fixed:-num_fixed] = np.linalg.lstsq(
        B[:, num_fixed:-num_fixed], q - B[:, at_ends] @ points[at_ends], rcond=None
    )[0]
    return points


class _LinearConstraints:
    """Linear inequalities A x <= b of x, which is all control points, (28, n) row by row, and then T^2."""

    def __init__(self) -> None:
        self._A, self._b = list[sparse.csr_matrix](), list[Floats]()

    def add(self, A_points: sparse.csr_matrix, A_square: Floats, b: Floats) -> None:
        """Some more: (m, 28 n), (m,) and (m,)."""
        self._A.append(sparse.hstack([A_points, sparse.csr_matrix(A_square[:, None])]))
        self._b.append(b)

    def add_two_sided(
        self, A_points: sparse.csr_matrix, bound: Floats, b: Floats | None = None
    ) -> None:
        """-bound T^2 - b <= A p <= bound T^2 + b."""
        for sign in (1, -1):
            self.add(sign * A_points, -bound, np.zeros_like(bound) if b is None else b)

    def add_to(self, prog: MathematicalProgram, x: NDArray[np.object_]) -> None:
        """Adds them to a program."""
        b = np.concatenate(self._b)
        prog.AddLinearConstraint(
            sparse.vstack(self._A, format="csc"), np.full(len(b), -np.inf), b, x
        )


def _directional_matrix(weights: Floats, directions: Floats) -> sparse.csr_matrix:
    """(m, 28 n), from all control points to what splines of these weights (m, 28) go in directions (m, n)."""
    return sparse.csr_matrix(
        (weights[:, :, None] * directions[:, None, :]).reshape(len(weights), -1)
    )


def _limit_constraints(
    problem: TrajectoryOptimizationProblem, points: Floats, duration: float
) -> _LinearConstraints:
    """Of speed, acceleration and distances, at a spline near which they hold."""
    rows, q = _LinearConstraints(), _VALUE_WEIGHTS @ points
    # T is at most the tangent to the root of its square, at the last round's.
    n, robot = problem.robot.num_joints, problem.robot
    speeds = np.tile(LIMIT_FRACTION * robot.velocity_limits, NUM_CONTROL_POINTS - 1)
    accelerations = np.tile(LIMIT_FRACTION * robot.acceleration_limits, NUM_CONTROL_POINTS - 2)
    rows.add_two_sided(_derivative_matrix(1, n), speeds / (2 * duration), speeds * duration / 2)
    rows.add_two_sided(_derivative_matrix(2, n), accelerations)
    if seen := [
        (k, wall)
        for k, s in enumerate(_SAMPLE_PARAMETERS)
        for wall in problem.nearby_distances(q[k], s)
    ]:
        at, gradients = (
            np.array([k for k, _ in seen]),
            np.array([wall.gradient for _, wall in seen]),
        )
        room = np.array([wall.slack for _, wall in seen])
        room = np.where(
            np.minimum(_SAMPLE_PARAMETERS, 1 - _SAMPLE_PARAMETERS)[at] < ENDPOINT_FRACTION,
            np.maximum(room, 0.0),
            room,
        )
        rows.add(
            _directional_matrix(-_VALUE_WEIGHTS[at], gradients),
            np.zeros(len(at)),
            room - (gradients * q[at]).sum(axis=1),
        )
    if math.isfinite(problem.max_tool_acceleration):
        at = np.repeat(np.arange(0, NUM_COLLISION_SAMPLES, 2), 3)
        J = np.vstack([problem.tool_jacobian(q[k])[3:] for k in at[::3]])
        rows.add_two_sided(
            _directional_matrix(_SECOND_DERIVATIVE_WEIGHTS[at], J),
            np.full(len(at), problem.max_tool_acceleration),
        )
    return rows


def _add_vertical_tool_constraints(
    problem: TrajectoryOptimizationProblem,
    points: Floats,
    prog: MathematicalProgram,
    control: NDArray[np.object_],
) -> None:
    """Keeps the tool vertical: exactly, or at control points to first order of the last round's.

    In the latter case not at those that are fixed, or move straight up, which are vertical already.
    """
    rows = problem.robot.vertical_tool_rows
    if rows is not None:
        for q in control:
            prog.AddLinearEqualityConstraint(rows, rows @ points[0], q)
        return
    for k in range(
        problem.num_fixed_control_points + 2,
        NUM_CONTROL_POINTS - problem.num_fixed_control_points - 2,
    ):
        (x, y, z), turning = problem.tool_axis(points[k]), problem.tool_jacobian(points[k])[:3]
        tilts = np.array([z * turning[1] - y * turning[2], x * turning[2] - z * turning[0]])
        prog.AddLinearEqualityConstraint(tilts, tilts @ points[k] - [x, y], control[k])


def _solve_subproblem(
    problem: TrajectoryOptimizationProblem,
    points: Floats,
    duration: float,
    trust_region_radius: float,
) -> tuple[Floats, float] | None:
    n = problem.robot.num_joints
    reach = np.full((NUM_CONTROL_POINTS, n), trust_region_radius)
    reach[: problem.num_fixed_control_points] = reach[-problem.num_fixed_control_points :] = 0.0
    prog = MathematicalProgram()
    x = prog.NewContinuousVariables(points.size + 1)
    lower, upper = problem.robot.position_limits.T
    nearest, furthest = np.maximum(points - reach, lower), np.minimum(points + reach, upper)
    prog.AddBoundingBoxConstraint(nearest.ravel(), furthest.ravel(), x[:-1])
    prog.AddBoundingBoxConstraint(0.05**2, (2 * duration + 0.1) ** 2, x[-1:])
    control = x[:-1].reshape(NUM_CONTROL_POINTS, n)
    for upright, end, inwards in (
        (problem.upright[0], 0, 1),
        (problem.upright[1], NUM_CONTROL_POINTS - 1, -1),
    ):
        if upright:
            J, q = problem.tool_jacobian(points[end]), points[end]
            for k, least in (
                (problem.num_fixed_control_points, 0.0),
                (problem.num_fixed_control_points + 1, MIN_VERTICAL_TRAVEL),
            ):
                prog.AddLinearEqualityConstraint(J[:5], J[:5] @ q, control[end + inwards * k])
                prog.AddLinearConstraint(
                    J[5:], J[5:] @ q + least, [np.inf], control[end + inwards * k]
                )
    if problem.keep_tool_vertical:
        _add_vertical_tool_constraints(problem, points, prog, control)
    _limit_constraints(problem, points, duration).add_to(prog, x)
    prog.AddLinearCost([1 / duration**2], 0.0, x[-1:])
    limits = np.tile(LIMIT_FRACTION * problem.robot.acceleration_limits, NUM_CONTROL_POINTS - 2)
    curved = sparse.diags(1 / limits) @ _derivative_matrix(2, n) / duration**2
    prog.AddQuadraticCost(
        2 * _SMOOTHNESS_WEIGHT * (curved.T @ curved).toarray(),
        np.zeros(points.size),
        x[:-1],
        is_convex=True,
    )
    result = ClarabelSolver().Solve(prog)
    if not result.is_success():
        return None
    found = result.GetSolution(x)
    return found[:-1].reshape(points.shape), math.sqrt(found[-1])
