"""Train a scene generator by soft Q-learning.

    python training/train_generator.py --config training/configs/sg_star.yaml --out runs/sg_star

An interrupted run is resumed by the same command, and ends with the same weights as an
uninterrupted one.
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import field
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from drake_clutter.agents.learned_generator import (
    CHECKPOINT_KIND,
    load_generator_checkpoint,
    load_rule_network,
    rule_network_metadata,
)
from drake_clutter.agents.message_passing import limit_operations_to_one_thread
from drake_clutter.agents.soft_q import (
    NUM_GRADIENT_SHARDS,
    SampledEpisode,
    SoftQConfig,
    SoftQLearner,
    sample_episodes,
)
from drake_clutter.catalog import load_catalog
from drake_clutter.config import ClutterConfig, upgrade_config
from drake_clutter.files import InputError
from drake_clutter.grammar import canonical_form
from drake_clutter.learning.training_run import TrainingRun, resolve_device
from drake_clutter.tasks.generation_task import (
    MAX_BALANCED_STACK_FRACTION,
    ClutterGeneration,
    GenerationTaskConfig,
)
from drake_clutter.validation import (
    Count,
    NonNegative,
    Seed,
    config_class,
    load_config_as,
    renamed_fields,
)
from training.script import (
    CatalogOption,
    ConfigOption,
    SettingsOption,
    run_script,
    settings_with_catalog,
)
from training.training_loop import (
    CheckpointSpec,
    DeviceOption,
    Metrics,
    OutOption,
    train_to_end,
)

CHECKPOINT = "generator.safetensors"
"""File name of the trained network in the folder of the run."""


@config_class
@renamed_fields(catalogue="catalog")
class GeneratorTrainingConfig:
    """Configuration of a generator's training.

    Attributes:
        objects: Name of the object set.
        catalog: Folder with additional object classes; "" for none.
        seed: Random seed; equal seeds give equal weights on the same kind of machine.
        warm_start: Checkpoint whose weights the training starts from; "" for random weights.
        evaluate_every: Steps between two evaluations.
        evaluation_scenes: Number of scenes that an evaluation samples.
        save_every: Steps between two saved states, from which an interrupted run is resumed.
        sampling_temperature: Temperature of the trained policy; 0 for that of the training.
        task: The Markov decision process.
        learning: Hyperparameters of soft Q-learning.
        world: Layout, settling and visibility of the scenes.
    """

    objects: str = "ycb7"
    catalog: str = ""
    seed: Seed = 0
    warm_start: str = ""
    evaluate_every: Count = 32_000
    evaluation_scenes: Count = 256
    save_every: Count = 64_000
    sampling_temperature: NonNegative = 0.0
    task: GenerationTaskConfig = field(default_factory=GenerationTaskConfig)
    learning: SoftQConfig = field(default_factory=SoftQConfig)
    world: ClutterConfig = field(default_factory=ClutterConfig)


CONFIG = GeneratorTrainingConfig()
"""Default configuration of the training."""


def scene_metrics(episodes: Sequence[SampledEpisode], classes: dict[str, Any]) -> dict[str, float]:
    """Return metrics of sampled scenes, by the static stability model.

    Args:
        episodes: The sampled episodes, some of which end without a scene.
        classes: The object classes of the set by name.
    """
    infos = [episode.info for episode in episodes if "scene" in episode.info]
    hidden = [len(info["verdict"].hidden) for info in infos]
    class_counts = Counter(o.object_class.name for info in infos for o in info["scene"].objects)
    graphs = [info["scene"].graph for info in infos]
    forms = {canonical_form(graph, classes) for graph in graphs}
    balanced = [graph.largest_stack_fraction() <= MAX_BALANCED_STACK_FRACTION for graph in graphs]
    return {
        "score": float(np.mean([episode.episodic_return for episode in episodes])),
        "stable": len(infos) / len(episodes),
        "hidden": float(np.mean(hidden)) if infos else 0.0,
        "distinct": len(forms) / max(1, len(infos)),
        "stacks": float(np.mean([len(graph.stack_bases()) for graph in graphs])) if infos else 0.0,
        "balanced": float(np.mean(balanced)) if infos else 0.0,
        "rarest_class": min(class_counts[name] for name in classes) / max(1, class_counts.total()),
    }


def main(
    out: OutOption,
    config: ConfigOption = None,
    settings: SettingsOption = None,
    catalog: CatalogOption = None,
    device: DeviceOption = "auto",
    threads: Annotated[
        int,
        typer.Option(
            min=1, max=NUM_GRADIENT_SHARDS, help="Threads of an update; changes no result."
        ),
    ] = NUM_GRADIENT_SHARDS,
) -> None:
    """Train a scene generator and write generator.safetensors."""
    training = load_config_as(
        CONFIG, config, settings_with_catalog(settings, catalog), upgrade_config
    )
    torch_device = resolve_device(device)
    limit_operations_to_one_thread()
    all_classes = load_catalog(Path(training.catalog) if training.catalog else None)
    classes = all_classes.object_set(training.objects)
    learning = training.learning

    def make_environment() -> ClutterGeneration:
        return ClutterGeneration(classes, training.task, training.world)

    grammar = make_environment().grammar
    learner = SoftQLearner(make_environment, learning, training.seed, torch_device, threads)
    if training.warm_start:
        checkpoint = load_generator_checkpoint(Path(training.warm_start))
        width = checkpoint.metadata["network"]["width"]
        if width != learning.width:
            raise InputError(
                f"warm_start: {training.warm_start}: has width {width}; "
                f"expected {learning.width} (learning.width)"
            )
        learner.warm_start(load_rule_network(checkpoint, grammar))
    run = TrainingRun(
        out,
        training,
        learner,
        learning.total_timesteps,
        steps_field="learning.total_timesteps",
    )
    metadata = {
        "kind": CHECKPOINT_KIND,
        "network": rule_network_metadata(grammar, learning.width),
        "temperature": training.sampling_temperature or learning.temperature,
    }

    def evaluate() -> tuple[Metrics, Metrics]:
        episodes = sample_episodes(
            learner.network,
            make_environment,
            training.evaluation_scenes,
            learning.temperature,
            training.seed,
        )
        loss = float(np.mean(learner.losses or [0.0]))
        learner.losses.clear()
        return scene_metrics(episodes, grammar.classes), {"loss": loss}

    train_to_end(
        run,
        learner,
        learning.total_timesteps,
        CheckpointSpec(CHECKPOINT, metadata, lambda metrics: metrics["score"]),
        train_iteration=learner.train_iteration,
        evaluate=evaluate,
        evaluate_every=training.evaluate_every,
        save_every=training.save_every,
    )


if __name__ == "__main__":
    run_script(main)
