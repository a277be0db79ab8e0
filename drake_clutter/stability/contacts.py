"""Horizontal contact polygons between objects.

Frame T is that of the support: its origin is at the center of the floor, and z points up.
"""

import numpy as np

from drake_clutter.compilation import njit

MAX_CONTACT_GAP = 0.002
"""Faces whose heights differ by less than this are in contact [m]."""
MAX_OVERLAP = 0.0015
"""Objects that overlap by more than this interpenetrate [m].

The overlap counts both in height and seen from above.
"""
MAX_MISS_DISTANCE = 0.060
"""Largest horizontal distance at which an object counts as placed beside another one [m].

Such an object is `UNSUPPORTED`: its bottom is at the height of the other object's top, but not
above it. The distance exceeds the gap of a standing pair (`LayoutConfig.standing_gap`, 50 mm).
"""
_MIN_CONTACT_WIDTH = 0.002
"""Narrower parts of the contact of objects that are not convex carry little [m]."""
_MAX_CENTER_LINE_MARGIN = 0.005
"""Largest margin up to which a narrow contact keeps its center line [m]."""
_MAX_OUTLINE_CORNERS = 32
"""Largest number of corners of the contact of objects that are not convex."""
# Faults that `find_contacts` returns; `InconclusiveReason` explains them.
NO_FAULT, LEANING, OUTSIDE, OVERLAPPING, FLOATING, EDGE, UNSUPPORTED = range(7)
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
    clipped = np.empty_like(polygon)
    num_clipped = 0
    for k in range(count):
        successor = (k + 1) % count
        distance = (polygon[k, 0] - x) * nx + (polygon[k, 1] - y) * ny - margin
        next_distance = (polygon[successor, 0] - x) * nx + (polygon[successor, 1] - y) * ny - margin
        if distance <= 0 and num_clipped < len(clipped):
            clipped[num_clipped, 0], clipped[num_clipped, 1] = polygon[k, 0], polygon[k, 1]
            num_clipped += 1
        if (distance < 0 < next_distance or next_distance < 0 < distance) and num_clipped < len(
            clipped
        ):
            fraction = distance / (distance - next_distance)
            for axis in range(2):
                clipped[num_clipped, axis] = polygon[k, axis] + fraction * (
                    polygon[successor, axis] - polygon[k, axis]
                )
            num_clipped += 1
    for k in range(num_clipped):
        polygon[k, 0], polygon[k, 1] = clipped[k, 0], clipped[k, 1]
    return num_clipped


