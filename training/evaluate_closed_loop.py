"""Evaluate closed-loop exploration with perfect or learned perception, teleported or arm motion.

    python training/evaluate_closed_loop.py --workers 2
    python training/evaluate_closed_loop.py runs/closed_loop --only arm --count 20 --out part.json

Every episode is a record in `training/results/closed_loop`, in one file for each row of the table.
An interrupted run is resumed by the same command. An episode that ends in an exception counts as a
failure.

An episode succeeds when every object has been in view, by ground truth. `list_recall` and
`list_precision` compare the agent's list of objects with the scene at the end of the successful
episodes: class, and position within 4 cm. `arm_can` is false for a scene in which some objects stay
hidden whatever the arm does, because suction cannot hold what covers them.
"""

import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from functools import cache
from pathlib import Path
from typing import Annotated, Any, Self

import numpy as np
import typer
from pydantic import BaseModel, model_validator

from drake_clutter.agents.explorers import PRETRAINED_EXPLORERS
from drake_clutter.catalog import load_catalog
from drake_clutter.cell.work_cell import load_cell
from drake_clutter.config import ClutterConfig, upgrade_header_configs
from drake_clutter.files import InputError, file_sha256
from drake_clutter.learning.pretrained import checkpoint_path
from drake_clutter.resources import resource_path
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
from drake_clutter.validation import (
    CountOrZero,
    Flag,
    NonEmptyText,
    NonNegative,
    override_config,
    rejected_error,
    to_plain,
)
from training.results_file import ResultsFile, Row, collect_records
from training.script import (
    RESULTS,
    SCENES,
    WorkersOption,
    format_number,
    print_table,
    run_script,
)

RESULTS_FILE = RESULTS / "closed_loop.json"
"""Published results."""
EPISODES = RESULTS / "closed_loop"
"""Folder of the published episodes."""
EPISODES_PER_PROCESS = 10
"""Episodes after which a process is replaced: each keeps some hundred MB, see `map_ordered`."""
CELLS = {"one_cup": "ur10_single_cup_tray", "two_cups": "ur10_epick_tray"}
"""Cells of the published episodes. The only cup of the first holds no marker."""
EXCEPTION = "exception"
"""How an episode ended that raised an exception."""
_CAUSES = {EXCEPTION, *(reason.value for reason in TerminationReason if reason.is_failed_move)}
"""Ends of episodes that are causes of failure themselves."""


@dataclass(frozen=True)
class ClosedLoopEvaluation:
    """One row of the table: episodes of one kind.

    Teleported moves with perfect perception are in the explorers' table.

    Attributes:
        perception: See `Scenario`.
        motion: "settle" (teleported, then settled in Drake) or "arm".
        scenes: Name of the scene dataset.
        agent: See `Scenario`.
        first: Number of the first scene; earlier scenes were used in development.
        count: Number of scenes.
        cell: Key of `CELLS`.
    """

    perception: str
    motion: str
    scenes: str
    agent: str
    first: int
    count: int
    cell: str

    @property
    def name(self) -> str:
        """Name of the record file; the cell is left out if it has one cup."""
        agent, perception = Path(self.agent).stem, Path(self.perception).stem
        name = f"{self.scenes}_{agent}_{perception}_{self.motion}"
        return name if self.cell == "one_cup" else f"{name}_{self.cell}"


EVALUATIONS = [
    ClosedLoopEvaluation(perception, motion, scenes, agent, first, count, cell)
    for scenes, agent, first, count in (
        ("sg_star_25", "student", 60, 100),
        ("sg_14", "student-14", 50, 50),
    )
    for perception, motion, cell in (
        ("depth", "settle", "one_cup"),
        ("depth-color", "settle", "one_cup"),
        ("depth", "arm", "one_cup"),
        ("labels", "arm", "one_cup"),
        ("depth", "arm", "two_cups"),
        ("labels", "arm", "two_cups"),
    )
]
"""Rows of the table."""


