"""Belief of an exploration policy, and the interfaces of policies.

An explorer is an agent with an exploration policy. K_t is the set of the objects that have been in
view up to time t.
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from drake_clutter.belief.class_belief import pose_with_same_top, revise_class
from drake_clutter.belief.hidden_belief import HiddenBelief
from drake_clutter.catalog import ObjectClass
from drake_clutter.scenes.interfaces import Detection, Move, MovePart, MoveResult, Observation
from drake_clutter.scenes.scene import TRAY, Pose, SceneObject

UNMOVED_TOLERANCE = 0.01
"""Largest displacement of an object that counts as not moved [m].

A pose estimate is more accurate than this, and a placement moves an object farther.
"""


MAX_TOP_DISTANCE = 0.03
"""Largest distance of the tops of a detection and of the known object that it may be [m]."""

MAX_FAILED_CARRIES = 2
"""Number of places to which no way was found, after which other objects are picked first.

One other place is tried: from the same pick, most ways start alike.
"""


def legal_moves(observation: Observation) -> list[Move]:
    """Return the moves of every object in view to the tray or onto another object in view."""
    names = [detection.name for detection in observation.detections]
    return [Move(x, y) for x in names for y in (TRAY, *names) if y != x]


@dataclass(frozen=True)
class Decision:
    """A policy's choice of a move, with the information that it was based on.

    Attributes:
        move: The move; None if the policy has no move.
        pick_probabilities: Probability of picking each object, by name; empty for a policy without
            probabilities.
        considered: Names of the objects that the choice was based on; empty for those in view.
        observation: Observation that the choice was based on, if it is not that of a perfect
            detector.
        hidden: What unseen space may hold; None if the policy does not estimate it.
        is_stop: Whether the policy stops because nothing is left to be found.
    """

    move: Move | None
    pick_probabilities: Mapping[str, float] = field(default_factory=dict)
    considered: tuple[str, ...] = ()
    observation: Observation | None = field(default=None, repr=False, compare=False)
    hidden: HiddenBelief | None = None
    is_stop: bool = False


@dataclass(frozen=True)
class FailedMove:
    """A move that failed, and what failed in it.

    Attributes:
        picked: The object as it was believed.
        result: Result of the move.
        part: Part of the move that failed; None if no single part is the cause.
    """

    picked: SceneObject
    result: MoveResult
    part: MovePart | None


@dataclass(frozen=True)
class Belief:
    """State of an explorer's knowledge during an episode.

    Attributes:
        objects: K_t, all objects that have been in view, in the order of their detection, each at
            the pose at which it was last detected or, since then, placed.
        history: All moves so far.
        invalid_moves: Moves that could not be carried out since the belief last changed.
        previous_pose: Pose X_TO of the object of the latest move before it was placed, until the
            next observation shows whether it has moved; otherwise None.
        failures: Moves that failed. An object that the gripper did not grasp is not picked again as
            long as it is believed to be the same. A failure of planning counts until an object has
            moved, see `deferred_moves`.
        touch: Likelihood of what the gripper felt in all moves of an object, by its name and class.
    """

    objects: tuple[SceneObject, ...] = ()
    history: tuple[Move, ...] = ()
    invalid_moves: tuple[Move, ...] = ()
    previous_pose: Pose | None = None
    failures: tuple[FailedMove, ...] = ()
    touch: Mapping[str, Mapping[ObjectClass, float]] = field(default_factory=dict)

    def update(self, observation: Observation) -> "Belief":
        """Return the belief after an observation.

        Objects in view are at their detected poses. If the object of the latest move is detected
        where it was before the move, it was not picked, and all its moves become invalid. So are
        those of an object that the gripper did not grasp, as long as it is believed to be the same.
        """
        updated = self._with_detections(observation)
        ungrasped = [f for f in self.failures if f.result is MoveResult.NOT_GRASPED]
        names = {d.name for d in observation.detections if _failures_of(d, ungrasped)}
        moves = [move for move in legal_moves(observation) if move.pick in names]
        known_moves = set(updated.invalid_moves)
        added = tuple(move for move in moves if move not in known_moves)
        return replace(updated, invalid_moves=(*updated.invalid_moves, *added))

    def _with_detections(self, observation: Observation) -> "Belief":
        """Return the belief after an observation, apart from objects that were not grasped."""
        objects = {o.name: o for o in self.objects}
        for d in observation.detections:
            known_object = objects.get(d.name)
            # Unchanged objects are kept, as they have cached their corners.
            if known_object is None or (known_object.object_class, known_object.X_TO) != (
                d.object_class,
                d.X_TO,
            ):
                objects[d.name] = SceneObject(d.name, d.object_class, d.X_TO)
        updated = replace(self, objects=tuple(objects.values()), previous_pose=None)
        if self.previous_pose is None:
            return updated
        picked = objects.get(self.history[-1].pick)
        if picked is None or np.linalg.norm(self.previous_pose.p - picked.X_TO.p) > (
            UNMOVED_TOLERANCE
        ):
            return replace(updated, invalid_moves=(), failures=self._lasting_failures())
        moves_of_picked = [move for move in legal_moves(observation) if move.pick == picked.name]
        invalid_moves = (*self.invalid_moves, *moves_of_picked) if moves_of_picked else ()
        return replace(updated, invalid_moves=invalid_moves)

    def record(
        self,
        move: Move,
        result: MoveResult,
        X_TO_place: Pose | None = None,
        touch: Mapping[ObjectClass, float] | None = None,
        failed_part: MovePart | None = None,
    ) -> "Belief":
        """Return the belief after a move.

        Args:
            move: The attempted move.
            result: Its result, as far as the explorer can observe it.
            X_TO_place: Pose at which the object was released, if it was placed.
            touch: Likelihood of what the gripper felt, by class; None if it felt nothing.
            failed_part: Part of the move for which no plan was found; None if there was a plan, or
                if no single part is the cause.
        """
        if touch is not None:
            earlier = self.touch.get(move.pick, {})
            product = {c: value * earlier.get(c, 1.0) for c, value in touch.items()}
            felt = replace(self, touch={**self.touch, move.pick: product})
            return felt.record(move, result, X_TO_place, failed_part=failed_part)
        history = (*self.history, move)
        if result is MoveResult.NOT_GRASPED or not result.was_executed:
            is_ungrasped = result is MoveResult.NOT_GRASPED
            part = MovePart.PICK if is_ungrasped else failed_part
            picked = [o for o in self.objects if o.name == move.pick]
            failures = (*self.failures, *(FailedMove(o, result, part) for o in picked))
            invalid_moves = self.invalid_moves if is_ungrasped else (*self.invalid_moves, move)
            return replace(self, history=history, invalid_moves=invalid_moves, failures=failures)
        if not result.is_at_placement or X_TO_place is None:
            failures = self._lasting_failures()
            return replace(self, history=history, invalid_moves=(), failures=failures)
        previous_pose = next(o.X_TO for o in self.objects if o.name == move.pick)
        objects = tuple(
            replace(o, X_TO=X_TO_place) if o.name == move.pick else o for o in self.objects
        )
        return replace(self, objects=objects, history=history, previous_pose=previous_pose)

    def _lasting_failures(self) -> tuple[FailedMove, ...]:
        """Return the failures that count although an object has moved."""
        return tuple(f for f in self.failures if f.result is MoveResult.NOT_GRASPED)

    def deferred_moves(self, observation: Observation) -> list[Move]:
        """Return the moves of objects for which another place is not expected to help.

        These are objects that could not be picked, or for which no way was found to
        `MAX_FAILED_CARRIES` places, as long as they are believed to be the same.

        Args:
            observation: Latest observation, with the names of the belief.
        """
        names = set[str]()
        for d in observation.detections:
            parts = [f.part for f in _failures_of(d, self.failures)]
            if MovePart.PICK in parts or parts.count(MovePart.CARRY) >= MAX_FAILED_CARRIES:
                names.add(d.name)
        return [move for move in legal_moves(observation) if move.pick in names]

    def remove(self, names: Collection[str]) -> "Belief":
        """Return the belief without some objects, which may be detected again as new objects.

        Args:
            names: Names of the objects.
        """
        if not names:
            return self
        objects = tuple(o for o in self.objects if o.name not in names)
        invalid_moves = tuple(
            move for move in self.invalid_moves if not {move.pick, move.place} & set(names)
        )
        touch = {name: values for name, values in self.touch.items() if name not in names}
        return replace(self, objects=objects, invalid_moves=invalid_moves, touch=touch)

    def revise(self, observation: Observation) -> "tuple[Belief, Observation]":
        """Return belief and observation with the classes that the gripper's touch suggests.

        A detection at the top of a known object that the gripper has felt gets the class that is
        most probable by both, if an object of that class can show such a top, and so does the known
        object.

        Args:
            observation: Observation with arbitrary names of the detections.
        """
        objects = {o.name: o for o in self.objects}
        detections = list(observation.detections)
        for name, likelihoods in self.touch.items():
            top = _top_center(objects[name])
            for k, d in enumerate(detections):
                seen = SceneObject(d.name, d.object_class, d.X_TO)
                if np.linalg.norm(_top_center(seen) - top) > MAX_TOP_DISTANCE:
                    continue
                revised = revise_class(d.object_class, d.class_probabilities, likelihoods)
                if revised.name == d.object_class.name:
                    X_TO: Pose | None = d.X_TO
                else:
                    X_TO = pose_with_same_top(seen, revised)
                if X_TO is not None:
                    detections[k] = replace(d, object_class=revised, X_TO=X_TO)
                    if objects[name].object_class.name != revised.name:
                        objects[name] = replace(objects[name], object_class=revised, X_TO=X_TO)
        belief = replace(self, objects=tuple(objects.values()))
        return belief, replace(observation, detections=tuple(detections))


def _top_center(o: SceneObject) -> NDArray[np.float64]:
    """Return the point at an object's highest level above its origin [m]. Shape (3,)."""
    return np.array([*o.X_TO.translation[:2], o.top_height])


