"""Render-and-compare score of an object pose, and the local search that improves it.

Camera rays are cast at a box or a cylinder. A pixel supports the pose if the measured depth is the
expected one. It contradicts the pose if the camera sees through the object, or if the pixel belongs
to the segment but the object does not cover it. Pixels with an occluder count neither way.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from drake_clutter.cell.pinhole import Floats, Pinhole, pose_to_camera, project
from drake_clutter.compilation import njit

DEPTH_TOLERANCE = 0.006
"""Depth difference at which a pixel stops to support a pose [m]; about twice the D435's noise."""
CENTER_PRIOR_WEIGHT = 0.001
"""Cost of a center 1 cm away from the guess. It decides only between poses of equal score."""
FLOOR_PENALTY = 20.0
"""Cost of a depth below the floor [1/m]; a depth of 5 cm costs as much as the best score."""
MAX_FLOOR_PENETRATION = 0.006
"""Depth below the floor that costs nothing [m], because measured depth may be wrong by as much."""
COARSE_RAYS = 350
"""Approximate number of rays for ranking candidates and for long steps of the search."""
FINE_RAYS = 1500
"""Approximate number of rays for short steps of the search and for the final score."""
MIN_COARSE_STEP = 0.0015
"""Shortest step of the search for which `COARSE_RAYS` are enough [m]."""


class SegmentView(NamedTuple):
    """One object's segment in a depth image.

    Attributes:
        depth: Measured depth [m]. Shape (H, W), float32.
        mask: Pixels of the segment. Shape (H, W).
        window: First row, end row, first column and end column of the segment.
        p_TO_guess: Rough position of the object's center [m]. Shape (3,).
        camera: Camera of the image.
    """

    depth: NDArray[np.float32]
    mask: NDArray[np.bool_]
    window: tuple[int, int, int, int]
    p_TO_guess: Floats
    camera: Pinhole


@njit(cache=True, error_model="numpy")
def _cast_rays_at_box(h, e, ray, step, first, stride, depths):  # type: ignore[no-untyped-def]
    """Cast a row of rays at a box; see `cast_ray_row`.

    Conditional expressions instead of branches let the compiler vectorize over rays.
    """
    for k in range(len(depths)):
        u = first + k * stride
        x, y, z = ray[0] + step[0] * u, ray[1] + step[1] * u, ray[2] + step[2] * u
        # No direction is exactly 0, so that a ray parallel to a face causes no division by zero.
        ix = 1 / (x if abs(x) > 1e-12 else 1e-12)
        iy = 1 / (y if abs(y) > 1e-12 else 1e-12)
        iz = 1 / (z if abs(z) > 1e-12 else 1e-12)
        rx, ry, rz = h[0] * abs(ix), h[1] * abs(iy), h[2] * abs(iz)
        near, far = -e[0] * ix - rx, -e[0] * ix + rx
        near_y, far_y = -e[1] * iy - ry, -e[1] * iy + ry
        near_z, far_z = -e[2] * iz - rz, -e[2] * iz + rz
        near, far = near if near > near_y else near_y, far if far < far_y else far_y
        near, far = near if near > near_z else near_z, far if far < far_z else far_z
        depths[k] = near if near <= far else np.inf


@njit(cache=True, error_model="numpy")
def _cast_rays_at_cylinder(h, e, ray, step, first, stride, depths):  # type: ignore[no-untyped-def]
    """Cast a row of rays at a cylinder; see `cast_ray_row` and `_cast_rays_at_box`."""
    c = e[0] * e[0] + e[1] * e[1] - h[0] * h[0]
    for k in range(len(depths)):
        u = first + k * stride
        x, y, z = ray[0] + step[0] * u, ray[1] + step[1] * u, ray[2] + step[2] * u
        a, b = x * x + y * y, e[0] * x + e[1] * y
        a = a if a > 1e-20 else 1e-20
        discriminant = b * b - a * c
        root = math.sqrt(discriminant if discriminant > 0 else 0.0)
        iz = 1 / (z if abs(z) > 1e-12 else 1e-12)
        rz = h[2] * abs(iz)
        near, far = (-b - root) / a, (-b + root) / a
        near_z, far_z = -e[2] * iz - rz, -e[2] * iz + rz
        near, far = near if near > near_z else near_z, far if far < far_z else far_z
        far = far if discriminant >= 0 else -np.inf
        depths[k] = near if near <= far else np.inf


@njit(cache=True)
def cast_ray_row(cylinder, h, e, ray, step, first, stride, depths):  # type: ignore[no-untyped-def]
    """Cast rays of one image row at a box or a cylinder.

    Ray k starts at the camera and has the direction ray + (first + k stride) step. All vectors are
    in the object's frame O.

    Args:
        cylinder: Whether the object is a cylinder, not a box.
        h: Half sizes of the object [m]. Shape (3,).
        e: Position of the camera, see `camera_position_in_object` [m]. Shape (3,).
        ray: Ray at the principal column, see `ray_row`. Shape (3,).
        step: Difference of the rays of neighboring columns, see `ray_row`. Shape (3,).
        first: Column of the first ray, relative to the principal column.
        stride: Distance between the columns of two rays.
        depths: Output: depth along the optical axis at which each ray enters the object [m]; inf
            where it misses. Shape (n,).
    """
    if cylinder:
        _cast_rays_at_cylinder(h, e, ray, step, first, stride, depths)
    else:
        _cast_rays_at_box(h, e, ray, step, first, stride, depths)


