"""Depth camera of a work cell: pose and pinhole model.

Frames: T is the support; C is the camera, z along the optical axis, x to the right of the image, y
down.
"""

import math
from collections.abc import Sequence
from functools import lru_cache
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform

from drake_clutter.cell.pinhole import MAX_DEPTH, MIN_DEPTH, Floats, Pinhole
from drake_clutter.cell.pose_spec import PoseSpec
from drake_clutter.cell.support import Support
from drake_clutter.limits import MAX_IMAGE_SIDE
from drake_clutter.validation import Flag, InRange, StrictModel

D435_FOV_Y_DEG = 42.5
"""Vertical field of view of the color stream of an Intel RealSense D435 [deg] (data sheet)."""
D435_FOCAL_LENGTH = 480 / 2 / math.tan(math.radians(D435_FOV_Y_DEG) / 2)
"""Focal length of the same stream at 640 x 480 [px]."""
_MIN_RAY_SLOPE = 1e-3
"""Slope of a ray towards the floor below which it counts as parallel to the floor."""


def pixel_grid(shape: tuple[int, ...]) -> NDArray[np.int64]:
    """Return column and row of each pixel of an image.

    Args:
        shape: Shape (height, width) of the image.

    Returns:
        Column and row [px]. Shape (height, width, 2).
    """
    row, column = np.indices(shape)
    return np.stack([column, row], axis=-1)


class Camera(StrictModel):
    """Pinhole depth camera.

    The defaults are the color stream of an Intel RealSense D435 at 640 x 480 pixels.

    Attributes:
        pose: Pose X_TC.
        width: Width of an image [px].
        height: Height of an image [px].
        fov_y_deg: Vertical field of view [deg].
        visibility_threshold: An object is hidden if less than this fraction of its unoccluded
            pixels is visible.
        depth_noise: Whether depth images for trained detectors have the noise of a stereo camera.
    """

    pose: PoseSpec
    width: Annotated[int, InRange(16, MAX_IMAGE_SIDE)] = 640
    height: Annotated[int, InRange(16, MAX_IMAGE_SIDE)] = 480
    fov_y_deg: Annotated[float, InRange(1.0, 170.0)] = D435_FOV_Y_DEG
    visibility_threshold: Annotated[float, InRange(0.0, 1.0)] = 0.30
    depth_noise: Flag = True

    @staticmethod
    def overhead(altitude: float, **fields: Any) -> "Camera":
        """Return a camera above the center of the support that looks straight down.

        Its x axis is parallel to that of the support.

        Args:
            altitude: Height above the floor [m].
            **fields: Other fields of the camera.
        """
        return Camera(
            pose=PoseSpec(translation=(0.0, 0.0, altitude), rpy_deg=(180.0, 0.0, 0.0)), **fields
        )

    @property
    def X_TC(self) -> RigidTransform:
        """Pose of the camera in T."""
        return self.pose.transform

    @property
    def focal_length(self) -> float:
        """Focal length along rows and columns [px]."""
        return self.height / 2 / math.tan(math.radians(self.fov_y_deg) / 2)

    @property
    def principal_point(self) -> tuple[float, float]:
        """Column and row of the principal point; integers are centers of pixels.

        Drake's VTK render engine draws half a pixel to the left of and above the principal point
        of its camera model, ((width - 1) / 2, (height - 1) / 2), see tests/test_camera_renderer.py.
        """
        return self.width / 2 - 1, self.height / 2 - 1

    @property
    def is_vertical(self) -> bool:
        """Whether the optical axis is vertical."""
        # Elements 8 and 9 of the 3 x 4 matrix are x and y of the optical axis in T.
        return self.pinhole.X_CT[8:10] == (0.0, 0.0)

    @property
    def pinhole(self) -> Pinhole:
        """Pinhole model for compiled loops."""
        return _pinhole(self)

    def to_camera(self, p_T: Floats) -> Floats:
        """Return points in C [m], shape (m, 3), for points in T [m], shape (m, 3)."""
        X_CT = _X_CT(self)
        return np.asarray(p_T @ X_CT[:, :3].T + X_CT[:, 3])

    def depth(self, p_T: Floats) -> Floats:
        """Return the depth [m], shape (m,), of points in T [m], shape (m, 3)."""
        return self.to_camera(p_T)[:, 2]

    def project(self, p_T: Floats) -> Floats:
        """Return the pixels, shape (m, 2) [px], of points in T, shape (m, 3) [m]."""
        return self.project_with_depth(p_T)[0]

    def project_with_depth(self, p_T: Floats) -> tuple[Floats, Floats]:
        """Return pixels and depth of points in T, see `project` and `depth`."""
        p_C = self.to_camera(p_T)
        pixels = self.focal_length * p_C[:, :2] / p_C[:, 2:] + np.array(self.principal_point)
        return np.asarray(pixels), p_C[:, 2]

    def backproject(self, pixels: NDArray[Any], depth: NDArray[Any]) -> NDArray[Any]:
        """Return the points in T at pixels with a depth.

        Args:
            pixels: Column and row [px]. Shape (..., 2).
            depth: Depth along the optical axis [m]. Shape (...).

        Returns:
            Points in T [m], with the data type of the images. Shape (..., 3).
        """
        u0, v0 = self.principal_point
        x = (pixels[..., 0] - u0) * depth / self.focal_length
        y = (pixels[..., 1] - v0) * depth / self.focal_length
        R_TC = self.X_TC.rotation().matrix().tolist()
        p_TC = self.X_TC.translation().tolist()
        return np.stack(
            [_rotate_component(row, (x, y, depth)) + p for row, p in zip(R_TC, p_TC, strict=True)],
            axis=-1,
        )

    def rays(self, pixels: NDArray[Any]) -> Floats:
        """Return directions in C with z = 1, shape (..., 3), through pixels (..., 2)."""
        slopes = (np.asarray(pixels, float) - np.array(self.principal_point)) / self.focal_length
        return np.concatenate([slopes, np.ones((*slopes.shape[:-1], 1))], axis=-1)

    @property
    def floor_depth(self) -> NDArray[np.float32]:
        """Depth image of the plane of the support's floor [m], read-only.

        It is infinite where rays do not meet the plane. Shape (height, width).
        """
        return _floor_depth(self)

    def support_bounds(self, support: Support, height: float) -> tuple[Floats, float] | None:
        """Return a square around the image of a support and of the space above it.

        Args:
            support: Support; a rectangular one is treated as the square of its larger side.
            height: Height of the space above the floor [m].

        Returns:
            Center (column, row), shape (2,), and side [px] of the square; None if a part of the
            space is not in front of the camera.
        """
        half = max(support.half_size)
        corners = np.array(
            [[x, y, z] for x in (-half, half) for y in (-half, half) for z in (0.0, height)]
        )
        if (self.depth(corners) < MIN_DEPTH).any():
            return None
        pixels = self.project(corners)
        low, high = pixels.min(axis=0), pixels.max(axis=0)
        return (low + high) / 2, float((high - low).max())

    def is_support_visible(self, support: Support) -> bool:
        """Return whether a part of the support's floor is in the image and within range."""
        x, y = (np.linspace(-half, half, 41) for half in support.half_size)
        p_T = np.stack([*np.meshgrid(x, y), np.zeros((len(y), len(x)))], axis=-1).reshape(-1, 3)
        depth = self.depth(p_T)
        p_T = p_T[(depth > MIN_DEPTH) & (depth < MAX_DEPTH)]
        if self.X_TC.translation()[2] <= 0 or not len(p_T):
            return False
        pixels = self.project(p_T)
        return bool(
            ((pixels >= -0.5) & (pixels < [self.width - 0.5, self.height - 0.5])).all(axis=1).any()
        )


