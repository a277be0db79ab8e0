"""Known objects that nothing known carries: something hidden must carry them."""

from collections.abc import Sequence
from enum import Enum

import numpy as np
from numpy.typing import NDArray

from drake_clutter.catalog import ObjectClass, RestOrientation
from drake_clutter.grammar.orientation import Orientation, resting_rotation
from drake_clutter.scenes.scene import SceneObject
from drake_clutter.stability.contacts import GROUND
from drake_clutter.stability.equilibrium import NO_LOADS, equilibrium_residuals
from drake_clutter.stability.load_check import known_contacts
from drake_clutter.stability.shape_table import ShapeTable

HEIGHT_TOLERANCE = 0.004
"""Largest difference of a gap's height and a stack's height that fills it [m].

It is the gap up to which `known_contacts` takes faces for touching.
"""
_SHAPES = ShapeTable()
REST_ORIENTATIONS = {
    RestOrientation.FLAT: Orientation.FLAT_0,
    RestOrientation.SIDE: Orientation.SIDE_0,
    RestOrientation.UPRIGHT: Orientation.UPRIGHT_0,
}


class SupportState(Enum):
    """How an object is carried.

    Attributes:
        CARRIED: Known objects and the floor carry it, even with less contact than believed.
        DOUBTFUL: It depends on the doubt of the poses whether known objects carry it.
        UNCARRIED: Known objects do not carry it, even with more contact than believed.
    """

    CARRIED = "carried"
    DOUBTFUL = "doubtful"
    UNCARRIED = "uncarried"


def find_support_states(
    objects: Sequence[SceneObject], position_doubt: float
) -> dict[str, SupportState]:
    """Return how each known object is carried, by name.

    Args:
        objects: Known objects.
        position_doubt: Width by which contacts may be larger or smaller than they seem [m].
    """
    certain = _uncarried(objects, -position_doubt)
    possible = _uncarried(objects, position_doubt) | certain
    return {
        o.name: SupportState.UNCARRIED
        if o.name in certain
        else SupportState.DOUBTFUL
        if o.name in possible
        else SupportState.CARRIED
        for o in objects
    }


def _uncarried(objects: Sequence[SceneObject], margin: float) -> set[str]:
    """Return the names of objects that hidden ones must carry.

    An object without a contact below is one of them. Of those that known contacts do not balance,
    the object farthest from equilibrium is one, until all others are balanced with the help of
    what carries it.

    Args:
        objects: Known objects.
        margin: Width by which contacts are shrunk [m].
    """
    if not objects:
        return set()
    rows, p_T = _SHAPES.rows_and_positions(objects)
    table = _SHAPES.arrays.table
    pairs = [tuple(pair) for pair in known_contacts(table, rows, p_T).tolist()]
    uppers = {upper for _, upper in pairs}
    # An object that leans touches others on edges, which the contacts do not cover.
    leaning = {k for k, row in enumerate(rows) if table[row]["bottom_count"] == 0}
    held = {k for k in range(len(objects)) if k not in uppers}
    pairs += [(GROUND, k) for k in held - leaning]
    for group in _connected(len(objects), pairs):
        members = [k for k in group if k not in leaning]
        while members:
            number = {k: n for n, k in enumerate(members)} | {GROUND: GROUND}
            within = [(number[a], number[b]) for a, b in pairs if b in number and a in number]
            residuals = equilibrium_residuals(
                table,
                rows[members],
                p_T[members],
                np.array(within, np.int64).reshape(-1, 2),
                np.full(len(members), margin),
                np.zeros((len(members), 2)),
                0.0,
                NO_LOADS,
            )
            worst = members[int(residuals.argmax())]
            if residuals.max() == 0 or worst in held:
                break
            held.add(worst)
            pairs.append((GROUND, worst))
    return {objects[k].name for k in held}


def _connected(count: int, pairs: Sequence[tuple[int, ...]]) -> list[list[int]]:
    """Return the groups of objects that contacts connect; the ground connects none."""
    group = list(range(count))
    for a, b in pairs:
        if a != GROUND:
            group = [group[a] if g == group[b] else g for g in group]
    return [[k for k in range(count) if group[k] == g] for g in dict.fromkeys(group)]


def resting_heights(object_class: ObjectClass) -> dict[RestOrientation, float]:
    """Return the height of a class in each orientation at rest that differs from others [m]."""
    heights: dict[RestOrientation, float] = {}
    for rest, orientation in REST_ORIENTATIONS.items():
        z = object_class.corners @ resting_rotation(object_class, orientation)[2]
        height = round(float(np.ptp(z)), 6)
        if height not in heights.values():
            heights[rest] = height
    return heights


def stack_heights(classes: Sequence[ObjectClass], highest: float) -> NDArray[np.bool_]:
    """Return which heights a stack of at least one object may have.

    Args:
        classes: Classes of the objects that there may be.
        highest: Largest height [m].

    Returns:
        Whether there is a stack of each whole number of millimeters. Shape (n,).
    """
    steps = {round(1000 * h) for c in classes for h in resting_heights(c).values()}
    is_reachable = np.zeros(max(round(1000 * highest), 0) + 1, bool)
    is_reachable[0] = True
    for height in range(1, len(is_reachable)):
        is_reachable[height] = any(
            step <= height and is_reachable[height - step] for step in steps if step > 0
        )
    is_reachable[0] = False
    return is_reachable


def can_fill(gap: float, stacks: NDArray[np.bool_]) -> bool:
    """Return whether a stack fills a gap within the tolerance.

    Args:
        gap: Height of the gap [m].
        stacks: See `stack_heights`.
    """
    low, high = (round(1000 * (gap + t)) for t in (-HEIGHT_TOLERANCE, HEIGHT_TOLERANCE))
    return high >= 0 and bool(stacks[max(low, 0) : high + 1].any())
