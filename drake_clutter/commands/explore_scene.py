"""Exploration episodes and given moves in a scene, with `episode.json` and a web page."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from drake_clutter.agents.backend_factory import make_backend_factory
from drake_clutter.agents.explorers import make_policy_factory
from drake_clutter.agents.retrieval import RetrievingExplorer
from drake_clutter.catalog import ObjectClass
from drake_clutter.config import ClutterConfig
from drake_clutter.files import InputError, input_error, write_json
from drake_clutter.perception.label_detector import LabelDetector
from drake_clutter.planning.pick_place_plan import (
    PlanningFailure,
    PlanningFailureReason,
    plan_to_dict,
)
from drake_clutter.planning.plan_export import (
    SUFFIXES,
    check_export,
    export_plan,
)
from drake_clutter.recording.episode_recorder import make_recorded_episode
from drake_clutter.recording.hdf5_file import action_name, save_episode
from drake_clutter.recording.recorded_episode import EpisodeHeader
from drake_clutter.reports.episode_page import write_episode_page
from drake_clutter.robots.robot_model import load_robot
from drake_clutter.scenes.interfaces import Move, Observation
from drake_clutter.scenes.placement import resolve_placement
from drake_clutter.scenes.scene import TRAY, Scene
from drake_clutter.scenes.scene_file import save_scene
from drake_clutter.seeding import item_rng
from drake_clutter.simulation.drake_judge import DrakeJudge
from drake_clutter.station.arm_executor import ArmExecutor
from drake_clutter.tasks.belief import Belief, Decision, Policy
from drake_clutter.tasks.episode import Backend, run_episode
from drake_clutter.tasks.exploration_task import (
    ExplorationTask,
    StopCriterion,
    TerminationReason,
    Transition,
)
from drake_clutter.tasks.search_target import require_target
from drake_clutter.tasks.stopping import StoppingPolicy
from drake_clutter.validation import NonEmptyText, StrictModel, to_plain, validate
from drake_clutter.yaml_io import read_yaml

EPISODE_FILE = "episode.json"
"""File of an episode's document, which is written last."""
TRAJECTORY_FILE = "trajectory.h5"
"""File of the motions of the arm."""
PLAN_FILE = "plan.json"
"""File of planned moves."""
DEFAULT_EXPORT_RATE = 500.0
"""Rate of exported samples [Hz]: that of the controller of UR arms since the e-Series."""

TransitionCallback = Callable[[Transition], None]
"""Function that is called with each transition of an episode."""


def settle_scene(scene: Scene, config: ClutterConfig, seed: int) -> Scene:
    """Return a scene at its settled poses.

    Raises:
        InputError: The scene is not stable.
    """
    verdict = DrakeJudge(config).judge(scene, item_rng(seed))
    if verdict.instability is not None:
        raise InputError(
            f"the scene is not stable: {verdict.instability}; expected a scene that is at rest "
            "when Drake simulates it"
        )
    return scene.with_poses(verdict.settled)


def explore_scene(
    scene: Scene,
    agent_name: str,
    fidelity: str,
    max_moves: int,
    seed: int,
    config: ClutterConfig,
    on_transition: TransitionCallback,
    target_text: str = "",
    *,
    retrieve: bool = False,
    until: StopCriterion = StopCriterion.ALL_FOUND,
    classes: Sequence[ObjectClass] = (),
) -> ExplorationTask:
    """Run an exploration episode.

    Args:
        scene: Scene at rest.
        agent_name: Name of the policy; see `make_policy_factory`.
        fidelity: Fidelity at which moves are executed, one of `FIDELITIES`.
        max_moves: Maximum number of moves.
        seed: Seed of the policy and the simulation.
        config: Configuration.
        on_transition: Called after each move.
        target_text: Target of the search, see `find_target`; "" for all objects.
        retrieve: Whether the target is moved to the hand-over place of the cell when it is seen.
        until: When an episode without a target ends.
        classes: Classes of the objects that there may be, for `StopCriterion.BELIEF`.

    Raises:
        InputError: The scene has no such target, or the policy cannot look for it, or the cell has
            no hand-over place.
    """
    rng = item_rng(seed)
    backend = make_backend_factory(fidelity, config, simulate_collapse=True)(scene, rng)
    target = None
    if target_text:
        in_view = [d.name for d in backend.perception.observation.detections]
        target = require_target(target_text, scene, in_view, rng)
    make_policy = make_policy_factory(agent_name, config, with_target=target is not None)
    policy = make_policy(backend, target=target)
    if target is not None and retrieve:
        policy = RetrievingExplorer(policy, target, config.cell, config.exploration)
    if until is StopCriterion.BELIEF:
        belief = config.exploration.belief
        policy = StoppingPolicy(policy, classes, backend.empty_depth, belief)
    return run_episode(
        backend,
        policy,
        max_moves=max_moves,
        on_transition=on_transition,
        target=target,
        retrieve=retrieve,
        until=until,
    )


