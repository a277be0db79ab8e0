"""Distances between convex shapes along a path of a serial arm, compiled.

Source: Gilbert, Johnson and Keerthi 1988, "A fast procedure for computing the distance between
complex objects in three-dimensional space" (GJK). A shape is a convex core with a radius around it,
so that distances of capsules and spheres are exact also where they penetrate.
"""

from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from drake_clutter.compilation import njit
from drake_clutter.robots.serial_chain import chain_frames

Floats = NDArray[np.float64]


class CoreKind(IntEnum):
    """Kinds of convex cores; the first three are centered at the origin of their frame.

    Attributes:
        SEGMENT: Segment along z, of a capsule or, without length, of a sphere.
        CYLINDER: Cylinder along z.
        BOX: Box along the axes.
        VERTICES: Convex hull of points.
        OTHER: Shape without a core here: its distances are not computed.
    """

    SEGMENT = 0
    CYLINDER = 1
    BOX = 2
    VERTICES = 3
    OTHER = 4


_CYLINDER, _BOX, _VERTICES, _OTHER = map(
    int, (CoreKind.CYLINDER, CoreKind.BOX, CoreKind.VERTICES, CoreKind.OTHER)
)
_MAX_ITERATIONS = 100
"""Largest number of GJK iterations; polyhedra need about five, cylinders about twenty."""
_TOLERANCE = 1e-7
"""Difference between upper and lower bound of a distance at convergence [m]."""
_INTERSECTING = 1e-9
"""Distance of cores below which they count as intersecting [m]."""


@njit(cache=True, nogil=True)
def _add_support(kind, size, vertices, X, sign, d, out):  # type: ignore[no-untyped-def]
    """Write the point of a core that is farthest along sign d to out; all in the world."""
    x = sign * (X[0, 0] * d[0] + X[1, 0] * d[1] + X[2, 0] * d[2])
    y = sign * (X[0, 1] * d[0] + X[1, 1] * d[1] + X[2, 1] * d[2])
    z = sign * (X[0, 2] * d[0] + X[1, 2] * d[1] + X[2, 2] * d[2])
    if kind == _VERTICES:
        best, largest = 0, -np.inf
        for k in range(len(vertices)):
            along = vertices[k, 0] * x + vertices[k, 1] * y + vertices[k, 2] * z
            if along > largest:
                best, largest = k, along
        px, py, pz = vertices[best, 0], vertices[best, 1], vertices[best, 2]
    else:
        px = py = 0.0
        pz = size[2] if z >= 0 else -size[2]
        if kind == _BOX:
            px = size[0] if x >= 0 else -size[0]
            py = size[1] if y >= 0 else -size[1]
        elif kind == _CYLINDER:
            length = np.sqrt(x * x + y * y)
            if length > 1e-12:
                px, py = size[0] * x / length, size[0] * y / length
    for i in range(3):
        out[i] = X[i, 0] * px + X[i, 1] * py + X[i, 2] * pz + X[i, 3]


