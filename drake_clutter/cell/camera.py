"""A depth camera of the cell: where it stands, and the pinhole model of its images.

Frames: T the support's frame; C the camera, z along the optical axis, x to the right of the image, y down.
"""

import math
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform

from drake_clutter.cell.pose import PoseSpec
from drake_clutter.validation import Between, Flag, Model

Floats = NDArray[np.float64]


D435_FOV_Y_DEG = 42.5
"""Vertical field of view of the color stream of an Intel RealSense D435 [deg] (data sheet)."""
D435_FOCAL_LENGTH = 480 / 2 / math.tan(math.radians(D435_FOV_Y_DEG) / 2)
"""Its focal length at 640 x 480 [px]."""


class Camera(Model):
    """A pinhole camera at a pose.

    The defaults are the color stream of an Intel RealSense D435 at 640 x 480 (vertical field of view 42.5 deg, data sheet).

    Attributes:
        pose: X_TC.
        width: Columns of an image.
        height: Rows of an image.
        fov_y_deg: Vertical field of view [deg].
        visibility_threshold: An object is hidden when the camera sees less than this share of its unoccluded pixels.
        depth_noise: Whether what a trained detector is given has the noise of a stereo camera.
    """

    pose: PoseSpec
    width: Annotated[int, Between(16, 4096)] = 640
    height: Annotated[int, Between(16, 4096)] = 480
    fov_y_deg: Annotated[float, Between(1.0, 170.0)] = D435_FOV_Y_DEG
    visibility_threshold: Annotated[float, Between(0.0, 1.0)] = 0.30
    depth_noise: Flag = True

    @staticmethod
    def over(altitude: float, **fields: Any) -> "Camera":
        """Return a camera above the support's center that looks straight down, x along the support's x.

        Args:
            altitude: Height above the floor [m].
            **fields: Other fields.
        """
        return Camera(pose=PoseSpec(translation=(0.0, 0.0, altitude), rpy_deg=(180.0, 0.0, 0.0)), **fields)

    @property
    def X_TC(self) -> RigidTransform:
        """Pose of the camera."""
        return self.pose.transform

    @property
    def altitude(self) -> float:
        """Height above the support's floor [m]."""
        return float(self.pose.translation[2])

    @property
    def focal_length(self) -> float:
        """Focal length, the same along rows and columns [px]."""
        return self.height / 2 / math.tan(math.radians(self.fov_y_deg) / 2)

    @property
    def principal_point(self) -> tuple[float, float]:
        """Column and row on the optical axis; whole numbers are the middles of pixels.

        Drake's VTK engine draws half a pixel left of and above the principal point that it is given, (width - 1) / 2,
        (height - 1) / 2: measured in tests/test_camera.py.
        """
        return self.width / 2 - 1, self.height / 2 - 1

    def to_camera(self, p_T: Floats) -> Floats:
        """Return points given in T [m] in C [m]. Shapes (N, 3)."""
        X_CT = self.X_TC.inverse()
        return np.asarray(p_T @ X_CT.rotation().matrix().T + X_CT.translation())

    def project(self, p_T: Floats) -> Floats:
        """Return column and row of the pixels on which points fall. Shapes (N, 3) [m] to (N, 2) [px]."""
        p_C = self.to_camera(p_T)
        return np.asarray(self.focal_length * p_C[:, :2] / p_C[:, 2:] + np.array(self.principal_point))

    def backproject(self, pixels: Floats, depth: Floats) -> Floats:
        """Return the points at pixels and depths.

        Args:
            pixels: Column and row [px]. Shape (N, 2).
            depth: Along the optical axis [m]. Shape (N,).

        Returns:
            p_T [m]. Shape (N, 3).
        """
        p_C = self.rays(pixels) * np.asarray(depth, float)[:, None]
        return np.asarray(p_C @ self.X_TC.rotation().matrix().T + self.X_TC.translation())

    def rays(self, pixels: Floats) -> Floats:
        """Return directions in C through pixels (N, 2), with z = 1. Shape (N, 3)."""
        along = (np.asarray(pixels, float) - np.array(self.principal_point)) / self.focal_length
        return np.column_stack([along, np.ones(len(along))])
