"""The projection of `Camera` for compiled loops.

With a camera whose axes are parallel to those of T all rotations are exact, so that every sum is
rounded as if it were written for that camera alone.
"""

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

Floats = NDArray[np.float64]

MIN_DEPTH = 0.01
"""What is not so far before the camera is out of its sight [m]."""
MAX_DEPTH = 10.0
"""What is farther has no depth in a rendered image [m]."""


class Pinhole(NamedTuple):
    """What compiled loops need of a camera.

    Attributes:
        focal_length: Focal length [px].
        u0: Column on the optical axis [px].
        v0: Row on the optical axis [px].
        X_CT: The three rows of rotation matrix and translation [m]. Shape (12,); a tuple, as each
            use of an array in a loop costs counting its references.
        p_TC: Position [m].
    """

    focal_length: float
    u0: float
    v0: float
    X_CT: tuple[float, ...]
    p_TC: tuple[float, float, float]


@njit(cache=True, nogil=True, inline="always")
def point_to_camera(camera, x, y, z):  # type: ignore[no-untyped-def]
    """Return a point of T [m] in C [m]."""
    X = camera.X_CT
    return (
        X[0] * x + X[1] * y + X[2] * z + X[3],
        X[4] * x + X[5] * y + X[6] * z + X[7],
        X[8] * x + X[9] * y + X[10] * z + X[11],
    )


@njit(cache=True, nogil=True, inline="always")
def vector_to_camera(camera, x, y, z):  # type: ignore[no-untyped-def]
    """Return a vector of T in C."""
    X = camera.X_CT
    return (
        X[0] * x + X[1] * y + X[2] * z,
        X[4] * x + X[5] * y + X[6] * z,
        X[8] * x + X[9] * y + X[10] * z,
    )


@njit(cache=True, nogil=True, inline="always")
def project(camera, x, y, z):  # type: ignore[no-untyped-def]
    """Return column and row [px] of the pixel on which a point of C [m] falls."""
    scale = camera.focal_length / z
    return camera.u0 + scale * x, camera.v0 + scale * y


@njit(cache=True, nogil=True, inline="always")
def backproject(camera, u, v, z):  # type: ignore[no-untyped-def]
    """Return the point of T [m] at a pixel [px] and a depth [m]."""
    X, p = camera.X_CT, camera.p_TC
    x, y = (u - camera.u0) / camera.focal_length * z, (v - camera.v0) / camera.focal_length * z
    return (
        X[0] * x + X[4] * y + X[8] * z + p[0],
        X[1] * x + X[5] * y + X[9] * z + p[1],
        X[2] * x + X[6] * y + X[10] * z + p[2],
    )


@njit(cache=True, nogil=True)
def pose_to_camera(camera, R, p):  # type: ignore[no-untyped-def]
    """Return R_CO (3, 3) and p_CO [m] of a pose R_TO (3, 3), p_TO (3,) [m]."""
    R_CO = np.empty((3, 3))
    for column in range(3):
        x, y, z = vector_to_camera(camera, R[0, column], R[1, column], R[2, column])
        R_CO[0, column], R_CO[1, column], R_CO[2, column] = x, y, z
    return R_CO, point_to_camera(camera, p[0], p[1], p[2])
