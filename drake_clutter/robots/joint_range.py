"""Joint limits, and equivalent positions of revolute joints within them."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drake_clutter.compilation import njit

Floats = NDArray[np.float64]

FULL_TURN = 2 * np.pi
"""Full turn of a revolute joint [rad]."""
_ROUNDING = 1e-9
"""Tolerance of the joint limits [rad or m]; positions beyond a limit by less are clipped."""


@dataclass(frozen=True, eq=False)
class JointRange:
    """Position limits of the joints of an arm.

    Attributes:
        limits: Lower and upper limit [rad, or m for a prismatic joint]. Shape (n, 2).
        revolute: Whether each joint is revolute. Shape (n,).
    """

    limits: Floats
    revolute: NDArray[np.bool_]

    @property
    def exceeds_full_turn(self) -> NDArray[np.bool_]:
        """Whether each revolute joint's range exceeds a full turn. Shape (n,)."""
        width = self.limits[:, 1] - self.limits[:, 0]
        return np.asarray(self.revolute & (width > FULL_TURN + _ROUNDING))

    def unwrap(self, q: Floats, reference: Floats) -> Floats:
        """Return the equivalent positions within the limits nearest to a reference.

        Args:
            q: Positions within the limits. Shape (..., n).
            reference: Reference positions. Shape (..., n).

        Returns:
            Positions; joints with a range of more than a full turn are moved by full turns. Shape
            (..., n).
        """
        nearest = q + FULL_TURN * np.round((reference - q) / FULL_TURN)
        nearest = np.where(
            nearest > self.limits[:, 1],
            nearest - FULL_TURN,
            np.where(nearest < self.limits[:, 0], nearest + FULL_TURN, nearest),
        )
        return np.asarray(np.where(self.exceeds_full_turn, nearest, q))

    def unwrap_path(self, path: Floats) -> None:
        """Replace each row of a path by its equivalent nearest to the row before, see `unwrap`.

        Args:
            path: Positions within the limits. Shape (m, n).
        """
        _unwrap_path(path, self.limits, self.exceeds_full_turn)

    def wrap_to_limits(self, q: Floats) -> Floats:
        """Return equivalent positions within the limits.

        Args:
            q: Positions. Shape (..., n).

        Returns:
            Positions; all NaN if a joint has no equivalent position within its limits. Shape
            (..., n).
        """
        lower, upper = self.limits.T
        center = (lower + upper) / 2
        wrapped = np.where(self.revolute, q - FULL_TURN * np.round((q - center) / FULL_TURN), q)
        q = np.where((q >= lower) & (q <= upper), q, wrapped)
        inside = ((q >= lower - _ROUNDING) & (q <= upper + _ROUNDING)).all(axis=-1, keepdims=True)
        return np.where(inside, np.clip(q, lower, upper), np.nan)


@njit(cache=True, nogil=True)
def _unwrap_path(path, limits, exceeds_full_turn):  # type: ignore[no-untyped-def]
    """Unwrap a path (m, n) in place, see `JointRange.unwrap_path`."""
    for joint in np.flatnonzero(exceeds_full_turn):
        lower, upper = limits[joint]
        for k in range(1, len(path)):
            turns = np.rint((path[k - 1, joint] - path[k, joint]) / FULL_TURN)
            q = path[k, joint] + FULL_TURN * turns
            if q > upper:
                q -= FULL_TURN
            elif q < lower:
                q += FULL_TURN
            path[k, joint] = q
