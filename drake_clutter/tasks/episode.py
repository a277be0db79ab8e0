"""One loop that plays an episode, over backends in which an explorer's moves are carried out."""

from collections.abc import Callable, Iterator, Mapping
from functools import partial
from typing import Protocol

import numpy as np

from drake_clutter.config import ClutterConfig, ExplorationConfig
from drake_clutter.files import InputError
from drake_clutter.perception.label_detector import LabelDetector, PerceptionResult
from drake_clutter.perception.ray_detector import RayDetector
from drake_clutter.scenes.interfaces import (
    Move,
    MoveExecutor,
    MoveResult,
    Observation,
    Outcome,
    PickPlaceCommand,
)
from drake_clutter.scenes.placement import resolve_placement
from drake_clutter.scenes.scene import Scene
from drake_clutter.simulation.hybrid import HybridExecutor
from drake_clutter.simulation.settle_executor import SettleExecutor
from drake_clutter.stability.static_executor import StaticExecutor
from drake_clutter.tasks.belief import (
    ActionFilter,
    Belief,
    Decision,
    Policy,
    Tracker,
    select_move,
    update_belief,
)
from drake_clutter.tasks.exploration_task import (
    ExplorationTask,
    MoveAttempt,
    TerminationReason,
    Transition,
)


class Backend(Protocol):
    """A scene in which a policy's moves are carried out."""

    @property
    def config(self) -> ExplorationConfig:
        """The task's config."""

    @property
    def scene(self) -> Scene:
        """The true objects, now."""

    @property
    def perception(self) -> PerceptionResult:
        """What a perfect detector sees, now."""

    @property
    def belief(self) -> Belief:
        """What the policy knows, now."""

    def rollout(self, policy: Policy) -> Iterator[MoveAttempt]:
        """Yield each attempt of a policy, once the scene has been observed again.

        It ends when the policy has no move left.
        """


def run_episode(
    backend: Backend,
    policy: Policy,
    *,
    max_moves: int,
    on_transition: Callable[[Transition], None] = lambda _: None,
    stop_when_all_found: bool = True,
) -> ExplorationTask:
    """Play an episode, and return its record.

    Args:
        backend: Where it takes place.
        policy: Chooses the moves.
        max_moves: Attempts after which the episode ends.
        on_transition: Called after each attempt.
        stop_when_all_found: Whether the episode ends when every object has been found.
    """
    task = ExplorationTask(backend.scene, backend.perception, backend.config, max_moves)
    goes_on = (None,) if stop_when_all_found else (None, TerminationReason.ALL_FOUND)
    attempts = backend.rollout(policy)
    while task.termination in goes_on and (attempt := next(attempts, None)) is not None:
        on_transition(task.record(attempt))
    return task


class Detector(Protocol):
    """A perfect detector."""

    def perceive(self, scene: Scene) -> PerceptionResult:
        """Return what the camera shows of a scene."""


