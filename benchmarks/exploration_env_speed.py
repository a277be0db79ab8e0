"""What a move and a new scene of `ClutterExploration-v0` take, judged fast, and where the time goes.

python benchmarks/exploration_env_speed.py --out benchmarks/results/exploration_environment.json
"""

import hashlib
import platform
from collections import defaultdict
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from rich.console import Console
from rich.table import Table

from benchmarks.generator_training_speed import timed
from drake_clutter.files import cli_error_handler, write_json
from drake_clutter.perception.ray_detector import RayDetector
from drake_clutter.resources import git_commit, resource_path
from drake_clutter.tasks import clutter_exploration
from drake_clutter.tasks.clutter_exploration import ClutterExploration
from drake_clutter.tasks.episode import SteppedBackend

SCENES = "training/scenes/sg_star_25.json"
"""Whose graphs are laid out anew; this set does not change."""
MOVE, SCENE = "a move", "a new scene"
PARTS: dict[str, tuple[Any, str]] = {
    MOVE: (ClutterExploration, "step"),
    SCENE: (ClutterExploration, "reset"),
    "of both: the move, judged": (SteppedBackend, "step"),
    "of both: the look": (RayDetector, "look"),
    "of both: the graph": (clutter_exploration, "exploration_graph"),
}
"""What is timed."""


def measured(privileged: bool, episodes: int, seconds: dict[str, float]) -> dict[str, Any]:
    """Random moves that are allowed, until the episodes are over; the same ones whenever this is measured."""
    environment, draw = (
        ClutterExploration(resource_path(SCENES), privileged=privileged),
        np.random.default_rng(0),
    )
    moves, told = 0, hashlib.sha256()
    for episode in range(-1, episodes):
        if episode == 0:  # what is compiled and read at first is not counted
            seconds.clear()
            moves, told = 0, hashlib.sha256()
        observation, _ = environment.reset(seed=episode + 1)
        over = out_of_moves = False
        while not (over or out_of_moves):
            allowed = np.argwhere(observation["allowed"])
            observation, _, over, out_of_moves, _ = environment.step(
                allowed[draw.integers(len(allowed))]
            )
            moves += 1
            for array in observation.values():
                told.update(array.tobytes())
    return {
        "privileged": privileged,
        "episodes": episodes,
        "moves": moves,
        "ms_a_move": 1000 * seconds[MOVE] / moves,
        "ms_a_scene": 1000 * seconds[SCENE] / episodes,
        "parts": {name: seconds[name] / (seconds[MOVE] + seconds[SCENE]) for name in PARTS},
        "observations_sha256": told.hexdigest(),
    }


def main(
    out: Annotated[Path | None, typer.Option(help="JSON to write.")] = None,
    episodes: Annotated[int, typer.Option(help="Of each kind of observation.")] = 200,
) -> None:
    """Measures and prints; with nothing else running."""
    seconds: dict[str, float] = defaultdict(float)
    for name, (owner, method) in PARTS.items():
        setattr(owner, method, timed(getattr(owner, method), name, seconds))
    rows = [measured(privileged, episodes, seconds) for privileged in (False, True)]
    heads = [
        f"{'all objects' if row['privileged'] else 'K_t'}: {row['moves']} moves, {row['episodes']} scenes"
        for row in rows
    ]
    table = Table("", *heads)
    table.add_row("ms for a move", *[f"{row['ms_a_move']:.1f}" for row in rows])
    table.add_row("ms for a new scene", *[f"{row['ms_a_scene']:.1f}" for row in rows])
    for name in PARTS:
        table.add_row(f"share of the time: {name}", *[f"{row['parts'][name]:.2f}" for row in rows])
    Console(width=120).print(table)
    if out is not None:
        machine = {"processor": platform.processor(), "system": platform.platform()}
        write_json(out, {"rows": rows, "machine": machine, "commit": git_commit()})


if __name__ == "__main__":
    with cli_error_handler():
        typer.run(main)
