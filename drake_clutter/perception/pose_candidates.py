"""Poses that an object may have, from the planes and edges among the points that a depth image shows of it."""

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from drake_clutter.cell.pinhole import Floats, backproject
from drake_clutter.perception.pose_score import (
    COARSE_RAYS,
    DEPTH_TOLERANCE,
    SegmentView,
    pose_objective,
)

MIN_POINTS = 12
COARSE_DEPTH_TOLERANCE = 0.015
SCREENING_RAYS, MAX_SCREENED_CANDIDATES = 60, 10
"""By so few rays all candidates are told apart first; so many of them by `COARSE_RAYS`."""
PLANE_TOLERANCE = 0.004
RANSAC_ITERATIONS = 120
MIN_SECOND_PLANE_FRACTION = 0.1
MAX_DEPTH_BELOW_FLOOR = 0.05
"""m below the floor, where nothing is that was measured rightly."""
HORIZONTAL_PLANE_TOLERANCE = math.radians(4.0)
EXTENT_TOLERANCES = (0.012, 0.048)
"""m, by which points may reach past the face that they are said to lie on; the second where the first leaves nothing good."""


@njit(cache=True, nogil=True)
def _backproject_pixel(camera, u, v, z):  # type: ignore[no-untyped-def]
    """p_TP, m, of what is seen at a pixel at a depth, m; infinitely deep if nothing is measured."""
    if not 0.05 < z < np.inf:
        return np.inf, np.inf, -np.inf
    return backproject(camera, u, v, z)


