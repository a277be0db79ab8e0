"""Compare the inverse reachability map with the planner, over random bases.

    python benchmarks/inverse_reachability.py --scenes 6 --bases 40 --workers 2 --out FILE

The possible moves of frozen scenes are planned from random bases beside the tray, each with a home
of its own, and looked up in the map. A move is right if both agree; falsely feasible if the map
reaches it and there is no plan.
"""

import math
import time
from collections import Counter
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from numpy.typing import NDArray

from benchmarks.measurement import describe_machine
from benchmarks.pick_place import OutOption, write_results
from drake_clutter.catalog import load_catalog
from drake_clutter.cell.work_cell import WorkCell, load_cell
from drake_clutter.config import ClutterConfig
from drake_clutter.feasibility.arm_clearance import ObstacleTops
from drake_clutter.feasibility.base_search import BaseGrid, find_reachable_moves
from drake_clutter.feasibility.inverse_reachability import (
    InverseReachabilityMap,
    build_inverse_reachability,
)
from drake_clutter.feasibility.move_poses import MovePoses
from drake_clutter.feasibility.move_study import find_legal_moves
from drake_clutter.feasibility.setups import Setup, SetupRequest, prepare_setup
from drake_clutter.perception.label_detector import LabelDetector
from drake_clutter.planning.pick_place_plan import PickPlacePlan, PlanningFailure
from drake_clutter.planning.pick_place_planner import PickPlacePlanner
from drake_clutter.planning.planner_config import PlannerConfig
from drake_clutter.resources import resource_path
from drake_clutter.scenes.scene_dataset import load_scene_dataset
from drake_clutter.seeding import item_rng
from drake_clutter.validation import load_config_as
from drake_clutter.workers.parallel_map import map_ordered
from training.script import SCENES, SeedOption, WorkersOption, progress, run_script

Floats = NDArray[np.float64]

DATASET = "sg_star_20"
"""Dataset of the scenes; the first ones are taken."""
BASE_RANGES = {"x": (-1.1, -0.4), "y": (-0.6, 0.6), "z": (0.0, 0.6)}
"""Ranges of the base positions in T [m]."""
NUM_TIMED_BASES = 2000
"""Number of bases in the measurement of the time of a query."""


@dataclass(frozen=True)
class BaseTest:
    """Base whose moves are planned and looked up.

    Attributes:
        index: Number of the base.
        settings: Settings that give the base.
    """

    index: int
    settings: tuple[str, ...]


class BaseTester:
    """Plans the possible moves of the scenes from one base; a worker for `map_ordered`."""

    def __init__(self, cell_file: Path, num_scenes: int, seed: int) -> None:
        """Load the scenes, and build the map.

        Args:
            cell_file: Work cell.
            num_scenes: Number of scenes.
            seed: Seed of the placements.
        """
        self._cell = load_cell(cell_file)
        self._config = ClutterConfig(cell=self._cell)
        self._seed = seed
        dataset = load_scene_dataset(SCENES / f"{DATASET}.json", load_catalog())
        self._scenes = [
            dataset.settled_scene(k, dataset.grammar, self._config) for k in range(num_scenes)
        ]
        self._maps = build_maps(self._cell)

    def __call__(self, test: BaseTest) -> dict[str, Any]:
        """Return the results of a base."""
        cell = load_config_as(self._cell, settings=test.settings)
        x, y, z = cell.robot.base.translation
        grid = BaseGrid(self._cell, (), np.array([[x, y, z, 0.0]]))
        setup = prepare_setup("it", SetupRequest(cell, keep_home=False))
        record: dict[str, Any] = {"settings": test.settings, "unusable": ""}
        if not isinstance(setup, Setup):
            return record | {"unusable": setup.reason}
        support = self._scenes[0].support
        planner = PickPlacePlanner(setup.cell.with_support(support), PlannerConfig(optimize=False))
        counts = Counter[str]()
        reasons = Counter[str]()
        for index, scene in enumerate(self._scenes):
            detector = LabelDetector(self._cell.camera)
            legal = find_legal_moves(scene, detector, self._config, self._seed, index)
            reachable = find_reachable_moves(grid, self._maps, scene, legal)
            for move, reach in zip(legal, reachable, strict=True):
                if move.command is None or reach is None:
                    continue
                place = move.command.X_TO_place
                plan = planner.plan(scene.objects, move.move.pick, place)
                planned = isinstance(plan, PickPlacePlan)
                counts[f"{'reached' if reach[0] else 'not reached'}, {planned=}"] += 1
                if reach[0] and isinstance(plan, PlanningFailure):
                    reasons[str(plan)] += 1
        return record | {"counts": dict(counts), "falsely_feasible": dict(reasons)}


def build_maps(cell: WorkCell) -> dict[str, InverseReachabilityMap]:
    """Return the inverse reachability map of each tool, by name."""
    return {name: build_inverse_reachability(cell, name) for name in cell.gripper.tools}


