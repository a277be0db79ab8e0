"""Data association of detections with known objects.

Detections get the names of known objects, and known objects that are gone are reported.
"""

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
"""Largest distance of a detection from the known object that it is associated with [m]."""
MAX_SEE_THROUGH_FRACTION = 0.3
"""Fraction of free-space violations among an object's conclusive pixels from which it is gone."""
REASSIGNED_FRACTION = 0.5
"""Fraction of an object's pixels that belong to other detections from which it is replaced."""
DUPLICATE_OVERLAP = 0.9
"""Fraction of a detection's pixels that missed objects explain from which it is a duplicate."""
EVIDENCE_RATIO = 1.1
"""How many times the pixels of a detection a missed object must explain to replace it."""
MAX_PENETRATION = 0.015
"""Largest penetration of detections by an object out of view, which otherwise is lost [m]."""
SUPPORT_FRACTION = 0.97
"""Fraction of a missed object's conclusive pixels that must be consistent with its pose."""


class AssociationResult(NamedTuple):
    """Detections associated with known objects.

    Attributes:
        observation: The observation. Its detections have the names of known objects, or new ones.
        lost: Names of known objects that are not at their poses and not detected elsewhere.
    """

    observation: Observation
    lost: tuple[str, ...]


def associate_detections(
    known: Sequence[SceneObject], observation: Observation
) -> AssociationResult:
    """Associate the detections of an image with known objects (a `Tracker`).

    Detections and objects of a class are assigned by the smallest sum of distances. A detection
    beyond the gating distance is an object that was moved, if one is no longer at its pose, and a
    new object otherwise.

    Args:
        known: Objects seen so far (K_t), each at its last known pose.
        observation: The observation, with names of detections that are arbitrary.
    """
    observation = _restore_missed_objects(known, observation)
    named: dict[str, Detection] = {}
    lost = list[str]()
    classes = [o.object_class for o in known] + [d.object_class for d in observation.detections]
    for object_class in dict.fromkeys(classes):
        objects = [o for o in known if o.object_class is object_class]
        detections = [d for d in observation.detections if d.object_class is object_class]
        pairs = _assign(objects, detections, GATING_DISTANCE)
        named |= {objects[k].name: detections[d] for k, d in pairs.items()}
        gone = [o for k, o in enumerate(objects) if k not in pairs and _is_gone(o, observation)]
        unassigned = [d for k, d in enumerate(detections) if k not in pairs.values()]
        moved = _assign(gone, unassigned, np.inf)
        named |= {gone[k].name: unassigned[d] for k, d in moved.items()}
        lost += [o.name for k, o in enumerate(gone) if k not in moved]
        used_names = {o.name for o in objects}
        numbered_names = (f"{object_class.name}_{number}" for number in count(1))
        new_names = (name for name in numbered_names if name not in used_names)
        new = [d for k, d in enumerate(unassigned) if k not in moved.values()]
        named |= {next(new_names): detection for detection in new}
    renamed = tuple(replace(detection, name=name) for name, detection in named.items())
    visible = [SceneObject(d.name, d.object_class, d.X_TO) for d in renamed]
    out_of_view = (o for o in known if o.name not in named and o.name not in lost)
    lost += [
        o.name
        for o in out_of_view
        if any(penetration_depth(o, other) > MAX_PENETRATION for other in visible)
    ]
    return AssociationResult(replace(observation, detections=renamed), tuple(lost))


def _restore_missed_objects(known: Sequence[SceneObject], observation: Observation) -> Observation:
    """Add known objects that the detector missed although the depth image confirms their poses.

    An uncertain detector may change its interpretation from image to image, for example of two
    boxes side by side as two boxes across them. The known interpretation is kept, and conflicting
    detections are removed, unless a detection is confident or explains more pixels.
    """
    detected_objects = set[str]()
    associated_detections = set[str]()
    for object_class in {o.object_class for o in known}:
        objects = [o for o in known if o.object_class is object_class]
        detections = [d for d in observation.detections if d.object_class is object_class]
        for k, d in _assign(objects, detections, GATING_DISTANCE).items():
            detected_objects.add(objects[k].name)
            associated_detections.add(detections[d].name)
    shape = observation.depth.shape
    missed = dict[str, Detection]()
    for o in known:
        if o.name in detected_objects:
            continue
        e = evaluate_pose(o.object_class, o.X_TO, observation.depth, observation.camera)
        num_consistent = np.count_nonzero(e.consistent)
        num_conclusive = num_consistent + e.num_free_space_violations
        min_consistent = max(1, observation.camera.visibility_threshold * e.num_unoccluded_pixels)
        if num_consistent >= min_consistent and num_consistent >= SUPPORT_FRACTION * num_conclusive:
            missed[o.name] = Detection(o.name, o.object_class, o.X_TO, e.mask(shape))
    explained = np.any([np.zeros(shape, bool), *(d.mask for d in missed.values())], axis=0)

    def is_redundant(detection: Detection) -> bool:
        """Return whether missed objects explain the pixels of a detection as well."""
        size = np.count_nonzero(detection.mask)
        overlaps = (
            np.count_nonzero(d.mask & detection.mask)
            for d in missed.values()
            if np.count_nonzero(d.mask) > EVIDENCE_RATIO * size
        )
        return bool(size) and (
            explained[detection.mask].mean() >= DUPLICATE_OVERLAP
            or any(overlap > REASSIGNED_FRACTION * size for overlap in overlaps)
        )

    kept = [
        d
        for d in observation.detections
        if d.name in associated_detections or d.is_confident or not is_redundant(d)
    ]
    claimed = np.any([np.zeros(shape, bool), *(d.mask for d in kept)], axis=0)
    restored = tuple(
        replace(d, mask=d.mask & ~claimed)
        for d in missed.values()
        if claimed[d.mask].mean() <= REASSIGNED_FRACTION
    )
    return replace(observation, detections=(*kept, *restored))


