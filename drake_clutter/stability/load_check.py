"""Whether known objects carry a further one, with a margin for what is not known of them."""

import numpy as np

from drake_clutter.compilation import njit
from drake_clutter.stability.contacts import GROUND, MAX_CONTACT_GAP, contact_polygon
from drake_clutter.stability.equilibrium import (
    NO_LOADS,
    equilibrium_residuals,
    find_rolling_object,
)

_MAX_HEIGHT_ERROR = 2 * MAX_CONTACT_GAP
"""Known faces whose heights differ by less than this are in contact [m].

It is larger than for exact poses, since heights of detected objects are wrong by a millimeter or
two.
"""


@njit(cache=True)
def known_contacts(table, shapes, p_T):  # type: ignore[no-untyped-def]
    """Return the contacts between objects of which some are not known.

    Args:
        table: Table of shapes, of type `SHAPE_DTYPE`. Shape (N,).
        shapes: Row of each object's shape in the table. Shape (n,).
        p_T: Origins of the objects in T [m]. Shape (n, 3).

    Returns:
        Lower (or `GROUND`) and upper object of each contact. Shape (c, 2).
    """
    n = len(shapes)
    pairs = np.empty((n * n, 2), np.int64)
    count = 0
    for j in range(n):
        upper = table[shapes[j]]
        if upper.bottom_count == 0:
            continue
        bottom_z = p_T[j, 2] + upper.bottom_z
        if bottom_z < _MAX_HEIGHT_ERROR:
            pairs[count, 0], pairs[count, 1] = GROUND, j
            count += 1
            continue
        for i in range(n):
            lower = table[shapes[i]]
            if (
                i == j
                or min(lower.bottom_count, lower.top_count) == 0
                or np.hypot(p_T[i, 0] - p_T[j, 0], p_T[i, 1] - p_T[j, 1])
                >= lower.footprint_radius + upper.footprint_radius
            ):
                continue
            # Of pieces, `contact_polygon` compares the heights.
            has_pieces = lower.first_part != shapes[i] or upper.first_part != shapes[j]
            if not has_pieces and abs(bottom_z - p_T[i, 2] - lower.top_z) >= _MAX_HEIGHT_ERROR:
                continue
            if len(contact_polygon(table, shapes[i], shapes[j], p_T[i], p_T[j], 0.0)) > 0:
                pairs[count, 0], pairs[count, 1] = i, j
                count += 1
    return pairs[:count]


@njit(cache=True)
def _distance_to_side(shape):  # type: ignore[no-untyped-def]
    """Return the distance of the center of mass from the nearest side of the bottom [m].

    It is negative if the center of mass is not above the bottom.
    """
    distance = np.inf
    for k in range(shape.bottom_count):
        after = (k + 1) % shape.bottom_count
        ex = shape.bottom[after, 0] - shape.bottom[k, 0]
        ey = shape.bottom[after, 1] - shape.bottom[k, 1]
        x, y = shape.com[0] - shape.bottom[k, 0], shape.com[1] - shape.bottom[k, 1]
        distance = min(distance, (ex * y - ey * x) / np.hypot(ex, ey))
    return distance


@njit(cache=True)
def collect_stack(table, shapes, p_T, pairs, carrier, margin, hidden_fraction):  # type: ignore[no-untyped-def]
    """Return the stack of a carrier, for `is_carried`.

    Where known contacts do not hold an object, something hidden carries it. Its weight and load are
    then known to be carried only near its center of mass.

    Args:
        table: Table of shapes, of type `SHAPE_DTYPE`. Shape (N,).
        shapes: Row of each known object's shape in the table. Shape (n,).
        p_T: Origins of the objects in T [m]. Shape (n, 3).
        pairs: Known contacts, see `known_contacts`. Shape (c, 2).
        carrier: Index of the object that is to carry.
        margin: Width by which contacts are shrunk [m].
        hidden_fraction: Part of an object's bottom, about its center of mass, on which hidden
            objects carry it.

    Returns:
        Rows of the shapes, that of the carrier first, and one more for what is placed on it, shape
        (m,); origins [m], shape (m, 3); contacts, shape (k, 2); and margins [m], shape (m,).
    """
    n = len(shapes)
    number = np.full(n + 1, -2)
    number[GROUND] = GROUND
    number[carrier] = 0
    grew = True
    count = 1
    while grew:
        grew = False
        for lower, upper in pairs:
            if lower >= 0 and (number[lower] == -2) != (number[upper] == -2):
                added = lower if number[lower] == -2 else upper
                number[added] = count
                count += 1
                grew = True
    stack_shapes = np.empty(count + 1, np.int64)
    stack_p_T = np.zeros((count + 1, 3))
    for k in range(n):
        if number[k] >= 0:
            stack_shapes[number[k]] = shapes[k]
            stack_p_T[number[k]] = p_T[k]
    stack_pairs = np.empty((len(pairs) + count + 1, 2), np.int64)
    num_pairs = 0
    for lower, upper in pairs:
        if number[upper] >= 0:
            stack_pairs[num_pairs, 0], stack_pairs[num_pairs, 1] = number[lower], number[upper]
            num_pairs += 1
    margins = np.full(count + 1, margin)
    residuals = equilibrium_residuals(
        table,
        stack_shapes[:count],
        stack_p_T[:count],
        stack_pairs[:num_pairs],
        np.zeros(count),
        np.zeros((count, 2)),
        0.0,
        NO_LOADS,
    )
    for k in range(count):
        if residuals[k] > 0:
            stack_pairs[num_pairs, 0], stack_pairs[num_pairs, 1] = GROUND, k
            num_pairs += 1
            inner = (1.0 - hidden_fraction) * _distance_to_side(table[stack_shapes[k]])
            margins[k] = max(margin, inner)
    stack_pairs[num_pairs, 0], stack_pairs[num_pairs, 1] = 0, count
    return stack_shapes, stack_p_T, stack_pairs[: num_pairs + 1], margins


@njit(cache=True)
def is_carried(table, stack, margin, placed_shape, p_placed):  # type: ignore[no-untyped-def]
    """Return whether a stack with a further object is in equilibrium under vertical forces.

    An object that is balanced on the line of a lying cylinder is not.

    Args:
        table: Table of shapes, of type `SHAPE_DTYPE`. Shape (N,).
        stack: See `collect_stack`; its last object is replaced.
        margin: See `collect_stack` [m].
        placed_shape: Row of the shape of the further object, which is put on the carrier.
        p_placed: Its origin in T [m]. Shape (3,).
    """
    shapes, p_T, pairs, margins = stack
    last = len(shapes) - 1
    shapes[last] = placed_shape
    p_T[last] = p_placed
    offsets = np.zeros((len(shapes), 2))
    residuals = equilibrium_residuals(table, shapes, p_T, pairs, margins, offsets, 0.0, NO_LOADS)
    if residuals.max() > 0:
        return False
    return find_rolling_object(table, shapes, p_T, pairs, margins, margin, 0.0) < 0
