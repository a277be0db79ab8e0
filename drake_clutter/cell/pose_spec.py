"""A rigid pose as it stands in a cell's file."""

import math
from functools import lru_cache

import numpy as np
from pydrake.math import RigidTransform, RotationMatrix

from drake_clutter.validation import StrictModel, Vector3


class PoseSpec(StrictModel):
    """A pose X_AB.

    Attributes:
        translation: p_AB [m]. Shape (3,).
        rpy_deg: Roll, pitch and yaw of R_AB = Rz(yaw) Ry(pitch) Rx(roll) [deg]. Shape (3,).
    """

    translation: Vector3 = (0.0, 0.0, 0.0)
    rpy_deg: Vector3 = (0.0, 0.0, 0.0)

    @property
    def transform(self) -> RigidTransform:
        """X_AB; angles that are multiples of 90 deg are exact."""
        return _transform(self)


@lru_cache(maxsize=256)
def _transform(pose: PoseSpec) -> RigidTransform:
    R = np.eye(3)
    for axis, angle in enumerate(pose.rpy_deg):
        c, s = math.cos(math.radians(angle)), math.sin(math.radians(angle))
        if angle % 90 == 0:
            c, s = float(round(c)), float(round(s))
        turn, (j, k) = np.eye(3), ((axis + 1) % 3, (axis + 2) % 3)
        turn[j, j], turn[j, k], turn[k, j], turn[k, k] = c, -s, s, c
        R = turn @ R + 0.0
    return RigidTransform(RotationMatrix(R), pose.translation)
