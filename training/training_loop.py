"""Training loop and common options of the scripts that train networks."""

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import typer

from drake_clutter.learning.training_run import Learner, TrainingRun

OutOption = Annotated[
    Path,
    typer.Option(
        "--out",
        metavar="DIR",
        help="Folder of the run. A run of the same configuration in it is resumed.",
    ),
]
DeviceOption = Annotated[str, typer.Option("--device", help="auto, cpu or cuda.")]

Metrics = Mapping[str, float]
"""Values of an evaluation by name."""


@dataclass(frozen=True)
class CheckpointSpec:
    """Checkpoints that a training writes.

    Attributes:
        file: File name of the checkpoint of the last step. That of the best evaluation has the
            same name with `_best`.
        metadata: Metadata of both.
        score: Score of an evaluation; the largest is the best.
    """

    file: str
    metadata: Mapping[str, Any]
    score: Callable[[Metrics], float]

    @property
    def best_file(self) -> str:
        """File name of the checkpoint of the best evaluation."""
        path = Path(self.file)
        return f"{path.stem}_best{path.suffix}"


def train_to_end(
    run: TrainingRun,
    learner: Learner,
    total_steps: int,
    checkpoint: CheckpointSpec,
    *,
    train_iteration: Callable[[], object],
    evaluate: Callable[[], tuple[Metrics, Metrics]],
    evaluate_every: int,
    save_every: int,
    max_minutes: float | None = None,
) -> None:
    """Train, evaluate and save until the learner has made all steps; write the checkpoints.

    A run that was interrupted, at any moment, is resumed from its last saved state, and ends with
    the same weights as an uninterrupted one.

    Args:
        run: The run, which may have been resumed.
        learner: What `train_iteration` trains. It counts its own steps.
        total_steps: Number of steps after which the training ends.
        checkpoint: The checkpoints.
        train_iteration: Trains for one or more steps.
        evaluate: Returns metrics of the network, and losses.
        evaluate_every: Steps between two evaluations. The last step is always evaluated.
        save_every: Steps between two saved states. The last step is always saved.
        max_minutes: Time after which the training is interrupted with a saved state; None: never.
    """
    deadline = None if max_minutes is None else time.monotonic() + 60 * max_minutes
    while learner.step < total_steps:
        if deadline is not None and time.monotonic() > deadline:
            run.save()
            print(f"interrupted after {learner.step} of {total_steps} steps; resumed when repeated")
            return
        before = learner.step
        train_iteration()
        run.check_convergence()
        run.report_progress()
        is_last = learner.step >= total_steps
        if is_last or learner.step // evaluate_every > before // evaluate_every:
            run.report(*evaluate())
            scores = [checkpoint.score(row) for row in run.history]
            if scores[-1] == max(scores):
                run.save_checkpoint(checkpoint.best_file, learner.network, checkpoint.metadata)
        if is_last or learner.step // save_every > before // save_every:
            run.save()
    run.finish(checkpoint.file, learner.network, checkpoint.metadata)
