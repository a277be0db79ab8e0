"""The closed loop on frozen sets: perfect or learned perception, moves teleported and settled, or carried out by the arm.

    python training/evaluate_closed_loop.py --workers 2
    python training/evaluate_closed_loop.py runs/closed_loop --only arm --count 20 --out runs/part.json

Every episode is a line of a file in training/results/closed_loop, a file for each row; what is there is not played again. An
episode that ends in an exception is counted as one. An episode is a success when a referee, who knows the truth, has seen every
object in view; `list_recall` and `list_precision` say how right the agent's own list of objects then is: class, and place within
4 cm. `arm_can` says of a scene that nothing hidden stays behind objects that no cup holds, or that carry such: more than that no
arm finds.
"""

import json
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cache
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from rich.console import Console
from rich.progress import track
from rich.table import Table

from drake_clutter.agents.explorers import PRETRAINED_EXPLORERS
from drake_clutter.catalog import load_catalog
from drake_clutter.config import upgrade_head
from drake_clutter.files import InputError, cli_error_handler, file_sha256, write_json
from drake_clutter.learning.pretrained import checkpoint_path
from drake_clutter.records import resume_jsonl
from drake_clutter.resources import git_commit
from drake_clutter.scenes.interfaces import MoveResult
from drake_clutter.scenes.scene import Scene, SceneObject
from drake_clutter.scenes.scene_dataset import SceneDataset, load_scene_dataset
from drake_clutter.statistics import mean_interval, wilson_interval
from drake_clutter.systems.closed_loop import ClosedLoop
from drake_clutter.systems.image_backend import ImageBackend
from drake_clutter.systems.scenario import (
    PRETRAINED_DETECTORS,
    Scenario,
    make_perception,
    make_policy,
)
from drake_clutter.systems.tracking import match_to_ground_truth
from drake_clutter.tasks.arm_reachability_bound import ArmReachabilityBound
from drake_clutter.tasks.episode import run_episode
from drake_clutter.tasks.exploration_task import ExplorationTask, TerminationReason
from drake_clutter.validation import to_plain
from drake_clutter.workers.parallel_map import map_ordered

HERE = Path(__file__).parent
EPISODES_OF_A_PROCESS = 10
"""Each keeps hundreds of MB, see `map_ordered`."""
OUT, EPISODES = HERE / "results" / "closed_loop.json", HERE / "results" / "closed_loop"


@dataclass(frozen=True)
class Row:
    """Episodes of one kind; labels with settle are in the explorers' own table.

    Attributes:
        perception, agent: see `Scenario`.
        motion: settle or arm.
        scenes: name of the set.
        first: scene of the set that is played: those before it were looked at while the loop was debugged.
        count: of scenes.
    """

    perception: str
    motion: str
    scenes: str
    agent: str
    first: int
    count: int

    @property
    def name(self) -> str:
        """Of its folder."""
        return f"{self.scenes}_{Path(self.agent).stem}_{Path(self.perception).stem}_{self.motion}"


ROWS = [
    Row(perception, motion, scenes, agent, first, count)
    for scenes, agent, first, count in (
        ("sg_star_25", "student", 60, 100),
        ("sg_14", "student-14", 50, 50),
    )
    for perception, motion in (
        ("depth", "settle"),
        ("depth-color", "settle"),
        ("depth", "arm"),
        ("labels", "arm"),
    )
]


@dataclass(frozen=True)
class Asked:
    """One episode: a scene of a row's set."""

    row: Row
    number: int