@njit(cache=True)
def _clip_to(polygon, count, other, other_count, dx, dy, margin):  # type: ignore[no-untyped-def]
    """Clip a polygon in place to another one, and return its number of corners.

    Args:
        polygon: Corners, of which the first `count` are used [m]. Shape (V, 2).
        count: Number of corners.
        other: Corners of the convex polygon to clip to, counter-clockwise [m]. Shape (W, 2).
        other_count: Number of its corners; 2 for a segment, which is a polygon without width.
        dx: Translation of the other polygon [m].
        dy: Translation of the other polygon [m].
        margin: Width by which the other polygon is shrunk [m].
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
        successor = (k + 1) % other_count
        ex, ey = other[successor, 0] - other[k, 0], other[successor, 1] - other[k, 1]
        length = np.hypot(ex, ey)
        count = _clip(
            polygon, count, other[k, 0] + dx, other[k, 1] + dy, ey / length, -ex / length, -margin
        )
        if count == 0:
            return 0
    return count


@njit(cache=True)
def _face_contact(table, lower_shape, upper_shape, p_lower, p_upper, margin):  # type: ignore[no-untyped-def]
    """Return the overlap of the bottom of a shape and the top of another, shrunk by a margin.

    See `contact_polygon`; the heights are not compared.
    """
    polygon = np.empty((48, 2))
    bottom, num_corners = table[upper_shape].bottom, table[upper_shape].bottom_count
    # Start with a square larger than the bottom, so that a negative margin can extend the contact.
    half_side = 0.1
    for k in range(num_corners):
        half_side = max(half_side, 0.1 + abs(bottom[k, 0]), 0.1 + abs(bottom[k, 1]))
    for k in range(4):
        polygon[k, 0] = p_upper[0] + (half_side if k in (1, 2) else -half_side)
        polygon[k, 1] = p_upper[1] + (half_side if k in (2, 3) else -half_side)
    count = _clip_to(polygon, 4, bottom, num_corners, p_upper[0], p_upper[1], margin)
    if lower_shape >= 0:
        top, num_corners = table[lower_shape].top, table[lower_shape].top_count
        count = (
            _clip_to(polygon, count, top, num_corners, p_lower[0], p_lower[1], margin)
            if num_corners > 0
            else 0
        )
    return polygon[:count]


@njit(cache=True)
def _is_left(a, b, c):  # type: ignore[no-untyped-def]
    """Return whether point c lies to the left of the line from a to b."""
    return (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0]) > 1e-15


@njit(cache=True)
def _outline(points):  # type: ignore[no-untyped-def]
    """Return the corners of the convex hull of points (n, 2), counter-clockwise.

    They are two for points on a line. The method is the monotone chain (Andrew 1979).
    """
    order = np.argsort(points[:, 0] + 1e-9 * points[:, 1])
    hull = np.empty((2 * len(points) + 1, 2))
    count = 0
    for side in range(2):
        start = count
        for k in range(len(order)):
            point = points[order[k] if side == 0 else order[len(order) - 1 - k]]
            while count >= start + 2 and not _is_left(hull[count - 2], hull[count - 1], point):
                count -= 1
            hull[count, 0], hull[count, 1] = point[0], point[1]
            count += 1
        count -= 1  # the last point is the first of the other side
    return hull[:count]


@njit(cache=True)
def contact_polygon(table, lower_shape, upper_shape, p_lower, p_upper, margin):  # type: ignore[no-untyped-def]
    """Return the contact polygon of an upper and a lower object in T, shrunk by a margin.

    Of objects that are not convex, it is the outline of the contacts of their pieces: what presses
    on the rim of a bowl may press anywhere within the outline.

    Args:
        table: Table of shapes, of type `SHAPE_DTYPE`. Shape (N,).
        lower_shape: Row of the lower object's shape; -1 for the support's floor.
        upper_shape: Row of the upper object's shape.
        p_lower: Origin of the lower object in T [m]. Shape (3,).
        p_upper: Origin of the upper object in T [m]. Shape (3,).
        margin: Width by which the contact is shrunk [m].

    Returns:
        Corners [m]. Shape (V, 2), V may be 0.
    """
    if lower_shape < 0 or (
        table[lower_shape].first_part == lower_shape
        and table[upper_shape].first_part == upper_shape
    ):
        return _face_contact(table, lower_shape, upper_shape, p_lower, p_upper, margin)
    # Narrow parts of the contact carry little; they count only if there are no others.
    outline = _contact_outline(
        table, lower_shape, upper_shape, p_lower, p_upper, _MIN_CONTACT_WIDTH / 2
    )
    if len(outline) == 0:
        outline = _contact_outline(table, lower_shape, upper_shape, p_lower, p_upper, 0.0)
    polygon = _shrink(outline, margin)
    if len(polygon) == 0 and len(outline) > 0 and margin < _MAX_CENTER_LINE_MARGIN:
        # The contact with a thin rim shrinks to its center line.
        kept, lost = 0.0, margin
        while lost - kept > 1e-5:
            middle = (kept + lost) / 2
            part = _shrink(outline, middle)
            if len(part) > 0:
                kept, polygon = middle, part
            else:
                lost = middle
    return polygon


@njit(cache=True)
def _contact_outline(table, lower_shape, upper_shape, p_lower, p_upper, margin):  # type: ignore[no-untyped-def]
    """Return the outline of the contacts of pieces at equal height, each shrunk by a margin.

    Its corners are counter-clockwise, at most `_MAX_OUTLINE_CORNERS`. See `contact_polygon`.
    """
    points = np.empty((256, 2))
    count = 0
    for a in range(table[upper_shape].first_part, table[upper_shape].last_part):
        if table[a].bottom_count == 0:
            continue
        for b in range(table[lower_shape].first_part, table[lower_shape].last_part):
            bottom_z = p_upper[2] + table[a].bottom_z
            if abs(bottom_z - p_lower[2] - table[b].top_z) >= MAX_CONTACT_GAP:
                continue
            part = _face_contact(table, b, a, p_lower, p_upper, margin)
            if count + len(part) > len(points):
                longer = np.empty((2 * len(points), 2))
                longer[:count] = points[:count]
                points = longer
            points[count : count + len(part)] = part
            count += len(part)
    if count < 2:
        return points[:0]
    outline = _outline(points[:count])
    if len(outline) < 2:
        return points[:0]
    corners = min(len(outline), _MAX_OUTLINE_CORNERS)
    chosen = np.empty((corners, 2))
    for k in range(corners):
        chosen[k] = outline[k * len(outline) // corners]
    return chosen


@njit(cache=True)
def _shrink(outline, margin):  # type: ignore[no-untyped-def]
    """Return a convex polygon (n, 2) shrunk by a margin, which may be negative. Shape (m, 2)."""
    polygon = np.empty((48, 2))
    if len(outline) == 0:
        return polygon[:0]
    # As in `_face_contact`, start with a square that is larger than the polygon.
    left, right = outline[:, 0].min(), outline[:, 0].max()
    front, back = outline[:, 1].min(), outline[:, 1].max()
    half_side = 0.1 + max(right - left, back - front)
    for k in range(4):
        polygon[k, 0] = (left + right) / 2 + (half_side if k in (1, 2) else -half_side)
        polygon[k, 1] = (front + back) / 2 + (half_side if k in (2, 3) else -half_side)
    return polygon[: _clip_to(polygon, 4, outline, len(outline), 0.0, 0.0, margin)]


@njit(cache=True)
def _overlap(table, i, j, p_i, p_j, measure_gap):  # type: ignore[no-untyped-def]
    """Return the overlap of two footprints by the separating-axis test [m].

    The result is not positive if they do not overlap. With `measure_gap`, a negative result is a
    lower bound of their distance.
    """
    gap = (
        np.hypot(p_i[0] - p_j[0], p_i[1] - p_j[1])
        - table[i].footprint_radius
        - table[j].footprint_radius
    )
    if gap > (MAX_MISS_DISTANCE if measure_gap else 0.0):
        return -gap
    min_overlap = np.inf
    for a, b, p_a, p_b in ((i, j, p_i, p_j), (j, i, p_j, p_i)):
        dx, dy = p_b[0] - p_a[0], p_b[1] - p_a[1]
        sides = table[a].sides
        corners = table[b].footprint
        for k in range(table[a].footprint_count):
            nx, ny, offset = sides[k, 0], sides[k, 1], sides[k, 2]
            min_projection = np.inf
            for m in range(table[b].footprint_count):
                min_projection = min(min_projection, corners[m, 0] * nx + corners[m, 1] * ny)
            min_overlap = min(min_overlap, offset - min_projection - dx * nx - dy * ny)
            if min_overlap <= 0 and not measure_gap:
                return min_overlap
    return min_overlap


@njit(cache=True)
def uncovered_top(table, lower, upper, p_lower, p_upper, margin):  # type: ignore[no-untyped-def]
    """Return the parts of an object's top that another object does not cover.

    Args:
        table: Table of shapes, of type `SHAPE_DTYPE`. Shape (N,).
        lower: Row of the lower object's shape.
        upper: Row of the upper object's shape.
        p_lower: Origin of the lower object in T [m]. Shape (3,).
        p_upper: Origin of the upper object in T [m]. Shape (3,).
        margin: Distance to keep from the upper object [m].

    Returns:
        Corners of all parts in T [m]. Shape (V, 2).
    """
    top, count = table[lower].top, table[lower].top_count
    outline, outline_count = table[upper].footprint, table[upper].footprint_count
    corners = np.empty((0, 2))
    for k in range(outline_count):  # add the part of the top beyond each side of the outline
        successor = (k + 1) % outline_count
        ex, ey = outline[successor, 0] - outline[k, 0], outline[successor, 1] - outline[k, 1]
        length = np.hypot(ex, ey)
        polygon = np.zeros((48, 2))
        polygon[:count] = top[:count] + p_lower[:2]
        num_corners = _clip(
            polygon,
            count,
            outline[k, 0] + p_upper[0],
            outline[k, 1] + p_upper[1],
            -ey / length,
            ex / length,
            -margin,
        )
        corners = np.vstack((corners, polygon[:num_corners]))
    return corners


@njit(cache=True)
def connected_objects(table, shapes, p_T, index, margin):  # type: ignore[no-untyped-def]
    """Return which objects may touch an object, directly or through others.

    Args:
        table: Table of shapes, of type `SHAPE_DTYPE`. Shape (N,).
        shapes: Row of each object's shape in the table. Shape (n,).
        p_T: Origins of the objects in T [m]. Shape (n, 3).
        index: Index of the object.
        margin: Largest gap between the axis-aligned boxes of touching objects [m].

    Returns:
        One bool for each object. Shape (n,).
    """
    n = len(shapes)
    lower, upper = np.empty((n, 3)), np.empty((n, 3))
    for i in range(n):
        for axis in range(3):
            lower[i, axis] = p_T[i, axis] + table[shapes[i]].lower[axis]
            upper[i, axis] = p_T[i, axis] + table[shapes[i]].upper[axis]
    reached = np.zeros(n, np.bool_)
    reached[index] = True
    pending = [index]
    while len(pending) > 0:
        i = pending.pop()
        for j in range(n):
            gap = -np.inf
            for axis in range(3):
                gap = max(gap, lower[i, axis] - upper[j, axis], lower[j, axis] - upper[i, axis])
            if gap <= margin and not reached[j]:
                reached[j] = True
                pending.append(j)
    return reached


@njit(cache=True)
def find_contacts(table, shapes, p_T, half_size, is_apart):  # type: ignore[no-untyped-def]
    """Find the contacts between objects, and the first fault.

    Args:
        table: Table of shapes, of type `SHAPE_DTYPE`. Shape (N,).
        shapes: Row of each object's shape in the table. Shape (n,).
        p_T: Origins of the objects in T [m]. Shape (n, 3).
        half_size: Half extents of the support's floor [m]. Shape (2,).
        is_apart: Pairs of objects that are known not to overlap; otherwise, pieces overlap if they
            do in height and seen from above. Shape (n, n).

    Returns:
        The first fault (`NO_FAULT` if there is none), the index of the object with the fault, the
        object that it overlaps or `GROUND`, the lower (or `GROUND`) and upper object of each
        contact, shape (c, 2), and the number of each object's stack, shape (n,).
    """
    n = len(shapes)
    pairs = np.empty((n * (n + 1), 2), np.int64)
    count = 0
    stack = np.arange(n)
    fault = NO_FAULT
    faulty_object, other_object = 0, GROUND
    for j in range(n):
        shape = shapes[j]
        if table[shape].fault != 0:  # The only one is `shape_table.Fault.LEANING`.
            return LEANING, j, GROUND, pairs[:0], stack
        for axis in range(2):
            beyond = (
                max(
                    table[shape].upper[axis] + p_T[j, axis],
                    -table[shape].lower[axis] - p_T[j, axis],
                )
                - half_size[axis]
            )
            if beyond > MAX_OVERLAP:
                return OUTSIDE, j, GROUND, pairs[:0], stack
    for j in range(n):
        upper = shapes[j]
        bottom_z = p_T[j, 2] + table[upper].bottom_z
        supported = False
        if bottom_z < -MAX_CONTACT_GAP:
            return OVERLAPPING, j, GROUND, pairs[:0], stack
        if bottom_z < MAX_CONTACT_GAP:
            pairs[count, 0], pairs[count, 1] = GROUND, j
            count += 1
            supported = True
        # Whether the top of another object at the height of this bottom is beside it, or below it.
        is_near = False
        is_above = False
        for i in range(n):
            if i == j:
                continue
            lower = shapes[i]
            is_joined = table[lower].first_part != lower or table[upper].first_part != upper
            if is_joined and (
                _overlap(table, upper, lower, p_T[j], p_T[i], True) <= -MAX_MISS_DISTANCE
            ):
                continue
            may_touch = False
            for a in range(table[upper].first_part, table[upper].last_part):
                for b in range(table[lower].first_part, table[lower].last_part):
                    part_bottom_z = p_T[j, 2] + table[a].bottom_z
                    top_z = p_T[i, 2] + table[b].top_z
                    same_height = (
                        table[a].bottom_count > 0 and abs(part_bottom_z - top_z) < MAX_CONTACT_GAP
                    )
                    height_overlap = min(p_T[j, 2] + table[a].top_z, top_z) - max(
                        part_bottom_z, p_T[i, 2] + table[b].bottom_z
                    )
                    if not same_height and height_overlap <= MAX_OVERLAP:
                        continue
                    overlap = _overlap(table, a, b, p_T[j], p_T[i], same_height)
                    if not same_height:
                        if overlap > MAX_OVERLAP and fault == NO_FAULT and not is_apart[i, j]:
                            fault, faulty_object, other_object = OVERLAPPING, j, i
                        continue
                    is_near |= overlap > -MAX_MISS_DISTANCE
                    is_above |= overlap > 0
                    may_touch |= overlap > 0
            if not may_touch:
                continue
            # Faces as large as the footprints are in contact where the footprints overlap.
            both_flat = table[upper].flat and table[lower].flat
            if both_flat or len(contact_polygon(table, lower, upper, p_T[i], p_T[j], 0.0)) > 0:
                pairs[count, 0], pairs[count, 1] = i, j
                count += 1
                supported = True
                old_stack, new_stack = stack[j], stack[i]
                for k in range(n):
                    if stack[k] == old_stack:
                        stack[k] = new_stack
        if not supported and fault == NO_FAULT:
            faulty_object = j
            fault = EDGE if is_above else UNSUPPORTED if is_near else FLOATING
    return fault, faulty_object, other_object, pairs[:count], stack
