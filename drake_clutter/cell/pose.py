"""A rigid pose as it stands in a cell's file."""

from functools import lru_cache

import numpy as np
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix

from drake_clutter.validation import Model, Vector3


class PoseSpec(Model):
    """A pose X_AB.

    Attributes:
        translation: p_AB [m]. Shape (3,).
        rpy_deg: Roll, pitch and yaw of R_AB = Rz(yaw) Ry(pitch) Rx(roll) [deg]. Shape (3,).
    """

    translation: Vector3 = (0.0, 0.0, 0.0)
    rpy_deg: Vector3 = (0.0, 0.0, 0.0)

    @property
    def transform(self) -> RigidTransform:
        """X_AB; multiples of 90 deg are exact."""
        return _transform(self)


@lru_cache(maxsize=256)
def _transform(pose: PoseSpec) -> RigidTransform:
    R = RollPitchYaw(np.radians(pose.rpy_deg)).ToRotationMatrix().matrix()
    if all(angle % 90 == 0 for angle in pose.rpy_deg):
        R = np.round(R) + 0.0
    return RigidTransform(RotationMatrix(R), pose.translation)
