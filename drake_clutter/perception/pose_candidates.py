"""Candidate poses of a box or cylinder from the planes and edges of its depth points."""

import math

import numpy as np
from numpy.typing import NDArray

from drake_clutter.cell.pinhole import Floats, backproject
from drake_clutter.compilation import njit
from drake_clutter.perception.pose_score import (
    COARSE_RAYS,
    DEPTH_TOLERANCE,
    SegmentView,
    pose_objective,
)

MIN_POINTS = 12
"""Smallest number of points of a segment from which candidates are made."""
COARSE_DEPTH_TOLERANCE = 0.015
"""Depth tolerance for ranking candidates, which are not refined yet [m]."""
SCREENING_RAYS = 60
"""Approximate number of rays by which all candidates are ranked first."""
MAX_SCREENED_CANDIDATES = 10
"""Number of the best candidates that are ranked again, by `COARSE_RAYS`."""
PLANE_TOLERANCE = 0.004
"""Largest distance of an inlier from its plane [m]."""
RANSAC_ITERATIONS = 120
"""Number of random planes that are compared."""
MIN_SECOND_PLANE_FRACTION = 0.1
"""Smallest fraction of the points on a second plane."""
MAX_DEPTH_BELOW_FLOOR = 0.05
"""Points farther below the tray's floor are measurement errors [m]."""
HORIZONTAL_PLANE_TOLERANCE = math.radians(4.0)
"""Planes with a smaller inclination count as horizontal [rad]."""
EXTENT_TOLERANCES = (0.012, 0.048)
"""By how much points may extend beyond the face that they lie on [m].

The second value is used if no candidate is good with the first one.
"""


@njit(cache=True, nogil=True)
def _backproject_pixel(camera, u, v, z):  # type: ignore[no-untyped-def]
    """Return the point p_TP of a pixel [m]; z = -inf if there is no measurement."""
    if not 0.05 < z < np.inf:
        return np.inf, np.inf, -np.inf
    return backproject(camera, u, v, z)


