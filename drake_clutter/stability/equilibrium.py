"""Quasi-static equilibrium of stacked objects.

Objects are in equilibrium if contact forces exist that balance their weights. All contacts are
level. A force may act anywhere in a contact polygon, that is, at its corners. Equilibrium under
vertical forces is a non-negative least-squares problem with three rows for each object (force, two
moments about its center of mass) and one column for each corner. With friction there are six rows
for each object and four columns for each corner, the edges of a friction pyramid.
"""

import numpy as np

from drake_clutter.compilation import njit
from drake_clutter.stability.contacts import GROUND, contact_polygon
from drake_clutter.stability.nnls import nnls

_MOMENT_ARM = 0.05
"""Length by which moments are divided, to weigh as much as forces [m]."""
_RESIDUAL_TOLERANCE = 1e-6
"""Residual that counts as zero, as a fraction of the total weight."""
NO_LOADS = np.empty((0, 4))
"""The argument `loads` of `equilibrium_residuals` without loads."""


@njit(cache=True)
def equilibrium_residuals(table, shapes, p_T, pairs, margins, com_offsets, friction, loads):  # type: ignore[no-untyped-def]
    """Return the weight and moment of each object that contacts cannot balance.

    Args:
        table: Table of shapes, of type `SHAPE_DTYPE`. Shape (N,).
        shapes: Row of each object's shape in the table. Shape (n,).
        p_T: Origins of the objects in T [m]. Shape (n, 3).
        pairs: Lower (or `GROUND`) and upper object of each contact. Shape (c, 2).
        margins: Width by which the contacts below each object are shrunk [m]. Shape (n,).
        com_offsets: Horizontal offsets of the centers of mass [m]. Shape (n, 2).
        friction: Coefficient of friction; 0 for vertical forces only.
        loads: Points x, y, z [m] at which anything may press straight down, and the index of the
            object below. Shape (l, 4), l may be 0.

    Returns:
        Norms of the residuals of force and moment, relative to the total weight, with moments
        divided by 5 cm. All are zero in equilibrium. Shape (n,).
    """
    n = len(shapes)
    points = np.empty((48 * len(pairs) + len(loads), 3))
    ends = np.empty((48 * len(pairs) + len(loads), 2), np.int64)
    count = 0
    for load in loads:
        points[count] = load[:3]
        ends[count, 0], ends[count, 1] = -1, int(load[3])
        count += 1
    for c in range(len(pairs)):
        lower, upper = pairs[c]
        lower_shape, lower_p = (shapes[lower], p_T[lower]) if lower >= 0 else (-1, p_T[upper])
        polygon = contact_polygon(
            table, lower_shape, shapes[upper], lower_p, p_T[upper], margins[upper]
        )
        for k in range(len(polygon)):
            points[count, 0], points[count, 1] = polygon[k, 0], polygon[k, 1]
            points[count, 2] = p_T[upper, 2] + table[shapes[upper]].bottom_z
            ends[count, 0], ends[count, 1] = upper, lower
            count += 1
    total = 0.0
    for i in range(n):
        total += table[shapes[i]].mass
    rows, sides = (6, 4) if friction > 0 else (3, 1)
    A = np.zeros((sides * count, rows * n))  # transposed: a row is a column of the problem
    b = np.zeros(rows * n)
    for i in range(n):
        b[rows * i] = table[shapes[i]].mass / total
    for k in range(count):
        for end in range(2):
            i = ends[k, end]
            if i < 0:
                continue
            sign = 1.0 - 2.0 * end
            com = table[shapes[i]].com
            x = (points[k, 0] - p_T[i, 0] - com[0] - com_offsets[i, 0]) / _MOMENT_ARM
            y = (points[k, 1] - p_T[i, 1] - com[1] - com_offsets[i, 1]) / _MOMENT_ARM
            z = (points[k, 2] - p_T[i, 2] - com[2]) / _MOMENT_ARM
            for side in range(sides):
                slants = sides > 1 and k >= len(loads)
                fx = friction * ((side == 0) - (side == 1)) if slants else 0.0
                fy = friction * ((side == 2) - (side == 3)) if slants else 0.0
                column = sides * k + side
                A[column, rows * i] = sign
                A[column, rows * i + 1] = sign * (y - z * fy)
                A[column, rows * i + 2] = sign * (z * fx - x)
                if sides > 1:
                    A[column, rows * i + 3] = sign * fx
                    A[column, rows * i + 4] = sign * fy
                    A[column, rows * i + 5] = sign * (x * fy - y * fx)
    residual = nnls(A, b, 1e-9)[1]
    norms = np.empty(n)
    for i in range(n):
        norm = np.sqrt((residual[rows * i : rows * i + rows] ** 2).sum())
        norms[i] = norm if norm > _RESIDUAL_TOLERANCE else 0.0
    return norms


