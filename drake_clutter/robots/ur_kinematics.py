"""Closed-form forward and inverse kinematics of the UR family.

Frames: B is the robot's base as in its controller, z up (`base_link` of ROS is rotated by 180
degrees about z); 1 to 6 are the Denavit-Hartenberg frames; frame 6 is the flange, z out of the arm.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from drake_clutter.compilation import njit
from drake_clutter.robots.serial_chain import SerialChain

Floats = NDArray[np.float64]

UR_JOINT_NAMES = (
    "shoulder_pan_joint",
    "shoulder_lift_joint",
    "elbow_joint",
    "wrist_1_joint",
    "wrist_2_joint",
    "wrist_3_joint",
)
"""Names of the joints, in the order of q."""
_SINGULAR_SINE = 1e-7
"""|sin(q5)| below which the wrist is singular: the axes of joints 4 and 6 are parallel."""


@dataclass(frozen=True)
class DenavitHartenberg:
    """Denavit-Hartenberg parameters: X_(i-1)(i) = Rz(q_i) Tz(d_i) Tx(a_i) Rx(alpha_i).

    Attributes:
        a: Link lengths [m]. Shape (6,).
        d: Link offsets [m]. Shape (6,).
        alpha: Link twists [rad]. Shape (6,).
    """

    a: tuple[float, ...]
    d: tuple[float, ...]
    alpha: tuple[float, ...]


UR10_PARAMETERS = DenavitHartenberg(
    a=(0.0, -0.612, -0.5723, 0.0, 0.0, 0.0),
    d=(0.1273, 0.0, 0.0, 0.163941, 0.1157, 0.0922),
    alpha=(np.pi / 2, 0.0, 0.0, np.pi / 2, -np.pi / 2, 0.0),
)
"""Parameters of the UR10 (Universal Robots, "DH parameters for calculations of kinematics and
dynamics")."""


def fixed_link_transform(parameters: DenavitHartenberg, joint: int) -> Floats:
    """Return Tz(d) Tx(a) Rx(alpha) of a joint. Shape (4, 4).

    Args:
        parameters: Denavit-Hartenberg parameters.
        joint: Index of the joint, from 0.
    """
    a = parameters.a[joint]
    d = parameters.d[joint]
    alpha = parameters.alpha[joint]
    c, s = np.round([np.cos(alpha), np.sin(alpha)], 15)
    return np.array([[1.0, 0, 0, a], [0, c, -s, 0], [0, s, c, d], [0, 0, 0, 1]])


def _rotations_about_z(angle: Floats) -> Floats:
    """Return Rz of angles [rad] of shape (...), as poses of shape (..., 4, 4)."""
    X = np.zeros((*np.shape(angle), 4, 4))
    X[..., 0, 0] = X[..., 1, 1] = np.cos(angle)
    X[..., 1, 0] = np.sin(angle)
    X[..., 0, 1] = -X[..., 1, 0]
    X[..., 2, 2] = X[..., 3, 3] = 1.0
    return X


def link_poses(q: Floats, parameters: DenavitHartenberg = UR10_PARAMETERS) -> Floats:
    """Return the poses X_B1 to X_B6. Shape (..., 6, 4, 4).

    Args:
        q: Joint positions [rad]. Shape (..., 6).
        parameters: Denavit-Hartenberg parameters.
    """
    q = np.asarray(q, float)
    X = np.broadcast_to(np.eye(4), (*q.shape[:-1], 4, 4))
    poses = []
    for joint in range(6):
        X = X @ _rotations_about_z(q[..., joint]) @ fixed_link_transform(parameters, joint)
        poses.append(X)
    return np.stack(poses, axis=-3)


def forward_kinematics(q: Floats, parameters: DenavitHartenberg = UR10_PARAMETERS) -> Floats:
    """Return the pose X_B6 of the flange. Shape (..., 4, 4).

    Args:
        q: Joint positions [rad]. Shape (..., 6).
        parameters: Denavit-Hartenberg parameters.
    """
    return _serial_chain(parameters).forward_kinematics(q)


@lru_cache(maxsize=32)
def _serial_chain(parameters: DenavitHartenberg) -> SerialChain:
    links = [fixed_link_transform(parameters, joint) for joint in range(6)]
    return SerialChain(np.array([np.eye(4), *links]), np.ones(6, bool))


def jacobian(q: Floats, parameters: DenavitHartenberg = UR10_PARAMETERS) -> Floats:
    """Return the spatial Jacobian of the flange in B, angular first. Shape (6, 6).

    Args:
        q: Joint positions [rad]. Shape (6,).
        parameters: Denavit-Hartenberg parameters.
    """
    X = np.concatenate([np.eye(4)[None], link_poses(q, parameters)])
    axes = X[:-1, :3, 2]
    p_B6 = X[-1, :3, 3]
    return np.vstack([axes.T, np.cross(axes, p_B6 - X[:-1, :3, 3]).T])


def manipulability(q: Floats, parameters: DenavitHartenberg = UR10_PARAMETERS) -> Floats:
    """Return the manipulability |det J| (Yoshikawa 1985) [m^3]. Shape (...).

    For the UR family, it is the product of the horizontal reach of the wrist in the plane of the
    arm, a2 a3 sin(q3) and sin(q5), each 0 at one of the three singularities.

    Args:
        q: Joint positions [rad]. Shape (..., 6).
        parameters: Denavit-Hartenberg parameters.
    """
    _, a2, a3 = parameters.a[:3]
    return np.asarray(
        np.abs(a2 * a3 * np.sin(q[..., 2]) * np.sin(q[..., 4]) * _wrist_reach(q, parameters))
    )


def _wrist_reach(q: Floats, parameters: DenavitHartenberg) -> Floats:
    """Return the wrist's horizontal coordinate in the arm's plane [m]. Shape (...)."""
    _, a2, a3 = parameters.a[:3]
    in_plane = np.cumsum(q[..., 1:4], axis=-1)
    links = a2 * np.cos(in_plane[..., 0]) + a3 * np.cos(in_plane[..., 1])
    return np.asarray(links + parameters.d[4] * np.sin(in_plane[..., 2]))


def branch_index(q: Floats, parameters: DenavitHartenberg) -> int:
    """Return the index of the branch of a configuration, see `ik_branches`.

    Args:
        q: Joint positions [rad]. Shape (6,).
        parameters: Denavit-Hartenberg parameters.
    """
    flags = _wrist_reach(q, parameters) > 0, np.sin(q[4]) < 0, np.sin(q[2]) < 0
    return int(np.dot(flags, (4, 2, 1)))


def inverse_kinematics(
    X_B6: Floats, singular_wrist_3: float = 0.0, parameters: DenavitHartenberg = UR10_PARAMETERS
) -> Floats:
    """Return all solutions of a pose.

    Args:
        X_B6: Pose of the flange. Shape (4, 4).
        singular_wrist_3: Position of the last joint at a wrist singularity, where it is free [rad].
        parameters: Denavit-Hartenberg parameters.

    Returns:
        Joint positions in [-pi, pi], m <= 8; equal branches are repeated. Shape (m, 6).
    """
    q = ik_branches(X_B6, singular_wrist_3, parameters)
    return q[np.isfinite(q[:, 0])]


def ik_branches(
    X_B6: Floats, singular_wrist_3: float = 0.0, parameters: DenavitHartenberg = UR10_PARAMETERS
) -> Floats:
    """Return the inverse kinematics solutions of poses by branch.

    Source: Hawkins 2013, "Analytic inverse kinematics for the Universal Robots UR-5/UR-10 arms". A
    branch keeps its index from pose to pose: 4 for the shoulder, 2 for the wrist and 1 for the
    elbow, if bent the other way.

    Args:
        X_B6: Poses of the flange. Shape (..., 4, 4).
        singular_wrist_3: Position of the last joint at a wrist singularity, where it is free [rad].
        parameters: Denavit-Hartenberg parameters.

    Returns:
        Joint positions in [-pi, pi]; NaN where a branch does not reach the pose. Shape (..., 8, 6).
    """
    X = np.ascontiguousarray(X_B6, float)
    lengths = (
        parameters.d[0],
        parameters.a[1],
        parameters.a[2],
        parameters.d[3],
        parameters.d[4],
        parameters.d[5],
    )
    return np.asarray(
        _solve_branches(X.reshape(-1, 4, 4), singular_wrist_3, *lengths).reshape(
            *X.shape[:-2], 8, 6
        )
    )


@njit(cache=True)
def solve_branch(X, branch, singular_wrist_3, d1, a2, a3, d4, d5, d6, q):  # type: ignore[no-untyped-def]
    """Write the solution of a pose X (4, 4) on a branch to q, and return whether there is one."""
    # Origin of frame 5.
    x = X[0, 3] - d6 * X[0, 2]
    y = X[1, 3] - d6 * X[1, 2]
    z = X[2, 3] - d6 * X[2, 2]
    reach = np.hypot(x, y)
    if reach < abs(d4):
        return False
    shoulder = 1 - 2 * (branch // 4)
    wrist = 1 - 2 * (branch // 2 % 2)
    elbow = 1 - 2 * (branch % 2)
    # The arm moves in a vertical plane at the distance d4 from the base's axis.
    q1 = np.arctan2(y, x) + shoulder * np.arccos(d4 / reach) + np.pi / 2
    s1, c1 = np.sin(q1), np.cos(q1)
    cosine = (X[0, 3] * s1 - X[1, 3] * c1 - d4) / d6
    if abs(cosine) > 1 + 1e-12:
        return False
    q5 = wrist * np.arccos(min(max(cosine, -1.0), 1.0))
    s5 = np.sin(q5)
    # Components along x and y of frame 6 of the axis of joint 2.
    along_x = X[0, 0] * s1 - X[1, 0] * c1
    along_y = X[0, 1] * s1 - X[1, 1] * c1
    q6 = np.arctan2(-along_y / s5, along_x / s5) if abs(s5) > _SINGULAR_SINE else singular_wrist_3
    # Origin of frame 4 in the vertical plane, with x along (c1, s1) and y up. From the
    # origin of frame 5, it is at d5 along y of frame 5, (u, v, w).
    s6, c6 = np.sin(q6), np.cos(q6)
    u = X[0, 0] * s6 + X[0, 1] * c6
    v = X[1, 0] * s6 + X[1, 1] * c6
    w = X[2, 0] * s6 + X[2, 1] * c6
    px = (x + d5 * u) * c1 + (y + d5 * v) * s1
    py = z + d5 * w - d1
    distance = np.hypot(px, py)
    cosine = (distance**2 - a2**2 - a3**2) / (2 * a2 * a3)
    if abs(cosine) > 1 + 1e-12:
        return False
    q3 = elbow * np.arccos(min(max(cosine, -1.0), 1.0))
    # Planar two-link arm; a2 and a3 are negative: links lie along -x of their frames.
    q2 = np.arctan2(py, px) - np.arctan2(a3 * np.sin(q3), a2 + a3 * np.cos(q3))
    # Sum of q2, q3 and q4: in the plane, z of frame 4, -(u, v, w), is (sin, -cos) of it.
    q234 = np.arctan2(-(u * c1 + v * s1), w)
    q[0] = q1
    q[1] = q2
    q[2] = q3
    q[3] = q234 - q2 - q3
    q[4] = q5
    q[5] = q6
    for joint in range(6):
        q[joint] = (q[joint] + np.pi) % (2 * np.pi) - np.pi
    return True


@njit(cache=True)
def _solve_branches(X_B6, singular_wrist_3, d1, a2, a3, d4, d5, d6):  # type: ignore[no-untyped-def]
    """Return the solutions of poses X_B6 (m, 4, 4). Shape (m, 8, 6)."""
    solutions = np.full((len(X_B6), 8, 6), np.nan)
    for k in range(len(X_B6)):
        for branch in range(8):
            solve_branch(
                X_B6[k], branch, singular_wrist_3, d1, a2, a3, d4, d5, d6, solutions[k, branch]
            )
    return solutions
