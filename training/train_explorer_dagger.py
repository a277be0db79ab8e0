"""Trains a student, which sees what the camera has shown, by cloning a teacher, which sees everything.

    python training/train_explorer_dagger.py --config training/configs/student_dagger.yaml --out runs/student_dagger

A run that was stopped, at any moment, goes on with the same command, and ends with the same weights as one that was not.
"""

from dataclasses import field
from pathlib import Path
from typing import Annotated

import typer

from drake_clutter.agents.behavior_cloning import BehaviorCloningConfig, BehaviorCloningLearner
from drake_clutter.agents.explorer_training import CHECKPOINT_FILE, ExplorerTrainingConfig
from drake_clutter.agents.learned_explorer import STUDENT, TEACHER, explorer_metadata, load_explorer
from drake_clutter.agents.message_passing import limit_operations_to_one_thread
from drake_clutter.config import upgrade
from drake_clutter.files import InputError, cli_error_handler
from drake_clutter.learning.checkpoint import load_checkpoint
from drake_clutter.learning.training_run import TrainingRun, resolve_device
from drake_clutter.validation import InRange, config_class, load_config_as


@config_class
class DAggerTrainingConfig(ExplorerTrainingConfig):
    """A training, see `ExplorerTraining`.

    Attributes:
        teacher: its checkpoint.
        evaluate_every: rounds.
        learning: see there.
    """

    teacher: str = "training/checkpoints/teacher.safetensors"
    evaluate_every: Annotated[int, InRange(1)] = 5
    learning: BehaviorCloningConfig = field(default_factory=BehaviorCloningConfig)


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
    limit_operations_to_one_thread()
    chosen = resolve_device(device)
    environment = given.make_environment()
    teacher, numbers = load_explorer(
        load_checkpoint(Path(given.teacher)), Path(given.teacher), TEACHER
    )
    if numbers != environment.node_kind_ids:
        raise InputError(
            f"teacher: {given.teacher} knows {', '.join(numbers)}; allowed is one of the objects of {given.scenes}"
        )
    learner = BehaviorCloningLearner(
        environment, teacher.to(chosen), given.learning, given.seed, chosen
    )
    run = TrainingRun(
        out, given, learner, given.learning.iterations, [Path(given.scenes), Path(given.teacher)]
    )
    while learner.step < given.learning.iterations:
        learner.train_iteration()
        if learner.step == given.learning.iterations or learner.step % given.evaluate_every == 0:
            run.report(given.evaluate(environment, learner.network), learner.losses)
            run.save()
    about = {
        "kind": STUDENT,
        "network": explorer_metadata(environment.node_kind_ids, given.learning.width),
    }
    run.finish(CHECKPOINT_FILE, learner.network, about)


if __name__ == "__main__":
    with cli_error_handler():
        typer.run(main)
