"""A depth camera of the cell: where it stands, and the pinhole model of its images.

Frames: T the support's frame; C the camera, z along the optical axis, x to the right of the image, y down.
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
from drake_clutter.validation import Flag, InRange, StrictModel

D435_FOV_Y_DEG = 42.5
"""Vertical field of view of the color stream of an Intel RealSense D435 [deg] (data sheet)."""
D435_FOCAL_LENGTH = 480 / 2 / math.tan(math.radians(D435_FOV_Y_DEG) / 2)
"""Its focal length at 640 x 480 [px]."""
_MIN_RAY_SLOPE = 1e-3
"""A ray that falls by less, for 1 m along the optical axis, is taken to be parallel to the floor [m]."""


def pixel_grid(shape: tuple[int, ...]) -> NDArray[np.int64]:
    """Return column and row of each pixel of an image.

    Args:
        shape: Of the image (height, width).

    Returns:
        Whole numbers [px]. Shape (height, width, 2).
    """
    row, column = np.indices(shape)
    return np.stack([column, row], axis=-1)


class Camera(StrictModel):
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
    width: Annotated[int, InRange(16, 4096)] = 640
    height: Annotated[int, InRange(16, 4096)] = 480
    fov_y_deg: Annotated[float, InRange(1.0, 170.0)] = D435_FOV_Y_DEG
    visibility_threshold: Annotated[float, InRange(0.0, 1.0)] = 0.30
    depth_noise: Flag = True

    @staticmethod
    def overhead(altitude: float, **fields: Any) -> "Camera":
        """Return a camera above the support's center that looks straight down, x along the support's x.

        Args:
            altitude: Height above the floor [m].
            **fields: Other fields.
        """
        return Camera(
            pose=PoseSpec(translation=(0.0, 0.0, altitude), rpy_deg=(180.0, 0.0, 0.0)), **fields
        )

    @property
    def X_TC(self) -> RigidTransform:
        """Pose of the camera."""
        return self.pose.transform

    @property
    def focal_length(self) -> float:
        """Focal length, the same along rows and columns [px]."""
        return self.height / 2 / math.tan(math.radians(self.fov_y_deg) / 2)

    @property
    def principal_point(self) -> tuple[float, float]:
        """Column and row on the optical axis; whole numbers are the middles of pixels.

        Drake's VTK engine draws half a pixel left of and above the principal point that it is given, (width - 1) / 2,
        (height - 1) / 2: measured in tests/test_camera_renderer.py.
        """
        return self.width / 2 - 1, self.height / 2 - 1

    @property
    def is_vertical(self) -> bool:
        """Whether the optical axis is."""
        return self.pinhole.X_CT[8:10] == (0.0, 0.0)

    @property
    def pinhole(self) -> Pinhole:
        """The same model for compiled loops."""
        return _pinhole(self)

    def to_camera(self, p_T: Floats) -> Floats:
        """Return points given in T [m] in C [m]. Shapes (N, 3)."""
        X_CT = _X_CT(self)
        return np.asarray(p_T @ X_CT[:, :3].T + X_CT[:, 3])

    def depth(self, p_T: Floats) -> Floats:
        """Return how far points (N, 3) [m] are along the optical axis [m]. Shape (N,)."""
        return self.to_camera(p_T)[:, 2]

    def project(self, p_T: Floats) -> Floats:
        """Return column and row of the pixels on which points fall. Shapes (N, 3) [m] to (N, 2) [px]."""
        return self.project_with_depth(p_T)[0]

    def project_with_depth(self, p_T: Floats) -> tuple[Floats, Floats]:
        """Return what `project` and `depth` do."""
        p_C = self.to_camera(p_T)
        return np.asarray(
            self.focal_length * p_C[:, :2] / p_C[:, 2:] + np.array(self.principal_point)
        ), p_C[:, 2]

    def backproject(self, pixels: NDArray[Any], depth: NDArray[Any]) -> NDArray[Any]:
        """Return the points at pixels and depths, in the images' type.

        Args:
            pixels: Column and row [px]. Shape (..., 2).
            depth: Along the optical axis [m]. Shape (...).

        Returns:
            p_T [m]. Shape (..., 3).
        """
        u0, v0 = self.principal_point
        x = (pixels[..., 0] - u0) * depth / self.focal_length
        y = (pixels[..., 1] - v0) * depth / self.focal_length
        R_TC, p_TC = self.X_TC.rotation().matrix().tolist(), self.X_TC.translation().tolist()
        return np.stack(
            [_rotate_component(row, (x, y, depth)) + p for row, p in zip(R_TC, p_TC, strict=True)],
            axis=-1,
        )

    def rays(self, pixels: NDArray[Any]) -> Floats:
        """Return directions in C through pixels (..., 2) [px], with z = 1. Shape (..., 3)."""
        along = (np.asarray(pixels, float) - np.array(self.principal_point)) / self.focal_length
        return np.concatenate([along, np.ones((*along.shape[:-1], 1))], axis=-1)

    @property
    def floor_depth(self) -> NDArray[np.float32]:
        """What the camera would see of the plane of the support's floor alone.

        Along the optical axis [m], infinite where the plane is not met; not to be written to.
        Shape (height, width).
        """
        return _floor_depth(self)

    def support_bounds(self, support: Support, height: float) -> tuple[Floats, float] | None:
        """Return where the support is in the image, with all that stands on it.

        Args:
            support: What the objects stand on; it is taken to be as wide as long.
            height: Of what stands on it [m].

        Returns:
            Column and row of the middle (2,) and side [px] of the upright square that holds it;
            None if a part of it is not before the camera.
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

    def sees_support(self, support: Support) -> bool:
        """Return whether any part of the support's floor is in the image, and near enough."""
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
    """Return the sum of components by a row of a rotation.

    What counts for nothing is left out, also where it is infinite.
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
    found = depth.astype(np.float32)
    found.setflags(write=False)
    return found
