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


def solve(
    scene: SceneArgument,
    out: OutOption,
    budget: Annotated[
        int, typer.Option(min=1, help="Moves that the search may try before it gives up.")
    ] = 5000,
    seed: SeedOption = 0,
    catalog: CatalogOption = None,
    config: ConfigOption = None,
    cell: CellOption = None,
    settings: SetOption = None,
    as_json: JsonOption = False,
) -> None:
    """Find the fewest moves that reveal everything, with full knowledge of the scene; Drake confirms the plan."""
    from drake_clutter.commands import explore_scene, solve_scene

    file, world = load_scene_and_config(scene, catalog, config, cell, settings)
    prepare_output_directory(out)
    fields = solve_scene.solve_scene(
        explore_scene.settle_scene(file.scene, world, seed),
        scene.name,
        out,
        seed,
        budget,
        world,
        print_transition,
    )
    print_result(fields, as_json, f"{out}")
