"""Measure what sb3-contrib's MaskablePPO reaches on `ClutterGeneration-v0`.

    python benchmarks/maskable_ppo.py FOLDER --minutes 10 --out maskable_ppo.json

Trains the model of `examples/09_train_maskable_ppo.py`, and evaluates it before and every two
minutes of processor time. FOLDER keeps the models; an interrupted run is resumed by the same
command.
"""

import runpy
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from benchmarks.measurement import describe_machine
from drake_clutter.statistics import mean_interval, wilson_interval
from training.results_file import ResultsFile, Row, provenance
from training.script import ROOT, ResultsOption, print_table, progress, run_script

EXAMPLE = ROOT / "examples/09_train_maskable_ppo.py"
EPISODES = 100
"""Number of episodes of an evaluation."""
PERIOD = 2
"""Processor time between two evaluations [min]."""
ROLLOUT_STEPS = 2048
"""Number of steps between two updates of MaskablePPO, after which the time is checked."""


def summarize(outcomes: Sequence[tuple[float, int]], nodes: int) -> Row:
    """Return the means of returns and hidden objects, and the fraction of stable scenes.

    Args:
        outcomes: Return of each episode, and how many objects its stable scene hides.
        nodes: Number of nodes of a graph, which bounds the number of hidden objects.
    """
    returns, hidden = np.transpose(outcomes)
    # The return of a stable scene is at least 0, that of every other is negative.
    num_stable = int(np.count_nonzero(returns >= 0))
    return {
        "episodes": len(outcomes),
        "return_mean": float(returns.mean()),
        "hidden_mean": float(hidden.mean()),
        "hidden_ci95": mean_interval(hidden.tolist(), 0, nodes),
        "stable": num_stable / len(outcomes),
        "stable_ci95": wilson_interval(num_stable, len(outcomes)),
    }


def main(
    folder: Annotated[Path, typer.Argument(metavar="FOLDER", help="Folder of the models.")],
    minutes: Annotated[int, typer.Option(min=0, help="Processor time of the training.")] = 10,
    out: ResultsOption = None,
) -> None:
    """Train MaskablePPO and evaluate it."""
    example = runpy.run_path(str(EXAMPLE))
    model, nodes = example["model"], example["task"].nodes
    header = {"nodes": nodes, "seed": model.seed, "algorithm": "MaskablePPO"}
    results = ResultsFile(out or folder / "maskable_ppo.json", header, ("minutes",))
    rows = []
    for end in progress(range(0, minutes + 1, PERIOD), "MaskablePPO"):
        file = folder / f"{end}.zip"
        row = results.find({"minutes": end})
        if row is not None and file.exists():
            model.set_parameters(file)
            model.num_timesteps = row["steps"]
        else:
            start = time.process_time()
            while end > 0 and time.process_time() - start < 60 * PERIOD:
                model.learn(ROLLOUT_STEPS, reset_num_timesteps=False)
            row = {"minutes": end, "steps": model.num_timesteps}
            row |= summarize([*example["evaluate"](EPISODES)], nodes)
            row |= describe_machine("sb3-contrib", "stable-baselines3", "torch") | provenance()
            model.save(file)
            results.add(row)
        rows.append(row)
    print_table(
        [
            {
                "processor time [min]": row["minutes"],
                "steps": row["steps"],
                "return": f"{row['return_mean']:.2f}",
                "hidden": f"{row['hidden_mean']:.2f}",
                "stable": f"{row['stable']:.2f}",
            }
            for row in rows
        ]
    )


if __name__ == "__main__":
    run_script(main)
