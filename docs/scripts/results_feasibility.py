"""The page docs/results/feasibility.md."""

from markdown_text import number, section, table
from results_files import read_benchmark_results

CELLS = {"ur10_epick_tray": "UR10", "iiwa14_epick_tray": "KUKA iiwa 14"}
"""Robots by the cells of the results files."""
FILES = ("inverse_reachability_ur10.json",)
"""Results files of the inverse reachability map."""


def page() -> str:
    """Return the page."""
    runs = [read_benchmark_results(name) for name in FILES]
    text = "# Feasibility studies\n\n" + section(
        "Inverse reachability map",
        "The possible moves of frozen scenes from random bases beside the tray, looked up in the "
        "map and planned. *Right*: map and planner agree. *Falsely feasible*: in reach by the map, "
        "and without a plan. Build and query: processor time on one core; a query is one move from "
        "one base with all grasps, which are sampled once for all bases; the median and the mean "
        "over the moves.",
        command=f"python {runs[0]['command']} --out FILE",
        seed=runs[0]["seed"],
        results=[f"benchmarks/results/{name}" for name in FILES],
    )
    head = ["robot", "dataset", "bases", "moves", "right", "falsely feasible"]
    head += ["falsely infeasible", "build [s]"]
    head += ["query, median [µs]", "query, mean [µs]"]
    return text + table(
        head,
        [
            [
                CELLS[run["cell"]],
                run["dataset"],
                str(run["bases"]),
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
