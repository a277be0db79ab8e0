"""Measure the time of simulated pick-and-place moves, paired with another checkout.

    python benchmarks/simulation_speed.py --baseline ../before --out simulation_speed.json

Random legal moves in stable scenes are planned by this checkout and simulated, in turn, by the
baseline and by this checkout, each in a process of its own, on one core. Every move is simulated
`REPEATS` times; the least time counts. The first move is simulated once before, so that
compilation does not count.
"""

import base64
import itertools
import json
import os
import pickle
import subprocess
import sys
from contextlib import ExitStack
from dataclasses import fields
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from benchmarks.pick_place import CONFIG, NODES, MoveSampler, OutOption, quantiles, write_results
from drake_clutter.planning.pick_place_plan import PickPlacePlan
from drake_clutter.resources import git_commit
from drake_clutter.station.arm_executor import ArmExecutor
from training.script import ROOT, SeedOption, progress, run_script

REPEATS = 2
"""Number of times that each checkout simulates a move."""


def sample_moves(count: int, seed: int) -> list[str]:
    """Return moves as lines for `simulation_worker.py`.

    Args:
        count: Number of moves.
        seed: Seed of scenes and moves.
    """
    sample_move, executor = MoveSampler(NODES, seed), ArmExecutor(CONFIG)
    names = {field.name for field in fields(PickPlacePlan)}
    lines = list[str]()
    for number in progress(itertools.count(), "plans", None):
        move = sample_move(number)
        plan = executor.plan(move.scene, move.command) if move else None
        if move and isinstance(plan, PickPlacePlan):
            # Fields of plans of earlier versions, which are properties in this one.
            names |= {"tool", "X_OG", "joints_open", "joints_held", "payload"}
            values = {name: getattr(plan, name) for name in names} | {"scene": move.scene}
            encoded = {k: base64.b64encode(pickle.dumps(v)).decode() for k, v in values.items()}
            lines.append(json.dumps(encoded))
        if len(lines) == count:
            break
    return lines


def start_worker(checkout: Path) -> subprocess.Popen[str]:
    """Start a process of `simulation_worker.py` that imports the package of a checkout."""
    one_core = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")
    return subprocess.Popen(
        [sys.executable, str(ROOT / "benchmarks/simulation_worker.py")],
        env={**os.environ, **one_core, "PYTHONPATH": str(checkout)},
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )


def simulate(process: subprocess.Popen[str], line: str) -> dict[str, Any]:
    """Return the result of a move in a worker."""
    assert process.stdin is not None
    assert process.stdout is not None
    process.stdin.write(line + "\n")
    process.stdin.flush()
    result: dict[str, Any] = json.loads(process.stdout.readline())
    return result


def summarize(results: list[dict[str, Any]]) -> dict[str, Any]:
    """Return the summary of the moves in a checkout."""
    return {
        "cpu_s": quantiles([result["cpu"] for result in results]),
        "wall_s": quantiles([result["wall"] for result in results]),
        "uneventful": sum(result["uneventful"] for result in results),
        "tracking_rad": quantiles([result["tracking"] for result in results]),
    }


def compare(before: list[dict[str, Any]], after: list[dict[str, Any]]) -> dict[str, Any]:
    """Return ratios before / after, and differences of the final positions of all objects."""
    pairs = list(zip(before, after, strict=True))
    differences = [
        np.linalg.norm(
            [np.subtract(p, a["positions"][o]) for o, p in b["positions"].items()], axis=1
        )
        for b, a in pairs
        if b["uneventful"] and a["uneventful"]
    ]
    return {
        "cpu": quantiles([b["cpu"] / a["cpu"] for b, a in pairs]),
        "wall": quantiles([b["wall"] / a["wall"] for b, a in pairs]),
        "total_cpu": sum(b["cpu"] for b, _ in pairs) / sum(a["cpu"] for _, a in pairs),
        "position_difference_m": quantiles([float(d.max()) for d in differences]),
    }


def main(
    out: OutOption,
    baseline: Annotated[Path, typer.Option(metavar="DIR", help="Checkout to compare with.")],
    count: Annotated[int, typer.Option(min=1, help="Number of moves.")] = 20,
    seed: SeedOption = 0,
) -> None:
    """Measure the time of simulated moves."""
    lines = sample_moves(count, seed)
    results = dict[str, list[dict[str, Any]]](before=[], after=[])
    with ExitStack() as stack:
        workers = {
            name: stack.enter_context(start_worker(checkout))
            for name, checkout in (("before", baseline), ("after", ROOT))
        }
        for worker in workers.values():
            simulate(worker, lines[0])
        for line in progress(lines, "moves", len(lines)):
            runs = dict[str, list[dict[str, Any]]](before=[], after=[])
            for _ in range(REPEATS):
                for name, worker in workers.items():
                    runs[name].append(simulate(worker, line))
            for name, repeated in runs.items():
                least = {key: min(run[key] for run in repeated) for key in ("cpu", "wall")}
                results[name].append(repeated[0] | least)
    rows = {name: summarize(part) for name, part in results.items()}
    rows["before / after"] = compare(results["before"], results["after"])
    command = f"benchmarks/simulation_speed.py --count {count} --seed {seed}"
    head = {"command": command, "baseline": git_commit(baseline)}
    write_results(out, {**head, "seed": seed, "count": count, "rows": rows})


if __name__ == "__main__":
    run_script(main)
