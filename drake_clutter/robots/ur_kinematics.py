"""Forward and inverse kinematics of the UR family in closed form, all eight branches at once.

Frames: B the robot's base as its controller has it (z up; the ROS description's is turned by 180 degrees about z), 1 to 6 the
frames of the Denavit-Hartenberg convention, frame 6 being the tool flange, z out of it.
"""

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

Floats = NDArray[np.float64]

UR_JOINT_NAMES = (
    "shoulder_pan_joint",
    "shoulder_lift_joint",
    "elbow_joint",
    "wrist_1_joint",
    "wrist_2_joint",
    "wrist_3_joint",
)
"""In the order of q, everywhere."""
_SINGULAR_SINE = 1e-7


@dataclass(frozen=True)
class DenavitHartenberg:
    """X_(i-1)(i) = Rz(q_i) Tz(d_i) Tx(a_i) Rx(alpha_i); lengths in m, angles in rad, (6,) each."""

    a: tuple[float, ...]
    d: tuple[float, ...]
    alpha: tuple[float, ...]


UR10_PARAMETERS = DenavitHartenberg(
    a=(0.0, -0.612, -0.5723, 0.0, 0.0, 0.0),
    d=(0.1273, 0.0, 0.0, 0.163941, 0.1157, 0.0922),
    alpha=(np.pi / 2, 0.0, 0.0, np.pi / 2, -np.pi / 2, 0.0),
)
"""Universal Robots, "DH parameters for calculations of kinematics and dynamics", UR10."""


def fixed_link_transform(parameters: DenavitHartenberg, joint: int) -> Floats:
    """(4, 4) Tz(d) Tx(a) Rx(alpha) of a joint, counted from 0: what its link adds once the joint has turned."""
    a, d, alpha = parameters.a[joint], parameters.d[joint], parameters.alpha[joint]
    c, s = np.round([np.cos(alpha), np.sin(alpha)], 15)
    return np.array([[1.0, 0, 0, a], [0, c, -s, 0], [0, s, c, d], [0, 0, 0, 1]])


def _rotations_about_z(angle: Floats) -> Floats:
    """(..., 4, 4) Rz of angles (...)."""
    X = np.zeros((*np.shape(angle), 4, 4))
    X[..., 0, 0] = X[..., 1, 1] = np.cos(angle)
    X[..., 1, 0] = np.sin(angle)
    X[..., 0, 1] = -X[..., 1, 0]
    X[..., 2, 2] = X[..., 3, 3] = 1.0
    return X


def link_poses(q: Floats, parameters: DenavitHartenberg = UR10_PARAMETERS) -> Floats:
    """X_B1 to X_B6, (..., 6, 4, 4), at joint angles q (..., 6) rad."""
    q = np.asarray(q, float)
    X = np.broadcast_to(np.eye(4), (*q.shape[:-1], 4, 4))
    found = []
    for joint in range(6):
        X = X @ _rotations_about_z(q[..., joint]) @ fixed_link_transform(parameters, joint)
        found.append(X)
    return np.stack(found, axis=-3)


def forward_kinematics(q: Floats, parameters: DenavitHartenberg = UR10_PARAMETERS) -> Floats:
    """X_B6, (..., 4, 4), at joint angles q (..., 6) rad."""
    return np.asarray(link_poses(q, parameters)[..., -1, :, :])


def jacobian(q: Floats, parameters: DenavitHartenberg = UR10_PARAMETERS) -> Floats:
    """(6, 6): w_B6 over v_B6, rad/s and m/s, from joint velocities, rad/s, at q (6,) rad."""
    X = np.concatenate([np.eye(4)[None], link_poses(q, parameters)])
    axes, p_B6 = X[:-1, :3, 2], X[-1, :3, 3]
    return np.vstack([axes.T, np.cross(axes, p_B6 - X[:-1, :3, 3]).T])


def manipulability(q: Floats, parameters: DenavitHartenberg = UR10_PARAMETERS) -> Floats:
    """(...) |det J|, m^3, at joint angles (..., 6) rad (Yoshikawa 1985); 0 in a singular configuration.

    The reach of the wrist in the arm's plane, times the elbow's and the wrist's bend: the determinant of an arm of the UR family.
    """
    _, a2, a3 = parameters.a[:3]
    return np.asarray(
        np.abs(a2 * a3 * np.sin(q[..., 2]) * np.sin(q[..., 4]) * _wrist_reach(q, parameters))
    )


def _wrist_reach(q: Floats, parameters: DenavitHartenberg) -> Floats:
    """Return the wrist's coordinate along the arm's plane, (...), at joint angles (..., 6) [m]."""
    _, a2, a3 = parameters.a[:3]
    in_plane = np.cumsum(q[..., 1:4], axis=-1)
    bars = a2 * np.cos(in_plane[..., 0]) + a3 * np.cos(in_plane[..., 1])
    return np.asarray(bars + parameters.d[4] * np.sin(in_plane[..., 2]))


