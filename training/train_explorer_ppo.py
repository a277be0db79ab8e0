"""Trains explorers by actor-critic learning: the privileged teacher, or a student that goes on where it was cloned.

    python training/train_explorer_ppo.py --config training/configs/teacher.yaml --out runs/teacher
    python training/train_explorer_ppo.py --config training/configs/student.yaml --out runs/student

A run that was stopped, at any moment, goes on with the same command, and ends with the same weights as one that was not.
"""

from dataclasses import field
from pathlib import Path
from typing import Annotated

import typer

from drake_clutter.agents.actor_critic import ActorCritic, ActorCriticConfig
from drake_clutter.agents.explorer_training import CHECKPOINT, ExplorerTraining
from drake_clutter.agents.learned_explorer import STUDENT, TEACHER, about_explorer, load_explorer
from drake_clutter.agents.message_passing import one_thread_per_operation
from drake_clutter.config import upgrade
from drake_clutter.files import InputError, cli_error_handler
from drake_clutter.learning.checkpoint import load_checkpoint
from drake_clutter.learning.training_run import TrainingRun, device_of
from drake_clutter.validation import Flag, InRange, config_class, load_config_as


@config_class
class PPOTrainingConfig(ExplorerTraining):
    """A training, see `ExplorerTraining`.

    Attributes:
        privileged: whether it sees everything, a teacher; or K_t, a student.
        warm_start: a checkpoint of the same kind to begin with, or "".
        evaluate_every: moves.
        learning: see there.
    """

    privileged: Flag = True
    warm_start: str = ""
    evaluate_every: Annotated[int, InRange(1)] = 15_000
    learning: ActorCriticConfig = field(default_factory=ActorCriticConfig)


CONFIG = PPOTrainingConfig()
"""Default configuration of the training."""


def main(
    out: Annotated[
        Path,
        typer.Option(metavar="DIR", help="Folder of the run; one of the same config is taken up."),
    ],
    config: Annotated[
        Path | None, typer.Option(metavar="FILE", help="YAML with fields of PPOTrainingConfig.")
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
    environment = given.environment(privileged=given.privileged)
    learner = ActorCritic(environment, given.learning, given.seed, device_of(device))
    kind = TEACHER if given.privileged else STUDENT
    if given.warm_start:
        begun, numbers = load_explorer(
            load_checkpoint(Path(given.warm_start)), Path(given.warm_start), kind
        )
        if (numbers, len(begun.mark)) != (environment.numbers, given.learning.width):
            raise InputError(
                f"warm_start: {given.warm_start}: is of other objects or another width; allowed is one of the same"
            )
        learner.network.load_state_dict(begun.state_dict())
    files = [Path(file) for file in (given.scenes, given.warm_start) if file]
    run = TrainingRun(out, given, learner, given.learning.steps, files)
    while learner.step < given.learning.steps:
        before = learner.step
        learner.advance()
        over = learner.step >= given.learning.steps
        if over or learner.step // given.evaluate_every > before // given.evaluate_every:
            run.report(given.evaluation(environment, learner.network), learner.losses)
            run.save()
    about = {"kind": kind, "network": about_explorer(environment.numbers, given.learning.width)}
    run.finish(CHECKPOINT, learner.network, about)


if __name__ == "__main__":
    with cli_error_handler():
        typer.run(main)
