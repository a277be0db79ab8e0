"""Exploration episodes, and backends that execute the moves of a policy."""

from collections.abc import Callable, Generator, Mapping
from dataclasses import replace
from functools import partial
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from drake_clutter.config import ClutterConfig, ExplorationConfig
from drake_clutter.files import InputError
from drake_clutter.perception.label_detector import LabelDetector, PerceptionResult
from drake_clutter.perception.ray_detector import RayDetector
from drake_clutter.scenes.interfaces import (
    Move,
    MoveExecutor,
    MovePart,
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
    StopCriterion,
    TerminationReason,
    Transition,
)
from drake_clutter.tasks.search_target import SearchTarget


class Backend(Protocol):
    """A scene, its observation, and the execution of moves in it."""

    @property
    def config(self) -> ExplorationConfig:
        """Configuration of the task."""

    @property
    def scene(self) -> Scene:
        """The current scene with true poses."""

    @property
    def perception(self) -> PerceptionResult:
        """Result of a perfect detector for the current scene."""

    @property
    def belief(self) -> Belief:
        """The current belief of the policy."""

    def rollout(self, policy: Policy) -> Generator[MoveAttempt, None, Decision]:
        """Execute the moves of a policy. Yield each attempt after the next observation.

        The generator ends when the policy has no move, and returns that decision.

        Args:
            policy: Chooses the moves.
        """


def run_episode(
    backend: Backend,
    policy: Policy,
    *,
    max_moves: int,
    on_transition: Callable[[Transition], None] = lambda _: None,
    target: SearchTarget | None = None,
    retrieve: bool = False,
    until: StopCriterion = StopCriterion.ALL_FOUND,
) -> ExplorationTask:
    """Run an episode, and return its record.

    Args:
        backend: Carries out the moves.
        policy: Chooses the moves.
        max_moves: Maximum number of attempted moves.
        on_transition: Called after each attempted move.
        target: What the episode looks for; None for all objects.
        retrieve: Whether the episode ends when the target is retrieved, instead of found.
        until: When an episode without a target ends. With `StopCriterion.BELIEF` the policy must
            stop by itself, see `StoppingPolicy`.
    """
    task = ExplorationTask(
        backend.scene,
        backend.perception,
        backend.config,
        max_moves,
        target,
        retrieve=retrieve,
        until=until,
    )
    nonterminal = (
        (None, TerminationReason.ALL_FOUND) if until is StopCriterion.LAST_MOVE else (None,)
    )
    attempts = backend.rollout(policy)
    while task.termination in nonterminal and len(task.transitions) < max_moves:
        try:
            attempt = next(attempts)
        except StopIteration as end:
            task.finish(end.value)
            break
        on_transition(task.record(attempt))
    return task


class PerfectDetector(Protocol):
    """Detector that returns the ground truth of the objects in view."""

    def perceive(self, scene: Scene) -> PerceptionResult:
        """Return class, pose and mask of each object in view."""


