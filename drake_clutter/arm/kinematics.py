"""Forward and inverse kinematics of the UR10 in closed form, all eight branches at once.

Frames: B the robot's base as its controller has it (z up; the ROS description's is turned by 180 degrees about z), 1 to 6 the
frames of the Denavit-Hartenberg convention, frame 6 being the tool flange, z out of it.
"""

from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

JOINTS = ("shoulder_pan_joint", "shoulder_lift_joint", "elbow_joint", "wrist_1_joint", "wrist_2_joint", "wrist_3_joint")
"""In the order of q, everywhere."""
_SINGULAR = 1e-7


@dataclass(frozen=True)
class DenavitHartenberg:
    """X_(i-1)(i) = Rz(q_i) Tz(d_i) Tx(a_i) Rx(alpha_i); lengths in m, angles in rad, (6,) each."""

    a: tuple[float, ...]
    d: tuple[float, ...]
    alpha: tuple[float, ...]


UR10 = DenavitHartenberg(
    a=(0.0, -0.612, -0.5723, 0.0, 0.0, 0.0),
    d=(0.1273, 0.0, 0.0, 0.163941, 0.1157, 0.0922),
    alpha=(np.pi / 2, 0.0, 0.0, np.pi / 2, -np.pi / 2, 0.0),
)
"""Universal Robots, "DH parameters for calculations of kinematics and dynamics", UR10."""


def after_joint(parameters: DenavitHartenberg, joint: int) -> Floats:
    """(4, 4) Tz(d) Tx(a) Rx(alpha) of a joint, counted from 0: what its link adds once the joint has turned."""
    a, d, alpha = parameters.a[joint], parameters.d[joint], parameters.alpha[joint]
    c, s = np.round([np.cos(alpha), np.sin(alpha)], 15)
    return np.array([[1.0, 0, 0, a], [0, c, -s, 0], [0, s, c, d], [0, 0, 0, 1]])


def _turned(angle: Floats) -> Floats:
    """(..., 4, 4) Rz of angles (...)."""
    X = np.zeros((*np.shape(angle), 4, 4))
    X[..., 0, 0] = X[..., 1, 1] = np.cos(angle)
    X[..., 1, 0] = np.sin(angle)
    X[..., 0, 1] = -X[..., 1, 0]
    X[..., 2, 2] = X[..., 3, 3] = 1.0
    return X


def link_poses(q: Floats, parameters: DenavitHartenberg = UR10) -> Floats:
    """X_B1 to X_B6, (..., 6, 4, 4), at joint angles q (..., 6) rad."""
    q = np.asarray(q, float)
    X = np.broadcast_to(np.eye(4), (*q.shape[:-1], 4, 4))
    found = []
    for joint in range(6):
        X = X @ _turned(q[..., joint]) @ after_joint(parameters, joint)
        found.append(X)
    return np.stack(found, axis=-3)


def forward_kinematics(q: Floats, parameters: DenavitHartenberg = UR10) -> Floats:
    """X_B6, (..., 4, 4), at joint angles q (..., 6) rad."""
    return np.asarray(link_poses(q, parameters)[..., -1, :, :])


def jacobian(q: Floats, parameters: DenavitHartenberg = UR10) -> Floats:
    """(6, 6): w_B6 over v_B6, rad/s and m/s, from joint velocities, rad/s, at q (6,) rad."""
    X = np.concatenate([np.eye(4)[None], link_poses(q, parameters)])
    axes, p_B6 = X[:-1, :3, 2], X[-1, :3, 3]
    return np.vstack([axes.T, np.cross(axes, p_B6 - X[:-1, :3, 3]).T])


def manipulability(q: Floats, parameters: DenavitHartenberg = UR10) -> float:
    """sqrt(det(J J^T)) = |det J|, m^3 (Yoshikawa 1985); 0 in a singular configuration."""
    return float(abs(np.linalg.det(jacobian(q, parameters))))


def inverse_kinematics(X_B6: Floats, wrist_3: float = 0.0, parameters: DenavitHartenberg = UR10) -> Floats:
    """All joint angles that reach a pose (Hawkins 2013, "Analytic inverse kinematics for the Universal Robots UR-5/UR-10 arms").

    Args:
        X_B6: (4, 4), of the flange.
        wrist_3: rad, taken where wrist 2 is straight, so that the last joint is free.
        parameters: of the arm.

    Returns:
        (n, 6) rad, within -pi to pi, n up to 8; none if it is out of reach. Branches that coincide are repeated.
    """
    X = np.asarray(X_B6, float)
    _, a2, a3, *_ = parameters.a
    _, _, _, d4, _, d6 = parameters.d
    p_B5 = X[:3, 3] - d6 * X[:3, 2]
    found = []
    reach = np.hypot(p_B5[0], p_B5[1])
    if reach < abs(d4):
        return np.empty((0, 6))
    for shoulder, wrist, elbow in product((1.0, -1.0), repeat=3):
        # The arm moves in a vertical plane at the distance d4 from the base's axis.
        q1 = np.arctan2(p_B5[1], p_B5[0]) + shoulder * np.arccos(d4 / reach) + np.pi / 2
        s1, c1 = np.sin(q1), np.cos(q1)
        cosine = (X[0, 3] * s1 - X[1, 3] * c1 - d4) / d6
        if abs(cosine) > 1 + 1e-12:
            continue
        q5 = wrist * np.arccos(np.clip(cosine, -1.0, 1.0))
        s5 = np.sin(q5)
        across = X[0, :2] * s1 - X[1, :2] * c1  # of the axis of joint 2 (and 3, and 4), along x and y of the flange
        q6 = np.arctan2(-across[1] / s5, across[0] / s5) if abs(s5) > _SINGULAR else wrist_3
        X_46 = _turned(np.array(q5)) @ after_joint(parameters, 4) @ _turned(np.array(q6)) @ after_joint(parameters, 5)
        X_B1 = _turned(np.array(q1)) @ after_joint(parameters, 0)
        X_14 = np.linalg.solve(X_B1, X) @ np.linalg.inv(X_46)
        p_13 = X_14[:3, 3] - d4 * X_14[:3, 1]
        distance = np.hypot(p_13[0], p_13[1])
        cosine = (distance**2 - a2**2 - a3**2) / (2 * a2 * a3)
        if abs(cosine) > 1 + 1e-12:
            continue
        q3 = elbow * np.arccos(np.clip(cosine, -1.0, 1.0))
        # Two bars of lengths a2 and a3, both negative: they lie along -x of their frames.
        q2 = np.arctan2(p_13[1], p_13[0]) - np.arctan2(a3 * np.sin(q3), a2 + a3 * np.cos(q3))
        X_13 = _turned(np.array(q2)) @ after_joint(parameters, 1) @ _turned(np.array(q3)) @ after_joint(parameters, 2)
        X_34 = np.linalg.solve(X_13, X_14)
        q4 = np.arctan2(X_34[1, 0], X_34[0, 0])
        found.append([q1, q2, q3, q4, q5, q6])
    angles = np.array(found).reshape(-1, 6)
    return np.asarray((angles + np.pi) % (2 * np.pi) - np.pi)