@njit(cache=True, nogil=True)
def sample_segment_points(view, max_points):  # type: ignore[no-untyped-def]
    """Sample the measured points of a segment, and of its outline.

    Args:
        view: The `SegmentView`.
        max_points: Approximate largest number of points.

    Returns:
        Points in the tray frame [m], shape (N, 3), and all points at edges of the object that are
        not edges of an occluder [m], shape (M, 3).
    """
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
    stride = max(1, (total + max_points - 1) // max_points)
    points, edge_points = np.empty((total // stride + 1, 3)), np.empty((total + 1, 3))
    count, num_points, num_edge_points = 0, 0, 0
    for v in range(row, row_end):
        for u in range(column, column_end):
            z = view.depth[v, u]
            if not view.mask[v, u]:
                continue
            point = _backproject_pixel(camera, u, v, z)
            if not point[2] > -MAX_DEPTH_BELOW_FLOOR:
                continue
            if count % stride == 0:
                points[num_points, 0] = point[0]
                points[num_points, 1] = point[1]
                points[num_points, 2] = point[2]
                num_points += 1
            count += 1
            for dv, du in ((0, 1), (1, 0), (0, -1), (-1, 0)):
                j, i = v + dv, u + du
                in_image = 0 <= j < height and 0 <= i < width
                if in_image and not view.mask[j, i] and not view.depth[j, i] < z - DEPTH_TOLERANCE:
                    edge_points[num_edge_points, 0] = point[0]
                    edge_points[num_edge_points, 1] = point[1]
                    edge_points[num_edge_points, 2] = point[2]
                    num_edge_points += 1
                    break
    return points[:num_points], edge_points[:num_edge_points]


@njit(cache=True, nogil=True)
def _ransac_plane(points):  # type: ignore[no-untyped-def]
    """Return the plane through three of the points that has the most inliers.

    The random numbers are those of a linear congruential generator with a constant seed.

    Args:
        points: Points [m]. Shape (N, 3).

    Returns:
        Unit normal, shape (3,), and a point of the plane [m], shape (3,).
    """
    count, state = len(points), 12345
    best, normal, point = 0, np.array((0.0, 0.0, 1.0)), points[0].copy()
    picks = np.empty(3, np.int64)
    for _ in range(RANSAC_ITERATIONS):
        for i in range(3):
            state = (state * 1103515245 + 12345) % 2147483648
            picks[i] = (state >> 8) % count
        p, q, r = points[picks[0]], points[picks[1]], points[picks[2]]
        ax, ay, az = q[0] - p[0], q[1] - p[1], q[2] - p[2]
        bx, by, bz = r[0] - p[0], r[1] - p[1], r[2] - p[2]
        x, y, z = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
        length = math.sqrt(x * x + y * y + z * z)
        if length < 1e-6:
            continue
        x, y, z = x / length, y / length, z / length
        num_inliers = 0
        for k in range(count):
            dx, dy, dz = points[k, 0] - p[0], points[k, 1] - p[1], points[k, 2] - p[2]
            num_inliers += abs(x * dx + y * dy + z * dz) < PLANE_TOLERANCE
        if num_inliers > best:
            best = num_inliers
            normal[0], normal[1], normal[2] = x, y, z
            point[:] = p
    return normal, point


@njit(cache=True, nogil=True)
def _plane_inliers(points, n, p):  # type: ignore[no-untyped-def]
    """Find the points on a plane.

    Args:
        points: Points [m]. Shape (N, 3).
        n: Unit normal. Shape (3,).
        p: A point of the plane [m]. Shape (3,).

    Returns:
        Whether each point is an inlier, shape (N,); the number of inliers; their mean [m], shape
        (3,); and their scatter matrix about the mean [m^2], shape (3, 3).
    """
    is_inlier, mean, scatter = np.zeros(len(points), np.bool_), np.zeros(3), np.zeros((3, 3))
    total = 0
    for k in range(len(points)):
        q = points[k]
        distance = (q[0] - p[0]) * n[0] + (q[1] - p[1]) * n[1] + (q[2] - p[2]) * n[2]
        if abs(distance) < PLANE_TOLERANCE:
            is_inlier[k] = True
            total += 1
            for i in range(3):
                mean[i] += q[i]
    for i in range(3):
        mean[i] /= max(total, 1)
    for k in range(len(points)):
        if is_inlier[k]:
            for i in range(3):
                for j in range(3):
                    scatter[i, j] += (points[k, i] - mean[i]) * (points[k, j] - mean[j])
    return is_inlier, total, mean, scatter


def _fit_plane(points: Floats, p_TC: Floats) -> tuple[Floats, Floats, NDArray[np.bool_]]:
    """Fit the plane with the most inliers.

    Args:
        points: Points [m]. Shape (N, 3).
        p_TC: Position of the camera [m]. Shape (3,).

    Returns:
        Unit normal towards the camera, shape (3,); a point of the plane [m], shape (3,); and
        whether each point is an inlier, shape (N,).
    """
    n, p = _ransac_plane(points)
    for _ in range(2):
        is_inlier, total, mean, scatter = _plane_inliers(points, n, p)
        if total < 3:
            break
        n, p = np.linalg.eigh(scatter)[1][:, 0].copy(), mean
    return (n if n @ p_TC >= n @ p else -n), p, is_inlier


@njit(cache=True)
def _trimmed_extent(points, p, axis):  # type: ignore[no-untyped-def]
    """Return the extent of points along an axis without the outermost 1 % on each side.

    Args:
        points: Points [m]. Shape (N, 3).
        p: Origin of the axis [m]. Shape (3,).
        axis: Unit vector. Shape (3,).

    Returns:
        Smallest and largest coordinate [m].
    """
    along = np.empty(len(points))
    for k in range(len(points)):
        along[k] = (
            (points[k, 0] - p[0]) * axis[0]
            + (points[k, 1] - p[1]) * axis[1]
            + (points[k, 2] - p[2]) * axis[2]
        )
    along.sort()
    num_trimmed = len(points) // 100
    return along[num_trimmed], along[len(points) - 1 - num_trimmed]


@njit(cache=True, nogil=True)
def _cross_product(a, b):  # type: ignore[no-untyped-def]
    """Return the cross product of two vectors; NumPy's own is slow for a single one."""
    return np.array(
        (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])
    )


@njit(cache=True, nogil=True)
def _plane_axes(n):  # type: ignore[no-untyped-def]
    """Return two unit vectors that form a right-handed frame with a plane's normal."""
    x_axis = _cross_product(
        np.array((0.0, 1.0, 0.0)) if abs(n[1]) < 0.9 else np.array((1.0, 0.0, 0.0)), n
    )
    x_axis /= math.sqrt(x_axis[0] * x_axis[0] + x_axis[1] * x_axis[1] + x_axis[2] * x_axis[2])
    return x_axis, _cross_product(n, x_axis)


@njit(cache=True, nogil=True)
def _hough_edge_angle(x, y):  # type: ignore[no-untyped-def]
    """Return the direction of a rectangle's edges by a Hough transform.

    Args:
        x: First coordinates of edge points in the plane [m]. Shape (N,).
        y: Second coordinates of edge points in the plane [m]. Shape (N,).

    Returns:
        Angle in [0, pi/2) at which the points concentrate on the fewest lines [rad].
    """
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
    """Return the direction of the smallest rectangle that contains points.

    Args:
        x: First coordinates of the points in the plane [m]. Shape (N,).
        y: Second coordinates of the points in the plane [m]. Shape (N,).

    Returns:
        Angle in [0, pi/2) [rad].
    """
    best, best_angle = np.inf, 0.0
    for k in range(45):
        angle = k * (math.pi / 90)
        c, s = math.cos(angle), math.sin(angle)
        low, high, left, right = np.inf, -np.inf, np.inf, -np.inf
        for i in range(len(x)):
            along, across = c * x[i] + s * y[i], c * y[i] - s * x[i]
            low, high = min(low, along), max(high, along)
            left, right = min(left, across), max(right, across)
        if (high - low) * (right - left) < best:
            best, best_angle = (high - low) * (right - left), angle
    return best_angle


@njit(cache=True)
def _side_centers(low, high, size, guess, tolerance):  # type: ignore[no-untyped-def]
    """Return where the center of an object's side may be along an axis.

    Args:
        low: Smallest coordinate of the side's points [m].
        high: Largest coordinate of the side's points [m].
        size: Length of the side [m].
        guess: Rough coordinate of the center [m].
        tolerance: By how much the points may extend beyond the side [m].

    Returns:
        Coordinates [m]: one if the whole side is visible; three if it is partly occluded (aligned
        with either end, and closest to the guess); none if the points extend too far. Shape (n,).
    """
    if high - low > size + tolerance:
        return np.empty(0)
    if high - low > size - EXTENT_TOLERANCES[0] / 2:
        return np.array([(low + high) / 2])
    return np.array(
        [low + size / 2, high - size / 2, min(max(guess, high - size / 2), low + size / 2)]
    )


@njit(cache=True, nogil=True)
def _add_face_candidates(  # type: ignore[no-untyped-def]
    half, axes, points, p, n, sides, guess, tolerance, R, p_TO, count
):
    """Add the poses at which a face of the object lies on a plane.

    Args:
        half: Half sizes of the object [m]. Shape (3,).
        axes: Indices of the object's axes that may be along the normal.
        points: Inliers of the plane [m]. Shape (N, 3).
        p: A point of the plane [m]. Shape (3,).
        n: Unit normal of the plane. Shape (3,).
        sides: Directions that the face's sides may have, right-handed with the normal. Shape
            (k, 2, 3).
        guess: Rough center of the object [m]. Shape (3,).
        tolerance: One of `EXTENT_TOLERANCES` [m].
        R: Output: orientations of the candidates. Shape (n, 3, 3).
        p_TO: Output: positions of the candidates [m]. Shape (n, 3).
        count: Number of candidates already in the outputs.

    Returns:
        New number of candidates.
    """
    for k in range(len(sides)):
        first, second = sides[k, 0], sides[k, 1]
        low, high = _trimmed_extent(points, p, first)
        left, right = _trimmed_extent(points, p, second)
        for a in axes:
            for swapped in range(2):
                b, c = ((a + 1) % 3, (a + 2) % 3) if swapped == 0 else ((a + 2) % 3, (a + 1) % 3)
                offset = guess - p
                for u in _side_centers(low, high, 2 * half[b], (offset * first).sum(), tolerance):
                    for v in _side_centers(
                        left, right, 2 * half[c], (offset * second).sum(), tolerance
                    ):
                        if count == len(R):
                            return count
                        R[count, :, a] = n
                        R[count, :, b] = first
                        R[count, :, c] = second if swapped == 0 else -second
                        p_TO[count] = p + u * first + v * second - half[a] * n
                        count += 1
    return count


@njit(cache=True, nogil=True)
def _add_lying_cylinder_candidates(  # type: ignore[no-untyped-def]
    half, points, axis, guess, tolerance, R, p_TO, count
):
    """Add the poses of a cylinder whose curved side is visible.

    Args:
        half: Half sizes of the cylinder [m]. Shape (3,).
        points: Points of the segment [m]. Shape (N, 3).
        axis: Unit vector along the cylinder's axis. Shape (3,).
        guess: Rough center of the cylinder [m]. Shape (3,).
        tolerance: One of `EXTENT_TOLERANCES` [m].
        R: Output: orientations of the candidates. Shape (n, 3, 3).
        p_TO: Output: positions of the candidates [m]. Shape (n, 3).
        count: Number of candidates already in the outputs.

    Returns:
        New number of candidates.
    """
    horizontal = math.hypot(axis[0], axis[1])
    if horizontal < 0.2:
        return count
    across = np.array([-axis[1] / horizontal, axis[0] / horizontal, 0.0])
    up = _cross_product(axis, across)
    low, high = _trimmed_extent(points, guess, axis)
    left, right = _trimmed_extent(points, guess, across)
    top = _trimmed_extent(points, guess, up)[1]
    axial_offsets = _side_centers(low, high, 2 * half[2], 0.0, tolerance)
    lateral_offsets = _side_centers(left, right, 2 * half[0], 0.0, tolerance)[-1:]
    if tolerance > EXTENT_TOLERANCES[0]:
        # The mask of a thin cylinder may hold more points of the tray than of the cylinder.
        axial_offsets = axial_offsets if len(axial_offsets) else np.zeros(1)
        lateral_offsets = lateral_offsets if len(lateral_offsets) else np.zeros(1)
    for u in axial_offsets:
        for v in lateral_offsets:
            if count == len(R):
                return count
            R[count, :, 2], R[count, :, 0], R[count, :, 1] = axis, across, up
            p_TO[count] = guess + u * axis + v * across + (top - half[0]) * up
            count += 1
    return count


@njit(cache=True, nogil=True)
def _evaluate_candidates(cylinder, half, R, p_TO, view, rays):  # type: ignore[no-untyped-def]
    """Return the objective of each candidate. Shape (n,)."""
    value = np.empty(len(R))
    for k in range(len(R)):
        value[k] = pose_objective(cylinder, half, R[k], p_TO[k], view, rays, COARSE_DEPTH_TOLERANCE)
    return value


def generate_pose_candidates(
    cylinder: bool,
    half: Floats,
    points: Floats,
    edge_points: Floats,
    view: SegmentView,
    tolerance: float,
) -> tuple[Floats, Floats, Floats]:
    """Return the most promising poses, best first.

    This function calls compiled ones but is not compiled itself, which would take 40 s.

    Args:
        cylinder: Whether the object is a cylinder, not a box.
        half: Half sizes of the object [m]. Shape (3,).
        points: Points of the segment, see `sample_segment_points` [m]. Shape (N, 3).
        edge_points: Points at the object's edges [m]. Shape (M, 3).
        view: The segment in the image.
        tolerance: One of `EXTENT_TOLERANCES` [m].

    Returns:
        Orientations R_TO, shape (n, 3, 3); positions p_TO [m], shape (n, 3); and values of the
        objective, shape (n,).
    """
    R, p_TO, count = np.empty((160, 3, 3)), np.empty((160, 3)), 0
    guess = view.p_TO_guess
    outputs = (tolerance, R, p_TO)
    p_TC = np.array(view.camera.p_TC)
    n, p, is_inlier = _fit_plane(points, p_TC)
    planes, rest = [(n, p, points[is_inlier])], points[~is_inlier]
    if len(rest) > max(MIN_POINTS, MIN_SECOND_PLANE_FRACTION * len(points)):
        second_n, second_p, second_inlier = _fit_plane(rest, p_TC)
        is_perpendicular = abs(n @ second_n) < 0.2
        if is_perpendicular and second_inlier.sum() > MIN_SECOND_PLANE_FRACTION * len(points):
            planes.append((second_n, second_p, rest[second_inlier]))
    normals = [
        np.array([0.0, 0.0, 1.0]) if n[2] > math.cos(HORIZONTAL_PLANE_TOLERANCE) else n
        for n, _, _ in planes
    ]
    for n, (_, p, face_points) in zip(normals, planes, strict=True):
        x_axis, y_axis = _plane_axes(n)
        angles = [0.0]
        if not cylinder:
            outline = edge_points[np.abs((edge_points - p) @ n) < 2 * PLANE_TOLERANCE]
            angles = []
            if len(outline) >= MIN_POINTS:
                angles.append(_hough_edge_angle((outline - p) @ x_axis, (outline - p) @ y_axis))
            face_x, face_y = (face_points - p) @ x_axis, (face_points - p) @ y_axis
            angles.append(_min_area_rectangle_angle(face_x, face_y))
            angles += [
                math.atan2(other @ y_axis, other @ x_axis) for other in normals if other is not n
            ]
        firsts = [math.cos(angle) * x_axis + math.sin(angle) * y_axis for angle in angles]
        sides = np.array([(first, _cross_product(n, first)) for first in firsts])
        axes = np.array([2]) if cylinder else np.arange(3)
        count = _add_face_candidates(half, axes, face_points, p, n, sides, guess, *outputs, count)
    if cylinder:
        centered, fewer = points - points.mean(axis=0), points[::2].copy()
        main = np.linalg.eigh(centered.T @ centered)[1][:, 2].copy()
        count = _add_lying_cylinder_candidates(half, fewer, main, guess, *outputs, count)
        azimuth = math.atan2(main[1], main[0])
        for tilt, num_azimuths in ((0.0, 12), (-0.5, 6), (0.5, 6)):
            for a in azimuth + np.arange(num_azimuths) * (math.pi / num_azimuths):
                axis = np.array(
                    [math.cos(tilt) * math.cos(a), math.cos(tilt) * math.sin(a), math.sin(tilt)]
                )
                count = _add_lying_cylinder_candidates(half, fewer, axis, guess, *outputs, count)
    rough = _evaluate_candidates(cylinder, half, R[:count], p_TO[:count], view, SCREENING_RAYS)
    best = np.argsort(-rough)[:MAX_SCREENED_CANDIDATES]
    value = _evaluate_candidates(cylinder, half, R[best], p_TO[best], view, COARSE_RAYS)
    order = np.argsort(-value)
    return R[best[order]], p_TO[best[order]], value[order]
