"""Scene exploration: find hidden objects, all or a target, by moving objects that are in view.

`ExplorationTask` evaluates an episode with the ground truth: discovered objects, rewards and the
reason of its termination.
"""

from dataclasses import dataclass
from enum import Enum

from drake_clutter.config import ExplorationConfig
from drake_clutter.perception.label_detector import PerceptionResult
from drake_clutter.scenes.interfaces import Move, MoveResult, Outcome
from drake_clutter.scenes.scene import Scene
from drake_clutter.tasks.belief import Decision
from drake_clutter.tasks.search_target import SearchTarget


class TerminationReason(Enum):
    """Why an episode ended.

    - `ALL_FOUND`: Every object has been in view.
    - `TARGET_FOUND`: An object that the search looks for has been in view.
    - `RETRIEVED`: An object that the search looks for is at the hand-over place.
    - `COLLAPSED`: The latest move made the scene collapse.
    - `LEFT_TRAY`: An object fell off the support at the latest move.
    - `OUT_OF_MOVES`: The maximum number of moves was reached.
    - `GAVE_UP`: The policy has no further move.
    - `NOTHING_LEFT`: The policy stopped, because its belief says that every object is known.
    """

    ALL_FOUND = "all found"
    TARGET_FOUND = "target found"
    RETRIEVED = "retrieved"
    COLLAPSED = MoveResult.COLLAPSED.value
    LEFT_TRAY = MoveResult.LEFT_TRAY.value
    OUT_OF_MOVES = "out of moves"
    GAVE_UP = "gave up"
    NOTHING_LEFT = "stopped: nothing left"

    @property
    def is_success(self) -> bool:
        """Whether the episode has reached its goal."""
        return self in (
            TerminationReason.ALL_FOUND,
            TerminationReason.TARGET_FOUND,
            TerminationReason.RETRIEVED,
        )

    @property
    def is_failed_move(self) -> bool:
        """Whether the latest move ruined the scene."""
        return self in (TerminationReason.COLLAPSED, TerminationReason.LEFT_TRAY)


class StopCriterion(Enum):
    """When an episode ends, besides a collapse and the maximum number of moves.

    - `ALL_FOUND`: Every object has been in view, by ground truth.
    - `BELIEF`: The policy stops by itself. The ground truth does not end the episode.
    - `LAST_MOVE`: The policy has no further move, such as at the end of a list of moves.
    """

    ALL_FOUND = "all-found"
    BELIEF = "belief"
    LAST_MOVE = "last-move"


@dataclass(frozen=True)
class MoveAttempt:
    """An attempted move and its outcome.

    Attributes:
        decision: The policy's decision, with the names of the true objects. Its move is not
            None.
        outcome: Outcome of the move.
        next_perception: Result of a perfect detector after the move.
    """

    decision: Decision
    outcome: Outcome
    next_perception: PerceptionResult

    @property
    def move(self) -> Move:
        """The attempted move."""
        assert self.decision.move is not None
        return self.decision.move


@dataclass(frozen=True)
class Transition(MoveAttempt):
    """An attempted move with its reward.

    Attributes:
        newly_found: Names of the objects that were detected for the first time, in the order of
            the scene's objects.
        reward: `detection_reward` per newly found object, or, in a search for a target, when an
            object of the target is found first; plus `collapse_penalty` if the scene collapsed or
            an object left the support.
    """

    newly_found: tuple[str, ...]
    reward: float


