"""Who stands on whom: level contacts between convex objects, as polygons."""

import numpy as np
from numba import njit

MAX_CONTACT_GAP = 0.002
"""m; surfaces whose heights differ by less touch each other."""
MAX_OVERLAP = 0.0015
"""m; objects that overlap further, in height and seen from above, interpenetrate."""
MAX_MISS_DISTANCE = 0.060
"""m; an object that begins at the height where another one ends, and no further beside it, was put on it and misses it. The gap
of a standing pair is smaller."""
# What `find_contacts` says of objects.
NO_FAULT, LEANING, NOT_CONVEX, OUTSIDE, OVERLAPPING, FLOATING, EDGE, UNSUPPORTED = range(8)
GROUND = -1


@njit(cache=True)
def _clip(polygon, count, x, y, nx, ny, margin):  # type: ignore[no-untyped-def]
    """Keeps what lies within `margin` of the line through (x, y) on the side that (nx, ny) points away from; in place."""
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
    """Clips a polygon to another one that is moved by (dx, dy) and shrunk by the margin; a segment counts as thin."""
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
    """Corners (V, 2) m in T where an object stands on another one (shape -1: on the tray), shrunk by the margin (m)."""
    polygon = np.empty((48, 2))
    bottom, corners = records[upper_shape].bottom, records[upper_shape].bottom_count
    # Larger than the bottom, so that a negative margin makes it grow.
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
    """How deep two outlines overlap seen from above, m (separating axes); not positive: they do not.

    With `measure_gap`, a negative value says how far apart they are at least.
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
        sides, corners = records[a].sides, records[b].footprint
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
    """Corners (V, 2) m in T of what an object's top has beside another object that covers some of it, and the margin (m)."""
    top, count = records[shape].top, records[shape].top_count
    outline, outline_count = records[above].footprint, records[above].footprint_count
    found = np.empty((0, 2))
    for k in range(outline_count):  # the part of the top beyond each side of the outline
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
        found = np.vstack((found, polygon[:beyond]))
    return found


@njit(cache=True)
def connected_objects(records, shapes, p_T, row, margin):  # type: ignore[no-untyped-def]
    """(n,) whether each object may touch that of a row, directly or through others: axis-aligned boxes within the margin (m)."""
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
    """Who stands on whom.

    Args:
        records: (N,) of `shapes.POSED`.
        shapes: (n,) the objects' rows.
        p_T: (n, 3) m.
        half_size: (2,) m, of the floor.

    Returns:
        What is wrong (`SOUND` if nothing is), with which object, the pairs (c, 2) of lower (`GROUND`: the tray) and upper
        object, and (n,) the number of the stack that each object belongs to.
    """
    n = len(shapes)
    pairs = np.empty((n * (n + 1), 2), np.int64)
    count = 0
    stack = np.arange(n)
    fault, faulty = NO_FAULT, 0
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
        beside, above = False, False  # or above something that ends where this begins
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
            beside |= overlap > -MAX_MISS_DISTANCE
            above |= overlap > 0
            if overlap <= 0:
                continue
            whole = (
                records[upper].flat and records[lower].flat
            )  # what overlaps seen from above is in contact
            if whole or len(contact_polygon(records, lower, upper, p_T[i], p_T[j], 0.0)) > 0:
                pairs[count, 0], pairs[count, 1] = i, j
                count += 1
                supported = True
                old, new = stack[j], stack[i]
                for k in range(n):
                    if stack[k] == old:
                        stack[k] = new
        if not supported and fault == NO_FAULT:
            faulty = j
            fault = EDGE if above else UNSUPPORTED if beside else FLOATING
    return fault, faulty, pairs[:count], stack
