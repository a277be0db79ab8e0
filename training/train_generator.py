"""Trains a Scene Generation agent by soft Q-learning.

    python training/train_generator.py --config training/configs/sg_star.yaml --out runs/sg_star

A run that was stopped, at any moment, goes on with the same command, and ends with the same weights as one that was not.
"""

import json
import time
from collections import Counter
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
import typer
from rich.console import Console
from torch.utils.tensorboard import SummaryWriter

from drake_clutter.agents.checkpoint import git_commit, load_checkpoint, save_checkpoint
from drake_clutter.agents.learned_generator import about_values, load_values
from drake_clutter.agents.message_passing import one_thread_per_operation
from drake_clutter.agents.soft_q import PARTS, Episode, SoftQConfig, SoftQLearner, play
from drake_clutter.catalogue import load_catalogue
from drake_clutter.config import ClutterConfig, config_yaml, load_typed
from drake_clutter.files import InputError, output_directory, told_in_one_line, write_json, write_text
from drake_clutter.grammar import canonical_form
from drake_clutter.tasks.generation import MOST_IN_A_STACK, ClutterGeneration, GenerationTask

CONFIG, STATE, HISTORY, TENSORBOARD = "config.yaml", "state.safetensors", "history.json", "tensorboard"
CHECKPOINT = "generator.safetensors"
FIGURES = ("score", "stable", "hidden", "distinct", "stacks", "balanced", "rarest_class")


@dataclass
class TrainGenerator:
    """A training.

    Attributes:
        objects: name of an object set; catalogue: a folder with object classes of one's own, or "".
        seed: same seed, same weights (on the same kind of machine).
        warm_start: a checkpoint to begin with, or "".
        evaluate_every: steps; evaluation_scenes: that are then sampled and judged by the fast judge.
        save_every: steps, after which all that is needed to go on is written.
        sampling_temperature: of the policy once it is trained; 0 for the one that it was trained with.
        task, learning, world: see there.
    """

    objects: str = "ycb7"
    catalogue: str = ""
    seed: int = 0
    warm_start: str = ""
    evaluate_every: int = 32_000
    evaluation_scenes: int = 256
    save_every: int = 64_000
    sampling_temperature: float = 0.0
    task: GenerationTask = field(default_factory=GenerationTask)
    learning: SoftQConfig = field(default_factory=SoftQConfig)
    world: ClutterConfig = field(default_factory=ClutterConfig)


def figures(episodes: list[Episode], classes: dict[str, Any]) -> dict[str, float]:
    """What the fast judge says of sampled scenes."""
    made = [episode.info for episode in episodes if "scene" in episode.info]
    hidden = [len(info["verdict"].hidden) for info in made]
    used = Counter(object_.object_class.name for info in made for object_ in info["scene"].objects)
    graphs = [info["scene"].graph for info in made]
    forms = {canonical_form(graph, classes) for graph in graphs}
    return {
        "score": float(np.mean([episode.score for episode in episodes])),
        "stable": len(made) / len(episodes),
        "hidden": float(np.mean(hidden)) if hidden else 0.0,
        "distinct": len(forms) / max(1, len(made)),
        "stacks": float(np.mean([len(graph.stacks()) for graph in graphs])) if made else 0.0,
        "balanced": float(np.mean([graph.largest_stack_share() <= MOST_IN_A_STACK for graph in graphs])) if made else 0.0,
        "rarest_class": min(used[name] for name in classes) / max(1, used.total()),
    }


