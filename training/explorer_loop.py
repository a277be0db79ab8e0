"""Training loop shared by the scripts that train explorers."""

from collections.abc import Sequence
from pathlib import Path

from drake_clutter.agents.behavior_cloning import BehaviorCloningLearner
from drake_clutter.agents.explorer_training import CHECKPOINT_FILE, ExplorerTrainingConfig
from drake_clutter.agents.learned_explorer import explorer_metadata
from drake_clutter.agents.ppo import PPOLearner
from drake_clutter.learning.training_run import TrainingRun
from drake_clutter.tasks.clutter_exploration import ClutterExploration
from training.training_loop import CheckpointSpec, Metrics, train_to_end


def train_explorer(
    out: Path,
    training: ExplorerTrainingConfig,
    environment: ClutterExploration,
    learner: BehaviorCloningLearner | PPOLearner,
    *,
    kind: str,
    total_steps: int,
    steps_field: str,
    evaluate_every: int,
    input_files: Sequence[Path],
) -> None:
    """Train an explorer to the end and write its checkpoint.

    Args:
        out: Folder of the run. A run of the same configuration in it is resumed.
        training: Configuration of the training.
        environment: Environment of the evaluations.
        learner: Learning algorithm.
        kind: Kind of the checkpoint: teacher or student.
        total_steps: Number of steps of the learner after which the training ends.
        steps_field: Field of the configuration that holds `total_steps`.
        evaluate_every: Steps between two evaluations and saved states.
        input_files: Files that the training reads, whose hashes the checkpoint records.
    """
    run = TrainingRun(out, training, learner, total_steps, input_files, steps_field=steps_field)
    network_metadata = explorer_metadata(
        environment.node_kind_ids,
        learner.config.width,
        finds_target=environment.target_text is not None,
    )
    metadata = {"kind": kind, "network": network_metadata}

    def evaluate() -> tuple[Metrics, Metrics]:
        return training.evaluate(environment, learner.network), learner.losses

    train_to_end(
        run,
        learner,
        total_steps,
        CheckpointSpec(CHECKPOINT_FILE, metadata, lambda metrics: metrics["score"]),
        train_iteration=learner.train_iteration,
        evaluate=evaluate,
        evaluate_every=evaluate_every,
        save_every=evaluate_every,
    )