@dataclass(frozen=True)
class EpisodeRequest:
    """One episode of a row.

    Attributes:
        evaluation: The row.
        number: Number of the scene in its set, and seed of the episode.
    """

    evaluation: ClosedLoopEvaluation
    number: int


def make_scenario(evaluation: ClosedLoopEvaluation, scenes: SceneDataset, seed: int) -> Scenario:
    """Return the scenario of an episode."""
    return Scenario(
        agent=evaluation.agent,
        perception=evaluation.perception,
        objects=scenes.metadata["objects"],
        seed=seed,
        world=make_world(evaluation.cell),
    )


@cache
def make_world(cell: str) -> ClutterConfig:
    """Return the configuration with one of the `CELLS`."""
    return ClutterConfig(cell=load_cell(resource_path(f"models/cells/{CELLS[cell]}.yaml")))


class EpisodeRunner:
    """Runs episodes; a worker for `map_ordered`."""

    def __init__(self) -> None:
        """Load the data that all episodes share."""
        catalog = load_catalog()
        self._load_set = cache(lambda name: load_scene_dataset(SCENES / f"{name}.json", catalog))
        self._make_policy = cache(lambda agent, cell: make_policy(agent, make_world(cell)))
        self._reachability_bound = cache(lambda cell: ArmReachabilityBound(make_world(cell)))

    def __call__(self, request: EpisodeRequest) -> Row:
        """Run an episode and return its record."""
        evaluation, number = request.evaluation, request.number
        scenes: SceneDataset = self._load_set(evaluation.scenes)
        scenario = make_scenario(evaluation, scenes, number)
        scene = scenes.settled_scene(number, scenes.grammar, scenario.world)
        start = time.perf_counter()
        record: Row = {
            "number": number,
            "solvable": scenes.scenes[number].solvable,
            "arm_can": not self._reachability_bound(evaluation.cell).find_unrevealable(scene),
        }
        try:
            task, known, robot_time = self.run(scene, scenario, evaluation)
        except Exception as error:  # Any exception is a result.
            record |= {"ended": EXCEPTION, "exception": repr(error)}
        else:
            record |= episode_record(task, known)
            record |= {
                "robot": robot_time,
                "ended": (task.termination or TerminationReason.GAVE_UP).value,
            }
        return record | {"wall": time.perf_counter() - start}

    def run(
        self, scene: Scene, scenario: Scenario, evaluation: ClosedLoopEvaluation
    ) -> tuple[ExplorationTask, tuple[SceneObject, ...], float]:
        """Return the episode, the agent's list of objects, and the robot's time [s]."""
        perceive = make_perception(scenario, scene)
        policy = self._make_policy(evaluation.agent, evaluation.cell)
        backend: ClosedLoop | ImageBackend
        if evaluation.motion == "arm":
            backend = ClosedLoop(
                scene, perceive=perceive, seed=scenario.seed, config=scenario.world
            )
        else:
            assert perceive is not None, "no row has perfect perception and teleported moves"
            backend = ImageBackend(scene, perceive, seed=scenario.seed, config=scenario.world)
        task = run_episode(backend, policy, max_moves=scenario.max_moves)
        robot_time = backend.timing.simulated if isinstance(backend, ClosedLoop) else 0.0
        return task, backend.belief.objects, robot_time


class EpisodeRecord(BaseModel):
    """Record of an episode; one that ended with an exception has the first fields alone."""

    number: CountOrZero
    arm_can: Flag
    ended: NonEmptyText
    wall: NonNegative
    commit: str
    hidden: CountOrZero = 0
    found: CountOrZero = 0
    moves: CountOrZero = 0
    objects: CountOrZero = 0
    known: CountOrZero = 0
    recognised: CountOrZero = 0
    robot: NonNegative = 0
    results: dict[str, CountOrZero] = {}
    not_planned: dict[str, CountOrZero] = {}

    @model_validator(mode="after")
    def _check_completeness(self) -> Self:
        missing = EpisodeRecord.model_fields.keys() - self.model_fields_set
        if missing and self.ended != EXCEPTION:
            raise rejected_error(f"{min(missing)}: is missing; expected the record of an episode")
        return self


