"""Level contacts between convex objects, as polygons."""

import numpy as np
from numba import njit

MAX_CONTACT_GAP = 0.002
"""Faces whose heights differ by less than this are in contact [m]."""
MAX_OVERLAP = 0.0015
"""Objects that overlap by more than this interpenetrate [m].

The overlap counts both in height and seen from above.
"""
MAX_MISS_DISTANCE = 0.060
"""Largest distance at which an object counts as placed beside its support [m].

Such an object begins at the height at which another one ends and misses it. The distance exceeds
the gap of a standing pair (50 mm).
"""
# Faults that `find_contacts` returns; `InconclusiveReason` explains them.
NO_FAULT, LEANING, NOT_CONVEX, OUTSIDE, OVERLAPPING, FLOATING, EDGE, UNSUPPORTED = range(8)
GROUND = -1
"""Index of the support's floor in pairs of objects."""


@njit(cache=True)
def _clip(polygon, count, x, y, nx, ny, margin):  # type: ignore[no-untyped-def]
    """Clip a polygon to a half-plane in place, and return its number of corners.

    Args:
        polygon: Corners, of which the first `count` are used [m]. Shape (V, 2).
        count: Number of corners.
        x: Point on the line [m].
        y: Point on the line [m].
        nx: Outward unit normal of the line.
        ny: Outward unit normal of the line.
        margin: Distance by which the half-plane extends beyond the line [m].
    """
    kept = np.empty_like(polygon)
    num_kept = 0
    for k in range(count):
        after = (k + 1) % count
        here = (polygon[k, 0] - x) * nx + (polygon[k, 1] - y) * ny - margin
        there = (polygon[after, 0] - x) * nx + (polygon[after, 1] - y) * ny - margin
        if here <= 0 and num_kept < len(kept):
            kept[num_kept, 0], kept[num_kept, 1] = polygon[k, 0], polygon[k, 1]
            num_kept += 1
        if (here < 0 < there or there < 0 < here) and num_kept < len(kept):
            fraction = here / (here - there)
            for axis in range(2):
                kept[num_kept, axis] = polygon[k, axis] + fraction * (
                    polygon[after, axis] - polygon[k, axis]
                )
            num_kept += 1
    for k in range(num_kept):
        polygon[k, 0], polygon[k, 1] = kept[k, 0], kept[k, 1]
    return num_kept


@njit(cache=True)
def _clip_to(polygon, count, other, other_count, dx, dy, margin):  # type: ignore[no-untyped-def]
    """Clip a polygon in place to another one, and return its number of corners.

    The other polygon is translated by (dx, dy) and shrunk by the margin [m]. A segment of two
    points counts as a polygon without width.
    """
    if other_count == 2:
        ex, ey = other[1, 0] - other[0, 0], other[1, 1] - other[0, 1]
        length = np.hypot(ex, ey)
        ex, ey = ex / length, ey / length
        count = _clip(polygon, count, other[0, 0] + dx, other[0, 1] + dy, -ex, -ey, -margin)
        count = _clip(polygon, count, other[1, 0] + dx, other[1, 1] + dy, ex, ey, -margin)
        count = _clip(polygon, count, other[0, 0] + dx, other[0, 1] + dy, -ey, ex, 1e-9)
        return _clip(polygon, count, other[0, 0] + dx, other[0, 1] + dy, ey, -ex, 1e-9)
    for k in range(other_count):
        after = (k + 1) % other_count
        ex, ey = other[after, 0] - other[k, 0], other[after, 1] - other[k, 1]
        length = np.hypot(ex, ey)
        count = _clip(
            polygon, count, other[k, 0] + dx, other[k, 1] + dy, ey / length, -ex / length, -margin
        )
        if count == 0:
            return 0
    return count


