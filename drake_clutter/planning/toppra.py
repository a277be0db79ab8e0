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

_NUM_BISECTIONS = 50
"""Bisection steps for the largest controllable x, to below double precision."""


@njit(cache=True, nogil=True)
def _acceleration_range(a, b, lower, upper, x):  # type: ignore[no-untyped-def]
    """Return the smallest and the largest u that the limits allow at x.

    The smallest is above the largest if the limits allow no u.
    """
    u_min, u_max = -np.inf, np.inf
    for row in range(len(a)):
        low, high = lower[row] - b[row] * x, upper[row] - b[row] * x
        if a[row] > 1e-12:
            u_min, u_max = max(u_min, low / a[row]), min(u_max, high / a[row])
        elif a[row] < -1e-12:
            u_min, u_max = max(u_min, high / a[row]), min(u_max, low / a[row])
        elif low > 0 or high < 0:
            return 1.0, 0.0
    return u_min, u_max


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
    a_next = a[1:] + 2 * step * b[1:]
    squared_speeds: Floats = _solve_toppra(
        step,
        np.hstack((a[:-1], a_next)),
        np.hstack((b[:-1], b[1:])),
        np.hstack((lower[:-1], lower[1:])),
        np.hstack((upper[:-1], upper[1:])),
        max_squared_speeds,
    )
    return squared_speeds


@njit(cache=True, nogil=True)
def _solve_toppra(step, a, b, lower, upper, max_squared_speeds):  # type: ignore[no-untyped-def]
    n = len(max_squared_speeds)
    # Backward pass: the largest x at each point from which rest at the end is reachable.
    controllable = np.zeros(n)
    for i in range(n - 2, -1, -1):
        feasible, infeasible, x = 0.0, max_squared_speeds[i], max_squared_speeds[i]
        for _ in range(_NUM_BISECTIONS):
            u_min, u_max = _acceleration_range(a[i], b[i], lower[i], upper[i], x)
            u_min = max(u_min, -x / (2 * step))
            u_max = min(u_max, (controllable[i + 1] - x) / (2 * step))
            if u_min <= u_max:
                feasible = x
                if x == max_squared_speeds[i]:
                    break
            else:
                infeasible = x
            x = (feasible + infeasible) / 2
        controllable[i] = feasible
    # Forward pass: the largest feasible acceleration at each point.
    x = np.zeros(n)
    for i in range(n - 1):
        _, u_max = _acceleration_range(a[i], b[i], lower[i], upper[i], x[i])
        x[i + 1] = max(0.0, min(x[i] + 2 * step * u_max, controllable[i + 1]))
    return x
