"""Denavit-Hartenberg parameters of the UR family, read off an arm's model.

Frames: B the model's base; 0 to 6 the frames of the convention; F the model's flange.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drake_clutter.robots.serial_chain import SerialChain
from drake_clutter.robots.ur_kinematics import DenavitHartenberg, forward_kinematics

Floats = NDArray[np.float64]

_LENGTH_DECIMALS = 12
"""Decimals of a length [m] that are kept: what lies below is rounding."""
_NUM_SAMPLES = 50


@dataclass(frozen=True, eq=False)
class UrFit:
    """An arm as one of the UR family: X_BF = X_B0 X_06(q) X_6F.

    Attributes:
        parameters: Of X_06.
        X_B0: None if it is the identity. Shape (4, 4).
        X_6F: None if it is the identity. Shape (4, 4).
        error: Largest difference to the model's poses: entries of rotations, and positions [m].
    """

    parameters: DenavitHartenberg
    X_B0: Floats | None
    X_6F: Floats | None
    error: float


def fit_ur(chain: SerialChain) -> UrFit:
    """Return the parameters that an arm has if it is of the UR family.

    They are read off the joints' axes at q = 0: z_1 along z of frame 0; z_2, z_3, z_4 and z_6 along
    -y; z_5 along -z.

    Args:
        chain: Any arm of six joints.
    """
    frames = chain.joint_frames(np.zeros(6))
    up, y = frames[0, :3, 2], -frames[1, :3, 2]
    X_B0 = np.eye(4)
    X_B0[:3, :3] = np.column_stack([np.cross(y, up), y, up])
    # Frame 0's origin may be anywhere on the first axis: it is put at the height of B's.
    X_B0[:3, 3] = frames[0, :3, 3] - up * (up @ frames[0, :3, 3])
    p = (frames[:, :3, 3] - X_B0[:3, 3]) @ X_B0[:3, :3]
    a2, a3 = p[2, 0] - p[1, 0], p[3, 0] - p[2, 0]
    d1, d4, d5, d6 = p[1, 2], -p[4, 1], p[1, 2] - p[5, 2], p[4, 1] - p[6, 1]
    a2, a3, d1, d4, d5, d6 = (
        round(float(length), _LENGTH_DECIMALS) for length in (a2, a3, d1, d4, d5, d6)
    )
    alpha = (np.pi / 2, 0.0, 0.0, np.pi / 2, -np.pi / 2, 0.0)
    parameters = DenavitHartenberg((0.0, a2, a3, 0.0, 0.0, 0.0), (d1, 0.0, 0.0, d4, d5, d6), alpha)
    X_6F = np.linalg.inv(X_B0 @ forward_kinematics(np.zeros(6), parameters)) @ frames[6]
    q = np.random.default_rng(0).uniform(-np.pi, np.pi, (_NUM_SAMPLES, 6))
    closed = X_B0 @ forward_kinematics(q, parameters) @ X_6F
    error = np.abs(closed - chain.forward_kinematics(q)).max()
    usable = min(abs(a2), abs(a3), abs(d6)) > 1e-3
    return UrFit(
        parameters,
        _none_if_identity(X_B0),
        _none_if_identity(X_6F),
        float(error) if usable else np.inf,
    )


def _none_if_identity(X: Floats) -> Floats | None:
    return None if np.abs(X - np.eye(4)).max() < 10.0**-_LENGTH_DECIMALS * 10 else X