@njit(cache=True, nogil=True)
def _dot(a, b):  # type: ignore[no-untyped-def]
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@njit(cache=True, nogil=True)
def _closest_weights(y, n, weights, trial, gram):  # type: ignore[no-untyped-def]
    """Write the weights of the point of a simplex y (n, 3) that is closest to the origin.

    All faces are tried: the closest point of the simplex is that of the nearest face whose own
    closest point, that of its affine hull, is inside. Returns the squared distance.
    """
    for i in range(n):
        for j in range(i + 1):
            gram[i, j] = gram[j, i] = _dot(y[i], y[j])
    nearest = np.inf
    for subset in range(1, 1 << n):
        for i in range(4):
            trial[i] = 0.0
        a = b = c = d = -1
        for i in range(n):
            if subset & (1 << i):
                if a < 0:
                    a = i
                elif b < 0:
                    b = i
                elif c < 0:
                    c = i
                else:
                    d = i
        if b < 0:
            trial[a] = 1.0
        elif c < 0:
            length = gram[a, a] - 2 * gram[a, b] + gram[b, b]
            if length < 1e-24:
                continue
            t = (gram[a, a] - gram[a, b]) / length
            if t <= 0 or t >= 1:
                continue
            trial[a], trial[b] = 1 - t, t
        elif d < 0:
            g11 = gram[b, b] - 2 * gram[a, b] + gram[a, a]
            g12 = gram[b, c] - gram[a, b] - gram[a, c] + gram[a, a]
            g22 = gram[c, c] - 2 * gram[a, c] + gram[a, a]
            r1 = gram[a, a] - gram[a, b]
            r2 = gram[a, a] - gram[a, c]
            determinant = g11 * g22 - g12 * g12
            if determinant <= 1e-14 * g11 * g22:
                continue
            t1 = (r1 * g22 - r2 * g12) / determinant
            t2 = (r2 * g11 - r1 * g12) / determinant
            if t1 <= 0 or t2 <= 0 or t1 + t2 >= 1:
                continue
            trial[a], trial[b], trial[c] = 1 - t1 - t2, t1, t2
        else:
            # The origin is inside if each vertex and the origin are on one side of the other face.
            inside = True
            for i in range(4):
                p, q, r = y[(i + 1) % 4], y[(i + 2) % 4], y[(i + 3) % 4]
                nx = (q[1] - p[1]) * (r[2] - p[2]) - (q[2] - p[2]) * (r[1] - p[1])
                ny = (q[2] - p[2]) * (r[0] - p[0]) - (q[0] - p[0]) * (r[2] - p[2])
                nz = (q[0] - p[0]) * (r[1] - p[1]) - (q[1] - p[1]) * (r[0] - p[0])
                of_origin = -(nx * p[0] + ny * p[1] + nz * p[2])
                of_vertex = nx * y[i, 0] + ny * y[i, 1] + nz * y[i, 2] + of_origin
                if of_origin * of_vertex <= 0:
                    inside = False
            if inside:
                return 0.0
            continue
        squared = 0.0
        for x in range(3):
            along = 0.0
            for i in range(n):
                along += trial[i] * y[i, x]
            squared += along * along
        if squared < nearest:
            nearest = squared
            for i in range(4):
                weights[i] = trial[i]
    return nearest


@njit(cache=True, nogil=True)
def _core_distance(  # type: ignore[no-untyped-def]
    kind_A, size_A, vertices_A, X_A, kind_B, size_B, vertices_B, X_B, max_distance, p_A, p_B
):
    """Return the distance of two cores, and write their closest points to p_A and p_B.

    Returns:
        The distance; infinite above `max_distance`, and 0 if the cores intersect.
    """
    a, b, y = np.empty((4, 3)), np.empty((4, 3)), np.empty((4, 3))
    weights, trial, gram = np.empty(4), np.empty(4), np.empty((4, 4))
    v = X_A[:, 3] - X_B[:, 3]
    if _dot(v, v) == 0:
        v[0] = 1.0
    n = 0
    squared = np.inf
    for _ in range(_MAX_ITERATIONS):
        _add_support(kind_A, size_A, vertices_A, X_A, -1.0, v, a[n])
        _add_support(kind_B, size_B, vertices_B, X_B, 1.0, v, b[n])
        for i in range(3):
            y[n, i] = a[n, i] - b[n, i]
        length = np.sqrt(_dot(v, v))
        lower = _dot(v, y[n]) / length
        if lower > max_distance:
            return np.inf
        if length - lower < _TOLERANCE and n:
            break
        n += 1
        new_squared = _closest_weights(y, n, weights, trial, gram)
        if new_squared <= _INTERSECTING**2:
            return 0.0
        if new_squared >= squared:
            # No progress within rounding: the weights of the previous simplex are restored.
            _closest_weights(y, n - 1, weights, trial, gram)
            n -= 1
            break
        squared = new_squared
        kept = 0
        for i in range(n):
            if weights[i] > 0:
                for x in range(3):
                    a[kept, x], b[kept, x], y[kept, x] = a[i, x], b[i, x], y[i, x]
                weights[kept] = weights[i]
                kept += 1
        n = kept
        for x in range(3):
            v[x] = 0.0
            for i in range(n):
                v[x] += weights[i] * y[i, x]
    for x in range(3):
        p_A[x] = p_B[x] = 0.0
        for i in range(n):
            p_A[x] += weights[i] * a[i, x]
            p_B[x] += weights[i] * b[i, x]
    return np.sqrt(squared)


