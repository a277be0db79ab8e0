"""Shorter ways than the sure one, by trajectory optimisation.

A cubic spline over joint angles is made as quick as the joints' limits and the cup's hold allow, while it keeps clear of
everything. Distances are linear in the joint angles for a small step, and so in the spline's control points: each round takes
them at the last round's spline, and moves no control point by more than a step (as in Schulman et al. 2014, "Motion planning with
sequential convex optimization and convex collision checking"). The result is a proposal: who asks checks it.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydrake.math import BsplineBasis
from pydrake.planning import KinematicTrajectoryOptimization
from pydrake.solvers import LinearConstraint, QuadraticConstraint, SnoptSolver, SolverOptions
from pydrake.trajectories import BsplineTrajectory, Trajectory

from drake_clutter.arm.paths import ACCELERATION_LIMIT, MARGIN, VELOCITY_LIMIT

Floats = NDArray[np.float64]

CONTROL_POINTS = 28
STEPS = (0.8, 0.4, 0.2)
"""rad, by which a control point may move in each round."""
LOOKED_AT = 50
"""Points of a spline at which distances are taken, and at half of them how the cup is accelerated."""
SETTLED = 0.02
"""rad; a round that moves no control point further is the last: the next would see the same distances."""
UPRIGHT = 0.002
"""m, that the cup moves straight up from a grasp, and straight down to a place."""
ENDS = 0.15
"""Share of a way at either end, where it may stay as close as it is: there the ends leave it no choice."""
_TILT = np.array([[0.0, 1.0, 1.0, 1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 0.0, 1.0, 0.0]])
_ORDER = 4
_OPTIONS = SolverOptions()
_OPTIONS.SetOption(SnoptSolver.id(), "Major optimality tolerance", 1e-3)
_OPTIONS.SetOption(SnoptSolver.id(), "Major feasibility tolerance", 1e-4)


@dataclass(frozen=True)
class Wall:
    """A distance, to first order.

    Attributes:
        gradient: (6,) m/rad.
        room: m, by which it is larger than it must be.
    """

    gradient: Floats
    room: float


@dataclass(frozen=True)
class Way:
    """What is to be shortened.

    Attributes:
        sure: the way that is known, timed.
        upright: whether it begins, and ends, straight above a face.
        level: whether the cup keeps pointing down, for the sake of what hangs on it: then wrist 2 does not turn, nor do shoulder
            lift, elbow and wrist 1 together.
        acceleration: m/s^2, of the cup along each axis, at most.
        walls: what is near, at joint angles (6,) rad and a share of the way in 0 to 1.
        jacobian: (6, 6) of the cup at joint angles, turning first.
    """

    sure: Trajectory
    upright: tuple[bool, bool]
    level: bool
    acceleration: float
    walls: Callable[[Floats, float], list[Wall]]
    jacobian: Callable[[Floats], Floats]

    @property
    def still(self) -> int:
        """Control points that are one at either end: two, and it is at rest there; three, and what it carries is not jerked."""
        return 3 if self.level else 2


def shortened(way: Way) -> BsplineTrajectory | None:
    """A quicker way, and how it is run through; None if none was found."""
    points = _fitted(way.sure, way.still)
    duration = way.sure.end_time()
    for step in STEPS:
        found = _round(way, points, duration, step)
        if found is None:
            return None
        moved = np.abs(found[0] - points).max()
        points, duration = found
        if moved < SETTLED:
            break
    return BsplineTrajectory(BsplineBasis(_ORDER, duration * np.array(_BASIS.knots())), points.T)


_BASIS = KinematicTrajectoryOptimization(6, CONTROL_POINTS, _ORDER, 1.0).basis()
_SECOND = BsplineTrajectory(_BASIS, np.eye(CONTROL_POINTS)).MakeDerivative(2)


def _fitted(sure: Trajectory, still: int) -> Floats:
    """Control points (n, 6) of the spline that is nearest to a timed way; the first, and the last, `still` of them are one."""
    s = np.linspace(0.0, 1.0, 120)
    q = sure.vector_values(s * sure.end_time()).T
    B = np.array([_BASIS.EvaluateLinearInControlPoints(x).ravel() for x in s])
    points = np.empty((CONTROL_POINTS, 6))
    points[:still], points[-still:] = q[0], q[-1]
    at_ends = [*range(still), *range(CONTROL_POINTS - still, CONTROL_POINTS)]
    points[still:-still] = np.linalg.lstsq(B[:, still:-still], q - B[:, at_ends] @ points[at_ends], rcond=None)[0]
    return points


def _round(way: Way, points: Floats, duration: float, step: float) -> tuple[Floats, float] | None:
    kto = KinematicTrajectoryOptimization(6, CONTROL_POINTS, _ORDER, duration)
    prog, variables = kto.get_mutable_prog(), kto.control_points()
    last = BsplineTrajectory(_BASIS, points.T)
    kto.SetInitialGuess(last)
    prog.SetInitialGuess(kto.duration(), duration)
    kto.AddDurationCost(1.0)
    kto.AddDurationConstraint(0.05, 2 * duration + 0.1)
    kto.AddVelocityBounds(-MARGIN * VELOCITY_LIMIT, MARGIN * VELOCITY_LIMIT)
    kto.AddAccelerationBounds(-MARGIN * ACCELERATION_LIMIT, MARGIN * ACCELERATION_LIMIT)
    for k in range(CONTROL_POINTS):
        reach = step if way.still <= k < CONTROL_POINTS - way.still else 0.0
        prog.AddBoundingBoxConstraint(points[k] - reach, points[k] + reach, variables[:, k])
        if way.level:
            prog.AddLinearEqualityConstraint(_TILT, _TILT @ points[0], variables[:, k])
    for upright, end, inwards in ((way.upright[0], 0, 1), (way.upright[1], CONTROL_POINTS - 1, -1)):
        if upright:
            J, q = way.jacobian(points[end]), points[end]
            for k, least in ((way.still, 0.0), (way.still + 1, UPRIGHT)):
                prog.AddLinearEqualityConstraint(J[:5], J[:5] @ q, variables[:, end + inwards * k])
                prog.AddLinearConstraint(J[5:], J[5:] @ q + least, [np.inf], variables[:, end + inwards * k])
    for number, s in enumerate(np.linspace(0.0, 1.0, LOOKED_AT + 2)[1:-1]):
        q = last.value(s).ravel()
        for wall in way.walls(q, s):
            room = max(wall.room, 0.0) if min(s, 1 - s) < ENDS else wall.room
            bound = float(wall.gradient @ q) - room
            kto.AddPathPositionConstraint(LinearConstraint(wall.gradient[None], [bound], [np.inf]), s)
        if math.isfinite(way.acceleration) and number % 2 == 0:
            _bound_cup(kto, way, q, s)
    result = SnoptSolver().Solve(prog, prog.initial_guess(), _OPTIONS)
    if not result.is_success():
        return None
    return np.asarray(result.GetSolution(variables).T), float(result.GetSolution(kto.duration()))


def _bound_cup(kto: KinematicTrajectoryOptimization, way: Way, q: Floats, s: float) -> None:
    """-a T^2 <= J r'' <= a T^2, at a point of the way; r'' is the spline's second derivative, J taken at q."""
    weights = _SECOND.value(s).ravel()
    active = np.flatnonzero(weights)
    variables = np.append(kto.control_points()[:, active].T.ravel(), kto.duration())
    Q = np.zeros((len(variables), len(variables)))
    Q[-1, -1] = -2 * way.acceleration
    for row in way.jacobian(q)[3:]:
        b = np.append(np.outer(weights[active], row).ravel(), 0.0)
        for sign in (1.0, -1.0):
            kto.get_mutable_prog().AddQuadraticConstraint(
                Q, sign * b, -np.inf, 0.0, variables, QuadraticConstraint.HessianType.kNegativeSemidefinite
            )
