"""Inverse kinematics: the protocol, and the closed-form solution of the UR family.

Frames: B is the robot's base, F is its flange.
"""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from drake_clutter.robots.joint_range import JointRange
from drake_clutter.robots.ur_kinematics import DenavitHartenberg, branch_index, ik_branches

Floats = NDArray[np.float64]

MAX_JOINT_JUMP = 0.5
"""Largest change of a joint between neighboring poses of a continuous path [rad]. A larger change
means that the solution changed its branch."""


class InverseKinematics(Protocol):
    """Inverse kinematics of an arm with n joints."""

    @property
    def num_solutions(self) -> int:
        """Largest number of solutions for a pose, K."""

    def solve(self, X_BF: Floats) -> Floats:
        """Return the solutions within the joint limits.

        Args:
            X_BF: Poses of the flange. Shape (..., 4, 4).

        Returns:
            Joint positions; NaN in rows without a solution. Shape (..., K, n).
        """

    def match(self, q_from: Floats, q_to: Floats) -> Floats:
        """Return solutions of a pose in the order of those of another pose.

        Args:
            q_from: Solutions of the first pose, see `solve`. Shape (..., K, n).
            q_to: Solutions of the second pose, see `solve`. Shape (..., K, n).

        Returns:
            Solutions of the second pose, each on the branch of the same row of `q_from`; NaN where
            there is none. Shape (..., K, n).
        """

    def track(self, X_BF: Floats, q_start: Floats) -> Floats | None:
        """Return the continuous path of solutions along closely spaced poses.

        Args:
            X_BF: Poses of the flange; the first is the pose at `q_start`. Shape (m, 4, 4).
            q_start: Joint positions at the first pose. Shape (n,).

        Returns:
            Joint positions, shape (m, n); None if a pose is unreachable, a joint limit is violated
            or a joint changes by more than `MAX_JOINT_JUMP`.
        """

    def follow(self, X_BF: Floats, q: Floats) -> Floats | None:
        """Return the solution of a pose on the branch of a configuration.

        Unlike in `track`, the pose may be far from the configuration.

        Args:
            X_BF: Pose of the flange. Shape (4, 4).
            q: Configuration. Shape (n,).

        Returns:
            The nearest equivalent of the solution to `q`, shape (n,); None if the pose is
            unreachable.
        """


@dataclass(frozen=True, eq=False)
class UrInverseKinematics:
    """Closed-form inverse kinematics of the UR family.

    There are eight branches, which keep their index from pose to pose.

    Attributes:
        parameters: Denavit-Hartenberg parameters of the arm.
        joint_range: Joint limits.
        X_0B: Pose of the model's base in Denavit-Hartenberg frame 0; None for the identity. Shape
            (4, 4).
        X_F6: Pose of Denavit-Hartenberg frame 6 in the flange; None for the identity. Shape (4, 4).
    """

    parameters: DenavitHartenberg
    joint_range: JointRange
    X_0B: Floats | None = None
    X_F6: Floats | None = None

    @property
    def num_solutions(self) -> int:
        """Number of branches, 8."""
        return 8

    def solve(self, X_BF: Floats) -> Floats:
        """Return all branches, see `InverseKinematics`. At singularities some are equal."""
        X = X_BF if self.X_0B is None else self.X_0B @ X_BF
        q = ik_branches(X if self.X_F6 is None else X @ self.X_F6, parameters=self.parameters)
        lower, upper = self.joint_range.limits.T
        return (
            q
            if (lower <= -np.pi).all() and (upper >= np.pi).all()
            else self.joint_range.wrap_to_limits(q)
        )

    def match(self, q_from: Floats, q_to: Floats) -> Floats:
        """Return `q_to`: its rows are already in the order of the branches."""
        return q_to

    def track(self, X_BF: Floats, q_start: Floats) -> Floats | None:
        """Return the branch of q_start along poses, see `InverseKinematics`."""
        q = np.ascontiguousarray(self.solve(X_BF)[:, branch_index(q_start, self.parameters)])
        if not np.isfinite(q).all():
            return None
        q[0] = q_start
        self.joint_range.unwrap_path(q)
        return None if (np.abs(np.diff(q, axis=0)) > MAX_JOINT_JUMP).any() else q

    def follow(self, X_BF: Floats, q: Floats) -> Floats | None:
        """Return the branch of q at a pose, see `InverseKinematics`."""
        q_branch = self.solve(X_BF)[branch_index(q, self.parameters)]
        q_nearest = self.joint_range.unwrap(q_branch, q)
        return q_nearest if np.isfinite(q_nearest).all() else None