@njit(cache=True, nogil=True)
def sample_segment_points(view, most):  # type: ignore[no-untyped-def]
    """The object's measured points (N, 3) m in T, at most so many, and those at its own edges, (M, 3)."""
    height, width = view.depth.shape
    camera = view.camera
    row, row_end, column, column_end = view.window
    total = 0
    for v in range(row, row_end):
        for u in range(column, column_end):
            if (
                view.mask[v, u]
                and _backproject_pixel(camera, u, v, view.depth[v, u])[2] > -MAX_DEPTH_BELOW_FLOOR
            ):
                total += 1
    every = max(1, (total + most - 1) // most)
    points, edges = np.empty((total // every + 1, 3)), np.empty((total + 1, 3))
    count, found, at_edge = 0, 0, 0
    for v in range(row, row_end):
        for u in range(column, column_end):
            z = view.depth[v, u]
            if not view.mask[v, u]:
                continue
            point = _backproject_pixel(camera, u, v, z)
            if not point[2] > -MAX_DEPTH_BELOW_FLOOR:
                continue
            if count % every == 0:
                points[found, 0], points[found, 1], points[found, 2] = point
                found += 1
            count += 1
            for dv, du in ((0, 1), (1, 0), (0, -1), (-1, 0)):
                j, i = v + dv, u + du
                beside = 0 <= j < height and 0 <= i < width
                if beside and not view.mask[j, i] and not view.depth[j, i] < z - DEPTH_TOLERANCE:
                    edges[at_edge, 0], edges[at_edge, 1], edges[at_edge, 2] = point
                    at_edge += 1
                    break
    return points[:found], edges[:at_edge]


@njit(cache=True, nogil=True)
def _ransac_plane(points):  # type: ignore[no-untyped-def]
    """Normal (3,) and a point (3,) m of that plane through three of the points (N, 3) which holds the most of them."""
    count, state = len(points), 12345
    best, normal, point = 0, np.array((0.0, 0.0, 1.0)), points[0].copy()
    picks = np.empty(3, np.int64)
    for _ in range(RANSAC_ITERATIONS):
        for i in range(3):
            state = (state * 1103515245 + 12345) % 2147483648
            picks[i] = (state >> 8) % count
        p, q, r = points[picks[0]], points[picks[1]], points[picks[2]]
        ax, ay, az, bx, by, bz = (
            q[0] - p[0],
            q[1] - p[1],
            q[2] - p[2],
            r[0] - p[0],
            r[1] - p[1],
            r[2] - p[2],
        )
        x, y, z = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
        length = math.sqrt(x * x + y * y + z * z)
        if length < 1e-6:
            continue
        x, y, z = x / length, y / length, z / length
        on = 0
        for k in range(count):
            on += (
                abs(
                    x * (points[k, 0] - p[0])
                    + y * (points[k, 1] - p[1])
                    + z * (points[k, 2] - p[2])
                )
                < PLANE_TOLERANCE
            )
        if on > best:
            best = on
            normal[0], normal[1], normal[2] = x, y, z
            point[:] = p
    return normal, point


@njit(cache=True, nogil=True)
def _plane_inliers(points, n, p):  # type: ignore[no-untyped-def]
    """Which of the points (N, 3) are on a plane, how many, their mean (3,), and their scatter (3, 3) about it."""
    member, mean, scatter = np.zeros(len(points), np.bool_), np.zeros(3), np.zeros((3, 3))
    total = 0
    for k in range(len(points)):
        q = points[k]
        if (
            abs((q[0] - p[0]) * n[0] + (q[1] - p[1]) * n[1] + (q[2] - p[2]) * n[2])
            < PLANE_TOLERANCE
        ):
            member[k] = True
            total += 1
            for i in range(3):
                mean[i] += q[i]
    for i in range(3):
        mean[i] /= max(total, 1)
    for k in range(len(points)):
        if member[k]:
            for i in range(3):
                for j in range(3):
                    scatter[i, j] += (points[k, i] - mean[i]) * (points[k, j] - mean[j])
    return member, total, mean, scatter


def _fit_plane(points: Floats, p_TC: Floats) -> tuple[Floats, Floats, NDArray[np.bool_]]:
    """Normal (3,) towards the camera, a point (3,) m, and the points (N,) bool on the plane that holds the most of them."""
    n, p = _ransac_plane(points)
    for _ in range(2):
        member, total, mean, scatter = _plane_inliers(points, n, p)
        if total < 3:
            break
        n, p = np.linalg.eigh(scatter)[1][:, 0].copy(), mean
    return (n if n @ p_TC >= n @ p else -n), p, member


@njit(cache=True)
def _trimmed_extent(points, p, axis):  # type: ignore[no-untyped-def]
    """Least and greatest m along an axis from p, without the outermost two in a hundred."""
    along = np.empty(len(points))
    for k in range(len(points)):
        along[k] = (
            (points[k, 0] - p[0]) * axis[0]
            + (points[k, 1] - p[1]) * axis[1]
            + (points[k, 2] - p[2]) * axis[2]
        )
    along.sort()
    cut = len(points) // 100
    return along[cut], along[len(points) - 1 - cut]


@njit(cache=True, nogil=True)
def _cross_product(a, b):  # type: ignore[no-untyped-def]
    """The cross product of two vectors (3,): NumPy's own is slow for so few."""
    return np.array(
        (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])
    )


@njit(cache=True, nogil=True)
def _plane_axes(n):  # type: ignore[no-untyped-def]
    """Two axes (3,) in the plane of a normal (3,), that make a right-handed frame with it."""
    x_axis = _cross_product(
        np.array((0.0, 1.0, 0.0)) if abs(n[1]) < 0.9 else np.array((1.0, 0.0, 0.0)), n
    )
    x_axis /= math.sqrt(x_axis[0] * x_axis[0] + x_axis[1] * x_axis[1] + x_axis[2] * x_axis[2])
    return x_axis, _cross_product(n, x_axis)


@njit(cache=True, nogil=True)
def _hough_edge_angle(x, y):  # type: ignore[no-untyped-def]
    """The angle, rad within a quarter turn, at which points x, y (N,) m fall on the fewest lines (a Hough transform)."""
    best, best_angle = -1.0, 0.0
    for k in range(60):
        angle = k * (math.pi / 120)
        lines = np.zeros((2, 256))
        c, s = math.cos(angle), math.sin(angle)
        for i in range(len(x)):
            lines[0, int((c * x[i] + s * y[i]) / 0.003 + 1152) % 256] += 1
            lines[1, int((c * y[i] - s * x[i]) / 0.003 + 1152) % 256] += 1
        value = (lines * lines).sum()
        if value > best:
            best, best_angle = value, angle
    return best_angle


@njit(cache=True, nogil=True)
def _min_area_rectangle_angle(x, y):  # type: ignore[no-untyped-def]
    """The angle, rad within a quarter turn, of the smallest rectangle about points x, y (N,) m."""
    best, best_angle = np.inf, 0.0
    for k in range(45):
        angle = k * (math.pi / 90)
        c, s = math.cos(angle), math.sin(angle)
        low, high, left, right = np.inf, -np.inf, np.inf, -np.inf
        for i in range(len(x)):
            along, across = c * x[i] + s * y[i], c * y[i] - s * x[i]
            low, high, left, right = (
                min(low, along),
                max(high, along),
                min(left, across),
                max(right, across),
            )
        if (high - low) * (right - left) < best:
            best, best_angle = (high - low) * (right - left), angle
    return best_angle


@njit(cache=True)
def _side_centers(low, high, size, guess, slack):  # type: ignore[no-untyped-def]
    """Where the middle of a side may be, m (n,), of which the points reach from low to high; none if they reach too far."""
    if high - low > size + slack:
        return np.empty(0)
    if high - low > size - EXTENT_TOLERANCES[0] / 2:
        return np.array([(low + high) / 2])
    return np.array(
        [low + size / 2, high - size / 2, min(max(guess, high - size / 2), low + size / 2)]
    )


@njit(cache=True, nogil=True)
def _add_face_candidates(half, axes, points, p, n, sides, guess, slack, R, p_TO, count):  # type: ignore[no-untyped-def]
    """Adds the poses with one of the axes along a plane's normal, its face on the plane's points, to R and p_TO; their number.

    `sides`: (k, 2, 3) directions in the plane that the face's sides may have, right-handed with the normal.
    """
    for k in range(len(sides)):
        first, second = sides[k, 0], sides[k, 1]
        low, high = _trimmed_extent(points, p, first)
        left, right = _trimmed_extent(points, p, second)
        for a in axes:
            for swapped in range(2):
                b, c = ((a + 1) % 3, (a + 2) % 3) if swapped == 0 else ((a + 2) % 3, (a + 1) % 3)
                off = guess - p
                for u in _side_centers(low, high, 2 * half[b], (off * first).sum(), slack):
                    for v in _side_centers(left, right, 2 * half[c], (off * second).sum(), slack):
                        if count == len(R):
                            return count
                        R[count, :, a], R[count, :, b], R[count, :, c] = (
                            n,
                            first,
                            second if swapped == 0 else -second,
                        )
                        p_TO[count] = p + u * first + v * second - half[a] * n
                        count += 1
    return count


@njit(cache=True, nogil=True)
def _add_lying_cylinder_candidates(half, points, axis, guess, slack, R, p_TO, count):  # type: ignore[no-untyped-def]
    """Adds the poses of a cylinder whose side is seen, its axis as given (3,), to R and p_TO; returns their number."""
    level = math.hypot(axis[0], axis[1])
    if level < 0.2:
        return count
    across = np.array([-axis[1] / level, axis[0] / level, 0.0])
    up = _cross_product(axis, across)
    low, high = _trimmed_extent(points, guess, axis)
    left, right = _trimmed_extent(points, guess, across)
    top = _trimmed_extent(points, guess, up)[1]
    along, to_the_side = (
        _side_centers(low, high, 2 * half[2], 0.0, slack),
        _side_centers(left, right, 2 * half[0], 0.0, slack)[-1:],
    )
    if slack > EXTENT_TOLERANCES[0]:  # a marker's mask may hold more of the tray than of it
        along, to_the_side = (
            along if len(along) else np.zeros(1),
            to_the_side if len(to_the_side) else np.zeros(1),
        )
    for u in along:
        for v in to_the_side:
            if count == len(R):
                return count
            R[count, :, 2], R[count, :, 0], R[count, :, 1] = axis, across, up
            p_TO[count] = guess + u * axis + v * across + (top - half[0]) * up
            count += 1
    return count


@njit(cache=True, nogil=True)
def _evaluate_candidates(cylinder, half, R, p_TO, view, rays):  # type: ignore[no-untyped-def]
    """(n,) values of poses."""
    value = np.empty(len(R))
    for k in range(len(R)):
        value[k] = pose_objective(cylinder, half, R[k], p_TO[k], view, rays, COARSE_DEPTH_TOLERANCE)
    return value


def generate_pose_candidates(
    cylinder: bool, half: Floats, points: Floats, edges: Floats, view: SegmentView, slack: float
) -> tuple[Floats, Floats, Floats]:
    """The most promising poses R (n, 3, 3), p (n, 3) m in the order of their values (n,), the best first.

    Not compiled, but made of what is: as one piece that takes the compiler 40 s.

    Args:
        cylinder: or a box. half: (3,) m, half its size.
        points, edges: see `spread_points`. view: where they are seen.
        slack: one of `SLACKS`.
    """
    R, p_TO, count = np.empty((160, 3, 3)), np.empty((160, 3)), 0
    guess, given = view.p_TO_guess, (slack, R, p_TO)
    p_TC = np.array(view.camera.p_TC)
    n, p, member = _fit_plane(points, p_TC)
    planes, rest = [(n, p, points[member])], points[~member]
    if len(rest) > max(MIN_POINTS, MIN_SECOND_PLANE_FRACTION * len(points)):
        second_n, second_p, second_member = _fit_plane(rest, p_TC)
        if abs(n @ second_n) < 0.2 and second_member.sum() > MIN_SECOND_PLANE_FRACTION * len(
            points
        ):
            planes.append((second_n, second_p, rest[second_member]))
    normals = [
        np.array([0.0, 0.0, 1.0]) if n[2] > math.cos(HORIZONTAL_PLANE_TOLERANCE) else n
        for n, _, _ in planes
    ]
    for n, (_, p, face) in zip(normals, planes, strict=True):
        x_axis, y_axis = _plane_axes(n)
        angles = [0.0]
        if not cylinder:
            beside = edges[np.abs((edges - p) @ n) < 2 * PLANE_TOLERANCE]
            angles = (
                [_hough_edge_angle((beside - p) @ x_axis, (beside - p) @ y_axis)]
                if len(beside) >= MIN_POINTS
                else []
            )
            angles.append(_min_area_rectangle_angle((face - p) @ x_axis, (face - p) @ y_axis))
            angles += [
                math.atan2(other @ y_axis, other @ x_axis) for other in normals if other is not n
            ]
        firsts = [math.cos(angle) * x_axis + math.sin(angle) * y_axis for angle in angles]
        sides = np.array([(first, _cross_product(n, first)) for first in firsts])
        count = _add_face_candidates(
            half,
            np.array([2]) if cylinder else np.arange(3),
            face,
            p,
            n,
            sides,
            guess,
            *given,
            count,
        )
    if cylinder:
        off, fewer = points - points.mean(axis=0), points[::2].copy()
        main = np.linalg.eigh(off.T @ off)[1][:, 2].copy()
        count = _add_lying_cylinder_candidates(half, fewer, main, guess, *given, count)
        azimuth = math.atan2(main[1], main[0])
        for tilt, parts in ((0.0, 12), (-0.5, 6), (0.5, 6)):
            for a in azimuth + np.arange(parts) * (math.pi / parts):
                axis = np.array(
                    [math.cos(tilt) * math.cos(a), math.cos(tilt) * math.sin(a), math.sin(tilt)]
                )
                count = _add_lying_cylinder_candidates(half, fewer, axis, guess, *given, count)
    rough = _evaluate_candidates(cylinder, half, R[:count], p_TO[:count], view, SCREENING_RAYS)
    best = np.argsort(-rough)[:MAX_SCREENED_CANDIDATES]
    value = _evaluate_candidates(cylinder, half, R[best], p_TO[best], view, COARSE_RAYS)
    order = np.argsort(-value)
    return R[best[order]], p_TO[best[order]], value[order]
