"""`drake-clutter explore`, `move`: moves in a scene, with `episode.json` and a page to watch."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from drake_clutter.agents.backends import backends
from drake_clutter.agents.exploration import make_explorers
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
from drake_clutter.simulation.judge import DrakeJudge
from drake_clutter.station.arm_executor import ArmExecutor
from drake_clutter.station.trajectory_file import write_trajectories
from drake_clutter.tasks.belief import Belief, Decision
from drake_clutter.tasks.episode import run_episode
from drake_clutter.tasks.exploration import EpisodeEnd, ExplorationTask, Step
from drake_clutter.validation import NonEmptyText, StrictModel, to_plain, validate
from drake_clutter.yaml_io import read_yaml

Report = Callable[[Step], None]


def at_rest(scene: Scene, config: ClutterConfig, seed: int) -> Scene:
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


def explore(
    scene: Scene,
    agent_name: str,
    fidelity: str,
    max_moves: int,
    seed: int,
    config: ClutterConfig,
    report: Report,
) -> ExplorationTask:
    """Plays an episode on a scene at rest.

    Args:
        scene: at rest.
        agent_name: see `make_explorers`.
        fidelity: one of `FIDELITIES`.
        max_moves: after which it ends.
        seed: of the agent's and the world's chances.
        config: the world.
        report: called after each move.
    """
    backend = backends(fidelity, config, follow_falls=True)(scene, item_rng(seed))
    policy = make_explorers(agent_name, config)(backend)
    return run_episode(backend, policy, max_moves=max_moves, report=report)


def _check_names(moves: Sequence[Move], number: int, in_view: Sequence[str], scene: Scene) -> None:
    move = moves[number]
    for role, name, allowed in (
        ("pick", move.pick, in_view),
        ("place", move.place, [TRAY, *in_view]),
    ):
        if name not in allowed or (role == "place" and name == move.pick):
            known = (
                "is not in view, or the object itself"
                if name in (*scene.names, TRAY)
                else "is not in the scene"
            )
            raise InputError(
                f"move {number + 1}, {role}: {name!r} {known}; allowed are {', '.join(allowed)}"
            )


def carry_out(
    scene: Scene,
    moves: Sequence[Move],
    seed: int,
    config: ClutterConfig,
    report: Report,
    fidelity: str = "settle",
) -> ExplorationTask:
    """Carries a list of moves out, on a scene at rest, until one makes it collapse.

    Raises:
        InputError: a move names an object that is not in the scene or not in view, or puts one on itself.
    """
    backend = backends(fidelity, config, follow_falls=True)(scene, item_rng(seed))

    def next_of_list(
        belief: Belief,
        observation: Observation,
        rng: np.random.Generator,
    ) -> Decision:
        number = len(belief.history)
        if number == len(moves):
            return Decision(None)
        _check_names(moves, number, [d.name for d in observation.detections], backend.scene)
        return Decision(moves[number])

    return run_episode(
        backend,
        next_of_list,
        max_moves=len(moves),
        report=report,
        until_all_found=False,
    )


def plan_only(
    scene: Scene, moves: Sequence[Move], seed: int, config: ClutterConfig, out: Path
) -> list[dict[str, Any]]:
    """Plans how the arm would carry out each move in a scene at rest, as it is; writes `plan.json`, and returns what it holds.

    Raises:
        InputError: as `carry_out`.
    """
    look, rng, executor = (
        LabelDetector(config.cell.camera).perceive(scene),
        item_rng(seed),
        ArmExecutor(config),
    )
    plans = list[dict[str, Any]]()
    for number, move in enumerate(moves):
        _check_names(moves, number, [d.name for d in look.observation.detections], scene)
        command = resolve_placement(move, look.observation, config.exploration, rng)
        found = (
            PlanningFailure(PlanningFailureReason.NO_FREE_SPOT, move.place)
            if command is None
            else executor.plan(
                scene,
                command,
            )
        )
        plans.append({"move": {"pick": move.pick, "place": move.place}, **plan_to_dict(found)})
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


def episode_fields(task: ExplorationTask, agent: str, fidelity: str, seed: int) -> dict[str, Any]:
    """The document of `episode.json`."""
    end = task.end or EpisodeEnd.GAVE_UP
    moves = []
    for step in task.steps:
        instability = step.outcome.instability
        moves.append(
            {
                "move": {"pick": step.move.pick, "place": step.move.place},
                "outcome": step.outcome.result.value,
                "instability": str(instability) if instability else None,
                "detail": step.outcome.detail,
                "newly_found": list(step.newly_found),
                "picks": dict(step.decision.picks),
                "known": list(step.decision.known),
                "visible_share": step.look.visible_fractions,
                "reward": step.reward,
            }
        )
    return {
        "agent": agent,
        "seed": seed,
        "fidelity": fidelity,
        "success": end is EpisodeEnd.ALL_FOUND,
        "ended": end.value,
        "objects": len(task.scene.objects),
        "hidden_at_start": list(task.hidden_at_start),
        "found": list(task.found),
        "total_reward": sum(step.reward for step in task.steps),
        "visible_share_at_start": task.first_look.visible_fractions,
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
    more: Mapping[str, Any] | None = None,
) -> dict[str, Any]:
    """Writes `episode.json`, `after.yaml` (the scene at the end) and the page; returns what `episode.json` holds.

    At fidelity `arm` also `trajectory.h5`, see `station/trajectory_file.py`. `more` is put over what is known of the episode.
    """
    fields = {**episode_fields(task, agent, fidelity, seed), **(more or {})}
    cell = config.cell.with_support(task.start.support)
    save_scene(out / "after.yaml", task.scene, cell)
    write_episode_page(out, title, task.start, task.first_look, task.steps, fields, cell)
    if fidelity == "arm":
        write_trajectories(
            out / "trajectory.h5",
            task.start,
            [(step.move, step.outcome) for step in task.steps],
            cell,
        )
    fields["cell"] = to_plain(cell)
    write_json(out / "episode.json", fields)
    return fields
