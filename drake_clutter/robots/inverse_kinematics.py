"""Inverse kinematics of a robot: the protocol, and the closed form of the UR family.

Frames: B the base; F the flange.
"""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from drake_clutter.robots.joint_range import JointRange
from drake_clutter.robots.ur_kinematics import DenavitHartenberg, branch_index, ik_branches

Floats = NDArray[np.float64]

MAX_JOINT_JUMP = 0.5
"""From one pose of a path to the next, a joint that turns further has left its branch [rad]."""


class InverseKinematics(Protocol):
    """Joint positions that reach poses of the flange.

    Attributes:
        num_solutions: Solutions that are given for each pose at most, K.
    """

    @property
    def num_solutions(self) -> int: ...

    def solve(self, X_BF: Floats) -> Floats:
        """Return joint positions within the limits.

        Args:
            X_BF: Shape (..., 4, 4).

        Returns:
            Shape (..., K, n); NaN in rows without a solution.
        """

    def match(self, q_from: Floats, q_to: Floats) -> Floats:
        """Return solutions in the order of those of another pose.

        Args:
            q_from: What `solve` gave for one pose. Shape (..., K, n).
            q_to: What `solve` gave for another. Shape (..., K, n).

        Returns:
            q_to, each row on the branch of the same row of q_from, or NaN. Shape (..., K, n).
        """

    def track(self, X_BF: Floats, q_start: Floats) -> Floats | None:
        """Return the continuous path of solutions along close poses.

        Args:
            X_BF: The first is that of q_start. Shape (m, 4, 4).
            q_start: Shape (n,).

        Returns:
            Shape (m, n); None if it leaves reach or limits, or jumps.
        """

    def follow(self, X_BF: Floats, q: Floats) -> Floats | None:
        """Return the solution on the branch of a configuration, at a pose that may be far from it.

        Args:
            X_BF: Shape (4, 4).
            q: Shape (n,).

        Returns:
            The equivalent that is nearest to q, shape (n,); None out of reach.
        """


@dataclass(frozen=True, eq=False)
class UrInverseKinematics:
    """Closed form of the UR family: eight branches, which keep their number from pose to pose.

    Attributes:
        parameters: Of the arm.
        joint_range: Range of the joints.
        X_0B: Of the model's base in frame 0 of the convention; None: the identity. Shape (4, 4).
        X_F6: Of frame 6 of the convention in the flange; None: the identity. Shape (4, 4).
    """

    parameters: DenavitHartenberg
    joint_range: JointRange
    X_0B: Floats | None = None
    X_F6: Floats | None = None

    @property
    def num_solutions(self) -> int:
        """Number of branches."""
        return 8

    def solve(self, X_BF: Floats) -> Floats:
        """Return all branches, see `InverseKinematics`; where singular, they coincide."""
        X = X_BF if self.X_0B is None else self.X_0B @ X_BF
        q = ik_branches(X if self.X_F6 is None else X @ self.X_F6, parameters=self.parameters)
        lower, upper = self.joint_range.limits.T
        return (
            q
            if (lower <= -np.pi).all() and (upper >= np.pi).all()
            else self.joint_range.wrap_to_limits(q)
        )

    def match(self, q_from: Floats, q_to: Floats) -> Floats:
        """Return q_to, whose rows are branches already."""
        return q_to

    def track(self, X_BF: Floats, q_start: Floats) -> Floats | None:
        """Return the branch of q_start along poses, see `InverseKinematics`."""
        q = self.solve(X_BF)[:, branch_index(q_start, self.parameters)]
        if not np.isfinite(q).all():
            return None
        q[0] = q_start
        for k in range(1, len(q)):
            q[k] = self.joint_range.unwrap(q[k], q[k - 1])
        return None if (np.abs(np.diff(q, axis=0)) > MAX_JOINT_JUMP).any() else q

    def follow(self, X_BF: Floats, q: Floats) -> Floats | None:
        """Return the branch of q at a pose, see `InverseKinematics`."""
        q_branch = self.solve(X_BF)[branch_index(q, self.parameters)]
        found = self.joint_range.unwrap(q_branch, q)
        return found if np.isfinite(found).all() else None