def _check_move(moves: Sequence[Move], index: int, visible: Sequence[str], scene: Scene) -> None:
    """Check that the objects of a move are visible and different.

    Args:
        moves: All moves.
        index: Index of the move to check.
        visible: Names of the visible objects.
        scene: The scene.

    Raises:
        InputError: A name is not allowed.
    """
    move = moves[index]
    for role, name, allowed in (
        ("pick", move.pick, visible),
        ("place", move.place, [TRAY, *visible]),
    ):
        if role == "place" and move.place_values is not None:
            continue
        if name not in allowed or (role == "place" and name == move.pick):
            problem = "is not in the scene"
            if name in (*scene.names, TRAY):
                problem = "is not in view, or the picked object itself"
            choices = ", ".join([*allowed, "X,Y,Z,YAW"] if role == "place" else allowed)
            raise InputError(f"move {index + 1}, {role}: {name!r} {problem}; expected {choices}")


def move_list_policy(moves: Sequence[Move], backend: Backend) -> Policy:
    """Return the policy of an episode that attempts a list of moves.

    It raises an InputError if a move names an object that is not visible.

    Args:
        moves: The moves.
        backend: Backend of the episode.
    """

    def next_move(belief: Belief, observation: Observation, rng: np.random.Generator) -> Decision:
        """Return the next move of the list; a `Policy`."""
        index = len(belief.history)
        if index == len(moves):
            return Decision(None)
        _check_move(moves, index, [d.name for d in observation.detections], backend.scene)
        return Decision(moves[index])

    return next_move


def execute_moves(
    scene: Scene,
    moves: Sequence[Move],
    seed: int,
    config: ClutterConfig,
    on_transition: TransitionCallback,
    fidelity: str = "settle",
) -> ExplorationTask:
    """Execute a list of moves in a scene at rest, until one makes it collapse.

    Args:
        scene: Scene at rest.
        moves: The moves.
        seed: Seed of placements and of the simulation.
        config: Configuration.
        on_transition: Called after each move.
        fidelity: Fidelity at which moves are executed, one of `FIDELITIES`.

    Raises:
        InputError: A move names an object that is not visible, or places an object on itself.
    """
    backend = make_backend_factory(fidelity, config, simulate_collapse=True)(scene, item_rng(seed))

    return run_episode(
        backend,
        move_list_policy(moves, backend),
        max_moves=len(moves),
        on_transition=on_transition,
        until=StopCriterion.LAST_MOVE,
    )


def plan_moves(
    scene: Scene,
    moves: Sequence[Move],
    seed: int,
    config: ClutterConfig,
    out: Path,
    exports: Sequence[str] = (),
    rate: float = DEFAULT_EXPORT_RATE,
) -> list[dict[str, Any]]:
    """Plan the arm's motion for each move without executing it; write `plan.json`.

    Every move is planned for the scene as it is, not for the scene after the moves before. The
    exported files are `plan.csv` and `plan.script`; of several moves `plan_1.csv`, and so on.

    Args:
        scene: Scene at rest.
        moves: The moves.
        seed: Seed of placements.
        config: Configuration.
        out: Output folder.
        exports: Formats in which the plans are exported, keys of `SUFFIXES`.
        rate: Rate of the exported samples [Hz].

    Returns:
        The plans as documents.

    Raises:
        InputError: A move names an object that is not visible, or places an object on itself; or
            the robot does not understand an export format.
    """
    robot = load_robot(config.cell.robot)
    for export_format in exports:
        check_export(export_format, rate, robot)
    perception = LabelDetector(config.cell.camera).perceive(scene)
    rng = item_rng(seed)
    executor = ArmExecutor(config)
    plans = list[dict[str, Any]]()
    for index, move in enumerate(moves):
        _check_move(moves, index, [d.name for d in perception.observation.detections], scene)
        command = resolve_placement(move, perception.observation, config.exploration, rng)
        plan = (
            PlanningFailure(PlanningFailureReason.NO_FREE_PLACEMENT, move.place)
            if command is None
            else executor.plan(scene, command)
        )
        plans.append({"move": {"pick": move.pick, "place": move.place}, **plan_to_dict(plan)})
        if isinstance(plan, PlanningFailure):
            continue
        name = "plan" if len(moves) == 1 else f"plan_{index + 1}"
        for export_format in exports:
            path = out / f"{name}{SUFFIXES[export_format]}"
            export_plan(plan, path, export_format, rate, robot, [*config.cell.gripper.tools])
    write_json(
        out / PLAN_FILE,
        {"seed": seed, "cell": to_plain(config.cell.with_support(scene.support)), "plans": plans},
    )
    return plans


