"""Trains a student, which sees what the camera has shown, by cloning a teacher, which sees everything.

    python training/clone_explorer.py --config training/configs/student_dagger.yaml --out runs/student_dagger

A run that was stopped, at any moment, goes on with the same command, and ends with the same weights as one that was not.
"""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import typer

from drake_clutter.agents.cloning import Cloning, CloningConfig
from drake_clutter.agents.exploration_episodes import acting, figures, play_episodes
from drake_clutter.agents.learned_explorer import STUDENT, TEACHER, about_explorer, load_explorer
from drake_clutter.agents.message_passing import one_thread_per_operation
from drake_clutter.catalogue import load_catalogue
from drake_clutter.config import ClutterConfig, load_typed
from drake_clutter.files import InputError, told_in_one_line
from drake_clutter.learning.checkpoint import load_checkpoint
from drake_clutter.learning.training_run import TrainingRun, device_of
from drake_clutter.scenes.scene_set import load_scene_set
from drake_clutter.tasks.clutter_exploration import ClutterExploration

CHECKPOINT = "explorer.safetensors"


@dataclass
class CloneExplorer:
    """A training.

    Attributes:
        teacher: its checkpoint.
        scenes: file of a set of scenes; catalogue: a folder with object classes of one's own, or "".
        seed: same seed, same weights (on the same kind of machine).
        fidelity: of the moves; max_moves: of an episode; most_objects: of a scene.
        evaluate_every: rounds; evaluation_episodes: that are then played with the likeliest moves.
        learning, world: see there.
    """

    teacher: str = "training/checkpoints/teacher.safetensors"
    scenes: str = "training/scenes/train_sg_star.json"
    catalogue: str = ""
    seed: int = 0
    fidelity: str = "equilibrium"
    max_moves: int = 20
    most_objects: int = 24
    evaluate_every: int = 5
    evaluation_episodes: int = 200
    learning: CloningConfig = field(default_factory=CloningConfig)
    world: ClutterConfig = field(default_factory=ClutterConfig)


def main(
    out: Annotated[Path, typer.Option(metavar="DIR", help="Folder of the run; one of the same config is taken up.")],
    config: Annotated[Path | None, typer.Option(metavar="FILE", help="YAML with fields of CloneExplorer.")] = None,
    settings: Annotated[list[str] | None, typer.Option("--set", metavar="FIELD=VALUE", help="A field over the file's.")] = None,
    device: Annotated[str, typer.Option(help="auto, cpu or cuda.")] = "auto",
) -> None:
    """Trains, evaluates as it goes, and writes explorer.safetensors."""
    given = load_typed(CloneExplorer(), config, settings or [])
    one_thread_per_operation()
    chosen = device_of(device)
    scenes = load_scene_set(Path(given.scenes), load_catalogue(Path(given.catalogue) if given.catalogue else None))
    environment = ClutterExploration(
        scenes, fidelity=given.fidelity, config=given.world, max_moves=given.max_moves, most_objects=given.most_objects
    )
    teacher, numbers = load_explorer(load_checkpoint(Path(given.teacher)), Path(given.teacher), TEACHER)
    if numbers != environment.numbers:
        raise InputError(f"teacher: {given.teacher} knows {', '.join(numbers)}; allowed is one of the objects of {given.scenes}")
    learner = Cloning(environment, teacher.to(chosen), given.learning, given.seed, chosen)
    run = TrainingRun(out, given, learner, given.learning.rounds, [Path(given.scenes), Path(given.teacher)])
    while learner.step < given.learning.rounds:
        learner.advance()
        if learner.step == given.learning.rounds or learner.step % given.evaluate_every == 0:
            episodes = play_episodes(environment, given.evaluation_episodes, (given.seed, 3), acting(learner.network, None))
            run.report(figures(episodes), learner.losses)
            run.save()
    about = {"kind": STUDENT, "network": about_explorer(environment.numbers, given.learning.width)}
    run.finish(CHECKPOINT, learner.network, about)


if __name__ == "__main__":
    with told_in_one_line():
        typer.run(main)
