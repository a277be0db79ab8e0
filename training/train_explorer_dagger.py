"""Trains a student, which sees what the camera has shown, by cloning a teacher, which sees everything.

    python training/train_explorer_dagger.py --config training/configs/student_dagger.yaml --out runs/student_dagger

A run that was stopped, at any moment, goes on with the same command, and ends with the same weights as one that was not.
"""

from dataclasses import field
from pathlib import Path
from typing import Annotated

import typer

from drake_clutter.agents.cloning import Cloning, CloningConfig
from drake_clutter.agents.explorer_training import CHECKPOINT, ExplorerTraining
from drake_clutter.agents.learned_explorer import STUDENT, TEACHER, about_explorer, load_explorer
from drake_clutter.agents.message_passing import one_thread_per_operation
from drake_clutter.config import upgrade
from drake_clutter.files import InputError, cli_error_handler
from drake_clutter.learning.checkpoint import load_checkpoint
from drake_clutter.learning.training_run import TrainingRun, device_of
from drake_clutter.validation import InRange, config_class, load_config_as


@config_class
class DAggerTrainingConfig(ExplorerTraining):
    """A training, see `ExplorerTraining`.

    Attributes:
        teacher: its checkpoint.
        evaluate_every: rounds.
        learning: see there.
    """

    teacher: str = "training/checkpoints/teacher.safetensors"
    evaluate_every: Annotated[int, InRange(1)] = 5
    learning: CloningConfig = field(default_factory=CloningConfig)


CONFIG = DAggerTrainingConfig()
"""Default configuration of the training."""


def main(
    out: Annotated[
        Path,
        typer.Option(metavar="DIR", help="Folder of the run; one of the same config is taken up."),
    ],
    config: Annotated[
        Path | None, typer.Option(metavar="FILE", help="YAML with fields of DAggerTrainingConfig.")
    ] = None,
    settings: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="FIELD=VALUE", help="A field over the file's."),
    ] = None,
    device: Annotated[str, typer.Option(help="auto, cpu or cuda.")] = "auto",
) -> None:
    """Trains, evaluates as it goes, and writes explorer.safetensors."""
    given = load_config_as(CONFIG, config, settings or [], upgrade)
    one_thread_per_operation()
    chosen = device_of(device)
    environment = given.environment()
    teacher, numbers = load_explorer(
        load_checkpoint(Path(given.teacher)), Path(given.teacher), TEACHER
    )
    if numbers != environment.numbers:
        raise InputError(
            f"teacher: {given.teacher} knows {', '.join(numbers)}; allowed is one of the objects of {given.scenes}"
        )
    learner = Cloning(environment, teacher.to(chosen), given.learning, given.seed, chosen)
    run = TrainingRun(
        out, given, learner, given.learning.rounds, [Path(given.scenes), Path(given.teacher)]
    )
    while learner.step < given.learning.rounds:
        learner.advance()
        if learner.step == given.learning.rounds or learner.step % given.evaluate_every == 0:
            run.report(given.evaluation(environment, learner.network), learner.losses)
            run.save()
    about = {"kind": STUDENT, "network": about_explorer(environment.numbers, given.learning.width)}
    run.finish(CHECKPOINT, learner.network, about)


if __name__ == "__main__":
    with cli_error_handler():
        typer.run(main)