def main(
    out: Annotated[Path, typer.Option(metavar="DIR", help="Folder of the run; one of the same config is taken up.")],
    config: Annotated[Path | None, typer.Option(metavar="FILE", help="YAML with fields of TrainGenerator.")] = None,
    settings: Annotated[list[str] | None, typer.Option("--set", metavar="FIELD=VALUE", help="A field over the file's.")] = None,
    device: Annotated[str, typer.Option(help="auto, cpu or cuda.")] = "auto",
    threads: Annotated[int, typer.Option(min=1, max=PARTS, help="That work on an update; changes no result.")] = PARTS,
) -> None:
    """Trains, evaluates as it goes, and writes generator.safetensors."""
    run = load_typed(TrainGenerator(), config, settings or [])
    if device not in ("auto", "cpu", "cuda"):
        raise InputError(f"--device {device}; allowed are auto, cpu, cuda")
    chosen = torch.device(("cuda" if torch.cuda.is_available() else "cpu") if device == "auto" else device)
    one_thread_per_operation()
    classes = load_catalogue(Path(run.catalogue) if run.catalogue else None).object_set(run.objects)

    def make_environment() -> ClutterGeneration:
        return ClutterGeneration(classes, run.task, run.world)

    example = make_environment()
    learner = SoftQLearner(make_environment, run.learning, run.seed, chosen, threads)
    if run.warm_start:
        learner.begin_with(load_values(load_checkpoint(Path(run.warm_start)), example.grammar))
    if not (out / CONFIG).exists():
        output_directory(out)
        write_text(out / CONFIG, config_yaml(run))
    elif (out / CONFIG).read_text() != config_yaml(run):
        raise InputError(f"--out {out}: holds a run of another config, see {CONFIG}; give the same one or another folder")
    history: list[dict[str, Any]] = []
    if (out / STATE).exists():
        learner.load(out / STATE)
        rows = json.loads((out / HISTORY).read_text()) if (out / HISTORY).exists() else []
        history = [row for row in rows if row["step"] <= learner.step]

    console, writer = Console(stderr=True), SummaryWriter(str(out / TENSORBOARD), purge_step=learner.step)
    seconds = history[-1]["seconds"] if history else 0.0
    begun, begun_at, losses = time.monotonic(), learner.step, list[float]()

    def evaluate() -> None:
        episodes = play(learner.network, make_environment, run.evaluation_scenes, run.learning.temperature, run.seed)
        spent = time.monotonic() - begun
        rate = (learner.step - begun_at) / spent if learner.step > begun_at else 0.0
        row: dict[str, Any] = {"step": learner.step, "seconds": seconds + spent, "commit": git_commit()}
        row["loss"] = float(np.mean(losses or [0.0]))
        row |= figures(episodes, example.grammar.classes)
        history.append(row)
        losses.clear()
        write_json(out / HISTORY, history)
        for name in FIGURES:
            writer.add_scalar(f"charts/{name}", row[name], learner.step)
        writer.add_scalar("charts/steps_per_second", rate, learner.step)
        writer.add_scalar("losses/q", row["loss"], learner.step)
        left = (run.learning.steps - learner.step) / rate / 60 if rate else float("nan")
        told = ", ".join(f"{name} {row[name]:.3g}" for name in (*FIGURES, "loss"))
        console.print(
            f"{learner.step:>7} of {run.learning.steps}: {told}; {rate:.0f} steps/s, {left:.0f} min left", highlight=False
        )

    while learner.step < run.learning.steps:
        before = learner.step
        learner.advance()
        losses += learner.losses
        if learner.step // run.evaluate_every > before // run.evaluate_every:
            evaluate()
        if learner.step // run.save_every > before // run.save_every:
            learner.save(out / STATE)
    if not history or history[-1]["step"] < learner.step:
        evaluate()
    about = {
        "kind": "generator",
        "network": about_values(example.grammar, run.learning.width),
        "temperature": run.sampling_temperature or run.learning.temperature,
        "config": asdict(run),
        "metrics": history[-1],
        "commits": list(dict.fromkeys(row["commit"] for row in history)),
    }
    save_checkpoint(out / CHECKPOINT, learner.network, about)
    learner.save(out / STATE)


if __name__ == "__main__":
    with told_in_one_line():
        typer.run(main)