class Player:
    """Plays episodes; a worker for the runner."""

    def __init__(self) -> None:
        self._catalog = load_catalog()
        self._set = cache(
            lambda name: load_scene_dataset(HERE / "scenes" / f"{name}.json", self._catalog)
        )
        self._policy = cache(lambda agent: make_policy(agent, Scenario().world))
        self._ceiling = ArmReachabilityBound(Scenario().world)

    def __call__(self, asked: Asked) -> dict[str, Any]:
        """Plays one, and tells how it went."""
        row, number = asked.row, asked.number
        held: SceneDataset = self._set(row.scenes)
        scenario = Scenario(
            agent=row.agent,
            perception=row.perception,
            objects=held.metadata["objects"],
            seed=number,
        )
        scene = held.settled_scene(number, held.grammar, scenario.world)
        begun = time.perf_counter()
        told: dict[str, Any] = {"number": number, "solvable": held.scenes[number].solvable}
        told["arm_can"] = not self._ceiling.find_unrevealable(scene)
        try:
            task, known, robot = self._played(scene, scenario, row.motion)
        except Exception as error:  # whatever it is, it is a result
            told |= {"ended": "exception", "exception": repr(error)}
        else:
            told |= told_of(task, known) | {
                "robot": robot,
                "ended": (task.termination or TerminationReason.GAVE_UP).value,
            }
        return told | {"wall": time.perf_counter() - begun}

    def _played(
        self,
        scene: Scene,
        scenario: Scenario,
        motion: str,
    ) -> tuple[ExplorationTask, tuple[SceneObject, ...], float]:
        perceive, policy = make_perception(scenario, scene.support), self._policy(scenario.agent)
        seed, world = scenario.seed, scenario.world
        backend: ClosedLoop | ImageBackend
        if motion == "arm":
            backend = ClosedLoop(scene, perceive=perceive, seed=seed, world=world)
        else:
            assert perceive is not None, "labels with settle are not in the rows"
            backend = ImageBackend(scene, perceive, seed=seed, world=world)
        task = run_episode(backend, policy, max_moves=scenario.max_moves)
        robot = backend.timing.simulated if isinstance(backend, ClosedLoop) else 0.0
        return task, backend.belief.objects, robot


def episodes_of(row: Row, count: int, workers: int, path: Path) -> list[dict[str, Any]]:
    """The first episodes of a row; those that the file has not got are played, and written as they end.

    Raises:
        InputError: the file holds episodes of other networks, scenes or settings.
    """
    scenes = load_scene_dataset(HERE / "scenes" / f"{row.scenes}.json", load_catalog())
    networks = [checkpoint_path(row.agent, PRETRAINED_EXPLORERS)]
    if row.perception != "labels":
        networks.append(checkpoint_path(row.perception, PRETRAINED_DETECTORS))
    scenario = to_plain(
        Scenario(agent=row.agent, perception=row.perception, objects=scenes.metadata["objects"])
    )
    scenario.pop("seed")  # each episode's own: the scene's number
    asked = {"row": row.name, "first": row.first, "sha256": scenes.sha256, "scenario": scenario}
    asked |= {"weights": [file_sha256(file) for file in networks]}
    commit = git_commit()

    def play(done: int) -> Iterator[dict[str, Any]]:
        missing = [Asked(row, row.first + k) for k in range(done, count)]
        made = map_ordered(
            Player, missing, workers=workers, max_items_per_process=EPISODES_OF_A_PROCESS
        )
        for told in track(made, row.name, count, completed=done, console=Console(stderr=True)):
            yield told | {"commit": commit}

    return list(resume_jsonl(path, asked, play, upgrade_head))[1 : 1 + count]


def told_of(task: ExplorationTask, known: Sequence[SceneObject]) -> dict[str, Any]:
    """What is kept of an episode."""
    results = Counter(step.outcome.result for step in task.transitions)
    reasons = Counter(
        s.outcome.detail.split(":")[0]
        for s in task.transitions
        if s.outcome.result is MoveResult.NOT_PLANNED
    )
    worst = (
        task.transitions[-1].outcome
        if task.transitions and task.termination is TerminationReason.COLLAPSED
        else None
    )
    return {
        "hidden": len(task.initially_hidden),
        "found": len(task.found),
        "found_after": np.cumsum(
            [len(step.newly_found) for step in task.transitions], dtype=int
        ).tolist(),
        "moves": len(task.transitions),
        "objects": len(task.scene.objects),
        "known": len(known),
        "recognised": len(match_to_ground_truth(known, task.scene.objects)),
        "results": {result.value: count for result, count in results.items()},
        "not_planned": dict(reasons),
        "collapse": f"{task.transitions[-1].move}: {worst.instability}; {worst.detail}"
        if worst
        else "",
    }


def stage(episode: dict[str, Any]) -> str:
    """What an episode that did not find everything failed of."""
    if episode["ended"] in ("exception", TerminationReason.COLLAPSED.value):
        return str(episode["ended"])
    if not episode["arm_can"]:
        return "what is left lies behind what no cup holds"
    refused = sum(episode["not_planned"].values())
    if refused > episode["moves"] / 2:
        return "moves that the arm cannot plan"
    return str(episode["ended"])