@njit(cache=True)
def camera_position_in_object(R, p):  # type: ignore[no-untyped-def]
    """Return the camera's position in the object's frame, p_OC [m].

    Args:
        R: R_CO. Shape (3, 3).
        p: p_CO [m]. Shape (3,).
    """
    return (
        -R[0, 0] * p[0] - R[1, 0] * p[1] - R[2, 0] * p[2],
        -R[0, 1] * p[0] - R[1, 1] * p[1] - R[2, 1] * p[2],
        -R[0, 2] * p[0] - R[1, 2] * p[1] - R[2, 2] * p[2],
    )


@njit(cache=True, error_model="numpy")
def image_bounds(half, R, p, shape, camera):  # type: ignore[no-untyped-def]
    """Return the bounds of a box in the image.

    Args:
        half: Half sizes of the box [m]. Shape (3,).
        R: R_CO. Shape (3, 3).
        p: p_CO [m]. Shape (3,).
        shape: Height and width of the image [px].
        camera: The `Pinhole`.

    Returns:
        First row, end row, first column and end column; all 0 if the box is too close to the
        camera.
    """
    height, width = shape
    top, bottom, left, right = height, 0, width, 0
    for corner in range(8):
        x = half[0] if corner & 1 else -half[0]
        y = half[1] if corner & 2 else -half[1]
        z = half[2] if corner & 4 else -half[2]
        z_C = p[2] + R[2, 0] * x + R[2, 1] * y + R[2, 2] * z
        if z_C < 0.05:
            return 0, 0, 0, 0
        x_C = p[0] + R[0, 0] * x + R[0, 1] * y + R[0, 2] * z
        y_C = p[1] + R[1, 0] * x + R[1, 1] * y + R[1, 2] * z
        u, v = project(camera, x_C, y_C, z_C)
        top, bottom = min(top, math.floor(v)), max(bottom, math.ceil(v) + 1)
        left, right = min(left, math.floor(u)), max(right, math.ceil(u) + 1)
    top, left = min(max(top, 0), height), min(max(left, 0), width)
    return top, max(top, min(bottom, height)), left, max(left, min(right, width))


@njit(cache=True)
def ray_row(R, v, camera):  # type: ignore[no-untyped-def]
    """Return the rays of an image row in the object's frame.

    Args:
        R: R_CO. Shape (3, 3).
        v: Row.
        camera: The `Pinhole`.

    Returns:
        Ray at the principal column, and the difference of the rays of neighboring columns. The
        rays have length 1 along the optical axis.
    """
    y = (v - camera.v0) / camera.focal_length
    focal_length = camera.focal_length
    ray = (R[1, 0] * y + R[2, 0], R[1, 1] * y + R[2, 1], R[1, 2] * y + R[2, 2])
    step = (R[0, 0] / focal_length, R[0, 1] / focal_length, R[0, 2] / focal_length)
    return ray, step


