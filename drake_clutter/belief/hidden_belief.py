"""Probability that something is hidden, from the supports of known objects and unseen space.

What stands on nothing known stands on something hidden. What carries nothing known may be hidden
where the camera sees nothing, if it fits in there.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drake_clutter.belief.hidden_space import (
    HiddenArea,
    HiddenFit,
    find_fits,
    find_hidden_columns,
    hidden_area,
)
from drake_clutter.belief.known_supports import (
    HEIGHT_TOLERANCE,
    SupportState,
    can_fill,
    find_support_states,
    stack_heights,
)
from drake_clutter.catalog import ObjectClass
from drake_clutter.config import BeliefConfig
from drake_clutter.scenes.free_space import Grid
from drake_clutter.scenes.interfaces import Observation
from drake_clutter.scenes.occlusion import count_unidentified_points
from drake_clutter.scenes.scene import SceneObject


@dataclass(frozen=True)
class HiddenSupport:
    """Something hidden that carries a known object, or may carry it.

    Without a class that fits, no hidden object carries it, but a pose of the belief is wrong.

    Attributes:
        carried: Name of the known object.
        is_certain: Whether known objects do not carry it, whatever the doubt of the poses.
        gap: Height between the object and the highest known surface below it [m].
        classes: Names of the classes of which an object fits below it, alone or on others.
    """

    carried: str
    is_certain: bool
    gap: float
    classes: tuple[str, ...]


@dataclass(frozen=True)
class HiddenBelief:
    """What unseen space may hold.

    Attributes:
        nothing_left: Probability that every object is known.
        supports: What carries known objects.
        num_unidentified_points: Number of depth points that belong to no known object.
        areas: Area in which an object of each class would stand on the floor unseen, by class name.
    """

    nothing_left: float
    supports: tuple[HiddenSupport, ...] = ()
    num_unidentified_points: int = 0
    areas: Mapping[str, HiddenArea] = field(default_factory=dict)

    def to_dict(self) -> dict[str, Any]:
        """Return the belief as a document, see `docs/reference/episode_file.md`."""
        return {
            "nothing_left": self.nothing_left,
            "supports": [
                {**asdict(support), "classes": list(support.classes)} for support in self.supports
            ],
            "unidentified_points": self.num_unidentified_points,
            "areas": {name: sum(area) for name, area in self.areas.items()},
        }


def estimate_hidden(
    known: Sequence[SceneObject],
    observation: Observation,
    empty_depth: NDArray[np.float32],
    classes: Sequence[ObjectClass],
    config: BeliefConfig,
) -> HiddenBelief:
    """Return what unseen space may hold.

    Args:
        known: Known objects (K_t), at their current poses.
        observation: Latest observation.
        empty_depth: Depth image of the cell without objects [m]. Shape (H, W).
        classes: Classes of the objects that there may be.
        config: Doubt of the poses, and how often something is hidden.
    """
    columns = find_hidden_columns(known, observation)
    fits = {c: find_fits(c, columns) for c in classes}
    areas = {c.name: hidden_area(fits[c], columns) for c in classes}
    num_points = count_unidentified_points(known, observation, empty_depth)
    states = find_support_states(known, config.contact_doubt)
    partly_seen = {}
    if any(state is not SupportState.CARRIED for state in states.values()):
        # What carries an object may be in sight, as long as the camera's threshold hides it.
        unseen = 1 - observation.camera.visibility_threshold
        partly_seen = {c: find_fits(c, columns, unseen) for c in classes}
    supports = tuple(
        HiddenSupport(
            o.name,
            states[o.name] is SupportState.UNCARRIED,
            _gap_below(o, known),
            _supporting_classes(o, known, partly_seen, Grid.over(observation.support)),
        )
        for o in known
        if states[o.name] is not SupportState.CARRIED
    )
    covered = float(np.mean([area.covered for area in areas.values()]))
    shadow = float(np.mean([area.shadow for area in areas.values()]))
    nothing_left = math.exp(-config.covered_rate * covered - config.shadow_rate * shadow)
    for support in supports:
        if (
            not support.classes
        ):  # Nothing fits: the pose of the object or of what carries it is wrong.
            continue
        nothing_left *= 1 - (
            config.uncarried_probability if support.is_certain else config.doubtful_probability
        )
    if num_points:
        nothing_left *= 1 - config.unidentified_probability
    return HiddenBelief(nothing_left, supports, num_points, areas)


def _surfaces_below(carried: SceneObject, known: Sequence[SceneObject]) -> list[float]:
    """Return the heights of the floor and of known objects below an object, ascending [m]."""
    lower, upper = carried.bounds_T
    heights = [0.0]
    for o in known:
        overlap = np.minimum(upper, o.bounds_T[1]) - np.maximum(lower, o.bounds_T[0])
        if o is not carried and overlap[:2].min() > 0 and o.top_height < lower[2]:
            heights.append(o.top_height)
    return sorted(heights)


def _gap_below(carried: SceneObject, known: Sequence[SceneObject]) -> float:
    """Return the height between an object and the highest known surface below it [m]."""
    return float(carried.bounds_T[0][2]) - _surfaces_below(carried, known)[-1]


def _supporting_classes(
    carried: SceneObject,
    known: Sequence[SceneObject],
    fits: Mapping[ObjectClass, Sequence[HiddenFit]],
    grid: Grid,
) -> tuple[str, ...]:
    """Return the names of the classes of which an object can be right below an object.

    It stands on the floor, where it must fit, or in a stack on the floor or on a known object.

    Args:
        carried: The object that is carried.
        known: Known objects.
        fits: Where an object of each class would stand on the floor, hardly seen.
        grid: Grid of the cells.
    """
    lower, upper = carried.bounds_T
    stacks = stack_heights(list(fits), float(lower[2]) + HEIGHT_TOLERANCE)
    surfaces = _surfaces_below(carried, known)
    names = []
    for object_class, poses in fits.items():
        reach = float(np.linalg.norm(object_class.size)) / 2
        near_x = (grid.x > lower[0] - reach) & (grid.x < upper[0] + reach)
        near_y = (grid.y > lower[1] - reach) & (grid.y < upper[1] + reach)
        for pose in poses:
            gaps = [float(lower[2]) - z - pose.height for z in surfaces]
            stands_alone = abs(gaps[0]) < HEIGHT_TOLERANCE and pose.cells[near_x][:, near_y].any()
            is_on_known = any(abs(gap) < HEIGHT_TOLERANCE for gap in gaps[1:])
            if stands_alone or is_on_known or any(can_fill(gap, stacks) for gap in gaps):
                names.append(object_class.name)
                break
    return tuple(names)
