"""Compare optimized carries with those straight up, across and down, in closed-loop episodes.

    python benchmarks/carry_clearance.py runs/carries --scenes 60:160 --workers 2 \
        --out benchmarks/results/carry_clearance.json

Each scene is explored twice with the same seed: with trajectory optimization and without. FOLDER
keeps one record per episode; an interrupted run is resumed by the same command, and a longer range
of scenes extends it.
"""

from collections.abc import Generator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from pydantic import BaseModel

from drake_clutter.catalog import load_catalog
from drake_clutter.config import ClutterConfig
from drake_clutter.files import InputError
from drake_clutter.planning.pick_place_plan import PickPlacePlan
from drake_clutter.scenes.interfaces import MoveResult
from drake_clutter.scenes.scene_dataset import load_scene_dataset
from drake_clutter.statistics import wilson_interval
from drake_clutter.systems.closed_loop import ClosedLoop, default_planner_config
from drake_clutter.systems.scenario import Scenario, make_perception, make_policy
from drake_clutter.tasks.belief import Decision, Policy
from drake_clutter.tasks.episode import run_episode
from drake_clutter.tasks.exploration_task import MoveAttempt, TerminationReason
from drake_clutter.validation import CountOrZero, Flag, NonEmptyText, NonNegative, to_plain
from training.results_file import ResultsFile, Row, collect_records
from training.script import SCENES, ResultsOption, WorkersOption, print_table, run_script

EXCEPTION = "exception"
"""How an episode ended that raised an exception."""
EPISODES_PER_PROCESS = 10
"""Episodes after which a process is replaced: each keeps some hundred MB, see `map_ordered`."""


@dataclass(frozen=True)
class EpisodeRequest:
    """One episode.

    Attributes:
        number: Number of the scene in its dataset, and seed of the episode.
        optimize: Whether trajectories are optimized.
    """

    number: int
    optimize: bool


class EpisodeRecord(BaseModel):
    """Record of an episode.

    Attributes:
        number: See `EpisodeRequest`.
        optimize: See `EpisodeRequest`.
        ended: Termination reason, or `EXCEPTION`.
        exception: The exception, or "".
        solved: Whether every object has been in view.
        collapsed: Whether the scene collapsed or an object left the tray.
        failure: Move and instability of such an episode, or "".
        came_off: Number of moves on which the object came off the gripper.
        moves: Number of moves, including those that could not be planned.
        executed: Number of moves that were carried out.
        motion_time: Duration of all planned trajectories [s].
        unoptimized_carries: Number of carries that optimization did not shorten.
    """

    number: CountOrZero
    optimize: Flag
    ended: NonEmptyText
    exception: str = ""
    solved: Flag = False
    collapsed: Flag = False
    failure: str = ""
    came_off: CountOrZero = 0
    moves: CountOrZero = 0
    executed: CountOrZero = 0
    motion_time: NonNegative = 0.0
    unoptimized_carries: CountOrZero = 0


class RecordedLoop(ClosedLoop):
    """Closed loop that keeps its plans.

    Attributes:
        plans: Plans that were carried out, by number.
    """

    plans: dict[int, PickPlacePlan]

    def rollout(self, policy: Policy) -> Generator[MoveAttempt, None, Decision]:
        """Run a policy, see `ClosedLoop.rollout`."""
        self.plans = {}
        attempts = super().rollout(policy)
        while True:
            try:
                attempt = next(attempts)
            except StopIteration as end:
                decision: Decision = end.value
                return decision
            state = self.simulation.executor_state
            if isinstance(state.plan, PickPlacePlan):
                self.plans[state.number] = state.plan
            yield attempt


