"""Kinematics of serial arms with revolute and prismatic joints, compiled.

Frames: B is the robot's base, F is its flange, z out of the arm.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drake_clutter.compilation import njit

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class SerialChain:
    """Kinematic chain X_BF = fixed[0] J_1(q_1) fixed[1] ... J_n(q_n) fixed[n].

    Attributes:
        fixed: Fixed transforms between the joints, whose axes are z. Shape (n + 1, 4, 4).
        revolute: Whether a joint rotates about its axis; else it moves along it. Shape (n,).
    """

    fixed: Floats
    revolute: NDArray[np.bool_]

    @property
    def num_joints(self) -> int:
        """Number of joints, n."""
        return len(self.revolute)

    def forward_kinematics(self, q: Floats) -> Floats:
        """Return X_BF, shape (..., 4, 4), at joint positions of shape (..., n)."""
        q = np.asarray(q, float)
        rows = np.ascontiguousarray(q).reshape(-1, self.num_joints)
        poses = _forward_kinematics(self.fixed, self.revolute, rows)
        return np.asarray(poses.reshape(*q.shape[:-1], 4, 4))

    def joint_frames(self, q: Floats) -> Floats:
        """Return the poses in B of the joint frames, z along the axes, and X_BF.

        Args:
            q: Joint positions. Shape (n,).

        Returns:
            Poses. Shape (n + 1, 4, 4).
        """
        n = self.num_joints
        frames, moved = np.empty((n + 1, 4, 4)), np.empty((n, 3, 4))
        chain_frames(self.fixed, self.revolute, np.ascontiguousarray(q, float), frames, moved)
        return frames

    def jacobian(self, q: Floats) -> Floats:
        """Return the spatial Jacobian of F in B, angular rows first. Shape (6, n).

        Args:
            q: Joint positions. Shape (n,).
        """
        J = np.empty((6, self.num_joints))
        chain_jacobian(self.joint_frames(q), self.revolute, J)
        return J

    def jacobians(self, q: Floats) -> Floats:
        """Return the spatial Jacobians of F in B, angular rows first. Shape (m, 6, n).

        Args:
            q: Joint positions. Shape (m, n).
        """
        jacobians = np.empty((len(q), 6, self.num_joints))
        _jacobians(self.fixed, self.revolute, np.ascontiguousarray(q, float), jacobians)
        return jacobians

    def manipulability(self, q: Floats) -> Floats:
        """Return the manipulability sqrt(det(J J^T)) (Yoshikawa 1985). Shape (...).

        Args:
            q: Joint positions. Shape (..., n).
        """
        q = np.asarray(q, float)
        rows = np.ascontiguousarray(q).reshape(-1, self.num_joints)
        manipulability = _manipulability(self.fixed, self.revolute, rows)
        return np.asarray(manipulability.reshape(q.shape[:-1]))


@njit(cache=True)
def chain_frames(fixed, revolute, q, frames, moved):  # type: ignore[no-untyped-def]
    """Write joint frames and X_BF into frames (n + 1, 4, 4).

    The frames of the joints are those without their own motion; the upper rows of those with it are
    written into moved (n, 3, 4).
    """
    n = len(revolute)
    for i in range(4):
        for j in range(4):
            frames[0, i, j] = fixed[0, i, j]
    for k in range(n):
        c, s, slide = 1.0, 0.0, 0.0
        if revolute[k]:
            c, s = np.cos(q[k]), np.sin(q[k])
        else:
            slide = q[k]
        for i in range(3):
            x = frames[k, i, 0] * c + frames[k, i, 1] * s
            y = frames[k, i, 1] * c - frames[k, i, 0] * s
            z = frames[k, i, 2]
            p = frames[k, i, 3] + slide * z
            moved[k, i, 0], moved[k, i, 1], moved[k, i, 2], moved[k, i, 3] = x, y, z, p
            for j in range(4):
                frames[k + 1, i, j] = (
                    x * fixed[k + 1, 0, j] + y * fixed[k + 1, 1, j] + z * fixed[k + 1, 2, j]
                )
            frames[k + 1, i, 3] += p
            frames[k + 1, 3, i] = 0.0
        frames[k + 1, 3, 3] = 1.0


@njit(cache=True)
def chain_jacobian(frames, revolute, J):  # type: ignore[no-untyped-def]
    """Write the Jacobian of the last of frames (n + 1, 4, 4), angular rows first."""
    n = len(revolute)
    for k in range(n):
        z0, z1, z2 = frames[k, 0, 2], frames[k, 1, 2], frames[k, 2, 2]
        if revolute[k]:
            x = frames[n, 0, 3] - frames[k, 0, 3]
            y = frames[n, 1, 3] - frames[k, 1, 3]
            z = frames[n, 2, 3] - frames[k, 2, 3]
            J[0, k], J[1, k], J[2, k] = z0, z1, z2
            J[3, k], J[4, k], J[5, k] = z1 * z - z2 * y, z2 * x - z0 * z, z0 * y - z1 * x
        else:
            J[0, k] = J[1, k] = J[2, k] = 0.0
            J[3, k], J[4, k], J[5, k] = z0, z1, z2


@njit(cache=True)
def _jacobians(fixed, revolute, q, jacobians):  # type: ignore[no-untyped-def]
    """Write the Jacobians (m, 6, n) at joint positions q (m, n)."""
    n = len(revolute)
    frames, moved = np.empty((n + 1, 4, 4)), np.empty((n, 3, 4))
    for k in range(len(q)):
        chain_frames(fixed, revolute, q[k], frames, moved)
        chain_jacobian(frames, revolute, jacobians[k])


@njit(cache=True)
def _forward_kinematics(fixed, revolute, q):  # type: ignore[no-untyped-def]
    """Return X_BF, shape (m, 4, 4), at joint positions q (m, n)."""
    n = len(revolute)
    poses = np.empty((len(q), 4, 4))
    frames, moved = np.empty((n + 1, 4, 4)), np.empty((n, 3, 4))
    for k in range(len(q)):
        chain_frames(fixed, revolute, q[k], frames, moved)
        poses[k] = frames[n]
    return poses


@njit(cache=True)
def _manipulability(fixed, revolute, q):  # type: ignore[no-untyped-def]
    """Return the manipulability, shape (m,), at q (m, n); NaN where q is NaN."""
    n = len(revolute)
    manipulability = np.empty(len(q))
    frames, moved = np.empty((n + 1, 4, 4)), np.empty((n, 3, 4))
    J = np.empty((6, n))
    for k in range(len(q)):
        chain_frames(fixed, revolute, q[k], frames, moved)
        chain_jacobian(frames, revolute, J)
        manipulability[k] = (
            np.sqrt(max(np.linalg.det(J @ J.T), 0.0)) if np.isfinite(q[k]).all() else np.nan
        )
    return manipulability
