"""Shortest plans from full state information, confirmed in Drake."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

from drake_clutter.commands.explore_scene import TransitionCallback, execute_moves, write_episode
from drake_clutter.config import ClutterConfig
from drake_clutter.files import write_json, write_text
from drake_clutter.scenes.scene import Scene
from drake_clutter.tasks.exploration_task import TerminationReason
from drake_clutter.tasks.oracle_search import OracleSearch, Solvability
from drake_clutter.yaml_io import to_yaml

SOLUTION_FILE = "solution.json"
"""File of the result, which is written last."""


def solve_scene(
    scene: Scene,
    scene_name: str,
    out: Path,
    seed: int,
    budget: int,
    config: ClutterConfig,
    on_evaluation: Callable[[], None],
    on_transition: TransitionCallback,
) -> dict[str, Any]:
    """Search for the shortest plan that reveals all objects, and execute it.

    Writes `solution.json` and, if there is a plan, `moves.yaml`, `episode.json` and a web page.

    Args:
        scene: Scene at rest.
        scene_name: Name of the scene, for the page's title.
        out: Output folder.
        seed: Seed of placements among equally good ones, and of Drake's random offsets.
        budget: Maximum number of moves that the search may evaluate.
        config: Configuration.
        on_evaluation: Called before each move that the search evaluates.
        on_transition: Called after each executed move.

    Returns:
        The document of `solution.json`.

    Raises:
        InputError: The scene has too many objects for the search.
    """
    solution = OracleSearch(config).solve(scene, seed, budget, on_evaluation=on_evaluation)
    fields: dict[str, Any] = {
        "solvability": solution.solvability.value,
        "moves": len(solution.plan) if solution.solvability is Solvability.SOLVABLE else None,
        "lower_bound": solution.lower_bound,
        "is_optimal": solution.is_optimal,
        "plan": [str(move) for move in solution.plan],
        "unrevealable": list(solution.unrevealable),
        "moves_evaluated": solution.moves_evaluated,
        "budget": budget,
        "seed": seed,
        "confirmed": None,
    }
    if solution.plan:
        moves = [{"pick": move.pick, "place": move.place} for move in solution.plan]
        write_text(out / "moves.yaml", to_yaml(moves))
        task = execute_moves(scene, solution.plan, seed, config, on_transition)
        fields["confirmed"] = task.termination is TerminationReason.ALL_FOUND
        write_episode(
            out,
            task,
            f"The fewest moves for {scene_name}",
            "full knowledge",
            "settle",
            seed,
            config,
        )
    write_json(out / SOLUTION_FILE, fields)
    return fields