class EpisodeRunner:
    """Runs episodes; a worker for `map_ordered`."""

    def __init__(self, name: str, scenario: Scenario) -> None:
        """Load the scenes and the policy.

        Args:
            name: Name of the scene dataset.
            scenario: Scenario of the episodes; the seed is the number of the scene.
        """
        self._scenes = load_scene_dataset(SCENES / f"{name}.json", load_catalog())
        self._scenario = scenario
        self._policy = make_policy(scenario.agent, scenario.world)

    def __call__(self, request: EpisodeRequest) -> Row:
        """Run an episode and return its record."""
        try:
            record = self._run(request)
        except Exception as error:  # Any exception is a result.
            record = EpisodeRecord(
                number=request.number,
                optimize=request.optimize,
                ended=EXCEPTION,
                exception=repr(error),
            )
        return record.model_dump()

    def _run(self, request: EpisodeRequest) -> EpisodeRecord:
        scenario = replace(self._scenario, seed=request.number)
        scene = self._scenes.settled_scene(request.number, self._scenes.grammar, scenario.world)
        perceive = make_perception(scenario, scene)
        loop = RecordedLoop(
            scene,
            perceive=perceive,
            seed=scenario.seed,
            config=scenario.world,
            planner_config=replace(
                default_planner_config(perceive is not None), optimize=request.optimize
            ),
        )
        task = run_episode(loop, self._policy, max_moves=scenario.max_moves)
        outcomes = [transition.outcome for transition in task.transitions]
        termination = task.termination or TerminationReason.GAVE_UP
        failure = ""
        if termination.is_failed_move:
            failure = f"{task.transitions[-1].move}: {outcomes[-1].instability_text}"
        carries = [
            segment
            for plan in loop.plans.values()
            for segment in plan.segments
            if segment.name == "carry"
        ]
        return EpisodeRecord(
            number=request.number,
            optimize=request.optimize,
            ended=termination.value,
            solved=termination is TerminationReason.ALL_FOUND,
            collapsed=termination.is_failed_move,
            failure=failure,
            came_off=sum(
                outcome.result is MoveResult.DROPPED or outcome.detail.startswith("came off")
                for outcome in outcomes
            ),
            moves=len(outcomes),
            executed=len(loop.plans),
            motion_time=sum(plan.duration for plan in loop.plans.values()),
            unoptimized_carries=sum(
                carry.duration >= carry.unoptimized_duration for carry in carries
            ),
        )


def summarize(episodes: Sequence[EpisodeRecord]) -> Row:
    """Return the metrics of the episodes of one kind."""
    count = len(episodes)
    num_executed = sum(episode.executed for episode in episodes)
    num_solved = sum(episode.solved for episode in episodes)
    num_collapsed = sum(episode.collapsed for episode in episodes)
    num_came_off = sum(episode.came_off for episode in episodes)
    return {
        "solved": num_solved,
        "solved_ci95": wilson_interval(num_solved, count),
        "collapsed": num_collapsed,
        "collapsed_ci95": wilson_interval(num_collapsed, count),
        "came_off": num_came_off,
        "executed_moves": num_executed,
        "exceptions": sum(episode.ended == EXCEPTION for episode in episodes),
        "motion_seconds_per_move": sum(episode.motion_time for episode in episodes)
        / max(1, num_executed),
        "unoptimized_carries": sum(episode.unoptimized_carries for episode in episodes),
        "failures": [f"{e.number}: {e.failure}" for e in episodes if e.failure],
    }


def compare(episodes: Sequence[EpisodeRecord]) -> Row:
    """Return the paired metrics: those of each kind, and how many scenes differ.

    Args:
        episodes: Episodes with and without optimization of the same scenes.
    """
    by_kind = {
        kind: {e.number: e for e in episodes if e.optimize is optimize}
        for kind, optimize in (("optimized", True), ("unoptimized", False))
    }
    pairs = [
        (with_, by_kind["unoptimized"][number]) for number, with_ in by_kind["optimized"].items()
    ]
    ratios = [
        (a.motion_time / a.executed) / (b.motion_time / b.executed)
        for a, b in pairs
        if a.executed and b.executed
    ]
    return {
        "scenes": len(pairs),
        **{kind: summarize([*of_kind.values()]) for kind, of_kind in by_kind.items()},
        "solved_only_optimized": sum(a.solved and not b.solved for a, b in pairs),
        "solved_only_unoptimized": sum(b.solved and not a.solved for a, b in pairs),
        "collapsed_only_optimized": sum(a.collapsed and not b.collapsed for a, b in pairs),
        "collapsed_only_unoptimized": sum(b.collapsed and not a.collapsed for a, b in pairs),
        "median_motion_time_ratio": float(np.median(ratios)) if ratios else None,
    }


