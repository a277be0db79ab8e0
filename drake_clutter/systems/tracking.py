"""Which object of an image is which of those known: the same object seen again is the same object, and a lost one is noticed."""

from collections.abc import Sequence
from dataclasses import replace
from itertools import count
from typing import NamedTuple

import numpy as np
from scipy.optimize import linear_sum_assignment

from drake_clutter.perception.pose_selection import evaluate_pose
from drake_clutter.scenes.geometry import penetration_depth
from drake_clutter.scenes.interfaces import Detection, Move, Observation
from drake_clutter.scenes.scene import TRAY, SceneObject
from drake_clutter.station.body_sleep import nearest_object
from drake_clutter.tasks.belief import Decision

GATING_DISTANCE = 0.04
"""m; an object that is seen so near to where one of its class is known to be is that one."""
MAX_SEE_THROUGH_FRACTION = 0.3
"""Of the pixels in which a known object should be seen, the share in which the camera sees past it if it is no longer there."""
REASSIGNED_FRACTION = 0.5
"""Of the pixels in which it seems to be in view, the share that is recognised as something else if it never was there."""

DUPLICATE_OVERLAP = 0.9
"""Of the pixels of a detection, the share in known objects that were not recognised, if it explains nothing that they do not."""
EVIDENCE_RATIO = 1.1
"""What a known object explains, over what a detection does that takes most of its pixels from it, if that is no better."""
MAX_PENETRATION = 0.015
"""m; what is known but out of view, and is deeper in something that is seen, cannot be there."""
SUPPORT_FRACTION = 0.97
"""Of the pixels that speak for or against a known object, the share that speaks for it if it is still where it was."""


class AssociationResult(NamedTuple):
    """An image, told in the names of what is known.

    Attributes:
        observation: its detections bear the names of the known objects that they are, or new ones.
        lost: names of known objects that are no longer where they were, or never were, and are not in view elsewhere.
    """

    observation: Observation
    lost: tuple[str, ...]


def associate_detections(
    known: Sequence[SceneObject], observation: Observation
) -> AssociationResult:
    """Gives the detections of an image names that last.

    Objects of a class are matched with the least sum of distances. What is far from all that is known of its class is an object
    that has been moved, if one is gone from its place, and else one that has never been seen.

    Args:
        known: K_t, each object where it was seen last, or where a move was to put it.
        observation: whose detections' names mean nothing.
    """
    observation = _restore_missed_objects(known, observation)
    named: dict[str, Detection] = {}
    lost = list[str]()
    classes = [o.object_class for o in known] + [d.object_class for d in observation.detections]
    for object_class in dict.fromkeys(classes):
        of_class = [o for o in known if o.object_class is object_class]
        seen = [d for d in observation.detections if d.object_class is object_class]
        pairs = _assign(of_class, seen, GATING_DISTANCE)
        left = [o for k, o in enumerate(of_class) if k not in pairs and _is_gone(o, observation)]
        unnamed = [d for k, d in enumerate(seen) if k not in pairs.values()]
        named |= {of_class[k].name: seen[d] for k, d in pairs.items()}
        moved = _assign(left, unnamed, np.inf)
        named |= {left[k].name: unnamed[d] for k, d in moved.items()}
        lost += [o.name for k, o in enumerate(left) if k not in moved]
        taken = {o.name for o in of_class}
        free = (
            name for number in count(1) if (name := f"{object_class.name}_{number}") not in taken
        )
        named |= {
            next(free): detection for k, detection in enumerate(unnamed) if k not in moved.values()
        }
    detections = tuple(replace(detection, name=name) for name, detection in named.items())
    there = [SceneObject(d.name, d.object_class, d.X_TO) for d in detections]
    unseen = (o for o in known if o.name not in named and o.name not in lost)
    lost += [
        o.name
        for o in unseen
        if any(penetration_depth(o, other) > MAX_PENETRATION for other in there)
    ]
    return AssociationResult(replace(observation, detections=detections), tuple(lost))


