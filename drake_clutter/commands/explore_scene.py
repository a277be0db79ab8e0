"""`drake-clutter explore`, `move`: moves in a scene, with `episode.json` and a page to watch."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from drake_clutter.agents.backend_factory import make_backend_factory
from drake_clutter.agents.explorers import make_policy_factory
from drake_clutter.config import ClutterConfig
from drake_clutter.files import InputError, input_error, write_json
from drake_clutter.perception.label_detector import LabelDetector
from drake_clutter.planning.pick_place_plan import (
    PlanningFailure,
    PlanningFailureReason,
    plan_to_dict,
)
from drake_clutter.reports.episode_page import write_episode_page
from drake_clutter.scenes.interfaces import Move, Observation
from drake_clutter.scenes.placement import resolve_placement
from drake_clutter.scenes.scene import TRAY, Scene
from drake_clutter.scenes.scene_file import save_scene
from drake_clutter.seeding import item_rng
from drake_clutter.simulation.drake_judge import DrakeJudge
from drake_clutter.station.arm_executor import ArmExecutor
from drake_clutter.station.trajectory_file import write_trajectories
from drake_clutter.tasks.belief import Belief, Decision
from drake_clutter.tasks.episode import run_episode
from drake_clutter.tasks.exploration_task import ExplorationTask, TerminationReason, Transition
from drake_clutter.validation import NonEmptyText, StrictModel, to_plain, validate
from drake_clutter.yaml_io import read_yaml

TransitionCallback = Callable[[Transition], None]


def settle_scene(scene: Scene, config: ClutterConfig, seed: int) -> Scene:
    """The scene as it settles.

    Raises:
        InputError: it is not stable, so there is nothing to explore.
    """
    verdict = DrakeJudge(config).judge(scene, item_rng(seed))
    if verdict.instability is not None:
        raise InputError(
            f"the scene is not stable: {verdict.instability}; allowed is one that stays as it is when it settles"
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
) -> ExplorationTask:
    """Plays an episode on a scene at rest.

    Args:
        scene: at rest.
        agent_name: see `make_explorers`.
        fidelity: one of `FIDELITIES`.
        max_moves: after which it ends.
        seed: of the agent's and the world's chances.
        config: the world.
        on_transition: called after each move.
    """
    backend = make_backend_factory(fidelity, config, follow_falls=True)(scene, item_rng(seed))
    policy = make_policy_factory(agent_name, config)(backend)
    return run_episode(backend, policy, max_moves=max_moves, on_transition=on_transition)


def _check_move(moves: Sequence[Move], index: int, visible: Sequence[str], scene: Scene) -> None:
    move = moves[index]
    for role, name, allowed in (
        ("pick", move.pick, visible),
        ("place", move.place, [TRAY, *visible]),
    ):
        if name not in allowed or (role == "place" and name == move.pick):
            problem = (
                "is not in view, or the object itself"
                if name in (*scene.names, TRAY)
                else "is not in the scene"
            )
            raise InputError(
                f"move {index + 1}, {role}: {name!r} {problem}; allowed are {', '.join(allowed)}"
            )


def execute_moves(
    scene: Scene,
    moves: Sequence[Move],
    seed: int,
    config: ClutterConfig,
    on_transition: TransitionCallback,
    fidelity: str = "settle",
) -> ExplorationTask:
    """Carries a list of moves out, on a scene at rest, until one makes it collapse.

    Raises:
        InputError: a move names an object that is not in the scene or not in view, or puts one on itself.
    """
    backend = make_backend_factory(fidelity, config, follow_falls=True)(scene, item_rng(seed))

    def next_move(
        belief: Belief,
        observation: Observation,
        rng: np.random.Generator,
    ) -> Decision:
        number = len(belief.history)
        if number == len(moves):
            return Decision(None)
        _check_move(moves, number, [d.name for d in observation.detections], backend.scene)
        return Decision(moves[number])

    return run_episode(
        backend,
        next_move,
        max_moves=len(moves),
        on_transition=on_transition,
        stop_when_all_found=False,
    )


def plan_moves(
    scene: Scene, moves: Sequence[Move], seed: int, config: ClutterConfig, out: Path
) -> list[dict[str, Any]]:
    """Plans how the arm would carry out each move in a scene at rest, as it is; writes `plan.json`, and returns what it holds.

    Raises:
        InputError: as `carry_out`.
    """
    perception, rng, executor = (
        LabelDetector(config.cell.camera).perceive(scene),
        item_rng(seed),
        ArmExecutor(config),
    )
    plans = list[dict[str, Any]]()
    for number, move in enumerate(moves):
        _check_move(moves, number, [d.name for d in perception.observation.detections], scene)
        command = resolve_placement(move, perception.observation, config.exploration, rng)
        plan = (
            PlanningFailure(PlanningFailureReason.NO_FREE_SPOT, move.place)
            if command is None
            else executor.plan(
                scene,
                command,
            )
        )
        plans.append({"move": {"pick": move.pick, "place": move.place}, **plan_to_dict(plan)})
    write_json(
        out / "plan.json",
        {"seed": seed, "cell": to_plain(config.cell.with_support(scene.support)), "plans": plans},
    )
    return plans


class _MoveEntry(StrictModel):
    pick: NonEmptyText
    place: NonEmptyText


def read_moves(path: Path) -> list[Move]:
    """Moves from a YAML list of `{pick: NAME, place: NAME or tray}`.

    Raises:
        InputError: the file, the entry and what is allowed.
    """
    content = f"a list of {{pick: NAME, place: NAME or {TRAY}}}"
    entries = validate(tuple[_MoveEntry, ...], read_yaml(path, content), str(path))
    if not entries:
        raise input_error(str(path), f"holds no moves; allowed is {content}")
    return [Move(entry.pick, entry.place) for entry in entries]


def episode_to_dict(task: ExplorationTask, agent: str, fidelity: str, seed: int) -> dict[str, Any]:
    """The document of `episode.json`."""
    end = task.termination or TerminationReason.GAVE_UP
    moves = []
    for step in task.transitions:
        instability = step.outcome.instability
        moves.append(
            {
                "move": {"pick": step.move.pick, "place": step.move.place},
                "outcome": step.outcome.result.value,
                "instability": str(instability) if instability else None,
                "detail": step.outcome.detail,
                "newly_found": list(step.newly_found),
                "pick_probabilities": dict(step.decision.pick_probabilities),
                "known_objects": list(step.decision.considered),
                "visible_fractions": step.next_perception.visible_fractions,
                "reward": step.reward,
            }
        )
    return {
        "agent": agent,
        "seed": seed,
        "fidelity": fidelity,
        "success": end is TerminationReason.ALL_FOUND,
        "termination": end.value,
        "num_objects": len(task.scene.objects),
        "initially_hidden": list(task.initially_hidden),
        "found": list(task.found),
        "total_reward": sum(step.reward for step in task.transitions),
        "initial_visible_fractions": task.initial_perception.visible_fractions,
        "moves": moves,
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
    """Writes `episode.json`, `after.yaml` (the scene at the end) and the page; returns what `episode.json` holds.

    At fidelity `arm` also `trajectory.h5`, see `station/trajectory_file.py`. `extra_fields` replace fields of the episode.
    """
    fields = {**episode_to_dict(task, agent, fidelity, seed), **(extra_fields or {})}
    cell = config.cell.with_support(task.initial_scene.support)
    save_scene(out / "after.yaml", task.scene, cell)
    write_episode_page(
        out, title, task.initial_scene, task.initial_perception, task.transitions, fields, cell
    )
    if fidelity == "arm":
        write_trajectories(
            out / "trajectory.h5",
            task.initial_scene,
            [(step.move, step.outcome) for step in task.transitions],
            cell,
        )
    fields["cell"] = to_plain(cell)
    write_json(out / "episode.json", fields)
    return fields
