"""The scene exploration task: find every hidden object by moving what is in view."""

from dataclasses import dataclass
from enum import Enum

from drake_clutter.config import ExplorationConfig
from drake_clutter.perception.label_detector import PerceptionResult
from drake_clutter.scenes.interfaces import Move, MoveResult, Outcome
from drake_clutter.scenes.scene import Scene
from drake_clutter.tasks.belief import Decision


class EpisodeEnd(Enum):
    """Why an episode is over."""

    ALL_FOUND = "all found"
    COLLAPSED = "collapsed"
    OUT_OF_MOVES = "out of moves"
    GAVE_UP = "gave up"


@dataclass(frozen=True)
class Attempt:
    """A decision, and what it led to.

    Attributes:
        decision: In the names of the true objects; its move is not None.
        outcome: How the move went.
        look: What a perfect detector sees afterwards.
    """

    decision: Decision
    outcome: Outcome
    look: PerceptionResult

    @property
    def move(self) -> Move:
        """What was tried."""
        assert self.decision.move is not None
        return self.decision.move


@dataclass(frozen=True)
class Step(Attempt):
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
        start: The scene at the start.
        scene: The scene now.
        first_look: What a perfect detector sees at the start.
        look: What a perfect detector sees now.
        known: Names of all objects that have been in view.
        steps: The attempts so far.
    """

    def __init__(
        self,
        scene: Scene,
        first_look: PerceptionResult,
        config: ExplorationConfig,
        max_moves: int,
    ) -> None:
        """Start the record of an episode on a scene at rest."""
        self._config, self._max_moves = config, max_moves
        self.start = self.scene = scene
        self.first_look = self.look = first_look
        self.known: tuple[str, ...] = tuple(d.name for d in first_look.observation.detections)
        self.hidden_at_start = tuple(name for name in scene.names if name not in self.known)
        self.steps: list[Step] = []

    @property
    def end(self) -> EpisodeEnd | None:
        """Why the episode is over, or None while it goes on."""
        if self.steps and self.steps[-1].outcome.result is MoveResult.COLLAPSED:
            return EpisodeEnd.COLLAPSED
        if len(self.known) == len(self.scene.objects):
            return EpisodeEnd.ALL_FOUND
        return EpisodeEnd.OUT_OF_MOVES if len(self.steps) >= self._max_moves else None

    @property
    def found(self) -> tuple[str, ...]:
        """The objects that were hidden at the start and are known now."""
        return tuple(name for name in self.hidden_at_start if name in self.known)

    def note(self, attempt: Attempt) -> Step:
        """Take in an attempt.

        Raises:
            ValueError: The scene has collapsed; after any other end an episode may go on.
        """
        if self.end is EpisodeEnd.COLLAPSED:
            raise ValueError("the scene has collapsed; allowed is a move in a scene that stands")
        collapsed = attempt.outcome.result is MoveResult.COLLAPSED
        self.scene, self.look = attempt.outcome.scene, attempt.look
        seen = {d.name for d in self.look.observation.detections}
        newly = tuple(n for n in self.scene.names if n in seen and n not in self.known)
        if collapsed:
            newly = ()
        self.known += newly
        reward = self._config.detection_reward * len(newly)
        reward += self._config.collapse_penalty if collapsed else 0.0
        step = Step(attempt.decision, attempt.outcome, attempt.look, newly, reward)
        self.steps.append(step)
        return step