class SteppedBackend:
    """Backend that executes one command at a time and observes the scene in between.

    The observations are those of a perfect detector. Derived backends may replace them.

    Attributes:
        config: Configuration of the task.
        scene: The current scene with true poses.
        perception: Result of the perfect detector for the current scene.
        belief: The current belief of the policy.
        observation: Latest observation; its detections have the object names of the belief.
    """

    def __init__(
        self,
        executor: MoveExecutor,
        detector: PerfectDetector,
        config: ExplorationConfig,
        scene: Scene,
        rng: np.random.Generator,
        *,
        tracker: Tracker | None = None,
        action_filter: ActionFilter | None = None,
    ) -> None:
        """Start an episode with the first observation of the scene.

        Args:
            executor: Executes the commands.
            detector: The perfect detector.
            config: Configuration of the task.
            scene: The scene, at rest.
            rng: Random generator of the policy, the placements and the outcomes.
            tracker: Associates detections with known objects; None if detections have the names of
                the true objects.
            action_filter: Adds infeasible moves to the invalid moves; None for no filter.
        """
        self._tracker = tracker
        self._action_filter = action_filter
        self._executor = executor
        self._detector = detector
        self._rng = rng
        self.config = config
        self.scene = scene
        self.perception = detector.perceive(scene)
        self.belief = Belief()
        self.update_belief()

    @property
    def policy_rng(self) -> np.random.Generator:
        """Random generator of the policy for the next move."""
        return self._rng

    @property
    def outcome_rng(self) -> np.random.Generator:
        """Random generator of the placement and the outcome of the next move."""
        return self._rng

    @property
    def empty_depth(self) -> NDArray[np.float32]:
        """Depth image of the cell without objects [m]. Shape (H, W)."""
        return self._detector.perceive(replace(self.scene, objects=())).observation.depth

    def observe(self) -> Observation:
        """Return the current observation."""
        return self.perception.observation

    def execute(self, command: PickPlaceCommand, rng: np.random.Generator) -> Outcome:
        """Execute a command, and return its outcome.

        Args:
            command: The command.
            rng: Random generator of the outcome.
        """
        outcome = self._executor.execute(self.scene, command, rng)
        if outcome.result.was_executed:
            self.scene = outcome.scene
            self.perception = self._detector.perceive(outcome.scene)
        return outcome

    def observable_result(self, outcome: Outcome) -> MoveResult:
        """Return the result of a move as the policy observes it."""
        return outcome.result

    def to_ground_truth(self, decision: Decision) -> Decision:
        """Return a decision with the names of the true objects."""
        return decision

    def update_belief(self) -> None:
        """Observe the scene, and update the belief."""
        self.belief, self.observation = update_belief(self.belief, self.observe(), self._tracker)

    def step(self, move: Move) -> Outcome:
        """Carry out a move if it has a free placement, and record it in the belief.

        Raises:
            KeyError: The move names an object that is not in view.
            ValueError: The move places an object on itself.
        """
        rng = self.outcome_rng
        command = resolve_placement(move, self.observation, self.config, rng)
        if command is None:
            part = MovePart.PLACE
            outcome = Outcome(MoveResult.NO_FREE_PLACEMENT, self.scene, failed_part=part)
            self.belief = self.belief.record(move, outcome.result, failed_part=part)
        else:
            outcome = self.execute(command, rng)
            result = self.observable_result(outcome)
            self.belief = self.belief.record(
                move, result, command.X_TO_place, failed_part=outcome.failed_part
            )
        return outcome

    def rollout(self, policy: Policy) -> Generator[MoveAttempt, None, Decision]:
        """Yield each move that the policy attempts; see `Backend.rollout`."""
        while True:
            decision = select_move(
                policy,
                self.belief,
                self.observation,
                self.policy_rng,
                self._action_filter,
            )
            if decision.move is None:
                return decision
            # Before the move: the next observation may change the names of the belief.
            true_decision = self.to_ground_truth(decision)
            outcome = self.step(decision.move)
            self.update_belief()
            yield MoveAttempt(true_decision, outcome, self.perception)


class BackendFactory(Protocol):
    """Creates the backends of episodes, which share an executor and a detector."""

    def __call__(self, scene: Scene, rng: np.random.Generator, /) -> SteppedBackend:
        """Return the backend of an episode.

        Args:
            scene: The scene, at rest.
            rng: Random generator of the episode.
        """


TELEPORT_FIDELITIES = ("static", "static_or_drake", "settle")
"""Models of the outcome of a move in which objects are teleported.

- `static`: The static stability judge decides. A move with an inconclusive verdict is not carried
  out. Used for training, because it needs no simulation.
- `static_or_drake`: Drake decides where the static stability judge is inconclusive.
- `settle`: Drake simulates every move.
"""

RENAMED_FIDELITIES: Mapping[str, str] = {"equilibrium": "static", "fast": "static_or_drake"}
"""Current name of a fidelity by its name in version 0.1."""


def current_fidelity(name: str) -> str:
    """Return the current name of a fidelity."""
    return RENAMED_FIDELITIES.get(name, name)


def make_teleport_backend_factory(
    fidelity: str,
    config: ClutterConfig,
    *,
    simulate_collapse: bool = False,
) -> BackendFactory:
    """Return a factory of backends in which objects are teleported.

    Args:
        fidelity: One of `TELEPORT_FIDELITIES`.
        config: Configuration of the simulated world.
        simulate_collapse: Whether Drake simulates a collapse to its end, for images of the scene.
            The result of a move does not depend on it.

    Raises:
        InputError: The fidelity is unknown.
    """
    executor: MoveExecutor
    detector: PerfectDetector = RayDetector(config.cell.camera)
    match current_fidelity(fidelity):
        case "static":
            executor = StaticExecutor(config)
        case "static_or_drake":
            executor = HybridExecutor(config, simulate_collapse=simulate_collapse)
        case "settle":
            executor = SettleExecutor(config, simulate_collapse=simulate_collapse)
            detector = LabelDetector(config.cell.camera)
        case _:
            allowed = ", ".join(TELEPORT_FIDELITIES)
            raise InputError(f"fidelity: {fidelity!r}; expected {allowed}")
    return partial(SteppedBackend, executor, detector, config.exploration)
