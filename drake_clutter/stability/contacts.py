"""Who stands on whom: level contacts between convex objects, as polygons."""

import numpy as np
from numba import njit

LEVEL_GAP = 0.002
"""m; surfaces whose heights differ by less touch each other."""
DEEPEST = 0.0015
"""m; objects that overlap further, in height and seen from above, interpenetrate."""
BESIDE = 0.060
"""m; an object that begins at the height where another one ends, and no further beside it, was put on it and misses it. The gap
of a standing pair is smaller."""
# What `find_contacts` says of objects.
SOUND, LEANING, NOT_CONVEX, OUTSIDE, OVERLAPPING, FLOATING, EDGE, UNSUPPORTED = range(8)
GROUND = -1


@njit(cache=True)
def _clip(polygon, count, x, y, nx, ny, room):  # type: ignore[no-untyped-def]
    """Keeps what lies within `room` of the line through (x, y) on the side that (nx, ny) points away from; in place."""
    kept = np.empty_like(polygon)
    found = 0
    for k in range(count):
        after = (k + 1) % count
        here = (polygon[k, 0] - x) * nx + (polygon[k, 1] - y) * ny - room
        there = (polygon[after, 0] - x) * nx + (polygon[after, 1] - y) * ny - room
        if here <= 0 and found < len(kept):
            kept[found, 0], kept[found, 1] = polygon[k, 0], polygon[k, 1]
            found += 1
        if (here < 0 < there or there < 0 < here) and found < len(kept):
            share = here / (here - there)
            for axis in range(2):
                kept[found, axis] = polygon[k, axis] + share * (
                    polygon[after, axis] - polygon[k, axis]
                )
            found += 1
    for k in range(found):
        polygon[k, 0], polygon[k, 1] = kept[k, 0], kept[k, 1]
    return found


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
def contact_polygon(posed, lower_shape, upper_shape, lower_p, upper_p, margin):  # type: ignore[no-untyped-def]
    """Corners (V, 2) m in T where an object stands on another one (shape -1: on the tray), shrunk by the margin (m)."""
    polygon = np.empty((48, 2))
    bottom, corners = posed[upper_shape].bottom, posed[upper_shape].bottom_count
    # Larger than the bottom, so that a negative margin makes it grow.
    reach = 0.1
    for k in range(corners):
        reach = max(reach, 0.1 + abs(bottom[k, 0]), 0.1 + abs(bottom[k, 1]))
    for k in range(4):
        polygon[k, 0] = upper_p[0] + (reach if k in (1, 2) else -reach)
        polygon[k, 1] = upper_p[1] + (reach if k in (2, 3) else -reach)
    count = _clip_to(polygon, 4, bottom, corners, upper_p[0], upper_p[1], margin)
    if lower_shape >= 0:
        top, corners = posed[lower_shape].top, posed[lower_shape].top_count
        count = (
            _clip_to(polygon, count, top, corners, lower_p[0], lower_p[1], margin)
            if corners > 0
            else 0
        )
    return polygon[:count]


@njit(cache=True)
def _overlap(posed, i, j, p_i, p_j, how_far):  # type: ignore[no-untyped-def]
    """How deep two outlines overlap seen from above, m (separating axes); not positive: they do not.

    With `how_far`, a negative value says how far apart they are at least.
    """
    apart = np.hypot(p_i[0] - p_j[0], p_i[1] - p_j[1]) - posed[i].reach - posed[j].reach
    if apart > (BESIDE if how_far else 0.0):
        return -apart
    least = np.inf
    for a, b, p_a, p_b in ((i, j, p_i, p_j), (j, i, p_j, p_i)):
        dx, dy = p_b[0] - p_a[0], p_b[1] - p_a[1]
        sides, corners = posed[a].sides, posed[b].footprint
        for k in range(posed[a].footprint_count):
            nx, ny, out = sides[k, 0], sides[k, 1], sides[k, 2]
            nearest = np.inf
            for m in range(posed[b].footprint_count):
                nearest = min(nearest, corners[m, 0] * nx + corners[m, 1] * ny)
            least = min(least, out - nearest - dx * nx - dy * ny)
            if least <= 0 and not how_far:
                return least
    return least


