"""Trains a Scene Generation agent by soft Q-learning.

    python training/train_generator.py --config training/configs/sg_star.yaml --out runs/sg_star

A run that was stopped, at any moment, goes on with the same command, and ends with the same weights as one that was not.
"""

from collections import Counter
from dataclasses import field
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from drake_clutter.agents.learned_generator import load_rule_network, rule_network_metadata
from drake_clutter.agents.message_passing import limit_operations_to_one_thread
from drake_clutter.agents.soft_q import (
    NUM_GRADIENT_SHARDS,
    SampledEpisode,
    SoftQConfig,
    SoftQLearner,
    sample_episodes,
)
from drake_clutter.catalog import load_catalog
from drake_clutter.config import ClutterConfig, upgrade
from drake_clutter.files import cli_error_handler
from drake_clutter.grammar import canonical_form
from drake_clutter.learning.checkpoint import load_checkpoint
from drake_clutter.learning.training_run import TrainingRun, resolve_device
from drake_clutter.tasks.generation_task import (
    MAX_BALANCED_STACK_FRACTION,
    ClutterGeneration,
    GenerationTaskConfig,
)
from drake_clutter.validation import (
    InRange,
    NonNegative,
    config_class,
    load_config_as,
    renamed_fields,
)

CHECKPOINT = "generator.safetensors"


@config_class
@renamed_fields(catalogue="catalog")
class GeneratorTrainingConfig:
    """A training.

    Attributes:
        objects: name of an object set; catalog: a folder with object classes of one's own, or "".
        seed: same seed, same weights (on the same kind of machine).
        warm_start: a checkpoint to begin with, or "".
        evaluate_every: steps; evaluation_scenes: that are then sampled and judged by the fast judge.
        save_every: steps, after which all that is needed to go on is written.
        sampling_temperature: of the policy once it is trained; 0 for the one that it was trained with.
        task, learning, world: see there.
    """

    objects: str = "ycb7"
    catalog: str = ""
    seed: Annotated[int, InRange(0)] = 0
    warm_start: str = ""
    evaluate_every: Annotated[int, InRange(1)] = 32_000
    evaluation_scenes: Annotated[int, InRange(1)] = 256
    save_every: Annotated[int, InRange(1)] = 64_000
    sampling_temperature: NonNegative = 0.0
    task: GenerationTaskConfig = field(default_factory=GenerationTaskConfig)
    learning: SoftQConfig = field(default_factory=SoftQConfig)
    world: ClutterConfig = field(default_factory=ClutterConfig)


CONFIG = GeneratorTrainingConfig()
"""Default configuration of the training."""


def figures(episodes: list[SampledEpisode], classes: dict[str, Any]) -> dict[str, float]:
    """What the fast judge says of sampled scenes."""
    made = [episode.info for episode in episodes if "scene" in episode.info]
    hidden = [len(info["verdict"].hidden) for info in made]
    used = Counter(object_.object_class.name for info in made for object_ in info["scene"].objects)
    graphs = [info["scene"].graph for info in made]
    forms = {canonical_form(graph, classes) for graph in graphs}
    return {
        "score": float(np.mean([episode.episodic_return for episode in episodes])),
        "stable": len(made) / len(episodes),
        "hidden": float(np.mean(hidden)) if hidden else 0.0,
        "distinct": len(forms) / max(1, len(made)),
        "stacks": float(np.mean([len(graph.stacks()) for graph in graphs])) if made else 0.0,
        "balanced": float(
            np.mean(
                [graph.largest_stack_share() <= MAX_BALANCED_STACK_FRACTION for graph in graphs]
            )
        )
        if made
        else 0.0,
        "rarest_class": min(used[name] for name in classes) / max(1, used.total()),
    }


def main(
    out: Annotated[
        Path,
        typer.Option(metavar="DIR", help="Folder of the run; one of the same config is taken up."),
    ],
    config: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="YAML with fields of GeneratorTrainingConfig."),
    ] = None,
    settings: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="FIELD=VALUE", help="A field over the file's."),
    ] = None,
    device: Annotated[str, typer.Option(help="auto, cpu or cuda.")] = "auto",
    threads: Annotated[
        int,
        typer.Option(
            min=1, max=NUM_GRADIENT_SHARDS, help="That work on an update; changes no result."
        ),
    ] = NUM_GRADIENT_SHARDS,
) -> None:
    """Trains, evaluates as it goes, and writes generator.safetensors."""
    given = load_config_as(CONFIG, config, settings or [], upgrade)
    chosen = resolve_device(device)
    limit_operations_to_one_thread()
    classes = load_catalog(Path(given.catalog) if given.catalog else None).object_set(given.objects)

    def make_environment() -> ClutterGeneration:
        return ClutterGeneration(classes, given.task, given.world)

    example, learning = make_environment(), given.learning
    learner = SoftQLearner(make_environment, learning, given.seed, chosen, threads)
    if given.warm_start:
        learner.warm_start(
            load_rule_network(load_checkpoint(Path(given.warm_start)), example.grammar)
        )
    run, losses = TrainingRun(out, given, learner, learning.total_timesteps), list[float]()

    def evaluate() -> None:
        episodes = sample_episodes(
            learner.network,
            make_environment,
            given.evaluation_scenes,
            learning.temperature,
            given.seed,
        )
        run.report(
            figures(episodes, example.grammar.classes), {"loss": float(np.mean(losses or [0.0]))}
        )
        losses.clear()

    while learner.step < learning.total_timesteps:
        before = learner.step
        learner.train_iteration()
        losses += learner.losses
        if learner.step // given.evaluate_every > before // given.evaluate_every:
            evaluate()
        if learner.step // given.save_every > before // given.save_every:
            run.save()
    if not run.history or run.history[-1]["step"] < learner.step:
        evaluate()
    about = {
        "kind": "generator",
        "network": rule_network_metadata(example.grammar, learning.width),
        "temperature": given.sampling_temperature or learning.temperature,
    }
    run.finish(CHECKPOINT, learner.network, about)


if __name__ == "__main__":
    with cli_error_handler():
        typer.run(main)
