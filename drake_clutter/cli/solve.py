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
from drake_clutter.cli.output import print_result, print_transition
from drake_clutter.files import prepare_output_directory
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
    from drake_clutter.commands.solve_scene import solve_scene
    from drake_clutter.reports.terminal_text import describe_solution

    file, config = load_scene_and_config(scene, catalog, config_file, cell_file, settings)
    prepare_output_directory(out)
    start = settle_scene(file.scene, config, seed)
    solution = solve_scene(start, scene.name, out, seed, budget, config, print_transition)
    print_result(solution, describe_solution(solution), as_json, f"{out}")