def _rotate_component(row: Sequence[float], components: Sequence[NDArray[Any]]) -> NDArray[Any]:
    """Return the product of a row of a rotation matrix and vector components.

    Terms with a factor 0 are left out, so that infinite components do not become NaN.
    """
    terms = [
        factor * component for factor, component in zip(row, components, strict=True) if factor
    ]
    return np.asarray(sum(terms[1:], terms[0]))


@lru_cache(maxsize=64)
def _X_CT(camera: Camera) -> Floats:
    return np.asarray(camera.X_TC.inverse().GetAsMatrix34())


@lru_cache(maxsize=64)
def _pinhole(camera: Camera) -> Pinhole:
    x, y, z = camera.X_TC.translation().tolist()
    return Pinhole(
        camera.focal_length,
        *camera.principal_point,
        tuple(_X_CT(camera).ravel().tolist()),
        (x, y, z),
    )


@lru_cache(maxsize=16)
def _floor_depth(camera: Camera) -> NDArray[np.float32]:
    rays = camera.rays(pixel_grid((camera.height, camera.width)))
    down = rays @ camera.X_TC.rotation().matrix()[2]
    height = camera.X_TC.translation()[2]
    depth = np.full(down.shape, np.inf)
    np.divide(-height, down, out=depth, where=down * height < -_MIN_RAY_SLOPE * abs(height))
    image = depth.astype(np.float32)
    image.setflags(write=False)
    return image
