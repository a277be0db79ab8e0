"""Fit of Denavit-Hartenberg parameters of the UR family to the model of an arm.

Frames: B is the model's base, 0 to 6 are the Denavit-Hartenberg frames, F is the model's flange.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drake_clutter.robots.serial_chain import SerialChain
from drake_clutter.robots.ur_kinematics import DenavitHartenberg, forward_kinematics

Floats = NDArray[np.float64]

_LENGTH_DECIMALS = 12
"""Decimals to which lengths are rounded [m]; removes rounding errors."""
_NUM_SAMPLES = 50
"""Random configurations at which the fit is compared with the model."""


@dataclass(frozen=True, eq=False)
class UrFit:
    """Kinematics of the UR family, X_BF = X_B0 X_06(q) X_6F.

    Attributes:
        parameters: Denavit-Hartenberg parameters of X_06.
        X_B0: Pose of frame 0 in the model's base; None for the identity. Shape (4, 4).
        X_6F: Pose of the model's flange in frame 6; None for the identity. Shape (4, 4).
        error: Largest difference to poses of the model: entries of rotation matrices, and positions
            [m]. Infinite if the arm has zero lengths that the closed form divides by.
    """

    parameters: DenavitHartenberg
    X_B0: Floats | None
    X_6F: Floats | None
    error: float


def fit_ur(chain: SerialChain) -> UrFit:
    """Fit the kinematics of the UR family to an arm with six joints.

    The parameters follow from the joint axes at q = 0. In frame 0, the axis of joint 1 is z, those
    of joints 2, 3, 4 and 6 are -y, and that of joint 5 is -z.

    Args:
        chain: Kinematic chain of the arm.
    """
    frames = chain.joint_frames(np.zeros(6))
    up = frames[0, :3, 2]
    y = -frames[1, :3, 2]
    X_B0 = np.eye(4)
    X_B0[:3, :3] = np.column_stack([np.cross(y, up), y, up])
    # The origin of frame 0 may be anywhere on the first axis: it gets the height of the base.
    X_B0[:3, 3] = frames[0, :3, 3] - up * (up @ frames[0, :3, 3])
    p = (frames[:, :3, 3] - X_B0[:3, 3]) @ X_B0[:3, :3]
    a2 = round(float(p[2, 0] - p[1, 0]), _LENGTH_DECIMALS)
    a3 = round(float(p[3, 0] - p[2, 0]), _LENGTH_DECIMALS)
    d1 = round(float(p[1, 2]), _LENGTH_DECIMALS)
    d4 = round(float(-p[4, 1]), _LENGTH_DECIMALS)
    d5 = round(float(p[1, 2] - p[5, 2]), _LENGTH_DECIMALS)
    d6 = round(float(p[4, 1] - p[6, 1]), _LENGTH_DECIMALS)
    alpha = (np.pi / 2, 0.0, 0.0, np.pi / 2, -np.pi / 2, 0.0)
    parameters = DenavitHartenberg((0.0, a2, a3, 0.0, 0.0, 0.0), (d1, 0.0, 0.0, d4, d5, d6), alpha)
    X_6F = np.linalg.inv(X_B0 @ forward_kinematics(np.zeros(6), parameters)) @ frames[6]
    q = np.random.default_rng(0).uniform(-np.pi, np.pi, (_NUM_SAMPLES, 6))
    fitted = X_B0 @ forward_kinematics(q, parameters) @ X_6F
    error = np.abs(fitted - chain.forward_kinematics(q)).max()
    is_usable = min(abs(a2), abs(a3), abs(d6)) > 1e-3
    return UrFit(
        parameters,
        _none_if_identity(X_B0),
        _none_if_identity(X_6F),
        float(error) if is_usable else np.inf,
    )


def _none_if_identity(X: Floats) -> Floats | None:
    return None if np.abs(X - np.eye(4)).max() < 10.0**-_LENGTH_DECIMALS * 10 else X
