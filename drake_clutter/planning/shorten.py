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

from drake_clutter.planning.paths import MARGIN
from drake_clutter.robots.robot_model import RobotModel

Floats = NDArray[np.float64]

CONTROL_POINTS = 28
STEPS = (0.8, 0.4, 0.2)
"""rad, by which a control point may move in each round."""
LEVEL_STEPS = (0.4, 0.2, 0.1, 0.05, 0.03)
"""The same, where a tool stays vertical to first order only."""
LOOKED_AT = 50
"""Points of a spline at which distances are taken, and at every second of them how the cup is accelerated."""
SETTLED = 0.02
"""rad; a round that moves no control point further, and changes the duration by no larger a share, is the last."""
UPRIGHT = 0.002
"""m, that the cup moves straight up from a grasp, and straight down to a place."""
ENDS = 0.15
"""Share of a way at either end, where it may stay as close as it is: there the ends leave it no choice."""
_ORDER = 4
_SMOOTH = 1e-4
"""Weight of the squared accelerations beside T^2: of ways that are as quick it takes the smoothest."""
_BASIS = BsplineBasis(_ORDER, CONTROL_POINTS, KnotVectorType.kClampedUniform, 0.0, 1.0)
_CURVE = BsplineTrajectory(_BASIS, np.eye(CONTROL_POINTS))
_ALONG = np.linspace(0.0, 1.0, LOOKED_AT + 2)[1:-1]
_TO_VALUES = _CURVE.vector_values(_ALONG).T
_TO_CURVATURES = _CURVE.MakeDerivative(2).vector_values(_ALONG).T
"""(LOOKED_AT, 28) each: from control points to the spline's values and second derivatives."""


@lru_cache(maxsize=16)
def _to_derivative(order: int, joints: int) -> sparse.csr_matrix:
    """From all control points, row by row, to those of a derivative, ((28 - order) n, 28 n)."""
    of_one = np.array(_CURVE.MakeDerivative(order).control_points())[..., 0]
    return sparse.csr_matrix(np.kron(of_one, np.eye(joints)))


@dataclass(frozen=True)
class Wall:
    """A distance, to first order.

    Attributes:
        gradient: (n,) m/rad.
        room: m, by which it is larger than it must be.
    """

    gradient: Floats
    room: float


@dataclass(frozen=True)
class Way:
    """What is to be shortened.

    Attributes:
        sure: The way that is known, timed.
        robot: Its limits, and how its joints keep a tool vertical.
        upright: Whether it begins, and ends, straight above a face.
        level: Whether the cup keeps pointing down, for the sake of what hangs on it.
        acceleration: Greatest of the cup along each axis [m/s^2].
        walls: What is near, at joint positions (n,) and a share of the way in 0 to 1.
        jacobian: Of the cup at joint positions (n,), turning first. Shape (6, n).
        axis: Of the cup, z in T, at joint positions (n,). Shape (3,).
    """

    sure: Trajectory
    robot: RobotModel
    upright: tuple[bool, bool]
    level: bool
    acceleration: float
    walls: Callable[[Floats, float], list[Wall]]
    jacobian: Callable[[Floats], Floats]
    axis: Callable[[Floats], Floats]

    @property
    def still(self) -> int:
        """Control points that are one at either end: two, and it is at rest there; three, and what it carries is not jerked."""
        return 3 if self.level else 2


def shortened(way: Way) -> BsplineTrajectory | None:
    """A quicker way, and how it is run through; None if none was found."""
    points = _fitted(way.sure, way.still)
    duration = way.sure.end_time()
    exact = not way.level or way.robot.vertical_tool_rows is not None
    for step in STEPS if exact else LEVEL_STEPS:
        found = _round(way, points, duration, step)
        if found is None:
            break
        settled = (
            np.abs(found[0] - points).max() < SETTLED
            and abs(found[1] - duration) < SETTLED * duration
        )
        points, duration = found
        if settled:
            break
    if duration >= way.sure.end_time():
        return None
    return BsplineTrajectory(BsplineBasis(_ORDER, duration * np.array(_BASIS.knots())), points.T)


def _fitted(sure: Trajectory, still: int) -> Floats:
    """Control points (28, n) of the spline that is nearest to a timed way; the first, and the last, `still` of them are one."""
    s = np.linspace(0.0, 1.0, 120)
    q = sure.vector_values(s * sure.end_time()).T
    B = _CURVE.vector_values(s).T
    points = np.empty((CONTROL_POINTS, q.shape[1]))
    points[:still], points[-still:] = q[0], q[-1]
    at_ends = [*range(still), *range(CONTROL_POINTS - still, CONTROL_POINTS)]
    points[still:-still] = np.linalg.lstsq(
        B[:, still:-still], q - B[:, at_ends] @ points[at_ends], rcond=None
    )[0]
    return points


class _Rows:
    """Linear inequalities A x <= b of x, which is all control points, (28, n) row by row, and then T^2."""

    def __init__(self) -> None:
        self._A, self._b = list[sparse.csr_matrix](), list[Floats]()

    def add(self, of_points: sparse.csr_matrix, of_square: Floats, b: Floats) -> None:
        """Some more: (m, 28 n), (m,) and (m,)."""
        self._A.append(sparse.hstack([of_points, sparse.csr_matrix(of_square[:, None])]))
        self._b.append(b)

    def add_both(
        self, of_points: sparse.csr_matrix, bound: Floats, b: Floats | None = None
    ) -> None:
        """-bound T^2 - b <= A p <= bound T^2 + b."""
        for sign in (1, -1):
            self.add(sign * of_points, -bound, np.zeros_like(bound) if b is None else b)

    def impose(self, prog: MathematicalProgram, x: NDArray[np.object_]) -> None:
        """Adds them to a program."""
        b = np.concatenate(self._b)
        prog.AddLinearConstraint(
            sparse.vstack(self._A, format="csc"), np.full(len(b), -np.inf), b, x
        )


