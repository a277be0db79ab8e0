"""Train an explorer by PPO: the privileged teacher, or a student that starts from a clone.

    python training/train_explorer_ppo.py --config training/configs/teacher.yaml --out runs/teacher
    python training/train_explorer_ppo.py --config training/configs/student.yaml --out runs/student

An interrupted run is resumed by the same command, and ends with the same weights as an
uninterrupted one.
"""

from dataclasses import field
from pathlib import Path

from drake_clutter.agents.explorer_training import ExplorerTrainingConfig
from drake_clutter.agents.learned_explorer import STUDENT, TEACHER, load_explorer
from drake_clutter.agents.message_passing import limit_operations_to_one_thread
from drake_clutter.agents.ppo import PPOConfig, PPOLearner
from drake_clutter.config import upgrade_config
from drake_clutter.files import InputError
from drake_clutter.learning.checkpoint import load_checkpoint
from drake_clutter.learning.training_run import resolve_device
from drake_clutter.validation import Count, Flag, config_class, load_config_as
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
class PPOTrainingConfig(ExplorerTrainingConfig):
    """Configuration of an explorer's training by PPO.

    Attributes:
        privileged: Whether the network sees the full state (a teacher), or what has been seen so
            far (a student).
        warm_start: Checkpoint of the same kind whose weights the training starts from; "" for
            random weights.
        evaluate_every: Moves between two evaluations.
        learning: Hyperparameters of PPO.
    """

    privileged: Flag = True
    warm_start: str = ""
    evaluate_every: Count = 15_000
    learning: PPOConfig = field(default_factory=PPOConfig)


CONFIG = PPOTrainingConfig()
"""Default configuration of the training."""


def main(
    out: OutOption,
    config: ConfigOption = None,
    settings: SettingsOption = None,
    catalog: CatalogOption = None,
    device: DeviceOption = "auto",
) -> None:
    """Train an explorer by PPO and write explorer.safetensors."""
    training = load_config_as(
        CONFIG, config, settings_with_catalog(settings, catalog), upgrade_config
    )
    limit_operations_to_one_thread()
    environment = training.make_environment(privileged=training.privileged)
    learner = PPOLearner(environment, training.learning, training.seed, resolve_device(device))
    kind = TEACHER if training.privileged else STUDENT
    if training.warm_start:
        path = Path(training.warm_start)
        network, numbers = load_explorer(load_checkpoint(path), path, kind)
        if (numbers, len(network.pick_marker)) != (
            environment.node_kind_ids,
            training.learning.width,
        ):
            raise InputError(
                f"warm_start: {path}: has other object classes or another width; expected a"
                " checkpoint with the same"
            )
        if network.finds_target and not training.target:
            raise InputError(f"warm_start: {path}: looks for one object; expected a target")
        # Without training, a network that is conditioned on a target acts as the same without one.
        learner.network.load_state_dict(learner.network.state_dict() | network.state_dict())
    train_explorer(
        out,
        training,
        environment,
        learner,
        kind=kind,
        total_steps=training.learning.total_timesteps,
        steps_field="learning.total_timesteps",
        evaluate_every=training.evaluate_every,
        input_files=[Path(file) for file in (training.scenes, training.warm_start) if file],
    )


if __name__ == "__main__":
    run_script(main)