def branch_index(q: Floats, parameters: DenavitHartenberg) -> int:
    """Return the number of the branch, see `branches`, on which joint angles (6,) are [rad]."""
    turned_back = _wrist_reach(q, parameters) > 0, np.sin(q[4]) < 0, np.sin(q[2]) < 0
    return int(np.dot(turned_back, (4, 2, 1)))


def inverse_kinematics(
    X_B6: Floats, singular_wrist_3: float = 0.0, parameters: DenavitHartenberg = UR10_PARAMETERS
) -> Floats:
    """All joint angles that reach a pose, see `branches`.

    Args:
        X_B6: (4, 4), of the flange.
        singular_wrist_3: rad, taken where wrist 2 is straight, so that the last joint is free.
        parameters: of the arm.

    Returns:
        (n, 6) rad, within -pi to pi, n up to 8; none if it is out of reach. Branches that coincide are repeated.
    """
    found = ik_branches(X_B6, singular_wrist_3, parameters)
    return found[np.isfinite(found[:, 0])]


def ik_branches(
    X_B6: Floats, singular_wrist_3: float = 0.0, parameters: DenavitHartenberg = UR10_PARAMETERS
) -> Floats:
    """The joint angles that reach poses, branch by branch (Hawkins 2013, "Analytic inverse kinematics for the Universal Robots
    UR-5/UR-10 arms").

    Args:
        X_B6: (..., 4, 4), of the flange.
        singular_wrist_3: rad, taken where wrist 2 is straight, so that the last joint is free.
        parameters: of an arm of the UR family.

    Returns:
        (..., 8, 6) rad, within -pi to pi; NaN where a branch does not reach. A branch keeps its number from pose to pose.
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
        _ik_branches(X.reshape(-1, 4, 4), singular_wrist_3, *lengths).reshape(*X.shape[:-2], 8, 6)
    )


@njit(cache=True)
def _ik_branches(X_B6, singular_wrist_3, d1, a2, a3, d4, d5, d6):  # type: ignore[no-untyped-def]
    found = np.full((len(X_B6), 8, 6), np.nan)
    for k in range(len(X_B6)):
        X = X_B6[k]
        x, y, z = (
            X[0, 3] - d6 * X[0, 2],
            X[1, 3] - d6 * X[1, 2],
            X[2, 3] - d6 * X[2, 2],
        )  # origin of frame 5
        reach = np.hypot(x, y)
        if reach < abs(d4):
            continue
        for branch in range(8):
            shoulder, wrist, elbow = (
                1 - 2 * (branch // 4),
                1 - 2 * (branch // 2 % 2),
                1 - 2 * (branch % 2),
            )
            # The arm moves in a vertical plane at the distance d4 from the base's axis.
            q1 = np.arctan2(y, x) + shoulder * np.arccos(d4 / reach) + np.pi / 2
            s1, c1 = np.sin(q1), np.cos(q1)
            cosine = (X[0, 3] * s1 - X[1, 3] * c1 - d4) / d6
            if abs(cosine) > 1 + 1e-12:
                continue
            q5 = wrist * np.arccos(min(max(cosine, -1.0), 1.0))
            s5 = np.sin(q5)
            # The axis of joint 2 (and 3, and 4), along x and y of the flange.
            along_x, along_y = X[0, 0] * s1 - X[1, 0] * c1, X[0, 1] * s1 - X[1, 1] * c1
            q6 = (
                np.arctan2(-along_y / s5, along_x / s5)
                if abs(s5) > _SINGULAR_SINE
                else singular_wrist_3
            )
            # In the plane, whose x is c1, s1 and whose y is up: frame 4 is d5 behind frame 5 along its y.
            s6, c6 = np.sin(q6), np.cos(q6)
            u, v, w = (
                X[0, 0] * s6 + X[0, 1] * c6,
                X[1, 0] * s6 + X[1, 1] * c6,
                X[2, 0] * s6 + X[2, 1] * c6,
            )
            px = (x + d5 * u) * c1 + (y + d5 * v) * s1
            py = z + d5 * w - d1
            distance = np.hypot(px, py)
            cosine = (distance**2 - a2**2 - a3**2) / (2 * a2 * a3)
            if abs(cosine) > 1 + 1e-12:
                continue
            q3 = elbow * np.arccos(min(max(cosine, -1.0), 1.0))
            # Two bars of lengths a2 and a3, both negative: they lie along -x of their frames.
            q2 = np.arctan2(py, px) - np.arctan2(a3 * np.sin(q3), a2 + a3 * np.cos(q3))
            # In the plane z of frame 4, which is minus (u, v, w), is sin(q2 + q3 + q4), -cos(q2 + q3 + q4).
            total = np.arctan2(-(u * c1 + v * s1), w)
            q = found[k, branch]
            q[0], q[1], q[2], q[3], q[4], q[5] = q1, q2, q3, total - q2 - q3, q5, q6
            for joint in range(6):
                q[joint] = (q[joint] + np.pi) % (2 * np.pi) - np.pi
    return found
