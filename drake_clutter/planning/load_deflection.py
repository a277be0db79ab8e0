"""Displacement of a load at rest by the compliance of the tool that holds it.

Frames: T is the support, G is the tool in the rigid model, O is the object.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform

from drake_clutter.catalog import ObjectClass
from drake_clutter.cell.gripper import Gripper
from drake_clutter.planning.carry_clearance import box_corners

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class LoadDeflection:
    """How far a load at rest is from its pose in the rigid model.

    Attributes:
        displacement: Largest displacement of a corner of its bounding box [m].
        drop: Height by which its lowest corner is lower [m].
    """

    displacement: float
    drop: float

    @staticmethod
    def of(
        gripper: Gripper, tool: str, object_class: ObjectClass, X_GO: RigidTransform, X_TG: Floats
    ) -> "LoadDeflection":
        """Return the deflection of an object in a tool.

        Args:
            gripper: Gripper with the tool.
            tool: Name of the tool.
            object_class: Class of the object.
            X_GO: Pose of the object in the tool.
            X_TG: Pose of the tool. Shape (4, 4).
        """
        up_G = X_TG[2, :3]
        corners = X_GO.multiply(box_corners(object_class).T)
        p_GCm = X_GO @ object_class.center_of_mass
        X_GD = gripper.deflection(tool, object_class.mass, p_GCm, -up_G)
        deflected = X_GD.multiply(corners)
        displacement = float(np.linalg.norm(deflected - corners, axis=0).max())
        heights, deflected_heights = up_G @ corners, up_G @ deflected
        return LoadDeflection(displacement, float(heights.min() - deflected_heights.min()))