def _restore_missed_objects(known: Sequence[SceneObject], observation: Observation) -> Observation:
    """An image with the known objects that are still where they were, also those that were not recognised in it.

    A detector in doubt may say one thing now and another then: two boxes side by side may be two that lie across them. What is
    known stands as long as the depth is as it should be there, and no detection is sure of something else or explains more.
    """
    recognised_now, familiar = set[str](), set[str]()
    for object_class in {o.object_class for o in known}:
        of_class = [o for o in known if o.object_class is object_class]
        seen = [d for d in observation.detections if d.object_class is object_class]
        for k, d in _assign(of_class, seen, GATING_DISTANCE).items():
            recognised_now.add(of_class[k].name)
            familiar.add(seen[d].name)
    shape = observation.depth.shape
    still = dict[str, Detection]()
    for o in known:
        if o.name in recognised_now:
            continue
        e = evaluate_pose(o.object_class, o.X_TO, observation.depth, observation.camera)
        for_it = np.count_nonzero(e.consistent)
        if for_it >= max(
            1, observation.camera.visibility_threshold * e.unoccluded_pixels
        ) and for_it >= SUPPORT_FRACTION * (for_it + e.free_space_violations):
            still[o.name] = Detection(o.name, o.object_class, o.X_TO, e.mask(shape))
    explained = np.any([np.zeros(shape, bool), *(d.mask for d in still.values())], axis=0)

    def no_better(detection: Detection) -> bool:
        size = np.count_nonzero(detection.mask)
        within = (
            np.count_nonzero(d.mask & detection.mask)
            for d in still.values()
            if np.count_nonzero(d.mask) > EVIDENCE_RATIO * size
        )
        return bool(size) and (
            explained[detection.mask].mean() >= DUPLICATE_OVERLAP
            or any(n > REASSIGNED_FRACTION * size for n in within)
        )

    kept = [
        d
        for d in observation.detections
        if d.name in familiar or d.is_confident or not no_better(d)
    ]
    taken = np.any([np.zeros(shape, bool), *(d.mask for d in kept)], axis=0)
    steady = (d for d in still.values() if taken[d.mask].mean() <= REASSIGNED_FRACTION)
    return replace(
        observation, detections=(*kept, *(replace(d, mask=d.mask & ~taken) for d in steady))
    )


def match_to_ground_truth(
    known: Sequence[SceneObject], objects: Sequence[SceneObject]
) -> tuple[str, ...]:
    """The names of those objects that are among the known: each is one of its class, not far from where it is known to be."""
    found = set[str]()
    for name in {o.object_class.name for o in known}:
        there = [o for o in objects if o.object_class.name == name]
        pairs = _assign([o for o in known if o.object_class.name == name], there, GATING_DISTANCE)
        found |= {there[k].name for k in pairs.values()}
    return tuple(o.name for o in objects if o.name in found)


def to_ground_truth_names(
    decision: Decision,
    known: Sequence[SceneObject],
    observation: Observation,
    objects: Sequence[SceneObject],
) -> Decision:
    """Return a decision in the names of what is really there.

    Args:
        decision: In the names of K_t; its move is not None.
        known: K_t when it was made; each object is the true one nearest to its place.
        observation: When it was made; it is kept in the decision.
        objects: The true ones.
    """
    assert decision.move is not None
    name = {TRAY: TRAY} | {o.name: nearest_object(objects, o.X_TO).name for o in known}
    return Decision(
        Move(name[decision.move.pick], name[decision.move.place]),
        {name[pick]: chance for pick, chance in decision.pick_probabilities.items()},
        tuple(name[known] for known in decision.considered),
        observation,
    )


def _assign(
    known: Sequence[SceneObject], seen: Sequence[SceneObject | Detection], within: float
) -> dict[int, int]:
    """Indices of the seen by those of the known, no further apart than `within`, m."""
    if not known or not seen:
        return {}
    apart = np.array([[np.linalg.norm(o.X_TO.p - d.X_TO.p) for d in seen] for o in known])
    cost = np.minimum(apart, min(within, 10.0))  # further away is no match, however far
    rows, columns = linear_sum_assignment(cost)
    return {int(k): int(d) for k, d in zip(rows, columns, strict=True) if apart[k, d] <= within}


def _is_gone(known: SceneObject, observation: Observation) -> bool:
    """Whether an object that was not recognised is not where it was: the camera sees past it, or sees something else there."""
    e = evaluate_pose(known.object_class, known.X_TO, observation.depth, observation.camera)
    as_expected = np.count_nonzero(e.consistent)
    if e.free_space_violations > MAX_SEE_THROUGH_FRACTION * (e.free_space_violations + as_expected):
        return True
    others = np.zeros(observation.depth.shape, bool)
    for detection in observation.detections:
        others |= detection.mask
    taken = np.count_nonzero(e.consistent & others[e.window])
    return bool(
        taken > REASSIGNED_FRACTION * as_expected
        and as_expected >= observation.camera.visibility_threshold * e.unoccluded_pixels
    )