def row_of(row: Row, episodes: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """The figures of a row."""
    won = [e["ended"] == TerminationReason.ALL_FOUND.value for e in episodes]
    played, able = (
        [e for e in episodes if e["ended"] != "exception"],
        [k for k, e in enumerate(episodes) if e["arm_can"]],
    )
    won_able = sum(won[k] for k in able)
    told = {
        "name": row.name,
        **asdict(row),
        "commits": sorted({e["commit"] for e in episodes}),
        "episodes": len(episodes),
        "success": sum(won) / len(won),
        "success_ci95": wilson_interval(sum(won), len(won)),
    }
    told |= {
        "arm_can": len(able) / len(episodes),
        "success_of_arm_can": won_able / len(able) if able else None,
    }
    told["success_of_arm_can_ci95"] = wilson_interval(won_able, len(able)) if able else None
    told |= {
        key: float(np.mean([e[key] for e in played])) if played else None
        for key in ("hidden", "found")
    }
    told["found_ci95"] = mean_interval([e["found"] for e in played])
    told["found_of_hidden"] = sum(e["found"] for e in played) / max(
        1, sum(e["hidden"] for e in played)
    )
    moves = [e["moves"] for e, success in zip(episodes, won, strict=True) if success]
    told["moves_of_successes"] = float(np.mean(moves)) if moves else None
    # Of the list of objects that the agent has at the end of a success.
    lists = [e for e in played if e["ended"] == TerminationReason.ALL_FOUND.value]
    right = sum(e["recognised"] for e in lists)
    told["list_recall"] = right / max(1, sum(e["objects"] for e in lists))
    told["list_precision"] = right / max(1, sum(e["known"] for e in lists))
    told["robot_minutes"] = float(np.median([e["robot"] for e in played])) / 60 if played else None
    told["wall_seconds"] = float(np.median([e["wall"] for e in episodes]))
    told["not_planned"] = dict(sum((Counter(e["not_planned"]) for e in played), Counter[str]()))
    told["dropped"] = sum(e["results"].get(MoveResult.DROPPED.value, 0) for e in played)
    told["failed_of"] = dict(
        Counter(stage(e) for e, success in zip(episodes, won, strict=True) if not success)
    )
    return told


def table_of(rows: Sequence[dict[str, Any]]) -> Table:
    """For the screen."""
    table = Table(
        "set",
        "perception",
        "motion",
        "episodes",
        "success",
        "arm can",
        "of these",
        "found",
        "moves",
        "robot min",
        "wall s",
    )
    for row in rows:
        low, high = row["success_ci95"]
        figures = (
            "arm_can",
            "success_of_arm_can",
            "found_of_hidden",
            "moves_of_successes",
            "robot_minutes",
        )
        numbers = [row[key] for key in figures]
        cells = [
            row["scenes"],
            row["perception"],
            row["motion"],
            str(row["episodes"]),
            f"{row['success']:.2f} ({low:.2f} to {high:.2f})",
        ]
        cells += ["" if number is None else f"{number:.2f}" for number in numbers]
        table.add_row(*cells, f"{row['wall_seconds']:.0f}")
    return table


def main(
    folder: Annotated[
        Path, typer.Argument(metavar="DIR", help="Where the episodes go.")
    ] = EPISODES,
    workers: Annotated[int, typer.Option(min=1)] = 1,
    count: Annotated[int | None, typer.Option(min=1, help="Of each row's scenes, at most.")] = None,
    only: Annotated[str | None, typer.Option(help="Of rows whose name contains this.")] = None,
    perception: Annotated[
        str | None,
        typer.Option(metavar="FILE", help="A detector's checkpoint, in place of the shipped."),
    ] = None,
    out: Annotated[Path, typer.Option(help="JSON to write.")] = OUT,
) -> None:
    """Plays what is missing and prints the table."""
    if out == OUT and (perception or folder != EPISODES):
        raise InputError(
            f"--out {out}: is of the shipped detectors and the episodes in {EPISODES}; give another file"
        )
    rows = [row for row in ROWS if only is None or only in row.name]
    if not rows:
        raise InputError(
            f"--only {only}; allowed is a part of one of {', '.join(row.name for row in ROWS)}"
        )
    folder.mkdir(parents=True, exist_ok=True)
    told = json.loads(out.read_text())["rows"] if out.exists() else []
    for row in rows:
        if perception is not None and row.perception != "labels":
            row = replace(row, perception=perception)
        there = min(row.count, count or row.count)
        made = row_of(row, episodes_of(row, there, workers, folder / f"{row.name}.jsonl"))
        told = sorted(
            [made, *(other for other in told if other["name"] != row.name)],
            key=lambda other: str(other["name"]),
        )
        write_json(out, {"rows": told})
    Console(width=180).print(table_of(told))


if __name__ == "__main__":
    with cli_error_handler():
        typer.run(main)
