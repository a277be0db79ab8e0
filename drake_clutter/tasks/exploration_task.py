"""The scene exploration task: find every hidden object by moving what is in view."""

from dataclasses import dataclass
from enum import Enum

from drake_clutter.config import ExplorationConfig
from drake_clutter.perception.label_detector import PerceptionResult
from drake_clutter.scenes.interfaces import Move, MoveResult, Outcome
from drake_clutter.scenes.scene import Scene
from drake_clutter.tasks.belief import Decision


class TerminationReason(Enum):
    """Why an episode is over."""

    ALL_FOUND = "all found"
    COLLAPSED = "collapsed"
    OUT_OF_MOVES = "out of moves"
    GAVE_UP = "gave up"


@dataclass(frozen=True)
class MoveAttempt:
    """A decision, and what it led to.

    Attributes:
        decision: In the names of the true objects; its move is not None.
        outcome: How the move went.
        next_perception: What a perfect detector sees afterwards.
    """

    decision: Decision
    outcome: Outcome
    next_perception: PerceptionResult

    @property
    def move(self) -> Move:
        """What was tried."""
        assert self.decision.move is not None
        return self.decision.move


@dataclass(frozen=True)
class Transition(MoveAttempt):
    """An attempt, and what it was worth.

    Attributes:
        newly_found: Objects detected for the first time, in the scene's order.
        reward: r_d per newly found object, plus the penalty if the scene collapsed.
    """

    newly_found: tuple[str, ...]
    reward: float


class ExplorationTask:
    """The record of an episode by the ground truth: what was found, its reward, and its end.

    An episode is over when every object has been in view, when the scene collapses (what that
    uncovers does not count), or after a number of moves; a move that could not be carried out
    counts as one.

    Attributes:
        initial_scene: The scene at the start.
        scene: The scene now.
        initial_perception: What a perfect detector sees at the start.
        perception: What a perfect detector sees now.
        detected: Names of all objects that have been in view.
        transitions: The attempts so far.
    """

    def __init__(
        self,
        scene: Scene,
        initial_perception: PerceptionResult,
        config: ExplorationConfig,
        max_moves: int,
    ) -> None:
        """Start the record of an episode on a scene at rest."""
        self._config, self._max_moves = config, max_moves
        self.initial_scene = self.scene = scene
        self.initial_perception = self.perception = initial_perception
        self.detected: tuple[str, ...] = tuple(
            d.name for d in initial_perception.observation.detections
        )
        self.initially_hidden = tuple(name for name in scene.names if name not in self.detected)
        self.transitions: list[Transition] = []

    @property
    def termination(self) -> TerminationReason | None:
        """Why the episode is over, or None while it goes on."""
        if self.transitions and self.transitions[-1].outcome.result is MoveResult.COLLAPSED:
            return TerminationReason.COLLAPSED
        if len(self.detected) == len(self.scene.objects):
            return TerminationReason.ALL_FOUND
        return TerminationReason.OUT_OF_MOVES if len(self.transitions) >= self._max_moves else None

    @property
    def found(self) -> tuple[str, ...]:
        """The objects that were hidden at the start and are known now."""
        return tuple(name for name in self.initially_hidden if name in self.detected)

    def record(self, attempt: MoveAttempt) -> Transition:
        """Take in an attempt.

        Raises:
            ValueError: The scene has collapsed; after any other end an episode may go on.
        """
        if self.termination is TerminationReason.COLLAPSED:
            raise ValueError("the scene has collapsed; allowed is a move in a scene that stands")
        collapsed = attempt.outcome.result is MoveResult.COLLAPSED
        self.scene, self.perception = attempt.outcome.scene, attempt.next_perception
        seen = {d.name for d in self.perception.observation.detections}
        newly = tuple(n for n in self.scene.names if n in seen and n not in self.detected)
        if collapsed:
            newly = ()
        self.detected += newly
        reward = self._config.detection_reward * len(newly)
        reward += self._config.collapse_penalty if collapsed else 0.0
        step = Transition(attempt.decision, attempt.outcome, attempt.next_perception, newly, reward)
        self.transitions.append(step)
        return step