def match_to_ground_truth(
    known: Sequence[SceneObject], objects: Sequence[SceneObject]
) -> tuple[str, ...]:
    """Return the names of the true objects that are known.

    Args:
        known: Objects of a belief.
        objects: True objects. One is known if it is assigned to a known object of its class within
            the gating distance.
    """
    matched = set[str]()
    for name in {o.object_class.name for o in known}:
        known_of_class = [o for o in known if o.object_class.name == name]
        true_of_class = [o for o in objects if o.object_class.name == name]
        pairs = _assign(known_of_class, true_of_class, GATING_DISTANCE)
        matched |= {true_of_class[k].name for k in pairs.values()}
    return tuple(o.name for o in objects if o.name in matched)


def to_ground_truth_names(
    decision: Decision,
    known: Sequence[SceneObject],
    observation: Observation | None,
    objects: Sequence[SceneObject],
) -> Decision:
    """Return a decision in the names of the true objects.

    Args:
        decision: Decision in the names of the belief.
        known: Objects of the belief (K_t) at the decision. Each is taken for the nearest true
            object.
        observation: Observation at the decision, which becomes part of the result.
        objects: True objects.
    """
    name = {TRAY: TRAY} | {o.name: nearest_object(objects, o.X_TO).name for o in known}
    move, hidden = decision.move, decision.hidden
    if hidden is not None:
        carried = (replace(s, carried=name[s.carried]) for s in hidden.supports)
        hidden = replace(hidden, supports=tuple(carried))
    return replace(
        decision,
        move=None if move is None else Move(name[move.pick], name[move.place]),
        hidden=hidden,
        pick_probabilities={
            name[pick]: probability for pick, probability in decision.pick_probabilities.items()
        },
        considered=tuple(name[known] for known in decision.considered),
        observation=observation,
    )


def _assign(
    known: Sequence[SceneObject],
    observed: Sequence[SceneObject | Detection],
    max_distance: float,
) -> dict[int, int]:
    """Assign observed objects to known ones by the smallest sum of distances.

    Args:
        known: Known objects of a class.
        observed: Observed objects of the class.
        max_distance: Largest distance of a pair [m].

    Returns:
        Index of the observed object by that of the known one.
    """
    if not known or not observed:
        return {}
    distance = np.array([[np.linalg.norm(o.X_TO.p - d.X_TO.p) for d in observed] for o in known])
    # Beyond the largest distance all pairs cost the same, because none of them counts.
    cost = np.minimum(distance, min(max_distance, 10.0))
    rows, columns = linear_sum_assignment(cost)
    return {
        int(k): int(d) for k, d in zip(rows, columns, strict=True) if distance[k, d] <= max_distance
    }


def _is_gone(known: SceneObject, observation: Observation) -> bool:
    """Return whether an undetected object is no longer at its pose.

    It is gone if the camera sees through it, or if other detections explain its pixels.
    """
    e = evaluate_pose(known.object_class, known.X_TO, observation.depth, observation.camera)
    num_consistent = np.count_nonzero(e.consistent)
    num_conclusive = e.num_free_space_violations + num_consistent
    if e.num_free_space_violations > MAX_SEE_THROUGH_FRACTION * num_conclusive:
        return True
    detected = np.zeros(observation.depth.shape, bool)
    for detection in observation.detections:
        detected |= detection.mask
    num_reassigned = np.count_nonzero(e.consistent & detected[e.window])
    is_visible = num_consistent >= observation.camera.visibility_threshold * e.num_unoccluded_pixels
    return bool(num_reassigned > REASSIGNED_FRACTION * num_consistent and is_visible)
