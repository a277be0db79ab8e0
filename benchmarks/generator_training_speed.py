"""Where the time of the generator's training goes, with one thread and with two.

python benchmarks/generator_training_speed.py --out benchmarks/results/generator_training.json
"""

import platform
import time
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import torch
import typer
from rich.console import Console
from rich.table import Table

from drake_clutter.agents.message_passing import limit_operations_to_one_thread
from drake_clutter.agents.soft_q import NUM_GRADIENT_SHARDS, ReplayBuffer, SoftQConfig, SoftQLearner
from drake_clutter.catalog import load_catalog
from drake_clutter.config import ClutterConfig
from drake_clutter.files import cli_error_handler, write_json
from drake_clutter.resources import git_commit
from drake_clutter.tasks.generation_task import ClutterGeneration, GenerationTaskConfig

TIMED: dict[str, tuple[type, str]] = {
    "environments": (ClutterGeneration, "step"),
    "new episodes": (ClutterGeneration, "reset"),
    "remembering": (ReplayBuffer, "add"),
    "updates": (SoftQLearner, "_update"),
    "of updates: drawing from memory": (ReplayBuffer, "draw"),
    "of updates: losses and gradients": (SoftQLearner, "_loss"),
}
"""What is timed. Gradients are summed over the threads, all else is of the wall clock."""


def timed(function: Callable[..., Any], name: str, seconds: dict[str, float]) -> Callable[..., Any]:
    """The function, with what it takes added up."""

    def call(*args: Any, **options: Any) -> Any:
        start = time.perf_counter()
        try:
            return function(*args, **options)
        finally:
            seconds[name] += time.perf_counter() - start

    return call


def measured(threads: int, steps: int) -> dict[str, Any]:
    """Steps per second after the warm-up, first without, then with the single parts timed."""
    classes = load_catalog().object_set("ycb7")
    learning = SoftQConfig(temperature=0.25)
    learner = SoftQLearner(
        lambda: ClutterGeneration(classes, GenerationTaskConfig(), ClutterConfig()),
        learning,
        0,
        torch.device("cpu"),
        threads,
    )

    def run() -> float:
        until, start = learner.step + steps, time.perf_counter()
        while learner.step < until:
            learner.train_iteration()
        return time.perf_counter() - start

    while learner.step < learning.learning_starts + steps:
        learner.train_iteration()
    whole = run()
    seconds: dict[str, float] = defaultdict(float)
    originals = {name: getattr(owner, method) for name, (owner, method) in TIMED.items()}
    for name, (owner, method) in TIMED.items():
        setattr(owner, method, timed(originals[name], name, seconds))
    try:
        parts = run()
    finally:
        for name, (owner, method) in TIMED.items():
            setattr(owner, method, originals[name])
    return {
        "threads": threads,
        "steps_per_s": steps / whole,
        "seconds": parts,
        "parts": {name: seconds[name] for name in TIMED},
    }


def main(
    out: Annotated[Path | None, typer.Option(help="JSON to write.")] = None,
    steps: Annotated[
        int, typer.Option(help="Of the environments, in each of three rounds.")
    ] = 8000,
) -> None:
    """Measures and prints; with nothing else running."""
    limit_operations_to_one_thread()
    rows = [measured(threads, steps) for threads in range(1, NUM_GRADIENT_SHARDS + 1)]
    table = Table(
        "part, share of the time",
        *[f"{row['threads']} thread(s), {row['steps_per_s']:.0f} steps/s" for row in rows],
    )
    for name in TIMED:
        table.add_row(name, *[f"{row['parts'][name] / row['seconds']:.2f}" for row in rows])
    Console().print(table)
    if out is not None:
        machine = {
            "processor": platform.processor(),
            "system": platform.platform(),
            "torch": torch.__version__,
        }
        write_json(out, {"steps": steps, "rows": rows, "machine": machine, "commit": git_commit()})


if __name__ == "__main__":
    with cli_error_handler():
        typer.run(main)