def collect_episodes(
    evaluation: ClosedLoopEvaluation, count: int, workers: int, path: Path
) -> list[Row]:
    """Return the records of a row's first episodes; those that the file lacks are run.

    Args:
        evaluation: The row.
        count: Number of episodes.
        workers: Number of processes.
        path: The record file.

    Raises:
        InputError: The file holds episodes of other networks, scenes or settings.
    """
    scenes = load_scene_dataset(SCENES / f"{evaluation.scenes}.json", load_catalog())
    networks = [checkpoint_path(evaluation.agent, PRETRAINED_EXPLORERS)]
    if evaluation.perception != "labels":
        networks.append(checkpoint_path(evaluation.perception, PRETRAINED_DETECTORS))
    scenario = to_plain(make_scenario(evaluation, scenes, seed=0))
    scenario.pop("seed")  # Each episode's seed is the number of its scene.
    header = {
        "row": evaluation.name,
        "first": evaluation.first,
        "sha256": scenes.sha256,
        "scenario": scenario,
        "weights": [file_sha256(file) for file in networks],
    }
    requests = [EpisodeRequest(evaluation, evaluation.first + k) for k in range(count)]
    return collect_records(
        path,
        header,
        EpisodeRunner,
        requests,
        schema=EpisodeRecord,
        workers=workers,
        max_items_per_process=EPISODES_PER_PROCESS,
        upgrade=upgrade_scenario,
    )


def upgrade_scenario(header: Any) -> Any:
    """Upgrade the header of a record file of an earlier version to the current names of fields."""
    header = upgrade_header_configs(header)
    scenario = to_plain(override_config(Scenario(), header["scenario"], "scenario"))
    scenario.pop("seed")
    return header | {"scenario": scenario}


def episode_record(task: ExplorationTask, known: Sequence[SceneObject]) -> Row:
    """Return the record of an episode.

    Args:
        task: The episode.
        known: The agent's list of objects at the end.
    """
    outcomes = [step.outcome for step in task.transitions]
    not_planned = [o.detail for o in outcomes if o.result is MoveResult.NOT_PLANNED]
    collapse = ""
    if outcomes and outcomes[-1].result.ends_episode:
        last = outcomes[-1]
        collapse = f"{task.transitions[-1].move}: {last.instability_text}; {last.detail}"
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
        "results": dict(Counter(o.result.value for o in outcomes)),
        "not_planned": dict(Counter(detail.split(":")[0] for detail in not_planned)),
        "failed_parts": dict(Counter(o.failed_part.value for o in outcomes if o.failed_part)),
        "collapse": collapse,
    }


def failure_cause(episode: Row) -> str:
    """Return why an unsuccessful episode failed."""
    if episode["ended"] in _CAUSES:
        return str(episode["ended"])
    if not episode["arm_can"]:
        return "remaining objects unreachable by suction"
    if sum(episode["not_planned"].values()) > episode["moves"] / 2:
        return "most moves not plannable"
    return str(episode["ended"])


