"""Compare 50 bases by the planner, and search the best one by the map; with the time.

    drake-clutter generate --agent sg-star --nodes 20 --count 100 --seed 11 --workers 2 --out SET
    python benchmarks/base_study.py SET/scenes --folder STUDIES --workers 2 --out FILE

The first study plans all moves of the scenes from every base of `BASES`. The second one looks the
same bases up in the inverse reachability map, and plans from the best of them. Without maps of
reachability; the times include home searches, tables and reports.
"""

import resource
import time
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import typer

from benchmarks.measurement import describe_machine
from benchmarks.pick_place import OutOption, write_results
from drake_clutter.catalog import load_catalog
from drake_clutter.cell.work_cell import default_cell
from drake_clutter.commands.feasibility_job import FeasibilityJob, collect_scene_files
from drake_clutter.commands.feasibility_run import run_feasibility_study
from drake_clutter.config import ClutterConfig
from drake_clutter.feasibility.setups import SetupRequest, parse_sweep, sweep_setups
from drake_clutter.files import InputError, read_json
from drake_clutter.scenes.scene_file import load_scene
from training.script import SeedOption, WorkersOption, progress, run_script

BASES = ("robot.base.x=-1:-0.55:0.05", "robot.base.z=0:0.4:0.1")
"""Ranges of the base, whose combinations are compared."""
GENERATION_FIELDS = ("agent", "nodes", "seed")
"""Fields of the job of `generate` that the results name."""


def run_study(job: FeasibilityJob, folder: Path, workers: int) -> tuple[dict[str, Any], float]:
    """Run a study from its beginning.

    Args:
        job: The study.
        folder: Folder of its results.
        workers: Number of processes.

    Returns:
        The summary, and the wall time [s].

    Raises:
        InputError: The folder exists.
    """
    if folder.exists():
        raise InputError(f"{folder}: exists; expected a new folder, so that the time is of all")
    start = time.perf_counter()
    summary = run_feasibility_study(
        job,
        folder,
        workers=workers,
        progress=lambda parts, num_done, total: progress(parts, folder.name, total, num_done),
    )
    return summary, time.perf_counter() - start


def cpu_time() -> float:
    """Return the processor time of this process and of its ended children [s]."""
    usages = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(usage.ru_utime + usage.ru_stime for usage in usages)


def _describe(setup: Mapping[str, Any]) -> dict[str, Any]:
    """Return the result of a base."""
    return {
        "name": setup["name"],
        "planned_share": setup["share"],
        "planned_share_ci95": setup["share_ci95"],
    }


def main(
    scenes: Annotated[Path, typer.Argument(metavar="SCENES", help="Folder of scene files.")],
    folder: Annotated[Path, typer.Option(metavar="DIR", help="New folder of the studies.")],
    out: OutOption,
    count: Annotated[
        int | None, typer.Option(min=1, help="Number of scenes; default: all of the folder.")
    ] = None,
    seed: SeedOption = 0,
    workers: WorkersOption = 1,
) -> None:
    """Run both studies, and write the results."""
    files = collect_scene_files([scenes])[:count]
    cell = default_cell().with_support(load_scene(files[0], load_catalog()).scene.support)
    ranges = [parse_sweep("BASES", text) for text in BASES]
    default = {"default": SetupRequest(cell)}
    every_base = FeasibilityJob(
        scenes=files,
        setups=sweep_setups(default, ranges),
        draws_maps=False,
        seed=seed,
        config=ClutterConfig(cell=cell),
    )
    planned, planned_s = run_study(every_base, folder / "planned", workers)
    planned_cpu_s = cpu_time()
    search = replace(every_base, setups=default, searches=tuple(ranges))
    searched, searched_s = run_study(search, folder / "searched", workers)
    of_base = {setup["name"]: setup for setup in planned["setups"]}
    best = planned["ranking"][0]
    found = next(name for name in searched["ranking"] if name in of_base)
    pairs = {(pair["first"], pair["second"]): pair for pair in planned["comparisons"]}
    job = read_json(scenes.parent / "job.json", "the job of `generate`")
    document: dict[str, Any] = {
        "command": f"benchmarks/base_study.py SET/scenes --folder STUDIES --workers {workers} "
        f"--seed {seed}" + ("" if count is None else f" --count {count}"),
        "machine": describe_machine("drake", "numba", "numpy"),
        "generation": {name: job[name] for name in GENERATION_FIELDS},
        "scenes": len(files),
        "stable_scenes": planned["scenes"],
        "bases": list(BASES),
        "num_bases": len(every_base.setups),
        "unusable": sum(setup["unusable"] is not None for setup in planned["setups"]),
        "seed": seed,
        "workers": workers,
        "moves": sum(setup["legal"] for setup in planned["setups"]),
        "possible": sum(setup["possible"] for setup in planned["setups"]),
        "planned_s": planned_s,
        "planned_cpu_s": planned_cpu_s,
        "searched_s": searched_s,
        "searched_cpu_s": cpu_time() - planned_cpu_s,
        "best": _describe(of_base[best]),
        "found": _describe(of_base[found]),
        "found_rank": planned["ranking"].index(found) + 1,
        "best_minus_found": pairs.get((best, found)),
        "planned_share_by_base": {name: setup["share"] for name, setup in of_base.items()},
    }
    write_results(out, document)


if __name__ == "__main__":
    run_script(main)