def _of_points(weights: Floats, directions: Floats) -> sparse.csr_matrix:
    """(m, 28 n), from all control points to what splines of these weights (m, 28) go in directions (m, n)."""
    return sparse.csr_matrix(
        (weights[:, :, None] * directions[:, None, :]).reshape(len(weights), -1)
    )


def _limits(way: Way, points: Floats, duration: float) -> _Rows:
    """Of speed, acceleration and distances, at a spline near which they hold."""
    rows, q = _Rows(), _TO_VALUES @ points
    # T is at most the tangent to the root of its square, at the last round's.
    n, robot = way.robot.num_joints, way.robot
    speeds = np.tile(MARGIN * robot.velocity_limits, CONTROL_POINTS - 1)
    accelerations = np.tile(MARGIN * robot.acceleration_limits, CONTROL_POINTS - 2)
    rows.add_both(_to_derivative(1, n), speeds / (2 * duration), speeds * duration / 2)
    rows.add_both(_to_derivative(2, n), accelerations)
    if seen := [(k, wall) for k, s in enumerate(_ALONG) for wall in way.walls(q[k], s)]:
        at, gradients = (
            np.array([k for k, _ in seen]),
            np.array([wall.gradient for _, wall in seen]),
        )
        room = np.array([wall.room for _, wall in seen])
        room = np.where(np.minimum(_ALONG, 1 - _ALONG)[at] < ENDS, np.maximum(room, 0.0), room)
        rows.add(
            _of_points(-_TO_VALUES[at], gradients),
            np.zeros(len(at)),
            room - (gradients * q[at]).sum(axis=1),
        )
    if math.isfinite(way.acceleration):
        at = np.repeat(np.arange(0, LOOKED_AT, 2), 3)
        J = np.vstack([way.jacobian(q[k])[3:] for k in at[::3]])
        rows.add_both(_of_points(_TO_CURVATURES[at], J), np.full(len(at), way.acceleration))
    return rows


def _keep_level(
    way: Way,
    points: Floats,
    prog: MathematicalProgram,
    control: NDArray[np.object_],
) -> None:
    """Keeps the tool vertical: exactly, or at control points to first order of the last round's.

    In the latter case not at those that are fixed, or move straight up, which are vertical already.
    """
    rows = way.robot.vertical_tool_rows
    if rows is not None:
        for q in control:
            prog.AddLinearEqualityConstraint(rows, rows @ points[0], q)
        return
    for k in range(way.still + 2, CONTROL_POINTS - way.still - 2):
        (x, y, z), turning = way.axis(points[k]), way.jacobian(points[k])[:3]
        tilts = np.array([z * turning[1] - y * turning[2], x * turning[2] - z * turning[0]])
        prog.AddLinearEqualityConstraint(tilts, tilts @ points[k] - [x, y], control[k])


def _round(way: Way, points: Floats, duration: float, step: float) -> tuple[Floats, float] | None:
    n = way.robot.num_joints
    reach = np.full((CONTROL_POINTS, n), step)
    reach[: way.still] = reach[-way.still :] = 0.0
    prog = MathematicalProgram()
    x = prog.NewContinuousVariables(points.size + 1)
    lower, upper = way.robot.position_limits.T
    nearest, furthest = np.maximum(points - reach, lower), np.minimum(points + reach, upper)
    prog.AddBoundingBoxConstraint(nearest.ravel(), furthest.ravel(), x[:-1])
    prog.AddBoundingBoxConstraint(0.05**2, (2 * duration + 0.1) ** 2, x[-1:])
    control = x[:-1].reshape(CONTROL_POINTS, n)
    for upright, end, inwards in ((way.upright[0], 0, 1), (way.upright[1], CONTROL_POINTS - 1, -1)):
        if upright:
            J, q = way.jacobian(points[end]), points[end]
            for k, least in ((way.still, 0.0), (way.still + 1, UPRIGHT)):
                prog.AddLinearEqualityConstraint(J[:5], J[:5] @ q, control[end + inwards * k])
                prog.AddLinearConstraint(
                    J[5:], J[5:] @ q + least, [np.inf], control[end + inwards * k]
                )
    if way.level:
        _keep_level(way, points, prog, control)
    _limits(way, points, duration).impose(prog, x)
    prog.AddLinearCost([1 / duration**2], 0.0, x[-1:])
    limits = np.tile(MARGIN * way.robot.acceleration_limits, CONTROL_POINTS - 2)
    curved = sparse.diags(1 / limits) @ _to_derivative(2, n) / duration**2
    prog.AddQuadraticCost(
        2 * _SMOOTH * (curved.T @ curved).toarray(), np.zeros(points.size), x[:-1], is_convex=True
    )
    result = ClarabelSolver().Solve(prog)
    if not result.is_success():
        return None
    found = result.GetSolution(x)
    return found[:-1].reshape(points.shape), math.sqrt(found[-1])
