"""Measure which scenes and moves a gripper can handle, for several work cells.

    python benchmarks/gripper_coverage.py scenes --workers 2 --out scenes.json
    python benchmarks/gripper_coverage.py moves --count 1000 --seed 41 --workers 2 --out moves.json

`scenes` computes an upper bound on the scenes of a frozen dataset in which the arm can find every
hidden object. `moves` plans random legal moves, without simulation, for every cell. An interrupted
run is resumed by the same command.
"""

import math
from collections import Counter
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import typer

from benchmarks.pick_place import (
    CONFIG,
    MOVES_PER_SCENE,
    NODES,
    OutOption,
    StableScenes,
    fraction,
    write_results,
)
from drake_clutter.catalog import load_catalog
from drake_clutter.cell.work_cell import DEFAULT_CELL, load_cell
from drake_clutter.config import ClutterConfig
from drake_clutter.perception.label_detector import LabelDetector
from drake_clutter.planning.pick_place_plan import PickPlacePlan
from drake_clutter.planning.pick_place_planner import PickPlacePlanner
from drake_clutter.planning.planner_config import PlannerConfig
from drake_clutter.records import partial_records
from drake_clutter.resources import resource_path
from drake_clutter.scenes.placement import resolve_placement
from drake_clutter.scenes.scene_dataset import load_scene_dataset
from drake_clutter.seeding import item_rng
from drake_clutter.tasks.arm_reachability_bound import ArmReachabilityBound
from drake_clutter.tasks.belief import legal_moves
from drake_clutter.validation import to_plain
from training.results_file import collect_records
from training.script import SCENES, SeedOption, WorkersOption, run_script

CELLS = {
    "one cup": resource_path("models/cells/ur10_single_cup_tray.yaml"),
    "two cups": resource_path(DEFAULT_CELL),
}
"""Compared cells."""
PLANNER = PlannerConfig(optimize=False)
"""Parameters of the planner; optimization changes neither success nor failure."""
PLANNED = "planned"
"""Result of a move for which there is a plan."""
MOVE_SEED_OFFSET = 1
"""Second key of the random generator of the moves; the first is the seed of the scene."""


@dataclass(frozen=True)
class SceneRecord:
    """Record of a scene of a dataset.

    Attributes:
        unrevealable: Names of the objects that the arm of each cell cannot reveal.
    """

    unrevealable: dict[str, tuple[str, ...]]


class SceneTester:
    """Bounds what the arm can find in a scene of a dataset; a worker for `map_ordered`."""

    def __init__(self, dataset: Path) -> None:
        """Load the dataset.

        Args:
            dataset: File of the dataset.
        """
        self._dataset = load_scene_dataset(dataset, load_catalog())
        self._bounds = {
            name: ArmReachabilityBound(ClutterConfig(cell=load_cell(path)))
            for name, path in CELLS.items()
        }

    def __call__(self, index: int) -> SceneRecord:
        """Return the record of a scene.

        Args:
            index: Index of the scene in the dataset.
        """
        scene = self._dataset.settled_scene(index, self._dataset.grammar, CONFIG)
        return SceneRecord(
            {name: bound.find_unrevealable(scene) for name, bound in self._bounds.items()}
        )


@dataclass(frozen=True)
class PlannedTrial:
    """One move with the gripper of one cell.

    Attributes:
        cell: Name of the cell.
        object_class: Class of the picked object.
        result: `PLANNED`, or why there is no plan.
        detail: Details of a failure.
        tool: Tool that holds the object; "" without a plan.
    """

    cell: str
    object_class: str
    result: str
    detail: str = ""
    tool: str = ""


@dataclass(frozen=True)
class SceneTrials:
    """Record of a scene.

    Attributes:
        trials: Its moves, each with every cell.
    """

    trials: tuple[PlannedTrial, ...]


