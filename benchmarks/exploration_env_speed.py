"""Time the moves and resets of the exploration environment, and their parts.

    python benchmarks/exploration_env_speed.py --out exploration_env_speed.json

Run it with no other work on the machine. The random moves are the same in every run, which the hash
of all observations confirms.
"""

import hashlib
from collections.abc import Callable
from typing import Annotated, Any

import numpy as np
import typer

from benchmarks.measurement import Stopwatch, describe_machine
from drake_clutter.files import write_json
from drake_clutter.perception.ray_detector import RayDetector
from drake_clutter.resources import resource_path
from drake_clutter.tasks import clutter_exploration
from drake_clutter.tasks.clutter_exploration import ClutterExploration
from drake_clutter.tasks.episode import SteppedBackend
from drake_clutter.tasks.exploration_graph import build_exploration_graph
from training.results_file import Row, provenance
from training.script import ResultsOption, print_table, progress, run_script

SCENES = "training/scenes/sg_star_25.json"
"""Scene dataset whose graphs are laid out again in every episode."""
MOVE = "a move"
"""Name of the measurement of the environment's steps."""
RESET = "a new scene"
"""Name of the measurement of the environment's resets."""
PARTS: dict[str, tuple[Any, Callable[..., Any]]] = {
    MOVE: (ClutterExploration, ClutterExploration.step),
    RESET: (ClutterExploration, ClutterExploration.reset),
    "of both: the move, judged": (SteppedBackend, SteppedBackend.step),
    "of both: the look": (RayDetector, RayDetector.perceive),
    "of both: the graph": (clutter_exploration, build_exploration_graph),
}
"""Measured functions by name, each with the class or module that it is called from."""


def run_episodes(environment: ClutterExploration, seeds: range, rng: np.random.Generator) -> Row:
    """Run episodes of random allowed moves.

    Args:
        environment: The environment.
        seeds: Seed of each episode.
        rng: Random generator of the moves.

    Returns:
        The number of moves, and the hash of all observations.
    """
    num_moves = 0
    observations_hash = hashlib.sha256()
    for seed in seeds:
        observation, _ = environment.reset(seed=seed)
        terminated = truncated = False
        while not (terminated or truncated):
            allowed = np.argwhere(observation["action_mask"])
            action = allowed[rng.integers(len(allowed))]
            observation, _, terminated, truncated, _ = environment.step(action)
            num_moves += 1
            for array in observation.values():
                observations_hash.update(array.tobytes())
    return {"moves": num_moves, "observations_sha256": observations_hash.hexdigest()}


def measure(privileged: bool, episodes: int) -> Row:
    """Return the times of the environment's parts.

    Args:
        privileged: Whether the observation is the full state.
        episodes: Number of episodes.
    """
    environment = ClutterExploration(resource_path(SCENES), privileged=privileged)
    rng = np.random.default_rng(0)
    run_episodes(environment, range(1), rng)  # Compiles code and reads files.
    stopwatch = Stopwatch()
    with stopwatch.watch(PARTS):
        run = run_episodes(environment, range(1, 1 + episodes), rng)
    total = stopwatch.total(MOVE) + stopwatch.total(RESET)
    return {
        "privileged": privileged,
        "episodes": episodes,
        "moves": run["moves"],
        "ms_a_move": 1000 * stopwatch.total(MOVE) / run["moves"],
        "ms_a_scene": 1000 * stopwatch.total(RESET) / episodes,
        "parts": {name: stopwatch.total(name) / total for name in PARTS},
        "observations_sha256": run["observations_sha256"],
    }


def table_row(row: Row) -> dict[str, str]:
    """Return a row of the results as cells of the printed table."""
    return {
        "observation": "full state" if row["privileged"] else "what has been seen",
        "moves": str(row["moves"]),
        "scenes": str(row["episodes"]),
        "move (ms)": f"{row['ms_a_move']:.1f}",
        "new scene (ms)": f"{row['ms_a_scene']:.1f}",
        **{f"fraction of time: {name}": f"{share:.2f}" for name, share in row["parts"].items()},
    }


def main(
    episodes: Annotated[int, typer.Option(min=1, help="Episodes of each kind.")] = 200,
    out: ResultsOption = None,
) -> None:
    """Measure the environment with both kinds of observations."""
    rows = [measure(privileged, episodes) for privileged in progress((False, True), "observations")]
    print_table([table_row(row) for row in rows])
    if out is not None:
        write_json(out, {"rows": rows, "machine": describe_machine(), **provenance()})


if __name__ == "__main__":
    run_script(main)