@njit(cache=True)
def _contains(corners, count, p, x, y, margin):  # type: ignore[no-untyped-def]
    """Return whether a point is in a convex polygon, at least a margin from its sides.

    The polygon is translated by p.
    """
    for k in range(count):
        after = (k + 1) % count
        ex, ey = corners[after, 0] - corners[k, 0], corners[after, 1] - corners[k, 1]
        across = ex * (y - p[1] - corners[k, 1]) - ey * (x - p[0] - corners[k, 0])
        if across < margin * np.hypot(ex, ey):
            return False
    return count > 2


@njit(cache=True)
def balanced_positions(table, lower, upper, p_T, margin):  # type: ignore[no-untyped-def]
    """Return at which positions an object balances on another one alone.

    Args:
        table: Table of shapes, of type `SHAPE_DTYPE`. Shape (N,).
        lower: Row of the lower object's shape.
        upper: Row of the upper object's shape.
        p_T: Positions of the upper object relative to the lower one [m]. Shape (n, 3).
        margin: Width by which the contact is shrunk [m].

    Returns:
        Whether the center of mass is over the contact. Shape (n,).
    """
    balanced = np.zeros(len(p_T), np.bool_)
    com = table[upper].com
    for k in range(len(p_T)):
        polygon = contact_polygon(table, lower, upper, np.zeros(3), p_T[k], margin)
        x, y = p_T[k, 0] + com[0], p_T[k, 1] + com[1]
        balanced[k] = _contains(polygon, len(polygon), np.zeros(3), x, y, 0.0)
    return balanced


@njit(cache=True)
def _is_stable_tower(table, shapes, p_T, pairs, margin):  # type: ignore[no-untyped-def]
    """Return whether a stack stands in which each object has one contact below.

    Then the loads add up from the top. The result is also False if an object has several contacts
    below, lies on a cylinder, or touches another one that is not convex; these cases need the
    solver.
    """
    n = len(shapes)
    below = np.full(n, -2)
    for lower, upper in pairs:
        if below[upper] != -2 or (lower >= 0 and table[shapes[lower]].rolls):
            return False
        if lower >= 0 and (
            table[shapes[lower]].first_part != shapes[lower]
            or table[shapes[upper]].first_part != shapes[upper]
        ):
            return False
        below[upper] = lower
    force, moment = np.empty(n), np.empty((n, 2))  # of the object and all that it carries
    for i in range(n):
        force[i] = table[shapes[i]].mass
        for axis in range(2):
            moment[i, axis] = force[i] * (p_T[i, axis] + table[shapes[i]].com[axis])
    for i in np.argsort(p_T[:, 2])[::-1]:
        x, y = moment[i, 0] / force[i], moment[i, 1] / force[i]
        shape, lower = shapes[i], below[i]
        if not _contains(table[shape].bottom, table[shape].bottom_count, p_T[i], x, y, margin):
            return False
        if lower >= 0:
            carrier = shapes[lower]
            if not _contains(
                table[carrier].top, table[carrier].top_count, p_T[lower], x, y, margin
            ):
                return False
            force[lower] += force[i]
            moment[lower, 0] += moment[i, 0]
            moment[lower, 1] += moment[i, 1]
    return True


@njit(cache=True)
def least_stable_object(table, shapes, p_T, pairs, margin, friction):  # type: ignore[no-untyped-def]
    """Return the object farthest from equilibrium, or -1, and whether it rolls.

    Vertical forces are tried first, then forces with friction, which hold for example an arch of
    two boxes that lean on a bridge. Contacts are shrunk by the margin. The line on which a cylinder
    carries has no width to shrink; instead, the object on it must also balance with its center of
    mass moved by the margin to either side of the line.

    Args:
        table: Table of shapes, of type `SHAPE_DTYPE`. Shape (N,).
        shapes: Row of each object's shape in the table. Shape (n,).
        p_T: Origins of the objects in T [m]. Shape (n, 3).
        pairs: Lower (or `GROUND`) and upper object of each contact. Shape (c, 2).
        margin: Width by which contacts are shrunk [m].
        friction: Coefficient of friction.
    """
    if _is_stable_tower(table, shapes, p_T, pairs, margin):
        return -1, False
    n = len(shapes)
    margins = np.full(n, margin)
    com_offsets = np.zeros((n, 2))
    residual = equilibrium_residuals(table, shapes, p_T, pairs, margins, com_offsets, 0.0, NO_LOADS)
    needed_friction = 0.0
    if residual.max() > 0:
        needed_friction = friction
        with_friction = equilibrium_residuals(
            table, shapes, p_T, pairs, margins, com_offsets, friction, NO_LOADS
        )
        if with_friction.max() > 0:
            # The tolerance makes the first of identical objects the result, despite rounding.
            largest = np.nonzero(residual > residual.max() - 1e-9)[0]
            return largest[0], False
    rolling = find_rolling_object(table, shapes, p_T, pairs, margins, margin, needed_friction)
    return rolling, rolling >= 0


