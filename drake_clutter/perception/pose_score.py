"""How well a pose of an object explains what a depth image shows, and the search for the pose that does best.

The camera's rays are cast at a box or a cylinder: where it is seen as it should be it gains, where the camera sees past it, and
where the mask shows what it does not cover, it loses; what stands before it counts neither way.
"""

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from drake_clutter.cell.pinhole import Floats, Pinhole, pose_to_camera, project

DEPTH_TOLERANCE = 0.006
"""m along the optical axis, within which what is seen agrees with a pose."""
CENTER_PRIOR_WEIGHT = 0.001
"""What a centre 1 cm away from the guess costs a score: little, it decides only what the image leaves open."""
FLOOR_PENALTY = 20.0
"""What 1 m below the floor costs a score: 5 cm, the whole of it."""
MAX_FLOOR_PENETRATION = 0.006
"""m, by which a pose may reach below the floor: as much as depth may be wrong."""
COARSE_RAYS, FINE_RAYS = 350, 1500
MIN_COARSE_STEP = 0.0015
"""m; a step that is at least so long is judged by few rays."""


class SegmentView(NamedTuple):
    """An object in the image.

    Attributes:
        depth: (height, width) float32 m.
        mask: (height, width) bool.
        window: first row, end row, first column, end column of the mask.
        p_TO_guess: (3,) m.
        camera: what it is seen by.
    """

    depth: NDArray[np.float32]
    mask: NDArray[np.bool_]
    window: tuple[int, int, int, int]
    p_TO_guess: Floats
    camera: Pinhole


@njit(cache=True, error_model="numpy")
def _box_distances(h, e, ray, step, first, stride, away):  # type: ignore[no-untyped-def]
    """See `distances_along`. Every choice is one between two numbers, so that the compiler does several rays at once."""
    for k in range(len(away)):
        u = first + k * stride
        x, y, z = ray[0] + step[0] * u, ray[1] + step[1] * u, ray[2] + step[2] * u
        # Never 0: a ray along a face is turned by a hair.
        ix = 1 / (x if abs(x) > 1e-12 else 1e-12)
        iy = 1 / (y if abs(y) > 1e-12 else 1e-12)
        iz = 1 / (z if abs(z) > 1e-12 else 1e-12)
        rx, ry, rz = h[0] * abs(ix), h[1] * abs(iy), h[2] * abs(iz)
        near, far = -e[0] * ix - rx, -e[0] * ix + rx
        near_y, far_y, near_z, far_z = (
            -e[1] * iy - ry,
            -e[1] * iy + ry,
            -e[2] * iz - rz,
            -e[2] * iz + rz,
        )
        near, far = near if near > near_y else near_y, far if far < far_y else far_y
        near, far = near if near > near_z else near_z, far if far < far_z else far_z
        away[k] = near if near <= far else np.inf


@njit(cache=True, error_model="numpy")
def _cylinder_distances(h, e, ray, step, first, stride, away):  # type: ignore[no-untyped-def]
    """Likewise."""
    c = e[0] * e[0] + e[1] * e[1] - h[0] * h[0]
    for k in range(len(away)):
        u = first + k * stride
        x, y, z = ray[0] + step[0] * u, ray[1] + step[1] * u, ray[2] + step[2] * u
        a, b = x * x + y * y, e[0] * x + e[1] * y
        a = a if a > 1e-20 else 1e-20
        square = b * b - a * c
        root, iz = math.sqrt(square if square > 0 else 0.0), 1 / (z if abs(z) > 1e-12 else 1e-12)
        rz = h[2] * abs(iz)
        near, far = (-b - root) / a, (-b + root) / a
        near_z, far_z = -e[2] * iz - rz, -e[2] * iz + rz
        near, far = near if near > near_z else near_z, far if far < far_z else far_z
        far = far if square >= 0 else -np.inf
        away[k] = near if near <= far else np.inf


@njit(cache=True)
def cast_ray_row(cylinder, h, e, ray, step, first, stride, away):  # type: ignore[no-untyped-def]
    """Fills away (n,) with distances, m along the optical axis, to a box or a cylinder of half sizes h; inf where it is missed.

    Ray k goes from the eye e along ray + (first + k stride) step, all three in O.
    """
    if cylinder:
        _cylinder_distances(h, e, ray, step, first, stride, away)
    else:
        _box_distances(h, e, ray, step, first, stride, away)


@njit(cache=True)
def camera_position_in_object(R, p):  # type: ignore[no-untyped-def]
    """Where the camera is in O, of a pose R_CO (3, 3), p_CO (3) m."""
    return (
        -R[0, 0] * p[0] - R[1, 0] * p[1] - R[2, 0] * p[2],
        -R[0, 1] * p[0] - R[1, 1] * p[1] - R[2, 1] * p[2],
        -R[0, 2] * p[0] - R[1, 2] * p[1] - R[2, 2] * p[2],
    )


