"""Scene exploration (SPEC section 4): find every hidden object by moving what is in view."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from enum import Enum
from itertools import takewhile
from typing import Protocol

import numpy as np

from drake_clutter.cell.camera import Camera
from drake_clutter.config import ClutterConfig, ExplorationConfig
from drake_clutter.perception.label_detector import LabelDetector, Look
from drake_clutter.perception.ray_detector import RayDetector
from drake_clutter.scenes.interfaces import Move, MoveExecutor, MoveResult, Observation, Outcome
from drake_clutter.scenes.scene import TRAY, Scene
from drake_clutter.simulation.executor import SettleExecutor
from drake_clutter.simulation.fallback import FastOrDrakeExecutor
from drake_clutter.stability.executor import FastExecutor
from drake_clutter.station.arm_executor import ArmExecutor


class ExecutorMaker(Protocol):
    """Makes an executor."""

    def __call__(self, config: ClutterConfig, *, follow_falls: bool = True) -> MoveExecutor:
        """`follow_falls`: whether to simulate what a collapse, which ends the episode, does to the whole scene."""


def _equilibrium(config: ClutterConfig, *, follow_falls: bool = True) -> MoveExecutor:
    return FastExecutor(config)


EXECUTORS: dict[str, ExecutorMaker] = {
    "equilibrium": _equilibrium,
    "fast": FastOrDrakeExecutor,
    "settle": SettleExecutor,
    "arm": ArmExecutor,
}
"""How moves are carried out, by the name of the fidelity. `equilibrium` is `fast` without Drake: what the fast judge cannot judge
cannot be done. It is for training, where asking Drake about one move in a hundred would take half the time."""


class Detector(Protocol):
    """Tells what is in view."""

    def look(self, scene: Scene) -> Look:
        """What the camera shows of a scene."""


DETECTORS: dict[str, Callable[[Camera], Detector]] = {
    "equilibrium": RayDetector,
    "fast": RayDetector,
    "settle": LabelDetector,
    "arm": LabelDetector,
}
"""What tells what is in view, by the name of the fidelity."""


class EpisodeEnd(Enum):
    """Why an episode is over."""

    ALL_FOUND = "all found"
    COLLAPSED = "collapsed"
    OUT_OF_MOVES = "out of moves"
    GAVE_UP = "gave up"


@dataclass(frozen=True)
class Decision:
    """What an agent decided, and why.

    Attributes:
        move: what to do; None: there is no move.
        picks: the probability of each pick, by name; empty if the agent has none.
        known: the objects that it went by; empty if that is what is in view.
        observation: what it was shown, if that is not what a perfect detector sees.
    """

    move: Move | None
    picks: Mapping[str, float] = field(default_factory=dict)
    known: tuple[str, ...] = ()
    observation: Observation | None = field(default=None, repr=False, compare=False)


@dataclass(frozen=True)
class Step:
    """One move and what came of it.

    Attributes:
        move: what was tried.
        outcome: how it went.
        look: what the camera showed afterwards.
        newly_found: objects detected for the first time, in the scene's order.
        reward: r_d per newly found object, plus the penalty if the scene collapsed.
        decision: of the agent that chose the move, if one did.
    """

    move: Move
    outcome: Outcome
    look: Look
    newly_found: tuple[str, ...]
    reward: float
    decision: Decision | None = None


def legal_moves(observation: Observation) -> list[Move]:
    """Every (x, y) with x in V_t, y in V_t or the tray, y != x; it says nothing of what is hidden."""
    names = [detection.name for detection in observation.detections]
    return [Move(x, y) for x in names for y in (TRAY, *names) if y != x]


class ExplorationTask:
    """An episode: V_t what is in view, K_t what has ever been in view.

    Over when every object is known, when the scene collapses (nothing found by that move counts), or after the config's
    number of moves; a move that could not be carried out counts as one.
    """

    def __init__(
        self, scene: Scene, executor: MoveExecutor, detector: Detector, config: ExplorationConfig, max_moves: int
    ) -> None:
        """Starts an episode on a scene at rest."""
        self._executor, self._detector, self._config, self._max_moves = executor, detector, config, max_moves
        self.start = self.scene = scene
        self.first_look = self.look = detector.look(scene)
        self.known: tuple[str, ...] = tuple(d.name for d in self.look.observation.detections)
        self.hidden_at_start: tuple[str, ...] = tuple(name for name in scene.names if name not in self.known)
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
    def failed(self) -> tuple[Move, ...]:
        """Moves that could not be carried out since the scene last changed: nothing is gained by trying them again."""
        latest = takewhile(lambda step: not step.outcome.result.carried_out, reversed(self.steps))
        return tuple(step.move for step in latest)

    @property
    def found(self) -> tuple[str, ...]:
        """The objects that were hidden at the start and are known now."""
        return tuple(name for name in self.hidden_at_start if name in self.known)

    def step(self, move: Move, rng: np.random.Generator, decision: Decision | None = None) -> Step:
        """Carries a move out and looks; `decision` is kept with it.

        Raises:
            KeyError: the move names an object that is not in view.
            ValueError: the move puts an object on itself, or the scene has collapsed. Otherwise an episode that is over may be
                played on, as with moves of one's own choice.
        """
        if self.end is EpisodeEnd.COLLAPSED:
            raise ValueError("the scene has collapsed; allowed is a move in a scene that stands")
        if move.place == move.pick:
            raise ValueError(f"move {move}: allowed is to put an object on another one or on {TRAY}")
        return self.note(move, self._executor.execute(self.scene, self.look.observation, move, rng), decision)

    def note(self, move: Move, outcome: Outcome, decision: Decision | None = None) -> Step:
        """Takes in what a move has led to, and looks."""
        collapsed = outcome.result is MoveResult.COLLAPSED
        self.scene = outcome.scene
        if outcome.result.carried_out:
            self.look = self._detector.look(self.scene)
        seen = {d.name for d in self.look.observation.detections}
        newly = () if collapsed else tuple(name for name in self.scene.names if name in seen and name not in self.known)
        self.known += newly
        reward = self._config.detection_reward * len(newly) + (self._config.collapse_penalty if collapsed else 0.0)
        self.steps.append(Step(move, outcome, self.look, newly, reward, decision))
        return self.steps[-1]