@njit(cache=True)
def contact_polygon(records, lower_shape, upper_shape, lower_p, upper_p, margin):  # type: ignore[no-untyped-def]
    """Return the corners of the contact below an object in T, shrunk by a margin.

    Args:
        records: Table of shapes, of type `SHAPE_DTYPE`. Shape (N,).
        lower_shape: Row of the lower object's shape; -1 for the support's floor.
        upper_shape: Row of the upper object's shape.
        lower_p: Origin of the lower object in T [m]. Shape (3,).
        upper_p: Origin of the upper object in T [m]. Shape (3,).
        margin: Width by which the contact is shrunk [m].

    Returns:
        Corners [m]. Shape (V, 2), V may be 0.
    """
    polygon = np.empty((48, 2))
    bottom, corners = records[upper_shape].bottom, records[upper_shape].bottom_count
    # Start with a square larger than the bottom, so that a negative margin can extend the contact.
    reach = 0.1
    for k in range(corners):
        reach = max(reach, 0.1 + abs(bottom[k, 0]), 0.1 + abs(bottom[k, 1]))
    for k in range(4):
        polygon[k, 0] = upper_p[0] + (reach if k in (1, 2) else -reach)
        polygon[k, 1] = upper_p[1] + (reach if k in (2, 3) else -reach)
    count = _clip_to(polygon, 4, bottom, corners, upper_p[0], upper_p[1], margin)
    if lower_shape >= 0:
        top, corners = records[lower_shape].top, records[lower_shape].top_count
        count = (
            _clip_to(polygon, count, top, corners, lower_p[0], lower_p[1], margin)
            if corners > 0
            else 0
        )
    return polygon[:count]


@njit(cache=True)
def _overlap(records, i, j, p_i, p_j, measure_gap):  # type: ignore[no-untyped-def]
    """Return how deep two footprints overlap seen from above [m], by separating axes.

    The result is not positive if they do not overlap. With `measure_gap`, a negative result is a
    lower bound of their distance.
    """
    gap = (
        np.hypot(p_i[0] - p_j[0], p_i[1] - p_j[1])
        - records[i].footprint_radius
        - records[j].footprint_radius
    )
    if gap > (MAX_MISS_DISTANCE if measure_gap else 0.0):
        return -gap
    least = np.inf
    for a, b, p_a, p_b in ((i, j, p_i, p_j), (j, i, p_j, p_i)):
        dx, dy = p_b[0] - p_a[0], p_b[1] - p_a[1]
        sides = records[a].sides
        corners = records[b].footprint
        for k in range(records[a].footprint_count):
            nx, ny, out = sides[k, 0], sides[k, 1], sides[k, 2]
            nearest = np.inf
            for m in range(records[b].footprint_count):
                nearest = min(nearest, corners[m, 0] * nx + corners[m, 1] * ny)
            least = min(least, out - nearest - dx * nx - dy * ny)
            if least <= 0 and not measure_gap:
                return least
    return least


@njit(cache=True)
def uncovered_top(records, shape, above, p_T, above_p, margin):  # type: ignore[no-untyped-def]
    """Return the parts of an object's top that another object does not cover.

    Args:
        records: Table of shapes, of type `SHAPE_DTYPE`. Shape (N,).
        shape: Row of the lower object's shape.
        above: Row of the upper object's shape.
        p_T: Origin of the lower object in T [m]. Shape (3,).
        above_p: Origin of the upper object in T [m]. Shape (3,).
        margin: Distance to keep from the upper object [m].

    Returns:
        Corners of all parts in T [m]. Shape (V, 2).
    """
    top, count = records[shape].top, records[shape].top_count
    outline, outline_count = records[above].footprint, records[above].footprint_count
    corners = np.empty((0, 2))
    for k in range(outline_count):  # add the part of the top beyond each side of the outline
        after = (k + 1) % outline_count
        ex, ey = outline[after, 0] - outline[k, 0], outline[after, 1] - outline[k, 1]
        length = np.hypot(ex, ey)
        polygon = np.zeros((48, 2))
        polygon[:count] = top[:count] + p_T[:2]
        beyond = _clip(
            polygon,
            count,
            outline[k, 0] + above_p[0],
            outline[k, 1] + above_p[1],
            -ey / length,
            ex / length,
            -margin,
        )
        corners = np.vstack((corners, polygon[:beyond]))
    return corners