@njit(cache=True, nogil=True)
def _is_far(center, radius, kind, size, X, other_center, other_radius, distance):  # type: ignore[no-untyped-def]
    """Return whether a bounding sphere is farther than a distance from another shape.

    The other shape is a box, or else represented by its bounding sphere.
    """
    squared = 0.0
    if kind == _BOX:
        for i in range(3):
            along = 0.0
            for x in range(3):
                along += X[x, i] * (center[x] - X[x, 3])
            outside = max(abs(along) - size[i], 0.0)
            squared += outside * outside
        limit = radius + distance
    else:
        for x in range(3):
            squared += (center[x] - other_center[x]) ** 2
        limit = radius + other_radius + distance
    return squared > limit * limit


@njit(cache=True, nogil=True)
def path_distances(  # type: ignore[no-untyped-def]
    fixed,
    revolute,
    q,
    depths,
    X_JS,
    kinds,
    sizes,
    radii,
    centers,
    bounds,
    vertices,
    starts,
    pairs,
    max_distance,
    X_TS,
    indices,
    found,
    distances,
    gradients,
):
    """Write the distances below a threshold along a path.

    Args:
        fixed: Fixed transforms of the chain, from the support T to the flange. Shape (n + 1, 4, 4).
        revolute: Whether joints rotate. Shape (n,).
        q: Joint positions. Shape (m, n).
        depths: Number of joints that move each shape. Shape (k,).
        X_JS: Poses of moving shapes in the frames of their last joints. Shape (k, 4, 4).
        kinds: `CoreKind` of each shape. Shape (k,).
        sizes: Radius or half sizes, and half length along z, of the cores [m]. Shape (k, 3).
        radii: Radii around the cores [m]. Shape (k,).
        centers: Centers of bounding spheres in the frames of the shapes [m]. Shape (k, 3).
        bounds: Radii of the bounding spheres [m]. Shape (k,).
        vertices: Vertices of all cores of vertices [m]. Shape (l, 3).
        starts: Index of the first vertex of each shape, and the number of all. Shape (k + 1,).
        pairs: Indices of two shapes. Shape (p, 2).
        max_distance: Threshold [m].
        X_TS: Poses of the shapes; those of moving ones are overwritten. Shape (k, 4, 4).
        indices: Receives the row of q of each distance. Shape (m p,).
        found: Receives the row of the pair of each distance. Shape (m p,).
        distances: Receives the distances [m]; NaN if the cores intersect or a shape has no core.
            Shape (m p,).
        gradients: Receives the derivatives by q [m/rad]; not computed without rows. Shape (m p, n).

    Returns:
        Number of distances.
    """
    n = len(revolute)
    frames = np.empty((n + 1, 4, 4))
    moved = np.empty((n, 3, 4))
    world = np.empty((len(depths), 3))
    p_A, p_B = np.empty(3), np.empty(3)
    count = 0
    for k in range(len(depths)):
        for i in range(3):
            world[k, i] = X_TS[k, i, 3]
            for x in range(3):
                world[k, i] += X_TS[k, i, x] * centers[k, x]
    for row in range(len(q)):
        chain_frames(fixed, revolute, q[row], frames, moved)
        for k in range(len(depths)):
            if depths[k] == 0:
                continue
            M = moved[depths[k] - 1]
            for i in range(3):
                for x in range(4):
                    X_TS[k, i, x] = (
                        M[i, 0] * X_JS[k, 0, x] + M[i, 1] * X_JS[k, 1, x] + M[i, 2] * X_JS[k, 2, x]
                    )
                X_TS[k, i, 3] += M[i, 3]
                world[k, i] = X_TS[k, i, 3]
                for x in range(3):
                    world[k, i] += X_TS[k, i, x] * centers[k, x]
        for pair in range(len(pairs)):
            A, B = pairs[pair, 0], pairs[pair, 1]
            if _is_far(
                world[A], bounds[A], kinds[B], sizes[B], X_TS[B], world[B], bounds[B], max_distance
            ) or _is_far(
                world[B], bounds[B], kinds[A], sizes[A], X_TS[A], world[A], bounds[A], max_distance
            ):
                continue
            distance = 0.0
            if kinds[A] != _OTHER and kinds[B] != _OTHER:
                distance = _core_distance(
                    kinds[A],
                    sizes[A],
                    vertices[starts[A] : starts[A + 1]],
                    X_TS[A, :3],
                    kinds[B],
                    sizes[B],
                    vertices[starts[B] : starts[B + 1]],
                    X_TS[B, :3],
                    max_distance + radii[A] + radii[B],
                    p_A,
                    p_B,
                )
            if distance == np.inf or distance - radii[A] - radii[B] > max_distance:
                continue
            indices[count] = row
            found[count] = pair
            distances[count] = distance - radii[A] - radii[B] if distance > 0 else np.nan
            if len(gradients) and distance > 0:
                for j in range(n):
                    gradients[count, j] = 0.0
                for x in range(3):
                    p_A[x] -= p_B[x]  # from B to A
                for j in range(n):
                    on_A, on_B = j < depths[A], j < depths[B]
                    if on_A == on_B:
                        continue
                    ax, ay, az = frames[j, 0, 2], frames[j, 1, 2], frames[j, 2, 2]
                    if revolute[j]:
                        # The moment of the normal about the axis is the same at both points.
                        rx = p_B[0] - frames[j, 0, 3]
                        ry = p_B[1] - frames[j, 1, 3]
                        rz = p_B[2] - frames[j, 2, 3]
                        along = (
                            p_A[0] * (ay * rz - az * ry)
                            + p_A[1] * (az * rx - ax * rz)
                            + p_A[2] * (ax * ry - ay * rx)
                        )
                    else:
                        along = p_A[0] * ax + p_A[1] * ay + p_A[2] * az
                    gradients[count, j] = (along if on_A else -along) / distance
            count += 1
    return count


