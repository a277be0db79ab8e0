"""What an explorer knows, and how it decides: the same for every backend."""

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from drake_clutter.scenes.interfaces import Move, MoveResult, Observation
from drake_clutter.scenes.scene import TRAY, Pose, SceneObject

UNMOVED_TOLERANCE = 0.01
"""Largest distance at which an object counts as not moved by the move that was to place it [m]."""


def legal_moves(observation: Observation) -> list[Move]:
    """Return every (x, y) with x in view, y in view or the tray, y != x."""
    names = [detection.name for detection in observation.detections]
    return [Move(x, y) for x in names for y in (TRAY, *names) if y != x]


@dataclass(frozen=True)
class Decision:
    """An explorer's choice of a move, and what it went by.

    Attributes:
        move: What to do; None: the explorer has no move.
        pick_probabilities: The probability of each pick, by name; empty if the explorer has none.
        considered: Names of the objects that it went by; empty if those are the ones in view.
        observation: What it was shown, if that is not what a perfect detector sees.
    """

    move: Move | None
    pick_probabilities: Mapping[str, float] = field(default_factory=dict)
    considered: tuple[str, ...] = ()
    observation: Observation | None = field(default=None, repr=False, compare=False)


@dataclass(frozen=True)
class Belief:
    """Everything that an explorer remembers of an episode.

    Attributes:
        objects: K_t, every object that has been in view, as it was seen last, in the order in
            which they were found. Until it is seen there, an object is where a move placed it.
        history: All moves so far.
        invalid_moves: Moves that could not be carried out since anything last changed.
        previous_pose: X_TO of the latest move's object before it was placed, until the next
            observation shows whether it has left there; else None.
    """

    objects: tuple[SceneObject, ...] = ()
    history: tuple[Move, ...] = ()
    invalid_moves: tuple[Move, ...] = ()
    previous_pose: Pose | None = None

    def update(self, observation: Observation) -> "Belief":
        """Return the belief after an observation: what is in view is where it is seen.

        A placed object that is seen where it was has not been picked; all its moves are invalid.
        """
        objects = {o.name: o for o in self.objects}
        for d in observation.detections:
            there = objects.get(d.name)
            # What is seen as it was keeps its object, which has cached its corners.
            if there is None or (there.object_class, there.X_TO) != (d.object_class, d.X_TO):
                objects[d.name] = SceneObject(d.name, d.object_class, d.X_TO)
        known = replace(self, objects=tuple(objects.values()), previous_pose=None)
        if self.previous_pose is None:
            return known
        pick = objects.get(self.history[-1].pick)
        if pick is None or np.linalg.norm(self.previous_pose.p - pick.X_TO.p) > UNMOVED_TOLERANCE:
            return replace(known, invalid_moves=())
        stuck = [move for move in legal_moves(observation) if move.pick == pick.name]
        invalid = (*self.invalid_moves, *stuck) if stuck else ()
        return replace(known, invalid_moves=invalid)

    def record(self, move: Move, result: MoveResult, X_TO_place: Pose | None = None) -> "Belief":
        """Return the belief after a move.

        Args:
            move: What was tried.
            result: How it ended, as far as the explorer can know.
            X_TO_place: Where the object was released, if it was placed.
        """
        history = (*self.history, move)
        if not result.was_executed:
            return replace(self, history=history, invalid_moves=(*self.invalid_moves, move))
        if result is not MoveResult.PLACED or X_TO_place is None:
            return replace(self, history=history, invalid_moves=())
        picked_from = next(o.X_TO for o in self.objects if o.name == move.pick)
        objects = (replace(o, X_TO=X_TO_place) if o.name == move.pick else o for o in self.objects)
        return replace(self, objects=tuple(objects), history=history, previous_pose=picked_from)

    def remove(self, names: Collection[str]) -> "Belief":
        """Return the belief without some objects, which may be found again as others."""
        if not names:
            return self
        objects = tuple(o for o in self.objects if o.name not in names)
        left = (move for move in self.invalid_moves if not {move.pick, move.place} & set(names))
        return replace(self, objects=objects, invalid_moves=tuple(left))


Policy = Callable[[Belief, Observation, np.random.Generator], Decision]
"""Chooses the next move from a belief, what is in view, and chance."""
Tracker = Callable[[Sequence[SceneObject], Observation], tuple[Observation, tuple[str, ...]]]
"""From K_t and an observation whose names mean nothing: the observation in the names of K_t, and
the names of known objects that are not where they were, nor in view elsewhere."""
ActionFilter = Callable[[Belief, Observation], Sequence[Move]]
"""The moves in view that are not worth trying."""


def update_belief(
    belief: Belief,
    observation: Observation,
    tracker: Tracker | None = None,
) -> tuple[Belief, Observation]:
    """Return the belief after an observation, and the observation in the belief's names.

    Args:
        belief: Before the observation.
        observation: What is in view.
        tracker: Gives detections names that last; None: they have them.
    """
    if tracker is not None:
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

    Args:
        policy: Chooses among the moves in view.
        belief: After the observation.
        observation: What is in view, in the names of the belief.
        rng: Of the policy's chances.
        action_filter: Adds to the invalid moves; None: every legal move may be tried.
    """
    if action_filter is not None:
        infeasible = action_filter(belief, observation)
        belief = replace(belief, invalid_moves=(*belief.invalid_moves, *infeasible))
    return policy(belief, observation, rng)
