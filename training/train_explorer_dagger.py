r"""Train a student explorer by cloning a teacher: DAgger, or plain behavior cloning.

    python training/train_explorer_dagger.py \
        --config training/configs/student_dagger.yaml --out runs/student_dagger

The student sees what the camera has shown so far, the teacher the full state. An interrupted run
is resumed by the same command, and ends with the same weights as an uninterrupted one.
"""

from dataclasses import field
from pathlib import Path

from drake_clutter.agents.behavior_cloning import BehaviorCloningConfig, BehaviorCloningLearner
from drake_clutter.agents.explorer_training import ExplorerTrainingConfig
from drake_clutter.agents.learned_explorer import STUDENT, TEACHER, load_explorer
from drake_clutter.agents.message_passing import limit_operations_to_one_thread
from drake_clutter.config import upgrade_config
from drake_clutter.files import InputError
from drake_clutter.learning.checkpoint import load_checkpoint
from drake_clutter.learning.training_run import resolve_device
from drake_clutter.validation import Count, config_class, load_config_as
from training.explorer_loop import train_explorer
from training.script import (
    CatalogOption,
    ConfigOption,
    SettingsOption,
    run_script,
    settings_with_catalog,
)
from training.training_loop import DeviceOption, OutOption


@config_class
class DAggerTrainingConfig(ExplorerTrainingConfig):
    """Configuration of a student's training by cloning.

    Attributes:
        teacher: Checkpoint of the teacher.
        evaluate_every: Iterations between two evaluations.
        learning: Hyperparameters of DAgger.
    """

    teacher: str = "training/checkpoints/teacher.safetensors"
    evaluate_every: Count = 5
    learning: BehaviorCloningConfig = field(default_factory=BehaviorCloningConfig)


CONFIG = DAggerTrainingConfig()
"""Default configuration of the training."""


def main(
    out: OutOption,
    config: ConfigOption = None,
    settings: SettingsOption = None,
    catalog: CatalogOption = None,
    device: DeviceOption = "auto",
) -> None:
    """Train a student by cloning a teacher and write explorer.safetensors."""
    training = load_config_as(
        CONFIG, config, settings_with_catalog(settings, catalog), upgrade_config
    )
    limit_operations_to_one_thread()
    torch_device = resolve_device(device)
    environment = training.make_environment()
    path = Path(training.teacher)
    teacher, numbers = load_explorer(load_checkpoint(path), path, TEACHER)
    if numbers != environment.node_kind_ids:
        raise InputError(
            f"teacher: {path} knows {', '.join(numbers)}; expected a teacher of the object"
            f" classes in {training.scenes}"
        )
    if teacher.finds_target != bool(training.target):
        wanted = "a target" if training.target else "all objects"
        raise InputError(f"teacher: {path}: looks for something else; expected one for {wanted}")
    learner = BehaviorCloningLearner(
        environment, teacher.to(torch_device), training.learning, training.seed, torch_device
    )
    train_explorer(
        out,
        training,
        environment,
        learner,
        kind=STUDENT,
        total_steps=training.learning.iterations,
        steps_field="learning.iterations",
        evaluate_every=training.evaluate_every,
        input_files=[Path(training.scenes), path],
    )


if __name__ == "__main__":
    run_script(main)