@njit(cache=True)
def free_top(posed, shape, above, p_T, above_p, margin):  # type: ignore[no-untyped-def]
    """Corners (V, 2) m in T of what an object's top has beside another object that covers some of it, and the margin (m)."""
    top, count = posed[shape].top, posed[shape].top_count
    outline, outline_count = posed[above].footprint, posed[above].footprint_count
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
def touching(posed, shapes, p_T, row, margin):  # type: ignore[no-untyped-def]
    """(n,) whether each object may touch that of a row, directly or through others: axis-aligned boxes within the margin (m)."""
    n = len(shapes)
    lower, upper = np.empty((n, 3)), np.empty((n, 3))
    for i in range(n):
        for axis in range(3):
            lower[i, axis] = p_T[i, axis] + posed[shapes[i]].lower[axis]
            upper[i, axis] = p_T[i, axis] + posed[shapes[i]].upper[axis]
    reached = np.zeros(n, np.bool_)
    reached[row] = True
    waiting = [row]
    while len(waiting) > 0:
        i = waiting.pop()
        for j in range(n):
            apart = -np.inf
            for axis in range(3):
                apart = max(apart, lower[i, axis] - upper[j, axis], lower[j, axis] - upper[i, axis])
            if apart <= margin and not reached[j]:
                reached[j] = True
                waiting.append(j)
    return reached


@njit(cache=True)
def find_contacts(posed, shapes, p_T, half_size):  # type: ignore[no-untyped-def]
    """Who stands on whom.

    Args:
        posed: (N,) of `shapes.POSED`.
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
    fault, culprit = SOUND, 0
    for j in range(n):
        shape = shapes[j]
        if posed[shape].fault != 0:
            return LEANING if posed[shape].fault == 1 else NOT_CONVEX, j, pairs[:0], stack
        for axis in range(2):
            beyond = (
                max(
                    posed[shape].upper[axis] + p_T[j, axis],
                    -posed[shape].lower[axis] - p_T[j, axis],
                )
                - half_size[axis]
            )
            if beyond > DEEPEST:
                return OUTSIDE, j, pairs[:0], stack
    for j in range(n):
        upper = shapes[j]
        low = p_T[j, 2] + posed[upper].low
        supported = False
        if low < -LEVEL_GAP:
            return OVERLAPPING, j, pairs[:0], stack
        if low < LEVEL_GAP:
            pairs[count, 0], pairs[count, 1] = GROUND, j
            count += 1
            supported = True
        beside, above = False, False  # or above something that ends where this begins
        for i in range(n):
            if i == j:
                continue
            lower = shapes[i]
            high = p_T[i, 2] + posed[lower].high
            level = abs(low - high) < LEVEL_GAP
            over = min(p_T[j, 2] + posed[upper].high, high) - max(low, p_T[i, 2] + posed[lower].low)
            if not level and over <= DEEPEST:
                continue
            deep = _overlap(posed, upper, lower, p_T[j], p_T[i], level)
            if not level:
                if deep > DEEPEST and fault == SOUND:
                    fault, culprit = OVERLAPPING, j
                continue
            beside |= deep > -BESIDE
            above |= deep > 0
            if deep <= 0:
                continue
            whole = (
                posed[upper].flat and posed[lower].flat
            )  # what overlaps seen from above is in contact
            if whole or len(contact_polygon(posed, lower, upper, p_T[i], p_T[j], 0.0)) > 0:
                pairs[count, 0], pairs[count, 1] = i, j
                count += 1
                supported = True
                old, new = stack[j], stack[i]
                for k in range(n):
                    if stack[k] == old:
                        stack[k] = new
        if not supported and fault == SOUND:
            culprit = j
            fault = EDGE if above else UNSUPPORTED if beside else FLOATING
    return fault, culprit, pairs[:count], stack
