"""Recording of episodes with the arm.

config = load_config()
make_policy = make_policy_factory("largest-clear", config)
header = EpisodeHeader("largest-clear", seed=0)
episode = record_episode(scene, make_policy, config, header)
save_episode(Path("episode.h5"), episode)
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from importlib.metadata import version

import numpy as np

import drake_clutter
from drake_clutter.cell.work_cell import WorkCell
from drake_clutter.config import ClutterConfig
from drake_clutter.perception.label_detector import LabelDetector
from drake_clutter.planning.pick_place_plan import PlanningFailureReason
from drake_clutter.recording.recorded_episode import (
    EpisodeHeader,
    RecordedAction,
    RecordedEpisode,
)
from drake_clutter.scenes.interfaces import MoveResult, Observation
from drake_clutter.scenes.scene import TRAY, Pose, Scene
from drake_clutter.seeding import item_rng
from drake_clutter.station.arm_executor import ArmExecutor
from drake_clutter.tasks.belief import Belief, Decision, Policy
from drake_clutter.tasks.episode import Backend, SteppedBackend, run_episode
from drake_clutter.tasks.exploration_task import StopCriterion, TerminationReason, Transition

POLICY_ERROR = "policy error"
"""`RecordedEpisode.termination` of an episode whose policy raised an exception."""


class _PolicyError(Exception):
    """An exception of a policy."""


def record_episode(
    scene: Scene,
    make_policy: Callable[[Backend], Policy],
    config: ClutterConfig,
    header: EpisodeHeader,
    *,
    max_moves: int | None = None,
    stop_when_all_found: bool = True,
    on_action: Callable[[RecordedAction], None] = lambda _: None,
) -> RecordedEpisode:
    """Run an episode with the arm, and return its record.

    An exception of the policy ends the episode: `RecordedEpisode.error` is its message.

    Args:
        scene: Scene at rest.
        make_policy: Creates the policy that chooses the moves.
        config: Configuration.
        header: Names, rate and seed; each number of an episode has random numbers of its own.
        max_moves: Largest number of moves; None for that of the configuration.
        stop_when_all_found: Whether the episode ends when every object has been seen.
        on_action: Called after each attempted move.
    """
    backend = SteppedBackend(
        ArmExecutor(config, rate=header.rate),
        LabelDetector(config.cell.camera),
        config.exploration,
        scene,
        item_rng(header.seed, header.index),
    )
    believed = list[dict[str, Pose]]()
    transitions = list[Transition]()
    tools = tuple(config.cell.gripper.tools)

    def record_action(transition: Transition) -> None:
        transitions.append(transition)
        on_action(recorded_action(transition, tools, believed[len(transitions) - 1]))

    error = ""
    try:
        task = run_episode(
            backend,
            _observed_policy(make_policy(backend), believed),
            max_moves=config.exploration.max_moves if max_moves is None else max_moves,
            on_transition=record_action,
            until=StopCriterion.ALL_FOUND if stop_when_all_found else StopCriterion.LAST_MOVE,
        )
        termination = (task.termination or TerminationReason.GAVE_UP).value
    except _PolicyError as raised:
        error, termination = str(raised), POLICY_ERROR
    episode = make_recorded_episode(
        scene, config.cell, transitions, header, termination=termination, believed=believed
    )
    return replace(episode, error=error)


def _observed_policy(policy: Policy, believed: list[dict[str, Pose]]) -> Policy:
    """Return a policy that also notes the poses of the belief at each of its decisions."""

    def choose(belief: Belief, observation: Observation, rng: np.random.Generator) -> Decision:
        believed.append({o.name: o.X_TO for o in belief.objects})
        try:
            decision = policy(belief, observation, rng)
            _check_decision(decision, observation)
        except Exception as error:
            raise _PolicyError(f"{type(error).__name__}: {error}") from error
        return decision

    return choose


def _check_decision(decision: Decision, observation: Observation) -> None:
    """Check that a move names objects in view.

    Raises:
        ValueError: It does not.
    """
    move = decision.move
    if move is None:
        return
    visible = [detection.name for detection in observation.detections]
    places = [TRAY, *(name for name in visible if name != move.pick)]
    is_place = move.place_values is not None or move.place in places
    if move.pick not in visible or not is_place:
        raise ValueError(f"{move}: expected objects in view, {', '.join(visible)}")


def make_recorded_episode(
    scene: Scene,
    cell: WorkCell,
    transitions: Sequence[Transition],
    header: EpisodeHeader,
    *,
    termination: str,
    believed: Sequence[Mapping[str, Pose]] = (),
) -> RecordedEpisode:
    """Return the record of an episode that was run at fidelity `arm`.

    Args:
        scene: Scene before the first move.
        cell: Work cell.
        transitions: Attempted moves.
        header: Names, rate and seed.
        termination: Why the episode ended.
        believed: Poses X_TO of the belief before each move, by name; empty if unknown.
    """
    tools = tuple(cell.gripper.tools)
    beliefs = believed or [dict[str, Pose]() for _ in transitions]
    actions = [
        recorded_action(transition, tools, belief)
        for transition, belief in zip(transitions, beliefs, strict=False)
    ]
    return RecordedEpisode(
        initial_scene=scene,
        cell=cell.with_support(scene.support),
        actions=tuple(actions),
        policy=header.policy,
        termination=termination,
        seed=header.seed,
        index=header.index,
        scene_name=header.scene_name,
        rate=header.rate,
        package_version=drake_clutter.__version__,
        drake_version=version("drake"),
    )


def recorded_action(
    transition: Transition, tools: Sequence[str], believed: Mapping[str, Pose]
) -> RecordedAction:
    """Return the record of an attempted move.

    Args:
        transition: The move and its outcome.
        tools: Names of the gripper's tools.
        believed: Poses X_TO of the belief before the move, by name.
    """
    outcome = transition.outcome
    failure_reason = outcome.failure_reason
    if outcome.result is MoveResult.NO_FREE_PLACEMENT:
        failure_reason = PlanningFailureReason.NO_FREE_PLACEMENT.value
    tool = ""
    if outcome.samples is not None and (outcome.samples.tool_commanded >= 0).any():
        commanded = outcome.samples.tool_commanded
        tool = tools[commanded[np.argmax(commanded >= 0)]]
    return RecordedAction(
        move=transition.move,
        result=outcome.result,
        detail=outcome.detail,
        failure_reason=failure_reason,
        instability=outcome.instability_text,
        tool=tool,
        X_TO_place=outcome.X_TO_released,
        believed=believed,
        samples=outcome.samples,
    )
