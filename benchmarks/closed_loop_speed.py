"""Measure the wall time of closed-loop episodes with the arm, and where it goes.

    python benchmarks/closed_loop_speed.py --count 20 --out closed_loop_speed.json

Episodes of the rows of `training/evaluate_closed_loop.py` with two cups in scenes of SG* are run in
this process. The first one is run once before, so that neither compilation nor loading counts.
The time of an episode includes building its diagram. Times mean little unless nothing else runs on
the machine.
"""

from collections.abc import Sequence
from typing import Annotated, Any

import typer

from benchmarks.measurement import Stopwatch, describe_machine
from benchmarks.pick_place import OutOption, quantiles, write_results
from drake_clutter.planning.pick_place_planner import PickPlacePlanner
from drake_clutter.simulation.plant_rasterizer import PlantRasterizer
from drake_clutter.station.arm_executor import evaluate_outcome
from drake_clutter.station.station_simulation import StationSimulation
from drake_clutter.systems import closed_loop
from drake_clutter.systems.perception_system import LabelPerception, LearnedPerception
from drake_clutter.systems.policy_system import PolicySystem
from training.evaluate_closed_loop import (
    EVALUATIONS,
    EXCEPTION,
    ClosedLoopEvaluation,
    EpisodeRequest,
    EpisodeRunner,
)
from training.results_file import Row
from training.script import progress, run_script

SCENES = "sg_star_25"
CELL = "two_cups"
STEPS = "steps of the diagrams"
"""Part that contains the parts `INSIDE_STEPS`."""
INSIDE_STEPS = ("planning", "policy", "detection", "images")
PARTS: dict[str, tuple[Any, Any]] = {
    STEPS: (StationSimulation, StationSimulation.step),
    "building of simulations": (StationSimulation, StationSimulation.__init__),
    "planning": (PickPlacePlanner, PickPlacePlanner.plan),
    "policy": (PolicySystem, PolicySystem.after_observation),
    "perfect detection": (LabelPerception, LabelPerception.__call__),
    "learned detection": (LearnedPerception, LearnedPerception.__call__),
    "images": (PlantRasterizer, PlantRasterizer.render),
    "settling": (closed_loop, evaluate_outcome),
    "episode": (EpisodeRunner, EpisodeRunner.run),
}
"""Owner and function of each part of an episode."""


def measure(evaluation: ClosedLoopEvaluation, count: int) -> dict[str, Any]:
    """Return the times of the first episodes of a row, and the share of each part."""
    runner = EpisodeRunner()
    numbers = [evaluation.first + k for k in range(count)]
    runner(EpisodeRequest(evaluation, numbers[0]))
    stopwatch = Stopwatch()
    with stopwatch.watch(PARTS):
        records = [
            runner(EpisodeRequest(evaluation, number))
            for number in progress(numbers, evaluation.name, count)
        ]
    return {
        "row": evaluation.name,
        "perception": evaluation.perception,
        "episodes": count,
        "wall_s": quantiles(stopwatch.seconds["episode"]),
        "shares": _shares(stopwatch),
        **_summary(records),
    }


def _shares(stopwatch: Stopwatch) -> dict[str, float]:
    """Return the share of each part of the time of all episodes."""
    seconds = {name: stopwatch.total(name) for name in PARTS if name != "episode"}
    seconds["detection"] = seconds.pop("perfect detection") + seconds.pop("learned detection")
    seconds["simulation"] = seconds.pop(STEPS) - sum(seconds[name] for name in INSIDE_STEPS)
    total = stopwatch.total("episode")
    shares = {name: value / total for name, value in seconds.items()}
    return shares | {"other": 1 - sum(shares.values())}


def _summary(records: Sequence[Row]) -> dict[str, Any]:
    """Return what the episodes did."""
    complete = [record for record in records if record["ended"] != EXCEPTION]
    return {
        "exceptions": len(records) - len(complete),
        "moves": quantiles([record["moves"] for record in complete]),
        "robot_s": quantiles([record["robot"] for record in complete]),
        "found_all": sum(record["found"] == record["hidden"] for record in complete),
    }


def main(
    out: OutOption,
    count: Annotated[int, typer.Option(min=1, help="Number of episodes of each row.")] = 20,
) -> None:
    """Measure the wall time of closed-loop episodes."""
    evaluations = [e for e in EVALUATIONS if (e.scenes, e.motion, e.cell) == (SCENES, "arm", CELL)]
    rows = [measure(evaluation, count) for evaluation in evaluations]
    machine = describe_machine("drake", "numpy", "numba", "torch")
    command = f"benchmarks/closed_loop_speed.py --count {count}"
    write_results(out, {"command": command, "count": count, "rows": rows, "machine": machine})


if __name__ == "__main__":
    run_script(main)
