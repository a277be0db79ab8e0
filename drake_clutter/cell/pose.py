"""A rigid pose as it stands in a cell's file."""

from functools import cached_property

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

    @cached_property
    def transform(self) -> RigidTransform:
        """X_AB; multiples of 90 deg are exact."""
        R = RollPitchYaw(np.radians(self.rpy_deg)).ToRotationMatrix().matrix()
        if all(angle % 90 == 0 for angle in self.rpy_deg):
            R = np.round(R) + 0.0
        return RigidTransform(RotationMatrix(R), self.translation)
