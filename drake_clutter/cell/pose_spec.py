"""Rigid pose in a cell file."""

import math
from functools import lru_cache

import numpy as np
from pydrake.math import RigidTransform, RotationMatrix

from drake_clutter.validation import StrictModel, Vector3


class PoseSpec(StrictModel):
    """Pose X_AB of a frame B in a frame A.

    Attributes:
        translation: Position p_AB [m]. Shape (3,).
        rpy_deg: Roll, pitch and yaw angles of R_AB = Rz(yaw) Ry(pitch) Rx(roll) [deg]. Shape (3,).
    """

    translation: Vector3 = (0.0, 0.0, 0.0)
    rpy_deg: Vector3 = (0.0, 0.0, 0.0)

    @property
    def transform(self) -> RigidTransform:
        """X_AB; the rotation matrix is exact for multiples of 90 degrees."""
        return _transform(self)


@lru_cache(maxsize=256)
def _transform(pose: PoseSpec) -> RigidTransform:
    R = np.eye(3)
    for axis, angle in enumerate(pose.rpy_deg):
        c, s = math.cos(math.radians(angle)), math.sin(math.radians(angle))
        if angle % 90 == 0:
            c, s = float(round(c)), float(round(s))
        R_axis = np.eye(3)
        j = (axis + 1) % 3
        k = (axis + 2) % 3
        R_axis[[j, k], [j, k]] = c
        R_axis[j, k] = -s
        R_axis[k, j] = s
        R = R_axis @ R + 0.0  # -0.0 + 0.0 is 0.0
    return RigidTransform(RotationMatrix(R), pose.translation)
