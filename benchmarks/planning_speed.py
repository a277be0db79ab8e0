"""Measure the CPU time of planning pick-and-place problems, paired with another checkout.

    python benchmarks/planning_speed.py problems.jsonl.gz --baseline ../before --out speed.json

Every problem of `planning_problems.py` is planned without and with trajectory optimization, in turn
by the baseline and by this checkout, each in a process of its own. Times are those of the process,
on one core. The collision model is cached, as in an episode; the first problem is planned twice, so
that no compilation counts.
"""

import json
import os
import subprocess
import sys
from collections import Counter
from contextlib import ExitStack
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from benchmarks.pick_place import OutOption, fraction, quantiles, write_results
from benchmarks.planning_problems import ProblemsArgument, load_problems
from drake_clutter.resources import git_commit
from training.script import ROOT, progress, run_script

PLANNERS = ("unoptimized", "optimized")
"""Planners of `planning_worker.py`."""


class PlanningProcess:
    """Process of `planning_worker.py` that imports the package of a checkout."""

    def __init__(self, checkout: Path) -> None:
        """Start the process.

        Args:
            checkout: Folder of the checkout.
        """
        one_core = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")
        self._process = subprocess.Popen(
            [sys.executable, str(ROOT / "benchmarks/planning_worker.py")],
            env={**os.environ, **one_core, "PYTHONPATH": str(checkout)},
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )

    def __enter__(self) -> "PlanningProcess":
        """Return the process."""
        return self

    def __exit__(self, *_: object) -> None:
        """End the process."""
        self._process.communicate()

    def plan(self, problem: dict[str, Any]) -> dict[str, Any]:
        """Return the results of a problem by the name of the planner."""
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.write(json.dumps(problem) + "\n")
        self._process.stdin.flush()
        results: dict[str, Any] = json.loads(self._process.stdout.readline())
        return results


def summarize(results: list[dict[str, Any]]) -> dict[str, Any]:
    """Return the summary of the results of one planner in one checkout."""
    planned = [result for result in results if not result["failure"]]
    return {
        "planned": fraction(len(planned), len(results)),
        "failures": Counter(r["failure"].partition(":")[0] for r in results if r["failure"]),
        "seconds": quantiles([result["seconds"] for result in planned]),
        "seconds_failed": quantiles([r["seconds"] for r in results if r["failure"]]),
        "duration_s": quantiles([result["duration"] for result in planned]),
        "min_distance_m": min(result["min_distance"] for result in planned),
    }


def compare(before: list[dict[str, Any]], after: list[dict[str, Any]]) -> dict[str, Any]:
    """Return ratios after / before over the problems that both plan, and lost problems."""
    pairs = list(zip(before, after, strict=True))
    both = [(b, a) for b, a in pairs if not b["failure"] and not a["failure"]]
    return {
        "seconds": quantiles([a["seconds"] / b["seconds"] for b, a in both]),
        "duration": quantiles([a["duration"] / b["duration"] for b, a in both]),
        "mean_duration": float(np.mean([a["duration"] / b["duration"] for b, a in both])),
        "lost": sum(bool(a["failure"]) and not b["failure"] for b, a in pairs),
        "gained": sum(bool(b["failure"]) and not a["failure"] for b, a in pairs),
    }


def main(
    problems: ProblemsArgument,
    out: OutOption,
    count: Annotated[int, typer.Option(min=1, help="Number of problems.")] = 200,
    baseline: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Another checkout to compare with.")
    ] = None,
) -> None:
    """Measure the CPU time of planning."""
    checkouts = {"after": ROOT} if baseline is None else {"before": baseline, "after": ROOT}
    found = load_problems(problems)[:count]
    results: dict[str, list[dict[str, Any]]] = {name: [] for name in checkouts}
    with ExitStack() as stack:
        processes = {
            name: stack.enter_context(PlanningProcess(checkout))
            for name, checkout in checkouts.items()
        }
        for process in processes.values():
            process.plan(found[0])
        for problem in progress(found, "problems", len(found)):
            for name, process in processes.items():
                results[name].append(process.plan(problem))
    of = {
        planner: {name: [r[planner] for r in part] for name, part in results.items()}
        for planner in PLANNERS
    }
    rows = {
        planner: {name: summarize(part) for name, part in parts.items()}
        | ({"after / before": compare(parts["before"], parts["after"])} if baseline else {})
        for planner, parts in of.items()
    }
    command = f"benchmarks/planning_speed.py {problems.name} --count {count}"
    head = {"command": command, "baseline": git_commit(baseline) if baseline else None}
    write_results(out, {**head, "count": len(found), "rows": rows})


if __name__ == "__main__":
    run_script(main)
