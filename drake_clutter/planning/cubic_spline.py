"""Cubic B-splines in joint space, compiled.

Source: Piegl and Tiller 1997, "The NURBS Book", sections 2.2 and 3.3.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from pydrake.math import BsplineBasis, KnotVectorType
from pydrake.trajectories import BsplineTrajectory

from drake_clutter.compilation import njit

Floats = NDArray[np.float64]

SPLINE_ORDER = 4
"""Order of the splines: cubic, so that accelerations are continuous."""


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


@dataclass(frozen=True, eq=False)
class CubicSpline:
    """Cubic B-spline, a path over its parameter or a trajectory over time.

    Attributes:
        knots: Knots, ascending. Shape (k + 4,).
        points: Control points. Shape (k, n).
    """

    knots: Floats
    points: Floats

    @property
    def start_time(self) -> float:
        """Lower end of the parameter."""
        return float(self.knots[SPLINE_ORDER - 1])

    @property
    def end_time(self) -> float:
        """Upper end of the parameter."""
        return float(self.knots[len(self.points)])

    def sample(self, parameters: Floats) -> MotionSamples:
        """Return positions and the first three derivatives.

        Args:
            parameters: Parameters, ascending. Shape (m,).
        """
        shape = len(parameters), self.points.shape[1]
        samples = MotionSamples(*(np.empty(shape) for _ in range(4)))
        _sample(self.knots, self.points, parameters, samples.q, samples.v, samples.a, samples.jerk)
        return samples

    def values(self, parameters: Floats) -> Floats:
        """Return positions. Shape (m, n).

        Args:
            parameters: Parameters, ascending. Shape (m,).
        """
        values = np.empty((len(parameters), self.points.shape[1]))
        _values(self.knots, self.points, parameters, values)
        return values

    def scaled(self, factor: float) -> "CubicSpline":
        """Return the spline with its parameter multiplied by a factor."""
        return CubicSpline(factor * self.knots, self.points)

    @staticmethod
    def from_trajectory(trajectory: BsplineTrajectory) -> "CubicSpline":
        """Return a cubic trajectory of Drake as a spline."""
        points = np.hstack(trajectory.control_points()).T
        return CubicSpline(np.array(trajectory.basis().knots()), points.copy())

    def to_trajectory(self) -> BsplineTrajectory:
        """Return the spline as a trajectory of Drake."""
        return BsplineTrajectory(BsplineBasis(SPLINE_ORDER, self.knots), self.points.T)


@lru_cache(maxsize=256)
def clamped_knots(num_points: int) -> Floats:
    """Return uniform knots in [0, 1] at which a spline ends at its last control points.

    Args:
        num_points: Number of control points, k.

    Returns:
        Knots. Shape (k + 4,).
    """
    kind = KnotVectorType.kClampedUniform
    return np.array(BsplineBasis(SPLINE_ORDER, num_points, kind, 0.0, 1.0).knots())


def uniform_spline(points: Floats, period: float) -> CubicSpline:
    """Return a spline with equidistant knots that starts at time 0.

    Args:
        points: Control points. Shape (k, n).
        period: Time between knots [s].
    """
    knots = np.arange(len(points) + SPLINE_ORDER) - (SPLINE_ORDER - 1.0)
    return CubicSpline(np.asarray(period * knots), points)


@njit(cache=True, nogil=True)
def _find_span(knots, num_points, x, first):  # type: ignore[no-untyped-def]
    """Return the index of the last knot up to x, from a first guess that is not above it."""
    span = first
    while span < num_points - 1 and knots[span + 1] <= x:
        span += 1
    return span


@njit(cache=True, nogil=True)
def _values(knots, points, parameters, q):  # type: ignore[no-untyped-def]
    """Write positions (m, n)."""
    num_points, n = points.shape
    span = 3
    for k in range(len(parameters)):
        x = parameters[k]
        span = _find_span(knots, num_points, x, span)
        t0, t1, t2 = knots[span - 2], knots[span - 1], knots[span]
        t3, t4, t5 = knots[span + 1], knots[span + 2], knots[span + 3]
        # Basis functions of orders 2, 3 and 4 that do not vanish.
        right = (x - t2) / (t3 - t2)
        left = 1.0 - right
        a, b, c = left / (t3 - t1), right / (t4 - t2), 0.0
        a, b, c = (t3 - x) * a, (x - t1) * a + (t4 - x) * b, (x - t2) * b
        a, b, c = a / (t3 - t0), b / (t4 - t1), c / (t5 - t2)
        w0 = (t3 - x) * a
        w1 = (x - t0) * a + (t4 - x) * b
        w2 = (x - t1) * b + (t5 - x) * c
        w3 = (x - t2) * c
        for j in range(n):
            q[k, j] = (
                w0 * points[span - 3, j]
                + w1 * points[span - 2, j]
                + w2 * points[span - 1, j]
                + w3 * points[span, j]
            )


@njit(cache=True, nogil=True)
def _sample(knots, points, parameters, q, v, a, jerk):  # type: ignore[no-untyped-def]
    """Write positions and three derivatives (m, n)."""
    num_points, n = points.shape
    _values(knots, points, parameters, q)
    span = 3
    for k in range(len(parameters)):
        x = parameters[k]
        span = _find_span(knots, num_points, x, span)
        t0, t1, t2 = knots[span - 2], knots[span - 1], knots[span]
        t3, t4, t5 = knots[span + 1], knots[span + 2], knots[span + 3]
        right = (x - t2) / (t3 - t2)
        left = 1.0 - right
        b0, b1 = left / (t3 - t1), right / (t4 - t2)
        w0, w1, w2 = (t3 - x) * b0, (x - t1) * b0 + (t4 - x) * b1, (x - t2) * b1
        for j in range(n):
            # Control points of the derivatives.
            v0 = 3 * (points[span - 2, j] - points[span - 3, j]) / (t3 - t0)
            v1 = 3 * (points[span - 1, j] - points[span - 2, j]) / (t4 - t1)
            v2 = 3 * (points[span, j] - points[span - 1, j]) / (t5 - t2)
            a0, a1 = 2 * (v1 - v0) / (t3 - t1), 2 * (v2 - v1) / (t4 - t2)
            v[k, j] = w0 * v0 + w1 * v1 + w2 * v2
            a[k, j] = left * a0 + right * a1
            jerk[k, j] = (a1 - a0) / (t3 - t2)