def draw_bases(cell: WorkCell, count: int, seed: int) -> list[BaseTest]:
    """Return random bases that do not stand in the support."""
    rng = item_rng(seed)
    tests = list[BaseTest]()
    while len(tests) < count:
        position = {axis: round(float(rng.uniform(*ends)), 3) for axis, ends in BASE_RANGES.items()}
        settings = tuple(f"robot.base.{axis}={value}" for axis, value in position.items())
        if not load_config_as(cell, settings=settings).pedestal_overlaps_support:
            tests.append(BaseTest(len(tests), settings))
    return tests


@dataclass(frozen=True, eq=False)
class TimedMap(InverseReachabilityMap):
    """Map that measures the processor time of its queries.

    Attributes:
        seconds: Time of each call [s].
    """

    seconds: list[float]

    def find_reachable(
        self, moves: MovePoses, bases: Floats, table_height: float, tops: ObstacleTops
    ) -> NDArray[np.bool_]:
        """Return which moves are reachable from each base; see `InverseReachabilityMap`."""
        start = time.process_time()
        found = super().find_reachable(moves, bases, table_height, tops)
        self.seconds.append(time.process_time() - start)
        return found


@dataclass(frozen=True)
class QueryTimes:
    """Processor times of the maps.

    Attributes:
        build_s: Time to build the maps of all tools [s].
        grasps_s: Mean time to sample the grasps of a move, once for all bases [s].
        query_s: Median over the moves of the time for one base [s].
        query_mean_s: Mean of it [s].
        timed_moves: Number of moves.
        timed_bases: Number of bases.
    """

    build_s: float
    grasps_s: float
    query_s: float
    query_mean_s: float
    timed_moves: int
    timed_bases: int


def measure_queries(cell: WorkCell, scenes: int, seed: int) -> QueryTimes:
    """Return the processor times of the maps for the possible moves of the first scenes."""
    start = time.process_time()
    built = build_maps(cell)
    build = time.process_time() - start
    seconds = list[float]()
    maps = {name: TimedMap(**vars(found), seconds=seconds) for name, found in built.items()}
    config = ClutterConfig(cell=cell)
    dataset = load_scene_dataset(SCENES / f"{DATASET}.json", load_catalog())
    low, high = np.array([*BASE_RANGES.values(), (0.0, 2 * math.pi)]).T
    bases = item_rng(seed, 1).uniform(low, high, (NUM_TIMED_BASES, 4))
    grid = BaseGrid(cell, (), bases)
    per_base, others = list[float](), list[float]()
    for index in range(scenes):
        scene = dataset.settled_scene(index, dataset.grammar, config)
        legal = find_legal_moves(scene, LabelDetector(cell.camera), config, seed, index)
        find_reachable_moves(BaseGrid(cell, (), bases[:1]), maps, scene, legal)  # compiles
        for move in legal:
            seconds.clear()
            start = time.process_time()
            (found,) = find_reachable_moves(grid, maps, scene, [move])
            if found is not None:
                others.append(time.process_time() - start - sum(seconds))
                per_base.append(sum(seconds) / NUM_TIMED_BASES)
    return QueryTimes(
        build,
        float(np.mean(others)),
        float(np.median(per_base)),
        float(np.mean(per_base)),
        len(per_base),
        NUM_TIMED_BASES,
    )


def main(
    out: OutOption,
    cell: Annotated[str, typer.Option(help="Name of a cell in models/cells.")] = "ur10_epick_tray",
    scenes: Annotated[int, typer.Option(min=1, help="Number of scenes.")] = 6,
    bases: Annotated[int, typer.Option(min=1, help="Number of bases.")] = 40,
    seed: SeedOption = 0,
    workers: WorkersOption = 1,
) -> None:
    """Compare map and planner, and write the results."""
    path = resource_path(f"models/cells/{cell}.yaml")
    work_cell = load_cell(path)
    times = measure_queries(work_cell, scenes, seed)
    tests = draw_bases(work_cell, bases, seed)
    make_tester = partial(BaseTester, path, scenes, seed)
    results = map_ordered(make_tester, tests, workers=workers)
    records = [*progress(results, "bases", len(tests))]
    counts = sum((Counter(r.get("counts", {})) for r in records), Counter[str]())
    total = counts.total()
    right = counts["reached, planned=True"] + counts["not reached, planned=False"]
    document: dict[str, Any] = {
        "command": f"benchmarks/inverse_reachability.py --cell {cell} --scenes {scenes} "
        f"--bases {bases} --seed {seed} --workers {workers}",
        "machine": describe_machine("drake", "numba", "numpy"),
        "cell": cell,
        "dataset": DATASET,
        "scenes": scenes,
        "seed": seed,
        "bases": bases,
        "unusable": dict(Counter(r["unusable"] for r in records if r["unusable"])),
        "moves": total,
        "right": right / total,
        "falsely_feasible": counts["reached, planned=False"] / total,
        "falsely_infeasible": counts["not reached, planned=True"] / total,
        **asdict(times),
        "counts": dict(counts),
        "reasons": dict(
            sum((Counter(r.get("falsely_feasible", {})) for r in records), Counter[str]())
        ),
        "records": records,
    }
    write_results(out, document)


if __name__ == "__main__":
    run_script(main)
