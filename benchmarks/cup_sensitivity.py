"""Measure how the assumed numbers of suction cups affect simulated pick-and-place moves.

    python benchmarks/cup_sensitivity.py --count 20 --out cup_sensitivity.json

Random legal moves are planned and simulated with the default cell, and with each number 30 %
smaller and 30 % larger. An interrupted run is resumed by the same command.
"""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Annotated, Any

import numpy as np
import typer

from benchmarks.pick_place import (
    CARRIED_OUT,
    CONFIG,
    NODES,
    MoveSampler,
    OutOption,
    SampledMove,
    execution_result,
    quantiles,
    write_results,
)
from drake_clutter.cell.suction import SuctionGripper
from drake_clutter.cell.work_cell import WorkCell, default_cell
from drake_clutter.planning.pick_place_plan import PickPlacePlan, PlanningFailure
from drake_clutter.planning.pick_place_planner import PickPlacePlanner
from drake_clutter.planning.planner_config import PlannerConfig
from drake_clutter.records import partial_records
from drake_clutter.station.arm_executor import ArmExecutor
from drake_clutter.station.station_simulation import simulate_plan
from training.results_file import collect_records
from training.script import SeedOption, run_script

GRIPPER_FIELDS = (
    "vacuum",
    "friction",
    "unevenness",
    "max_tilt_deg",
    "pump_time_constant",
    "leak_time_constant",
    "loss_time_constant",
    "detection_vacuum",
    "lift_vacuum",
)
"""Numbers of the gripper that are varied."""
CUP_FIELDS = {
    "stiffness": "stiffness",
    "bending_stiffness": "hinge_stiffness",
    "stroke": "stroke",
}
"""Numbers of every cup that are varied, and the names of their present values."""
FACTORS = (0.7, 1.3)
"""Factors by which a number is changed."""
SETTINGS = [("default", 1.0), *itertools.product((*GRIPPER_FIELDS, *CUP_FIELDS), FACTORS)]
"""Name of the changed number and factor of each setting."""


@dataclass(frozen=True)
class SettingTrials:
    """Record of a setting.

    Attributes:
        results: Result of each move, or why there is no plan.
        durations: Simulated time of each planned move [s].
        place_errors: Error of the final position of each move that was carried out [m].
        load_ratios: Largest ratio of the load to the load capacity of each planned move.
    """

    results: tuple[str, ...]
    durations: tuple[float, ...]
    place_errors: tuple[float, ...]
    load_ratios: tuple[float, ...]


def change_cell(name: str, factor: float) -> WorkCell:
    """Return the default cell with one number of its gripper or of all cups multiplied."""
    cell = default_cell()
    gripper = cell.gripper
    assert isinstance(gripper, SuctionGripper)
    changes: dict[str, Any] = {}
    if name in GRIPPER_FIELDS:
        largest = 1.0 if name == "lift_vacuum" else np.inf
        changes = {name: min(factor * getattr(gripper, name), largest)}
    elif name in CUP_FIELDS:
        present = CUP_FIELDS[name]
        cups = [c.model_copy(update={name: factor * getattr(c, present)}) for c in gripper.cups]
        changes = {"cups": tuple(cups)}
    return cell.model_copy(update={"gripper": gripper.model_copy(update=changes)})


class SettingTester:
    """Plans and simulates the same moves with a setting; a worker for `map_ordered`."""

    def __init__(self, count: int, seed: int) -> None:
        """Sample moves that are planned with the default cell.

        Args:
            count: Number of moves.
            seed: Seed of scenes and moves.
        """
        executor = ArmExecutor(CONFIG)
        found = (
            move
            for move in filter(None, map(MoveSampler(NODES, seed), itertools.count()))
            if isinstance(executor.plan(move.scene, move.command), PickPlacePlan)
        )
        self._moves: list[SampledMove] = list(itertools.islice(found, count))

    def __call__(self, number: int) -> SettingTrials:
        """Return the trials with the setting of a number."""
        cell = change_cell(*SETTINGS[number])
        results, durations = list[str](), list[float]()
        errors, ratios = list[float](), list[float]()
        for move in self._moves:
            scene = move.scene
            planner = PickPlacePlanner(cell.with_support(scene.support), PlannerConfig())
            plan = planner.plan(*move.arguments)
            if isinstance(plan, PlanningFailure):
                results.append(str(plan.reason.value))
                continue
            simulated = simulate_plan(cell, scene, plan)
            results.append(execution_result(simulated))
            durations.append(simulated.simulated_time)
            ratios.append(simulated.max_load_ratio)
            if results[-1] == CARRIED_OUT:
                errors.append(simulated.position_error)
        return SettingTrials(tuple(results), tuple(durations), tuple(errors), tuple(ratios))


def summarize(name: str, factor: float, trials: dict[str, Sequence[Any]]) -> dict[str, Any]:
    """Return the row of a setting."""
    results = trials["results"]
    return {
        "number": name,
        "factor": factor,
        "planned": len(trials["durations"]),
        "carried_out": sum(result == CARRIED_OUT for result in results),
        "results": {result: results.count(result) for result in sorted(set(results))},
        "duration_s": quantiles(trials["durations"]),
        "place_error_m": quantiles(trials["place_errors"]),
        "load_ratio": quantiles(trials["load_ratios"]),
    }


def main(
    out: OutOption,
    count: Annotated[int, typer.Option(min=1, help="Number of moves of each setting.")] = 20,
    seed: SeedOption = 0,
) -> None:
    """Measure the effect of the numbers of suction cups."""
    with partial_records(out) as path:
        header = {"count": count, "seed": seed, "settings": SETTINGS}
        records = collect_records(
            path,
            header,
            partial(SettingTester, count, seed),
            range(len(SETTINGS)),
            schema=SettingTrials,
            workers=1,
        )
        rows = [
            summarize(name, factor, record)
            for (name, factor), record in zip(SETTINGS, records, strict=True)
        ]
        command = f"benchmarks/cup_sensitivity.py --count {count} --seed {seed}"
        write_results(out, {"command": command, "seed": seed, "count": count, "rows": rows})


if __name__ == "__main__":
    run_script(main)