@njit(cache=True, nogil=True)
def lowest_points(fixed, revolute, q, depths, X_JS, kinds, sizes, radii, vertices, starts, shapes):  # type: ignore[no-untyped-def]
    """Return the height of the lowest point of some moving shapes at each q [m]. Shape (m,).

    Args:
        fixed: See `path_distances`; as the arguments that follow.
        revolute: See `path_distances`.
        q: See `path_distances`.
        depths: See `path_distances`.
        X_JS: See `path_distances`.
        kinds: See `path_distances`.
        sizes: See `path_distances`.
        radii: See `path_distances`.
        vertices: See `path_distances`.
        starts: See `path_distances`.
        shapes: Indices of the shapes. Shape (k,).
    """
    n = len(revolute)
    frames = np.empty((n + 1, 4, 4))
    moved = np.empty((n, 3, 4))
    X = np.empty((3, 4))
    down = np.array([0.0, 0.0, -1.0])
    point = np.empty(3)
    lowest = np.full(len(q), np.inf)
    for row in range(len(q)):
        chain_frames(fixed, revolute, q[row], frames, moved)
        for shape in shapes:
            M = moved[depths[shape] - 1]
            for i in range(3):
                for j in range(4):
                    X[i, j] = (
                        M[i, 0] * X_JS[shape, 0, j]
                        + M[i, 1] * X_JS[shape, 1, j]
                        + M[i, 2] * X_JS[shape, 2, j]
                    )
                X[i, 3] += M[i, 3]
            _add_support(
                kinds[shape],
                sizes[shape],
                vertices[starts[shape] : starts[shape + 1]],
                X,
                1.0,
                down,
                point,
            )
            lowest[row] = min(lowest[row], point[2] - radii[shape])
    return lowest
