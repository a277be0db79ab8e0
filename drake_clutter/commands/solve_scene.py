"""`drake-clutter solve`: the fewest moves that reveal everything, and whether Drake confirms them."""

from pathlib import Path
from typing import Any

from drake_clutter.commands.explore_scene import TransitionCallback, execute_moves, write_episode
from drake_clutter.config import ClutterConfig
from drake_clutter.files import write_json, write_text
from drake_clutter.scenes.scene import Scene
from drake_clutter.tasks.exploration_task import TerminationReason
from drake_clutter.tasks.oracle_search import OracleSearch, Solvability
from drake_clutter.yaml_io import to_yaml


def solve_scene(
    scene: Scene,
    scene_name: str,
    out: Path,
    seed: int,
    budget: int,
    config: ClutterConfig,
    on_transition: TransitionCallback,
) -> dict[str, Any]:
    """Searches, carries a plan out at fidelity `settle`, and writes `solution.json`; with a plan also `moves.yaml` and a page.

    Args:
        scene: at rest.
        scene_name: of the scene, for the page's title.
        out: the folder.
        seed: of the places that are equally good, and of Drake's random offsets.
        budget: moves that the search may try.
        config: the world.
        on_transition: called after each move that is carried out.

    Returns:
        What `solution.json` holds.

    Raises:
        InputError: the scene has more objects than the search takes.
    """
    solution = OracleSearch(config).solve(scene, seed, budget)
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
    write_json(out / "solution.json", fields)
    return fields