@njit(cache=True, error_model="numpy")
def image_bounds(half, R, p, shape, camera):  # type: ignore[no-untyped-def]
    """First row, end row, first column, end column of the pixels that a box falls on; none if too close.

    Half its sizes are (3,) m, its pose is R_CO (3, 3) and p_CO (3) m.
    """
    height, width = shape
    top, bottom, left, right = height, 0, width, 0
    for corner in range(8):
        x = half[0] if corner & 1 else -half[0]
        y = half[1] if corner & 2 else -half[1]
        z = half[2] if corner & 4 else -half[2]
        away = p[2] + R[2, 0] * x + R[2, 1] * y + R[2, 2] * z
        if away < 0.05:
            return 0, 0, 0, 0
        right_of = p[0] + R[0, 0] * x + R[0, 1] * y + R[0, 2] * z
        below = p[1] + R[1, 0] * x + R[1, 1] * y + R[1, 2] * z
        u, v = project(camera, right_of, below, away)
        top, bottom = min(top, math.floor(v)), max(bottom, math.ceil(v) + 1)
        left, right = min(left, math.floor(u)), max(right, math.ceil(u) + 1)
    top, left = min(max(top, 0), height), min(max(left, 0), width)
    return top, max(top, min(bottom, height)), left, max(left, min(right, width))


@njit(cache=True)
def ray_row(R, v, camera):  # type: ignore[no-untyped-def]
    """In O, of a pose R_CO (3, 3): the ray in row v and column u0, and the step to the next column."""
    y, focal = (v - camera.v0) / camera.focal_length, camera.focal_length
    ray = (R[1, 0] * y + R[2, 0], R[1, 1] * y + R[2, 1], R[1, 2] * y + R[2, 2])
    return ray, (R[0, 0] / focal, R[0, 1] / focal, R[0, 2] / focal)


@njit(cache=True, nogil=True, error_model="numpy")
def pose_consistency(cylinder, half, R, p, view, rays, within):  # type: ignore[no-untyped-def]
    """0 to 1, how well a pose R (3, 3), p (3,) m explains what is seen, from about as many `rays` as are asked for."""
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
    speaks_for, against = 0.0, 0.0
    row_of_rays = np.empty((column_end - column) // stride + 2)
    for v in range(row - row % stride, row_end, stride):
        if v < row:
            continue
        ray, step = ray_row(R, v, camera)
        first = column - column % stride + (v // stride) % stride
        distances = row_of_rays[: max(0, (column_end - first + stride - 1) // stride)]
        cast_ray_row(cylinder, h, e, ray, step, first - camera.u0, stride, distances)
        for k in range(len(distances)):
            u, away = first + k * stride, distances[k]
            seen, ours = view.depth[v, u], view.mask[v, u]
            if away == np.inf:
                against += 1.0 if ours else 0.0
            elif not 0.05 < seen < 50.0:
                speaks_for += 0.5 if ours else 0.0
                against += 0.0 if ours else 0.5
            elif ours:
                off = min(abs(seen - away) / within, 1.0)
                speaks_for += 1.0 - off * off
                against += off * off
            elif seen > away - within:
                against += (
                    1.0 if seen > away + within else 0.5
                )  # masks are drawn too small rather than objects
    return speaks_for / (speaks_for + against) if speaks_for > 0 else 0.0


@njit(cache=True, nogil=True)
def pose_objective(cylinder, half, R, p, view, rays, within):  # type: ignore[no-untyped-def]
    """The score, less what the distance to the guess costs, and what reaching below the tray's floor does."""
    off = p - view.p_TO_guess
    if cylinder:
        lowest = (
            p[2] - half[2] * abs(R[2, 2]) - half[0] * math.sqrt(max(0.0, 1.0 - R[2, 2] * R[2, 2]))
        )
    else:
        lowest = p[2] - half[0] * abs(R[2, 0]) - half[1] * abs(R[2, 1]) - half[2] * abs(R[2, 2])
    cost = CENTER_PRIOR_WEIGHT * (off * off).sum() / 1e-4 + FLOOR_PENALTY * max(
        0.0, -lowest - MAX_FLOOR_PENETRATION
    )
    return pose_consistency(cylinder, half, R, p, view, rays, within) - cost


@njit(cache=True)
def rotate_about_axis(R, axis, angle):  # type: ignore[no-untyped-def]
    """R (3, 3) turned about a unit axis (3,) of T by an angle, rad."""
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
def refine_pose(cylinder, half, R, p, view, first_step, steps, resting):  # type: ignore[no-untyped-def]
    """Moves and turns a pose to a greater value, in steps that are halved; a resting one turns about the vertical only."""
    step, reach, rays, best = first_step, half.max(), 0, 0.0
    vertical = np.array([0.0, 0.0, 1.0])
    for _ in range(steps):
        if rays != FINE_RAYS:
            rays = FINE_RAYS if step < MIN_COARSE_STEP else COARSE_RAYS
            best = pose_objective(cylinder, half, R, p, view, rays, DEPTH_TOLERANCE)
        for _ in range(3):
            better = False
            for way in range(6):
                turn = way - 3
                if way >= 3 and (
                    (resting and turn != 2) or (cylinder and not resting and turn == 2)
                ):
                    continue
                if resting and cylinder and way == 5 and abs(R[2, 2]) > 0.999:
                    continue
                for sign in (1.0, -1.0):
                    new_R, new_p = R, p.copy()
                    if way < 3:
                        new_p[way] += sign * step
                    else:
                        axis = vertical if resting else R[:, turn].copy()
                        new_R = rotate_about_axis(R, axis, sign * step / reach)
                    value = pose_objective(
                        cylinder, half, new_R, new_p, view, rays, DEPTH_TOLERANCE
                    )
                    if value > best + 1e-6:
                        best, R, p, better = value, new_R, new_p, True
                        break
            if not better:
                break
        step /= 2
    return best, R, p