class ExplorationTask:
    """Ground-truth record of an exploration episode.

    An episode ends by its `StopCriterion`, when the scene collapses or an object leaves the
    support, or after a maximum number of moves. Objects that the last move of a ruined scene
    uncovers do not count as found. A move that could not be carried out counts as a move.

    An episode with a target ends when one of its objects has been in view, or has been retrieved.

    Attributes:
        target: What the episode looks for; None for all objects.
        initial_scene: The scene at the start.
        scene: The current scene.
        initial_perception: Result of a perfect detector at the start.
        perception: Result of a perfect detector for the current scene.
        detected: Names of all objects that have been in view.
        initially_hidden: Names of the objects that were hidden at the start.
        transitions: The attempted moves so far.
    """

    def __init__(
        self,
        scene: Scene,
        initial_perception: PerceptionResult,
        config: ExplorationConfig,
        max_moves: int,
        target: SearchTarget | None = None,
        *,
        retrieve: bool = False,
        until: StopCriterion = StopCriterion.ALL_FOUND,
    ) -> None:
        """Start the record of an episode.

        Args:
            scene: The scene, at rest.
            initial_perception: Result of a perfect detector for the scene.
            config: Rewards.
            max_moves: Maximum number of moves.
            target: What the episode looks for; None for all objects.
            retrieve: Whether the episode ends when the target is retrieved, instead of found.
            until: When an episode without a target ends.
        """
        self.target = target
        self._retrieve = retrieve
        self._config = config
        self._max_moves = max_moves
        self._until = until
        self._last_decision: Decision | None = None
        self.initial_scene = scene
        self.scene = scene
        self.initial_perception = initial_perception
        self.perception = initial_perception
        self.detected: tuple[str, ...] = tuple(
            d.name for d in initial_perception.observation.detections
        )
        self.initially_hidden = tuple(name for name in scene.names if name not in self.detected)
        self.transitions: list[Transition] = []

    @property
    def termination(self) -> TerminationReason | None:
        """Why the episode has ended; None while it continues."""
        if self.transitions and self.transitions[-1].outcome.result.ends_episode:
            return TerminationReason(self.transitions[-1].outcome.result.value)
        if self._last_decision is not None and self._last_decision.is_stop:
            return TerminationReason.NOTHING_LEFT
        if self._retrieve:
            if self.transitions and self._is_retrieved(self.transitions[-1]):
                return TerminationReason.RETRIEVED
        elif self.target is not None:
            if self.is_target_found:
                return TerminationReason.TARGET_FOUND
        elif self.has_found_all and self._until is not StopCriterion.BELIEF:
            return TerminationReason.ALL_FOUND
        if len(self.transitions) >= self._max_moves:
            return TerminationReason.OUT_OF_MOVES
        return None if self._last_decision is None else TerminationReason.GAVE_UP

    @property
    def has_found_all(self) -> bool:
        """Whether every object has been in view, by ground truth."""
        return len(self.detected) == len(self.scene.objects)

    @property
    def is_success(self) -> bool:
        """Whether the episode has reached its goal; a policy must stop when all is found."""
        end = self.termination
        if end is TerminationReason.NOTHING_LEFT:
            return self.has_found_all
        return end is not None and end.is_success

    @property
    def last_decision(self) -> Decision | None:
        """The policy's decision without a move; None as long as it has moves."""
        return self._last_decision

    def finish(self, decision: Decision) -> None:
        """Record that the policy has no further move.

        Args:
            decision: Its decision, without a move.
        """
        self._last_decision = decision

    @property
    def is_target_found(self) -> bool:
        """Whether an object that the episode looks for has been in view."""
        return self.target is not None and not self.target.names.isdisjoint(self.detected)

    def _is_retrieved(self, transition: Transition) -> bool:
        """Return whether a move has placed an object of the target beside the support."""
        pick = transition.move.pick
        return (
            self.target is not None
            and pick in self.target.names
            and transition.outcome.result.is_at_placement
            and not self.scene.support.carries(self.scene[pick].X_TO.translation)
        )

    @property
    def found(self) -> tuple[str, ...]:
        """Names of the initially hidden objects that have been detected."""
        return tuple(name for name in self.initially_hidden if name in self.detected)

    def record(self, attempt: MoveAttempt) -> Transition:
        """Record an attempted move, and return it with its reward.

        Raises:
            ValueError: The scene has collapsed or an object left the support. After any other
                termination, an episode may continue.
        """
        if self.termination is not None and self.termination.is_failed_move:
            reason = self.termination.value
            raise ValueError(f"the episode has ended ({reason}); no further move can be recorded")
        has_failed = attempt.outcome.result.ends_episode
        self.scene = attempt.outcome.scene
        self.perception = attempt.next_perception
        in_view = {d.name for d in self.perception.observation.detections}
        newly_found = tuple(
            name
            for name in self.scene.names
            if name in in_view and name not in self.detected and not has_failed
        )
        was_target_found = self.is_target_found
        self.detected += newly_found
        num_rewarded = len(newly_found)
        if self.target is not None:
            num_rewarded = int(self.is_target_found and not was_target_found)
        reward = self._config.detection_reward * num_rewarded
        reward += self._config.collapse_penalty if has_failed else 0.0
        transition = Transition(
            attempt.decision, attempt.outcome, attempt.next_perception, newly_found, reward
        )
        self.transitions.append(transition)
        return transition