def summarize(evaluation: ClosedLoopEvaluation, episodes: Sequence[Row]) -> Row:
    """Return the metrics of a row.

    Args:
        evaluation: The row.
        episodes: Records of its episodes.
    """
    successes = [e["ended"] == TerminationReason.ALL_FOUND.value for e in episodes]
    successful = [e for e, success in zip(episodes, successes, strict=True) if success]
    failed = [e for e, success in zip(episodes, successes, strict=True) if not success]
    completed = [e for e in episodes if e["ended"] != EXCEPTION]
    solvable = [k for k, e in enumerate(episodes) if e["arm_can"]]
    num_solved = sum(successes[k] for k in solvable)
    num_matched = sum(e["recognised"] for e in successful)
    causes = Counter(failure_cause(e) for e in failed)
    planning_failures = sum((Counter(e["not_planned"]) for e in completed), Counter[str]())

    def mean(key: str) -> float | None:
        return float(np.mean([e[key] for e in completed])) if completed else None

    return {
        "name": evaluation.name,
        **asdict(evaluation),
        "commits": sorted({e["commit"] for e in episodes}),
        "episodes": len(episodes),
        "success": sum(successes) / len(successes),
        "success_ci95": wilson_interval(sum(successes), len(successes)),
        "arm_can": len(solvable) / len(episodes),
        "success_of_arm_can": num_solved / len(solvable) if solvable else None,
        "success_of_arm_can_ci95": wilson_interval(num_solved, len(solvable)) if solvable else None,
        "hidden": mean("hidden"),
        "found": mean("found"),
        "found_ci95": mean_interval(
            [e["found"] for e in completed],
            0,
            max((e["objects"] for e in completed), default=0),
        ),
        "found_of_hidden": sum(e["found"] for e in completed)
        / max(1, sum(e["hidden"] for e in completed)),
        "moves_of_successes": float(np.mean([e["moves"] for e in successful]))
        if successful
        else None,
        "list_recall": num_matched / max(1, sum(e["objects"] for e in successful)),
        "list_precision": num_matched / max(1, sum(e["known"] for e in successful)),
        "robot_minutes": float(np.median([e["robot"] for e in completed])) / 60
        if completed
        else None,
        "wall_seconds": float(np.median([e["wall"] for e in episodes])),
        "not_planned": dict(planning_failures),
        "dropped": sum(e["results"].get(MoveResult.DROPPED.value, 0) for e in completed),
        "failed_of": dict(causes),
    }


def table_row(row: Row) -> dict[str, str]:
    """Return a row of the results as cells of the printed table."""
    low, high = row["success_ci95"]
    return {
        "set": row["scenes"],
        "perception": row["perception"],
        "motion": row["motion"],
        "cell": row.get("cell", "one_cup"),
        "episodes": str(row["episodes"]),
        "success (95 %)": f"{row['success']:.2f} ({low:.2f}-{high:.2f})",
        "solvable by arm": format_number(row["arm_can"]),
        "success of these": format_number(row["success_of_arm_can"]),
        "found of hidden": format_number(row["found_of_hidden"]),
        "moves": format_number(row["moves_of_successes"]),
        "robot (min)": format_number(row["robot_minutes"]),
        "wall (s)": format_number(row["wall_seconds"], 0),
    }


def main(
    folder: Annotated[
        Path, typer.Argument(metavar="DIR", help="Folder for the records of the episodes.")
    ] = EPISODES,
    workers: WorkersOption = 1,
    count: Annotated[
        int | None, typer.Option(min=1, help="Only the first N scenes of each row.")
    ] = None,
    only: Annotated[
        str | None, typer.Option(metavar="TEXT", help="Only rows whose name contains this text.")
    ] = None,
    perception: Annotated[
        str | None,
        typer.Option(metavar="FILE", help="Checkpoint of a detector, instead of the shipped ones."),
    ] = None,
    out: Annotated[
        Path, typer.Option(metavar="FILE", help="Results file to write (JSON).")
    ] = RESULTS_FILE,
) -> None:
    """Run the episodes that are missing, and print the table."""
    if out == RESULTS_FILE and (perception or folder != EPISODES):
        raise InputError(
            f"--out {out}: is for the shipped detectors and the episodes in {EPISODES}; give"
            " another file"
        )
    evaluations = [e for e in EVALUATIONS if only is None or only in e.name]
    if not evaluations:
        names = ", ".join(e.name for e in EVALUATIONS)
        raise InputError(f"--only {only}; expected a part of one of {names}")
    folder.mkdir(parents=True, exist_ok=True)
    results = ResultsFile(out, {}, ("name",))
    results.read()
    for evaluation in evaluations:
        if perception is not None and evaluation.perception != "labels":
            evaluation = replace(evaluation, perception=perception)
        num_episodes = min(evaluation.count, count or evaluation.count)
        path = folder / f"{evaluation.name}.jsonl.gz"
        episodes = collect_episodes(evaluation, num_episodes, workers, path)
        results.add(summarize(evaluation, episodes))
    print_table([table_row(row) for row in results.read()])


if __name__ == "__main__":
    run_script(main)