def _is_same(detection: Detection, o: SceneObject) -> bool:
    """Return whether a detection is an object as it was believed."""
    distance = float(np.linalg.norm(detection.X_TO.p - o.X_TO.p))
    is_same_class = detection.object_class.name == o.object_class.name
    return is_same_class and distance < UNMOVED_TOLERANCE


def _failures_of(detection: Detection, failures: Sequence[FailedMove]) -> list[FailedMove]:
    """Return the failures of a detected object that is believed to be the same since then."""
    return [failure for failure in failures if _is_same(detection, failure.picked)]


class Policy(Protocol):
    """Exploration policy: chooses the next move from what has been seen."""

    def __call__(
        self, belief: Belief, observation: Observation, rng: np.random.Generator, /
    ) -> Decision:
        """Return the next move.

        Args:
            belief: State of the knowledge; its invalid moves must not be chosen.
            observation: Latest observation, with the names of the belief.
            rng: Random generator.
        """


class Tracker(Protocol):
    """Data association of detections with known objects."""

    def __call__(
        self, objects: Sequence[SceneObject], observation: Observation, /
    ) -> tuple[Observation, tuple[str, ...]]:
        """Return an observation with the names of the known objects.

        Args:
            objects: K_t.
            observation: Observation with arbitrary names of the detections.

        Returns:
            The observation with the names of K_t, and the names of known objects that are neither
            at their pose nor in view elsewhere.
        """