class MovePlanner:
    """Plans random legal moves in a scene for every cell; a worker for `map_ordered`."""

    def __init__(self, nodes: int, seed: int) -> None:
        """Create the scenes, the detector and the planners.

        Args:
            nodes: Number of nodes of the scene graphs.
            seed: Seed of the scenes and moves.
        """
        self._scenes = StableScenes(nodes, seed)
        self._seed = seed
        self._detector = LabelDetector(CONFIG.cell.camera)
        self._planners = {
            name: PickPlacePlanner(load_cell(path).with_support(CONFIG.cell.support), PLANNER)
            for name, path in CELLS.items()
        }

    def __call__(self, number: int) -> SceneTrials:
        """Return the trials in the scene of a number."""
        scene = self._scenes(number)
        rng = item_rng(self._seed, number, MOVE_SEED_OFFSET)
        observation = self._detector.perceive(scene).observation
        moves = legal_moves(observation)
        trials = list[PlannedTrial]()
        for k in rng.permutation(len(moves))[:MOVES_PER_SCENE]:
            move = moves[k]
            name = scene[move.pick].object_class.name
            command = resolve_placement(move, observation, CONFIG.exploration, rng)
            for cell, planner in self._planners.items():
                if command is None:
                    trials.append(PlannedTrial(cell, name, "no free spot"))
                    continue
                plan = planner.plan(scene.objects, move.pick, command.X_TO_place)
                if isinstance(plan, PickPlacePlan):
                    trials.append(PlannedTrial(cell, name, PLANNED, tool=plan.tool))
                else:
                    trials.append(PlannedTrial(cell, name, plan.reason.value, plan.detail))
        return SceneTrials(tuple(trials))


def scenes(
    out: OutOption,
    dataset: Annotated[str, typer.Option(help="Name of the scene dataset.")] = "sg_star_25",
    limit: Annotated[
        int | None, typer.Option(min=1, help="Evaluate only the first N scenes.")
    ] = None,
    workers: WorkersOption = 1,
) -> None:
    """Bound the scenes in which the arm can find every hidden object."""
    path = SCENES / f"{dataset}.json"
    count = len(load_scene_dataset(path, load_catalog()).scenes)
    indices = range(min(count, limit or count))
    header = {"dataset": dataset, "config": to_plain(CONFIG), "cells": _cells()}
    with partial_records(out) as record_path:
        records = collect_records(
            record_path,
            header,
            partial(SceneTester, path),
            indices,
            schema=SceneRecord,
            workers=workers,
        )
        found = [record["unrevealable"] for record in records]
        rows = [
            {
                "cell": name,
                "solvable": fraction(sum(not part[name] for part in found), len(found)),
                "unrevealable_by_class": Counter(
                    unrevealable.rsplit("_", 1)[0] for part in found for unrevealable in part[name]
                ),
            }
            for name in CELLS
        ]
        command = f"scenes --dataset {dataset} --workers {workers}"
        fields = {
            "command": f"benchmarks/gripper_coverage.py {command}",
            "dataset": dataset,
            "count": len(found),
            "cells": _cells(),
            "rows": rows,
        }
        write_results(out, fields)


def moves(
    out: OutOption,
    count: Annotated[int, typer.Option(min=1, help="Number of moves.")] = 1000,
    nodes: Annotated[int, typer.Option(min=3, help="Number of nodes of the scene graphs.")] = NODES,
    seed: SeedOption = 0,
    workers: WorkersOption = 1,
) -> None:
    """Plan random legal moves in stable scenes of the random generator."""
    numbers = range(math.ceil(count / MOVES_PER_SCENE))
    header = {"nodes": nodes, "seed": seed, "config": to_plain(CONFIG), "cells": _cells()}
    with partial_records(out) as record_path:
        records = collect_records(
            record_path,
            {**header, "planner": asdict(PLANNER)},
            partial(MovePlanner, nodes, seed),
            numbers,
            schema=SceneTrials,
            workers=workers,
        )
        trials = [PlannedTrial(**trial) for record in records for trial in record["trials"]]
        rows = []
        for name in CELLS:
            of_cell = [trial for trial in trials if trial.cell == name][:count]
            failed = [trial for trial in of_cell if trial.result != PLANNED]
            rows.append(
                {
                    "cell": name,
                    "results": Counter(trial.result for trial in of_cell),
                    "tools": Counter(trial.tool for trial in of_cell if trial.tool),
                    "failed_by_class": Counter(f"{t.object_class}: {t.result}" for t in failed),
                    "collisions": Counter(t.detail for t in failed if t.result == "in collision"),
                }
            )
        command = f"moves --count {count} --nodes {nodes} --seed {seed} --workers {workers}"
        fields = {
            "command": f"benchmarks/gripper_coverage.py {command}",
            "seed": seed,
            "count": count,
            "cells": _cells(),
            "planner": asdict(PLANNER),
            "rows": rows,
        }
        write_results(out, fields)


def _cells() -> dict[str, Any]:
    return {name: to_plain(load_cell(path)) for name, path in CELLS.items()}


if __name__ == "__main__":
    run_script(scenes, moves)
