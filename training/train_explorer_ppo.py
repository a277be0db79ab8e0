"""Trains explorers by actor-critic learning: the privileged teacher, or a student that goes on where it was cloned.

    python training/train_explorer_ppo.py --config training/configs/teacher.yaml --out runs/teacher
    python training/train_explorer_ppo.py --config training/configs/student.yaml --out runs/student

A run that was stopped, at any moment, goes on with the same command, and ends with the same weights as one that was not.
"""

from dataclasses import field
from pathlib import Path
from typing import Annotated

import typer

from drake_clutter.agents.explorer_training import CHECKPOINT_FILE, ExplorerTrainingConfig
from drake_clutter.agents.learned_explorer import STUDENT, TEACHER, explorer_metadata, load_explorer
from drake_clutter.agents.message_passing import limit_operations_to_one_thread
from drake_clutter.agents.ppo import PPOConfig, PPOLearner
from drake_clutter.config import upgrade
from drake_clutter.files import InputError, cli_error_handler
from drake_clutter.learning.checkpoint import load_checkpoint
from drake_clutter.learning.training_run import TrainingRun, resolve_device
from drake_clutter.validation import Flag, InRange, config_class, load_config_as


@config_class
class PPOTrainingConfig(ExplorerTrainingConfig):
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
    learning: PPOConfig = field(default_factory=PPOConfig)


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
    limit_operations_to_one_thread()
    environment = given.make_environment(privileged=given.privileged)
    learner = PPOLearner(environment, given.learning, given.seed, resolve_device(device))
    kind = TEACHER if given.privileged else STUDENT
    if given.warm_start:
        begun, numbers = load_explorer(
            load_checkpoint(Path(given.warm_start)), Path(given.warm_start), kind
        )
        if (numbers, len(begun.pick_marker)) != (environment.node_kind_ids, given.learning.width):
            raise InputError(
                f"warm_start: {given.warm_start}: is of other objects or another width; allowed is one of the same"
            )
        learner.network.load_state_dict(begun.state_dict())
    files = [Path(file) for file in (given.scenes, given.warm_start) if file]
    run = TrainingRun(out, given, learner, given.learning.total_timesteps, files)
    while learner.step < given.learning.total_timesteps:
        before = learner.step
        learner.train_iteration()
        over = learner.step >= given.learning.total_timesteps
        if over or learner.step // given.evaluate_every > before // given.evaluate_every:
            run.report(given.evaluate(environment, learner.network), learner.losses)
            run.save()
    about = {
        "kind": kind,
        "network": explorer_metadata(environment.node_kind_ids, given.learning.width),
    }
    run.finish(CHECKPOINT_FILE, learner.network, about)


if __name__ == "__main__":
    with cli_error_handler():
        typer.run(main)
