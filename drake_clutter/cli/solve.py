"""`drake-clutter solve`."""

from typing import Annotated

import typer

from drake_clutter.cli.config_from_options import load_scene_and_config
from drake_clutter.cli.options import (
    CatalogOption,
    CellOption,
    ConfigOption,
    JsonOption,
    OutOption,
    SceneArgument,
    SeedOption,
    SetOption,
)
from drake_clutter.cli.output import counter, print_result, print_transition
from drake_clutter.limits import MAX_COUNT


def solve(
    scene: SceneArgument,
    out: OutOption,
    budget: Annotated[
        int,
        typer.Option(
            min=1, max=MAX_COUNT, help="Maximum number of moves that the search may evaluate."
        ),
    ] = 5000,
    seed: SeedOption = 0,
    catalog: CatalogOption = None,
    config_file: ConfigOption = None,
    cell_file: CellOption = None,
    settings: SetOption = None,
    as_json: JsonOption = False,
) -> None:
    """Find the shortest plan that reveals all objects, given full state information.

    The search uses the static stability model; a plan is then executed and confirmed in Drake.
    Writes `solution.json` and, with a plan, `moves.yaml`, `episode.json` and `index.html`.
    """
    from drake_clutter.commands.explore_scene import settle_scene
    from drake_clutter.commands.job_file import open_job_folder, read_result, scene_job
    from drake_clutter.commands.solve_scene import SOLUTION_FILE, solve_scene
    from drake_clutter.reports.terminal_text import describe_solution

    file, config = load_scene_and_config(scene, catalog, config_file, cell_file, settings)
    job = scene_job("solve", scene, config, catalog, seed=seed, budget=budget)
    with open_job_folder(out, job):
        solution = read_result(out / SOLUTION_FILE)
        if solution is None:
            start = settle_scene(file.scene, config, seed)
            with counter("moves evaluated", budget) as on_evaluation:
                solution = solve_scene(
                    start, scene.name, out, seed, budget, config, on_evaluation, print_transition
                )
    print_result(solution, describe_solution(solution), as_json, f"{out}")
