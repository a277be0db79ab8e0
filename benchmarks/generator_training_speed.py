"""Time the training of a scene generator and its parts, by number of threads.

    python benchmarks/generator_training_speed.py --out generator_training_speed.json

Run it with no other work on the machine.
"""

import time
from collections.abc import Callable
from typing import Annotated, Any

import torch
import typer

from benchmarks.measurement import Stopwatch, describe_machine
from drake_clutter.agents.message_passing import limit_operations_to_one_thread
from drake_clutter.agents.replay_buffer import ReplayBuffer
from drake_clutter.agents.soft_q import NUM_GRADIENT_SHARDS, SoftQConfig, SoftQLearner
from drake_clutter.catalog import load_catalog
from drake_clutter.config import ClutterConfig
from drake_clutter.files import write_json
from drake_clutter.tasks.generation_task import ClutterGeneration, GenerationTaskConfig
from training.results_file import Row, provenance
from training.script import ResultsOption, print_table, progress, run_script

PARTS: dict[str, tuple[Any, Callable[..., Any]]] = {
    "environments": (ClutterGeneration, ClutterGeneration.step),
    "new episodes": (ClutterGeneration, ClutterGeneration.reset),
    "remembering": (ReplayBuffer, ReplayBuffer.add),
    "updates": (SoftQLearner, SoftQLearner._update),
    "of updates: drawing from memory": (ReplayBuffer, ReplayBuffer.sample_sequences),
    "of updates: losses and gradients": (SoftQLearner, SoftQLearner._shard_loss),
}
"""Measured methods by name, each with its class.

The times of losses and gradients are summed over the threads; all others are wall-clock times.
"""


def measure(threads: int, steps: int) -> Row:
    """Return the steps per second after the warm-up, and the times of the parts.

    Args:
        threads: Number of threads of an update.
        steps: Steps of the environments in each of three rounds: one to warm up, one to measure the
            whole, and one to measure the parts, which takes slightly longer.
    """
    classes = load_catalog().object_set("ycb7")
    learning = SoftQConfig(temperature=0.25)
    learner = SoftQLearner(
        lambda: ClutterGeneration(classes, GenerationTaskConfig(), ClutterConfig()),
        learning,
        0,
        torch.device("cpu"),
        threads,
    )

    def train(until_step: int) -> float:
        """Train until a step; return the time that it took [s]."""
        start = time.perf_counter()
        while learner.step < until_step:
            learner.train_iteration()
        return time.perf_counter() - start

    train(learning.learning_starts + steps)
    seconds = train(learner.step + steps)
    stopwatch = Stopwatch()
    with stopwatch.watch(PARTS):
        seconds_with_parts = train(learner.step + steps)
    return {
        "threads": threads,
        "steps_per_s": steps / seconds,
        "seconds": seconds_with_parts,
        "parts": {name: stopwatch.total(name) for name in PARTS},
    }


def table_row(row: Row) -> dict[str, str]:
    """Return a row of the results as cells of the printed table."""
    fractions = {name: seconds / row["seconds"] for name, seconds in row["parts"].items()}
    return {
        "threads": str(row["threads"]),
        "steps per second": f"{row['steps_per_s']:.0f}",
        **{f"fraction of time: {name}": f"{value:.2f}" for name, value in fractions.items()},
    }


def main(
    steps: Annotated[
        int, typer.Option(min=1, help="Steps of the environments in each of three rounds.")
    ] = 8000,
    out: ResultsOption = None,
) -> None:
    """Measure the training with one thread, two threads, and so on."""
    limit_operations_to_one_thread()
    threads = range(1, NUM_GRADIENT_SHARDS + 1)
    rows = [measure(number, steps) for number in progress(threads, "numbers of threads")]
    print_table([table_row(row) for row in rows])
    if out is not None:
        machine = describe_machine("torch")
        write_json(out, {"steps": steps, "rows": rows, "machine": machine, **provenance()})


if __name__ == "__main__":
    run_script(main)