@njit(cache=True)
def connected_objects(records, shapes, p_T, row, margin):  # type: ignore[no-untyped-def]
    """Return which objects may touch an object, directly or through others.

    Args:
        records: Table of shapes, of type `SHAPE_DTYPE`. Shape (N,).
        shapes: Row of each object's shape in the table. Shape (n,).
        p_T: Origins of the objects in T [m]. Shape (n, 3).
        row: Index of the object.
        margin: Largest gap between the axis-aligned boxes of touching objects [m].

    Returns:
        One bool for each object. Shape (n,).
    """
    n = len(shapes)
    lower, upper = np.empty((n, 3)), np.empty((n, 3))
    for i in range(n):
        for axis in range(3):
            lower[i, axis] = p_T[i, axis] + records[shapes[i]].lower[axis]
            upper[i, axis] = p_T[i, axis] + records[shapes[i]].upper[axis]
    reached = np.zeros(n, np.bool_)
    reached[row] = True
    waiting = [row]
    while len(waiting) > 0:
        i = waiting.pop()
        for j in range(n):
            gap = -np.inf
            for axis in range(3):
                gap = max(gap, lower[i, axis] - upper[j, axis], lower[j, axis] - upper[i, axis])
            if gap <= margin and not reached[j]:
                reached[j] = True
                waiting.append(j)
    return reached


@njit(cache=True)
def find_contacts(records, shapes, p_T, half_size):  # type: ignore[no-untyped-def]
    """Find which object stands on which.

    Args:
        records: Table of shapes, of type `SHAPE_DTYPE`. Shape (N,).
        shapes: Row of each object's shape in the table. Shape (n,).
        p_T: Origins of the objects in T [m]. Shape (n, 3).
        half_size: Half extents of the support's floor [m]. Shape (2,).

    Returns:
        The first fault (`NO_FAULT` if there is none), the index of the object with the fault, the
        lower (or `GROUND`) and upper object of each contact, shape (c, 2), and the number of each
        object's stack, shape (n,).
    """
    n = len(shapes)
    pairs = np.empty((n * (n + 1), 2), np.int64)
    count = 0
    stack = np.arange(n)
    fault = NO_FAULT
    faulty = 0
    for j in range(n):
        shape = shapes[j]
        if records[shape].fault != 0:
            return LEANING if records[shape].fault == 1 else NOT_CONVEX, j, pairs[:0], stack
        for axis in range(2):
            beyond = (
                max(
                    records[shape].upper[axis] + p_T[j, axis],
                    -records[shape].lower[axis] - p_T[j, axis],
                )
                - half_size[axis]
            )
            if beyond > MAX_OVERLAP:
                return OUTSIDE, j, pairs[:0], stack
    for j in range(n):
        upper = shapes[j]
        bottom_z = p_T[j, 2] + records[upper].bottom_z
        supported = False
        if bottom_z < -MAX_CONTACT_GAP:
            return OVERLAPPING, j, pairs[:0], stack
        if bottom_z < MAX_CONTACT_GAP:
            pairs[count, 0], pairs[count, 1] = GROUND, j
            count += 1
            supported = True
        # Whether another object ends at the height of this one's bottom, near it or below it.
        is_near = False
        is_above = False
        for i in range(n):
            if i == j:
                continue
            lower = shapes[i]
            top_z = p_T[i, 2] + records[lower].top_z
            level = abs(bottom_z - top_z) < MAX_CONTACT_GAP
            height_overlap = min(p_T[j, 2] + records[upper].top_z, top_z) - max(
                bottom_z, p_T[i, 2] + records[lower].bottom_z
            )
            if not level and height_overlap <= MAX_OVERLAP:
                continue
            overlap = _overlap(records, upper, lower, p_T[j], p_T[i], level)
            if not level:
                if overlap > MAX_OVERLAP and fault == NO_FAULT:
                    fault, faulty = OVERLAPPING, j
                continue
            is_near |= overlap > -MAX_MISS_DISTANCE
            is_above |= overlap > 0
            if overlap <= 0:
                continue
            # Faces as large as the footprints are in contact where the footprints overlap.
            both_flat = records[upper].flat and records[lower].flat
            if both_flat or len(contact_polygon(records, lower, upper, p_T[i], p_T[j], 0.0)) > 0:
                pairs[count, 0], pairs[count, 1] = i, j
                count += 1
                supported = True
                old, new = stack[j], stack[i]
                for k in range(n):
                    if stack[k] == old:
                        stack[k] = new
        if not supported and fault == NO_FAULT:
            faulty = j
            fault = EDGE if is_above else UNSUPPORTED if is_near else FLOATING
    return fault, faulty, pairs[:count], stack