class SteppedBackend:
    """A backend that carries out one command at a time, and observes the scene in between.

    It is observed by a perfect detector, whose names are those of the true objects.

    Attributes:
        config: Of the task.
        scene: The true objects, now.
        perception: What a perfect detector sees, now.
        belief: What the policy knows, now.
        observation: The latest, in the names of the belief.
    """

    def __init__(
        self,
        executor: MoveExecutor,
        detector: Detector,
        config: ExplorationConfig,
        scene: Scene,
        rng: np.random.Generator,
        *,
        tracker: Tracker | None = None,
        action_filter: ActionFilter | None = None,
    ) -> None:
        """Start on a scene at rest, and observe it.

        Args:
            executor: Carries out the commands.
            detector: The perfect detector.
            config: Of the task.
            scene: The objects, at rest.
            rng: Draws for the policy, the placement and the world.
            tracker: Gives detections names that last; None: they have them.
            action_filter: Adds to the invalid moves; None: every legal move may be tried.
        """
        self._tracker, self._action_filter = tracker, action_filter
        self._executor, self._detector, self._rng = executor, detector, rng
        self.config, self.scene, self.perception = config, scene, detector.perceive(scene)
        self.belief = Belief()
        self.update_belief()

    @property
    def policy_rng(self) -> np.random.Generator:
        """What the policy draws the next move from."""
        return self._rng

    @property
    def world_rng(self) -> np.random.Generator:
        """What the placement and the outcome of the next move are drawn from."""
        return self._rng

    def observe(self) -> Observation:
        """Return what is in view now."""
        return self.perception.observation

    def execute(self, command: PickPlaceCommand, rng: np.random.Generator) -> Outcome:
        """Carry out a command."""
        outcome = self._executor.execute(self.scene, command, rng)
        if outcome.result.was_executed:
            self.scene, self.perception = outcome.scene, self._detector.perceive(outcome.scene)
        return outcome

    def observable_result(self, outcome: Outcome) -> MoveResult:
        """Return what the policy can know of an outcome."""
        return outcome.result

    def to_ground_truth(self, decision: Decision) -> Decision:
        """Return a decision in the names of the true objects."""
        return decision

    def update_belief(self) -> None:
        """Observe the scene."""
        self.belief, self.observation = update_belief(self.belief, self.observe(), self._tracker)

    def step(self, move: Move) -> Outcome:
        """Carry out a move, if there is a free place, and record it in the belief.

        Raises:
            KeyError: The move names an object that is not in view.
            ValueError: The move puts an object on itself.
        """
        rng = self.world_rng
        command = resolve_placement(move, self.observation, self.config, rng)
        if command is None:
            outcome = Outcome(MoveResult.NO_FREE_PLACEMENT, self.scene)
            self.belief = self.belief.record(move, outcome.result)
        else:
            outcome = self.execute(command, rng)
            result = self.observable_result(outcome)
            self.belief = self.belief.record(move, result, command.X_TO_place)
        return outcome

    def rollout(self, policy: Policy) -> Iterator[MoveAttempt]:
        """See `Backend.rollout`."""
        while True:
            decision = select_move(
                policy,
                self.belief,
                self.observation,
                self.policy_rng,
                self._action_filter,
            )
            if decision.move is None:
                return
            recorded = self.to_ground_truth(decision)
            outcome = self.step(decision.move)
            self.update_belief()
            yield MoveAttempt(recorded, outcome, self.perception)


BackendFactory = Callable[[Scene, np.random.Generator], SteppedBackend]
"""Starts an episode on a scene at rest; its executor and detector are kept from one to the next."""

TELEPORT_FIDELITIES = ("static", "static_or_drake", "settle")
"""How moves are judged when objects are teleported: by the static judge; by Drake where that cannot
judge; by Drake. What `static` cannot judge cannot be done: for training, where asking Drake
about one move in a hundred would take half the time."""


RENAMED_FIDELITIES: Mapping[str, str] = {"equilibrium": "static", "fast": "static_or_drake"}
"""Current name of a fidelity by its name in version 0.1."""


def current_fidelity(name: str) -> str:
    """Return the current name of a fidelity."""
    return RENAMED_FIDELITIES.get(name, name)


def make_teleport_backend_factory(
    fidelity: str,
    config: ClutterConfig,
    *,
    follow_falls: bool = False,
) -> BackendFactory:
    """Return what starts episodes in which objects are teleported.

    Args:
        fidelity: One of `TELEPORT_FIDELITIES`.
        config: The world.
        follow_falls: Whether Drake simulates what a collapse, which ends the episode, does to the
            whole scene; for pictures.

    Raises:
        InputError: No such fidelity.
    """
    executor: MoveExecutor
    detector: Detector = RayDetector(config.cell.camera)
    match current_fidelity(fidelity):
        case "static":
            executor = StaticExecutor(config)
        case "static_or_drake":
            executor = HybridExecutor(config, simulate_collapse=follow_falls)
        case "settle":
            executor = SettleExecutor(config, simulate_collapse=follow_falls)
            detector = LabelDetector(config.cell.camera)
        case _:
            allowed = ", ".join(TELEPORT_FIDELITIES)
            raise InputError(f"fidelity: {fidelity!r}; allowed are {allowed}")
    return partial(SteppedBackend, executor, detector, config.exploration)
