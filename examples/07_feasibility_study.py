"""Compare two base positions of an arm by the moves that it can execute, in parallel."""

import argparse
from collections import Counter
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from functools import partial
from multiprocessing import get_context

from drake_clutter import (
    ClutterConfig,
    FeasibilityStudy,
    load_catalog,
    load_scene_dataset,
    resource_path,
)

BASES = (-0.75, -1.25)
"""Positions of the base along x, from the center of the support [m]."""


def count_results(base_x: float, index: int) -> Counter[str]:
    """Count the planning results of the legal moves in a scene."""
    config = ClutterConfig()
    robot = config.cell.robot
    base = robot.base.model_copy(update={"translation": (base_x, 0.0, 0.3)})
    robot = robot.model_copy(update={"base": base})
    config = replace(config, cell=config.cell.model_copy(update={"robot": robot}))

    scenes = load_scene_dataset(resource_path("training/scenes/sg_star_10.json"), load_catalog())
    scene = scenes.settled_scene(index, scenes.grammar, config)
    study = FeasibilityStudy(f"base {base_x}", config, 0)
    return Counter(row.result for row in study.plan_all_moves(f"{index:04d}", index, scene))


def main(count: int, workers: int) -> None:
    with ProcessPoolExecutor(workers, get_context("spawn")) as pool:
        for base_x in BASES:
            results = sum(pool.map(partial(count_results, base_x), range(count)), Counter[str]())
            counts = ", ".join(f"{n} {result}" for result, n in results.most_common())
            print(f"base at x = {base_x} m: {results.total()} moves: {counts}")


# Worker processes import this file; the guard keeps them from running `main`.
if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=10, help="number of scenes")
    parser.add_argument("--workers", type=int, default=2, help="number of processes")
    arguments = parser.parse_args()
    main(arguments.count, arguments.workers)
