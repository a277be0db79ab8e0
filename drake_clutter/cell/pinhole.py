"""Pinhole projection of `Camera` for compiled loops.

Frames: T is the support; C is the camera, z along the optical axis, x to the right of the image, y
down. If the axes of C are parallel to those of T, the rotation matrix has only entries 0, 1 and -1,
and all products with it are exact.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from drake_clutter.compilation import njit

Floats = NDArray[np.float64]

MIN_DEPTH = 0.01
"""Near clipping distance along the optical axis [m]."""
MAX_DEPTH = 10.0
"""Far clipping distance: rendered images have no depth beyond it [m]."""


class Pinhole(NamedTuple):
    """Pinhole camera as a tuple of numbers.

    Attributes:
        focal_length: Focal length [px].
        u0: Column of the principal point [px].
        v0: Row of the principal point [px].
        X_CT: Rows of the 3 x 4 matrix of rotation and translation [m]. Shape (12,). It is a tuple,
            because numba counts references of arrays in loops.
        p_TC: Position [m]. Shape (3,).
    """

    focal_length: float
    u0: float
    v0: float
    X_CT: tuple[float, ...]
    p_TC: tuple[float, float, float]


@njit(cache=True, nogil=True, inline="always")
def point_to_camera(camera, x, y, z):  # type: ignore[no-untyped-def]
    """Transform a point from T to C [m]."""
    X = camera.X_CT
    return (
        X[0] * x + X[1] * y + X[2] * z + X[3],
        X[4] * x + X[5] * y + X[6] * z + X[7],
        X[8] * x + X[9] * y + X[10] * z + X[11],
    )


@njit(cache=True, nogil=True, inline="always")
def vector_to_camera(camera, x, y, z):  # type: ignore[no-untyped-def]
    """Rotate a vector from T to C."""
    X = camera.X_CT
    return (
        X[0] * x + X[1] * y + X[2] * z,
        X[4] * x + X[5] * y + X[6] * z,
        X[8] * x + X[9] * y + X[10] * z,
    )


@njit(cache=True, nogil=True, inline="always")
def project(camera, x, y, z):  # type: ignore[no-untyped-def]
    """Project a point in C [m] and return its column and row [px]."""
    scale = camera.focal_length / z
    return camera.u0 + scale * x, camera.v0 + scale * y


@njit(cache=True, nogil=True, inline="always")
def backproject(camera, u, v, z):  # type: ignore[no-untyped-def]
    """Return the point in T [m] at a pixel [px] and a depth [m]."""
    X = camera.X_CT
    p = camera.p_TC
    x = (u - camera.u0) / camera.focal_length * z
    y = (v - camera.v0) / camera.focal_length * z
    return (
        X[0] * x + X[4] * y + X[8] * z + p[0],
        X[1] * x + X[5] * y + X[9] * z + p[1],
        X[2] * x + X[6] * y + X[10] * z + p[2],
    )


@njit(cache=True, nogil=True)
def pose_to_camera(camera, R, p):  # type: ignore[no-untyped-def]
    """Transform a pose R_TO (3, 3), p_TO (3,) [m] to R_CO (3, 3), p_CO (3,) [m]."""
    R_CO = np.empty((3, 3))
    for column in range(3):
        x, y, z = vector_to_camera(camera, R[0, column], R[1, column], R[2, column])
        R_CO[0, column], R_CO[1, column], R_CO[2, column] = x, y, z
    return R_CO, point_to_camera(camera, p[0], p[1], p[2])