class _MoveEntry(StrictModel):
    pick: NonEmptyText
    place: NonEmptyText


def read_moves(path: Path) -> list[Move]:
    """Return the moves of a YAML list of `{pick: NAME, place: NAME, tray or "X,Y,Z,YAW"}`.

    Raises:
        InputError: The file or one of its entries cannot be used.
    """
    content = f'a list of {{pick: NAME, place: NAME, {TRAY} or "X,Y,Z,YAW"}}'
    entries = validate(tuple[_MoveEntry, ...], read_yaml(path, content), str(path))
    if not entries:
        raise input_error(str(path), f"holds no moves; expected {content}")
    return [Move(entry.pick, entry.place) for entry in entries]


def target_to_dict(task: ExplorationTask) -> dict[str, Any]:
    """Return the target of an episode, and which of its objects were found."""
    assert task.target is not None
    names = sorted(task.target.names)
    return {
        "asked": task.target.text,
        "object_class": task.target.object_class.name,
        "objects": names,
        "found": [name for name in names if name in task.detected],
        "retrieved": [
            name
            for name in names
            if task.termination is TerminationReason.RETRIEVED
            and name == task.transitions[-1].move.pick
        ],
    }


def hidden_document(decision: Decision | None) -> dict[str, Any] | None:
    """Return what unseen space may hide at a decision; None if the policy does not estimate it."""
    hidden = None if decision is None else decision.hidden
    return None if hidden is None else hidden.to_dict()


def episode_to_dict(task: ExplorationTask, agent: str, fidelity: str, seed: int) -> dict[str, Any]:
    """Return the document of `episode.json`."""
    end = task.termination or TerminationReason.GAVE_UP
    moves = []
    for number, step in enumerate(task.transitions, start=1):
        part = step.outcome.failed_part
        moves.append(
            {
                "action": action_name(number) if fidelity == "arm" else None,
                "move": {"pick": step.move.pick, "place": step.move.place},
                "outcome": step.outcome.result.value,
                "instability": step.outcome.instability_text or None,
                "detail": step.outcome.detail,
                "failed_part": None if part is None else part.value,
                "newly_found": list(step.newly_found),
                "pick_probabilities": dict(step.decision.pick_probabilities),
                "known_objects": list(step.decision.considered),
                "hidden": hidden_document(step.decision),
                "visible_fractions": step.next_perception.visible_fractions,
                "reward": step.reward,
            }
        )
    return {
        "agent": agent,
        "seed": seed,
        "fidelity": fidelity,
        "success": task.is_success,
        "termination": end.value,
        "trajectory": TRAJECTORY_FILE if fidelity == "arm" else None,
        "num_objects": len(task.scene.objects),
        "target": None if task.target is None else target_to_dict(task),
        "initially_hidden": list(task.initially_hidden),
        "found": list(task.found),
        "total_reward": sum(step.reward for step in task.transitions),
        "initial_visible_fractions": task.initial_perception.visible_fractions,
        "moves": moves,
        "hidden_at_end": hidden_document(task.last_decision),
    }


def write_episode(
    out: Path,
    task: ExplorationTask,
    title: str,
    agent: str,
    fidelity: str,
    seed: int,
    config: ClutterConfig,
    *,
    extra_fields: Mapping[str, Any] | None = None,
) -> dict[str, Any]:
    """Write `episode.json`, the final scene `after.yaml` and the web page of an episode.

    At fidelity `arm` also `trajectory.h5`, the recorded motions.

    Args:
        out: Output folder.
        task: The episode.
        title: Title of the page.
        agent: Name of the policy.
        fidelity: Fidelity at which moves were executed.
        seed: Seed of the episode.
        config: Configuration.
        extra_fields: Fields that are added to the document, or replace its own.

    Returns:
        The document of `episode.json`.
    """
    fields = {**episode_to_dict(task, agent, fidelity, seed), **(extra_fields or {})}
    cell = config.cell.with_support(task.initial_scene.support)
    save_scene(out / "after.yaml", task.scene, cell)
    write_episode_page(
        out, title, task.initial_scene, task.initial_perception, task.transitions, fields, cell
    )
    if fidelity == "arm":
        episode = make_recorded_episode(
            task.initial_scene,
            cell,
            task.transitions,
            EpisodeHeader(agent, seed, scene_name=title),
            termination=fields["termination"],
        )
        save_episode(out / TRAJECTORY_FILE, episode)
    fields["cell"] = to_plain(cell)
    write_json(out / EPISODE_FILE, fields)
    return fields