@njit(cache=True, nogil=True, error_model="numpy")
def pose_consistency(cylinder, half, R, p, view, rays, tolerance):  # type: ignore[no-untyped-def]
    """Return how consistent a pose is with a segment, from 0 to 1.

    Args:
        cylinder: Whether the object is a cylinder, not a box.
        half: Half sizes of the object [m]. Shape (3,).
        R: R_TO. Shape (3, 3).
        p: p_TO [m]. Shape (3,).
        view: The `SegmentView`.
        rays: Approximate number of rays to cast.
        tolerance: Depth difference at which a pixel stops to support the pose [m].

    Returns:
        Weight of the supporting pixels divided by that of the supporting and contradicting ones.
    """
    camera, window = view.camera, view.window
    R, p = pose_to_camera(camera, R, p)
    top, bottom, left, right = image_bounds(half, R, p, view.depth.shape, camera)
    if top == bottom or left == right:
        return 0.0
    row, row_end = min(window[0], top), max(window[1], bottom)
    column, column_end = min(window[2], left), max(window[3], right)
    stride = max(1, round(math.sqrt((window[1] - window[0]) * (window[3] - window[2]) / rays)))
    e = camera_position_in_object(R, p)
    h = (half[0], half[1], half[2])
    support, contradiction = 0.0, 0.0
    row_depths = np.empty((column_end - column) // stride + 2)
    for v in range(row - row % stride, row_end, stride):
        if v < row:
            continue
        ray, step = ray_row(R, v, camera)
        first = column - column % stride + (v // stride) % stride
        depths = row_depths[: max(0, (column_end - first + stride - 1) // stride)]
        cast_ray_row(cylinder, h, e, ray, step, first - camera.u0, stride, depths)
        for k in range(len(depths)):
            u, expected = first + k * stride, depths[k]
            measured, in_segment = view.depth[v, u], view.mask[v, u]
            if expected == np.inf:
                contradiction += 1.0 if in_segment else 0.0
            elif not 0.05 < measured < 50.0:
                support += 0.5 if in_segment else 0.0
                contradiction += 0.0 if in_segment else 0.5
            elif in_segment:
                error = min(abs(measured - expected) / tolerance, 1.0)
                support += 1.0 - error * error
                contradiction += error * error
            elif measured > expected - tolerance:
                # Masks are rather too small than objects too large, so agreeing depth outside of
                # the mask counts half.
                contradiction += 1.0 if measured > expected + tolerance else 0.5
    return support / (support + contradiction) if support > 0 else 0.0


@njit(cache=True, nogil=True)
def pose_objective(cylinder, half, R, p, view, rays, tolerance):  # type: ignore[no-untyped-def]
    """Return the objective of the pose search: consistency less two costs.

    The costs are for the distance from the guess and for reaching below the tray's floor.
    Arguments are those of `pose_consistency`.
    """
    offset = p - view.p_TO_guess
    if cylinder:
        tilt_sine = math.sqrt(max(0.0, 1.0 - R[2, 2] * R[2, 2]))
        lowest = p[2] - half[2] * abs(R[2, 2]) - half[0] * tilt_sine
    else:
        lowest = p[2] - half[0] * abs(R[2, 0]) - half[1] * abs(R[2, 1]) - half[2] * abs(R[2, 2])
    prior_cost = CENTER_PRIOR_WEIGHT * (offset * offset).sum() / 1e-4
    cost = prior_cost + FLOOR_PENALTY * max(0.0, -lowest - MAX_FLOOR_PENETRATION)
    return pose_consistency(cylinder, half, R, p, view, rays, tolerance) - cost


@njit(cache=True)
def rotate_about_axis(R, axis, angle):  # type: ignore[no-untyped-def]
    """Return a rotation matrix rotated about an axis (Rodrigues' formula).

    Args:
        R: R_TO. Shape (3, 3).
        axis: Unit vector in T. Shape (3,).
        angle: Angle [rad].
    """
    c, s = math.cos(angle), math.sin(angle)
    rotated = np.empty((3, 3))
    for i in range(3):
        column = R[:, i]
        along = axis[0] * column[0] + axis[1] * column[1] + axis[2] * column[2]
        for j in range(3):
            k, m = (j + 1) % 3, (j + 2) % 3
            rotated[j, i] = (
                c * column[j]
                + s * (axis[k] * column[m] - axis[m] * column[k])
                + (1 - c) * along * axis[j]
            )
    return rotated


@njit(cache=True, nogil=True)
def refine_pose(cylinder, half, R, p, view, first_step, num_steps, resting):  # type: ignore[no-untyped-def]
    """Improve a pose by pattern search with a step that is halved.

    Args:
        cylinder: Whether the object is a cylinder, not a box.
        half: Half sizes of the object [m]. Shape (3,).
        R: R_TO at the start. Shape (3, 3).
        p: p_TO at the start [m]. Shape (3,).
        view: The `SegmentView`.
        first_step: First step, of positions and of the object's surface by rotations [m].
        num_steps: Number of step sizes.
        resting: Whether rotations are about the vertical only.

    Returns:
        Objective, R_TO and p_TO of the best pose.
    """
    step, reach, rays, best = first_step, half.max(), 0, 0.0
    vertical = np.array([0.0, 0.0, 1.0])
    for _ in range(num_steps):
        if rays != FINE_RAYS:
            rays = FINE_RAYS if step < MIN_COARSE_STEP else COARSE_RAYS
            best = pose_objective(cylinder, half, R, p, view, rays, DEPTH_TOLERANCE)
        for _ in range(3):
            improved = False
            # Coordinates 0 to 2 are translations along T's axes, 3 to 5 rotations about O's axes.
            for coordinate in range(6):
                rotation_axis = coordinate - 3
                if coordinate >= 3 and (
                    (resting and rotation_axis != 2)
                    or (cylinder and not resting and rotation_axis == 2)
                ):
                    continue
                if resting and cylinder and coordinate == 5 and abs(R[2, 2]) > 0.999:
                    continue
                for sign in (1.0, -1.0):
                    new_R, new_p = R, p.copy()
                    if coordinate < 3:
                        new_p[coordinate] += sign * step
                    else:
                        axis = vertical if resting else R[:, rotation_axis].copy()
                        new_R = rotate_about_axis(R, axis, sign * step / reach)
                    value = pose_objective(
                        cylinder, half, new_R, new_p, view, rays, DEPTH_TOLERANCE
                    )
                    if value > best + 1e-6:
                        best, R, p, improved = value, new_R, new_p, True
                        break
            if not improved:
                break
        step /= 2
    return best, R, p