def parse_range(text: str) -> range:
    """Return the range of scenes FIRST:LAST, without LAST.

    Raises:
        InputError: The text is no such range.
    """
    first, _, last = text.partition(":")
    if first.isdecimal() and last.isdecimal() and int(first) < int(last):
        return range(int(first), int(last))
    raise InputError(f"--scenes {text}; expected FIRST:LAST, two numbers with FIRST < LAST")


def main(
    folder: Annotated[Path, typer.Argument(metavar="FOLDER", help="Folder of the record files.")],
    scenes: Annotated[
        str, typer.Option(metavar="FIRST:LAST", help="Scenes of the dataset, without LAST.")
    ],
    dataset: Annotated[str, typer.Option(metavar="NAME", help="Scene dataset.")] = "sg_star_25",
    perception: Annotated[
        str, typer.Option(metavar="NAME", help="labels, depth or depth-color.")
    ] = "labels",
    agent: Annotated[str, typer.Option(metavar="NAME", help="Explorer.")] = "student",
    workers: WorkersOption = 1,
    out: ResultsOption = None,
) -> None:
    """Run the episodes that are missing, and print the table."""
    numbers = parse_range(scenes)
    loaded = load_scene_dataset(SCENES / f"{dataset}.json", load_catalog())
    if numbers.stop > len(loaded.scenes):
        raise InputError(f"--scenes {scenes}; expected numbers up to {len(loaded.scenes)}")
    objects = loaded.metadata["objects"]
    scenario = Scenario(agent=agent, perception=perception, objects=objects, world=ClutterConfig())
    planner = default_planner_config(perception != "labels")
    plain = to_plain(scenario)
    plain.pop("seed")  # Each episode's seed is the number of its scene.
    header = {
        "dataset": dataset,
        "sha256": loaded.sha256,
        "first": numbers.start,
        "scenario": plain,
        "planner": to_plain(planner),
    }
    folder.mkdir(parents=True, exist_ok=True)
    records = collect_records(
        folder / f"{dataset}_{agent}_{perception}_{numbers.start}.jsonl",
        header,
        partial(EpisodeRunner, dataset, scenario),
        [EpisodeRequest(number, optimize) for number in numbers for optimize in (True, False)],
        schema=EpisodeRecord,
        workers=workers,
        max_items_per_process=EPISODES_PER_PROCESS,
    )
    row = compare([EpisodeRecord(**record) for record in records])
    row = {
        "dataset": dataset,
        "agent": agent,
        "perception": perception,
        "first": numbers.start,
        "last": numbers.stop - 1,
        **row,
        "commits": sorted({record["commit"] for record in records}),
        "commit": records[-1]["commit"],
        "software_version": records[-1]["software_version"],
    }
    if out:
        common = {"planner": to_plain(planner)}
        ResultsFile(out, common, ("dataset", "agent", "perception", "first")).add(row)
    print_table(
        [
            {
                "carries": kind,
                "scenes": str(row["scenes"]),
                "solved": str(row[kind]["solved"]),
                "collapsed": str(row[kind]["collapsed"]),
                "came off": str(row[kind]["came_off"]),
                "moves": str(row[kind]["executed_moves"]),
                "s per move": f"{row[kind]['motion_seconds_per_move']:.2f}",
            }
            for kind in ("optimized", "unoptimized")
        ]
    )


if __name__ == "__main__":
    run_script(main)