@njit(cache=True)
def find_rolling_object(table, shapes, p_T, pairs, margins, offset, friction):  # type: ignore[no-untyped-def]
    """Return an object that is balanced on the line of a lying cylinder, or -1.

    It does not balance with its center of mass moved to either side of the line.

    Args:
        table: Table of shapes, of type `SHAPE_DTYPE`. Shape (N,).
        shapes: Row of each object's shape in the table. Shape (n,).
        p_T: Origins of the objects in T [m]. Shape (n, 3).
        pairs: Lower (or `GROUND`) and upper object of each contact. Shape (c, 2).
        margins: Width by which the contacts below each object are shrunk [m]. Shape (n,).
        offset: Distance by which the center of mass is moved [m].
        friction: Coefficient of friction; 0 for vertical forces only.
    """
    com_offsets = np.zeros((len(shapes), 2))
    for lower, upper in pairs:
        if lower >= 0 and table[shapes[lower]].rolls:
            line = table[shapes[lower]].top[1] - table[shapes[lower]].top[0]
            for sign in (-1.0, 1.0):
                com_offsets[upper, 0] = -sign * offset * line[1] / np.hypot(line[0], line[1])
                com_offsets[upper, 1] = sign * offset * line[0] / np.hypot(line[0], line[1])
                residual = equilibrium_residuals(
                    table, shapes, p_T, pairs, margins, com_offsets, friction, NO_LOADS
                )
                if residual.max() > 0:
                    return upper
            com_offsets[upper] = 0.0
    return -1


@njit(cache=True)
def canonical_order(shapes, p_T, stack, grid):  # type: ignore[no-untyped-def]
    """Return a description of stacks that is independent of their positions.

    Args:
        shapes: Row of each object's shape in the table. Shape (n,).
        p_T: Origins of the objects in T [m]. Shape (n, 3).
        stack: Number of each object's stack; objects of stack -1 are left out. Shape (n,).
        grid: Positions are rounded to multiples of this [m].

    Returns:
        The m objects by stack, then by height, shape, x and y, shape (m,); the index at which each
        of the k stacks begins in that order, and the end, shape (k + 1,); and, in the same order,
        shape, x, y relative to the stack's first object and z, the positions in multiples of the
        grid, shape (m, 4).
    """
    n = len(shapes)
    order = np.empty(n, np.int64)
    count = 0
    key = np.empty((n, 5), np.int64)
    for i in range(n):
        if stack[i] < 0:
            continue
        key[i, 0] = stack[i]
        key[i, 1] = np.rint(p_T[i, 2] / grid)
        key[i, 2] = shapes[i]
        key[i, 3] = np.rint(p_T[i, 0] / grid)
        key[i, 4] = np.rint(p_T[i, 1] / grid)
        at = count  # insertion sort
        while at > 0:
            before = order[at - 1]
            column = 0
            while column < 4 and key[before, column] == key[i, column]:
                column += 1
            if key[before, column] <= key[i, column]:
                break
            order[at] = before
            at -= 1
        order[at] = i
        count += 1
    description = np.empty((count, 4), np.int64)
    first = np.empty(count + 1, np.int64)
    stacks = 0
    for k in range(count):
        i = order[k]
        if k == 0 or stack[i] != stack[order[k - 1]]:
            first[stacks] = k
            stacks += 1
        base = order[first[stacks - 1]]
        description[k, 0] = shapes[i]
        description[k, 1] = key[i, 3] - key[base, 3]
        description[k, 2] = key[i, 4] - key[base, 4]
        description[k, 3] = key[i, 1]
    first[stacks] = count
    return order[:count], first[: stacks + 1], description


@njit(cache=True)
def least_stable_objects(table, shapes, p_T, pairs, order, first, selected, margin, friction):  # type: ignore[no-untyped-def]
    """Return the results of `least_stable_object` for several stacks.

    Args:
        table: Table of shapes, of type `SHAPE_DTYPE`. Shape (N,).
        shapes: Row of each object's shape in the table. Shape (n,).
        p_T: Origins of the objects in T [m]. Shape (n, 3).
        pairs: Lower (or `GROUND`) and upper object of each contact. Shape (c, 2).
        order: Objects by stack, see `canonical_order`. Shape (m,).
        first: Index in `order` at which each stack begins, and the end. Shape (s + 1,).
        selected: Numbers of the stacks to solve. Shape (k,).
        margin: Width by which contacts are shrunk [m].
        friction: Coefficient of friction.

    Returns:
        Position in its stack of the object farthest from equilibrium, or -1, and whether it rolls.
        Shape (k, 2).
    """
    results = np.empty((len(selected), 2), np.int64)
    for k in range(len(selected)):
        rows = order[first[selected[k]] : first[selected[k] + 1]]
        position = np.full(len(shapes) + 1, -2)
        position[GROUND] = GROUND
        for own, row in enumerate(rows):
            position[row] = own
        within = np.empty_like(pairs)
        contacts = 0
        for lower, upper in pairs:
            if position[lower] != -2 and position[upper] != -2:
                within[contacts, 0], within[contacts, 1] = position[lower], position[upper]
                contacts += 1
        results[k, 0], results[k, 1] = least_stable_object(
            table, shapes[rows], p_T[rows], within[:contacts], margin, friction
        )
    return results