class ActionFilter(Protocol):
    """Finds moves that the backend cannot execute."""

    def __call__(self, belief: Belief, observation: Observation, /) -> Sequence[Move]:
        """Return the infeasible ones among the legal moves."""


def update_belief(
    belief: Belief,
    observation: Observation,
    tracker: Tracker | None = None,
) -> tuple[Belief, Observation]:
    """Update a belief with an observation.

    Args:
        belief: The belief before the observation.
        observation: The observation.
        tracker: Associates detections with known objects; None if their names persist.

    Returns:
        The belief, and the observation with the names of the belief.
    """
    if tracker is not None:
        belief, observation = belief.revise(observation)
        observation, lost = tracker(belief.objects, observation)
        belief = belief.remove(lost)
    return belief.update(observation), observation


def select_move(
    policy: Policy,
    belief: Belief,
    observation: Observation,
    rng: np.random.Generator,
    action_filter: ActionFilter | None = None,
) -> Decision:
    """Return a policy's decision.

    Moves that are deferred are left to the policy only if it has no other one.

    Args:
        policy: The policy.
        belief: The belief after the observation.
        observation: The observation, with the names of the belief.
        rng: Random generator of the policy.
        action_filter: Adds infeasible moves to the invalid ones; None adds none.
    """
    if action_filter is not None:
        infeasible = action_filter(belief, observation)
        belief = replace(belief, invalid_moves=(*belief.invalid_moves, *infeasible))
    deferred = belief.deferred_moves(observation)
    if deferred:
        others = replace(belief, invalid_moves=(*belief.invalid_moves, *deferred))
        decision = policy(others, observation, rng)
        if decision.move is not None or decision.is_stop:
            return decision
    return policy(belief, observation, rng)
