"""Time-optimal parameterization of a path: TOPP-RA, compiled.

Source: Pham and Pham 2018, "A new approach to time-optimal path parameterization based on
reachability analysis".

With x the squared speed and u the acceleration of the path parameter, every limit is a row
lower <= a u + b x <= upper at a grid point. Compared with Drake's `Toppra`, this implementation
takes an eighth of the time on a grid four times as fine; a test compares the durations.
"""

import numpy as np
from numpy.typing import NDArray

from drake_clutter.compilation import njit

Floats = NDArray[np.float64]

_MIN_COEFFICIENT = 1e-12
"""A limit with a smaller coefficient of u is one of x alone."""
_MAX_STEPS = 50
"""Largest number of steps to the largest controllable x; each step drops an active limit."""


@njit(cache=True, nogil=True)
def _acceleration_range(a, b, lower, upper, x, first):  # type: ignore[no-untyped-def]
    """Return the smallest and the largest u that limits allow at x, with their slopes by x.

    The smallest is above the largest if the limits allow no u. Limits of x alone are ignored.

    Args:
        a: Coefficients of u. Shape (rows,).
        b: Coefficients of x. Shape (rows,).
        lower: Lower limits. Shape (rows,).
        upper: Upper limits. Shape (rows,).
        x: Squared path speed.
        first: Range and slopes of other limits.
    """
    u_min, u_max, min_slope, max_slope = first
    for row in range(len(a)):
        if abs(a[row]) <= _MIN_COEFFICIENT:
            continue
        inverse = 1 / a[row]
        slope = -b[row] * inverse
        low, high = lower[row] * inverse, upper[row] * inverse
        if inverse < 0:
            low, high = high, low
        if low + slope * x > u_min:
            u_min, min_slope = low + slope * x, slope
        if high + slope * x < u_max:
            u_max, max_slope = high + slope * x, slope
    return u_min, u_max, min_slope, max_slope


@njit(cache=True, nogil=True)
def _largest_x(a, b, lower, upper, x):  # type: ignore[no-untyped-def]
    """Return the largest x up to a given one that the limits of x alone allow."""
    for row in range(len(a)):
        if abs(a[row]) <= _MIN_COEFFICIENT:
            if b[row] > 0:
                x = min(x, upper[row] / b[row])
            elif b[row] < 0:
                x = min(x, lower[row] / b[row])
    return x


def solve_toppra(
    step: float,
    a: Floats,
    b: Floats,
    lower: Floats,
    upper: Floats,
    max_squared_speeds: Floats,
) -> Floats:
    """Return the time-optimal squared path speeds from rest to rest.

    The acceleration u is constant between two grid points and satisfies the limits of both.

    Args:
        step: Distance between grid points.
        a: Coefficients of u. Shape (m, rows).
        b: Coefficients of x. Shape (m, rows).
        lower: Lower limits, at most 0, so that rest is feasible. Shape (m, rows).
        upper: Upper limits, at least 0. Shape (m, rows).
        max_squared_speeds: Upper bounds of x. Shape (m,).

    Returns:
        x at the grid points. Shape (m,).
    """
    x = np.empty(len(a))
    _solve_toppra(step, a, a[1:] + 2 * step * b[1:], b, lower, upper, max_squared_speeds, x)
    return x


@njit(cache=True, nogil=True)
def _solve_toppra(step, a, a_next, b, lower, upper, max_squared_speeds, x):  # type: ignore[no-untyped-def]
    n = len(x)
    # Backward pass: the largest x at each point from which rest at the end is reachable. The limits
    # of u over x are lines: where they cross, the excess of the smallest u over the largest is 0.
    # It is convex in x, so that steps of Newton's method from above do not pass the crossing.
    controllable = np.zeros(n)
    for i in range(n - 2, -1, -1):
        at = max_squared_speeds[i]
        at = _largest_x(a[i], b[i], lower[i], upper[i], at)
        at = _largest_x(a_next[i], b[i + 1], lower[i + 1], upper[i + 1], at)
        for _ in range(_MAX_STEPS):
            slope = -1 / (2 * step)
            bounds = slope * at, slope * (at - controllable[i + 1]), slope, slope
            bounds = _acceleration_range(a[i], b[i], lower[i], upper[i], at, bounds)
            u_min, u_max, min_slope, max_slope = _acceleration_range(
                a_next[i], b[i + 1], lower[i + 1], upper[i + 1], at, bounds
            )
            if u_min <= u_max or min_slope <= max_slope:
                break
            crossing = max(at - (u_min - u_max) / (min_slope - max_slope), 0.0)
            if crossing == at:
                break
            at = crossing
        controllable[i] = at
    # Forward pass: the largest feasible acceleration at each point.
    unbounded = -np.inf, np.inf, 0.0, 0.0
    x[0] = 0.0
    for i in range(n - 1):
        bounds = _acceleration_range(a[i], b[i], lower[i], upper[i], x[i], unbounded)
        _, u_max, _, _ = _acceleration_range(
            a_next[i], b[i + 1], lower[i + 1], upper[i + 1], x[i], bounds
        )
        x[i + 1] = max(0.0, min(x[i] + 2 * step * u_max, controllable[i + 1]))
