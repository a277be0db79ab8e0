"""The page docs/results/feasibility.md."""

from typing import Any

from markdown_text import estimate, number, section, table
from results_files import has_benchmark_results, read_benchmark_results

CELLS = {"ur10_epick_tray": "UR10", "iiwa14_epick_tray": "KUKA iiwa 14"}
"""Robots by the cells of the results files."""
FILES = ("inverse_reachability_ur10.json",)
"""Results files of the inverse reachability map."""
BASE_STUDY = "base_study.json"
"""Results file of the comparison of bases."""


def page() -> str:
    """Return the page."""
    runs = [read_benchmark_results(name) for name in FILES]
    text = "# Feasibility studies\n\n" + section(
        "Inverse reachability map",
        "The possible moves of frozen scenes from random bases beside the tray, looked up in the "
        "map and planned. *Right*: map and planner agree. *Falsely feasible*: in reach by the map, "
        "and without a plan. Build and query: processor time on one core; a query is one move from "
        "one base with all grasps, which are sampled once for all bases; the median and the mean "
        "of some of the moves, from many bases. Bases without a configuration that clears cell and "
        "camera view are left out.",
        command=f"python {runs[0]['command']} --out FILE",
        seed=runs[0]["seed"],
        results=[f"benchmarks/results/{name}" for name in FILES],
    )
    head = ["robot", "dataset", "bases", "moves", "right", "falsely feasible"]
    head += ["falsely infeasible", "build [s]"]
    head += ["query, median [µs]", "query, mean [µs]"]
    text += table(
        head,
        [
            [
                CELLS[run["cell"]],
                run["dataset"],
                str(run["bases"] - sum(run["unusable"].values())),
                str(run["moves"]),
                number(run["right"], 3),
                number(run["falsely_feasible"], 3),
                number(run["falsely_infeasible"], 3),
                number(run["build_s"], 0),
                number(1e6 * run["query_s"], 1),
                number(1e6 * run["query_mean_s"], 1),
            ]
            for run in runs
        ],
    )
    return text + (_base_study() if has_benchmark_results(BASE_STUDY) else "")


def _base_study() -> str:
    """Return the section on the comparison of bases."""
    run = read_benchmark_results(BASE_STUDY)
    generation = run["generation"]
    text = "\n" + section(
        "Bases compared",
        f"All moves of {run['stable_scenes']} scenes of {generation['nodes']} nodes "
        f"(`generate --agent {generation['agent']} --seed {generation['seed']}`) from "
        f"{run['num_bases']} bases (`{'`, `'.join(run['bases'])}`): planned from each base, and "
        "looked up in the inverse reachability map with the best bases planned. "
        f"{run['machine']['cpu']}, {run['workers']} processes; the times include homes, tables and "
        "report. *Planned*: share of the possible moves with a plan from the best base that was "
        "found.",
        command=f"python {run['command']} --out FILE",
        seed=run["seed"],
        results=[f"benchmarks/results/{BASE_STUDY}"],
    )
    return text + table(
        ["method", "time [min]", "processor time [min]", "best base", "planned"],
        [
            _base_study_row("planner", run, "planned", run["best"]),
            _base_study_row("map, then planner", run, "searched", run["found"]),
        ],
    )


def _base_study_row(
    method: str, run: dict[str, Any], study: str, base: dict[str, Any]
) -> list[str]:
    return [
        method,
        number(run[f"{study}_s"] / 60, 1),
        number(run[f"{study}_cpu_s"] / 60, 1),
        f"`{base['name']}`",
        estimate(base, "planned_share", "planned_share_ci95", 3),
    ]
