"""Positions that joints can take, and whole turns within them."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

FULL_TURN = 2 * np.pi
_ROUNDING = 1e-9
"""A joint that is no further outside of its range is put on its limit [rad or m]."""


@dataclass(frozen=True, eq=False)
class JointRange:
    """Ranges of an arm's joints.

    Attributes:
        limits: Least and greatest position [rad, or m for a prismatic joint]. Shape (n, 2).
        revolute: Which joints turn. Shape (n,).
    """

    limits: Floats
    revolute: NDArray[np.bool_]

    @property
    def exceeds_full_turn(self) -> NDArray[np.bool_]:
        """Which joints can reach a pose at more than one angle. Shape (n,)."""
        return np.asarray(self.revolute & (self.limits[:, 1] - self.limits[:, 0] > FULL_TURN))

    def unwrap(self, q: Floats, reference: Floats) -> Floats:
        """Return equivalent positions that are nearest to others.

        Args:
            q: Positions within the limits. Shape (..., n).
            reference: Shape (..., n).

        Returns:
            q, joints with a range of more than a turn moved by whole turns. Shape (..., n).
        """
        turned = q + FULL_TURN * np.round((reference - q) / FULL_TURN)
        turned = np.where(
            turned > self.limits[:, 1],
            turned - FULL_TURN,
            np.where(turned < self.limits[:, 0], turned + FULL_TURN, turned),
        )
        return np.asarray(np.where(self.exceeds_full_turn, turned, q))

    def wrap_to_limits(self, q: Floats) -> Floats:
        """Return equivalent positions within the limits; all NaN if one joint has none.

        Args:
            q: Shape (..., n).
        """
        lower, upper = self.limits.T
        middle = (lower + upper) / 2
        moved = np.where(self.revolute, q - FULL_TURN * np.round((q - middle) / FULL_TURN), q)
        q = np.where((q >= lower) & (q <= upper), q, moved)
        inside = ((q >= lower - _ROUNDING) & (q <= upper + _ROUNDING)).all(axis=-1, keepdims=True)
        return np.where(inside, np.clip(q, lower, upper), np.nan)
