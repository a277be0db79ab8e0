"""`drake-clutter move`."""

from pathlib import Path
from typing import Annotated

import typer

from drake_clutter.cli.config_from_options import load_scene_and_config
from drake_clutter.cli.options import (
    CatalogOption,
    CellOption,
    ConfigOption,
    Fidelity,
    FidelityOption,
    JsonOption,
    OutOption,
    SceneArgument,
    SeedOption,
    SetOption,
)
from drake_clutter.cli.output import print_episode, print_result, print_transition
from drake_clutter.files import InputError, prepare_output_directory


def move(
    scene: SceneArgument,
    out: OutOption,
    pick: Annotated[str | None, typer.Option(help="Name of the object to pick.")] = None,
    place: Annotated[
        str | None, typer.Option(help="Name of the object to put it on, or tray.")
    ] = None,
    moves: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="YAML list of {pick: NAME, place: NAME or tray}."),
    ] = None,
    fidelity: FidelityOption = Fidelity.SETTLE,
    plan_only: Annotated[
        bool,
        typer.Option(
            "--plan-only",
            help="With --fidelity arm: write how the arm would move (plan.json), move nothing.",
        ),
    ] = False,
    seed: SeedOption = 0,
    catalog: CatalogOption = None,
    config: ConfigOption = None,
    cell: CellOption = None,
    settings: SetOption = None,
    as_json: JsonOption = False,
) -> None:
    """Carry out one chosen move, or a list of them; writes episode.json and a page, index.html."""
    from drake_clutter.commands import explore_scene as command
    from drake_clutter.reports.terminal_text import describe_plans
    from drake_clutter.scenes.interfaces import Move

    if (moves is None) == (pick is None) or (pick is None) != (place is None):
        raise InputError("move: allowed is either --pick NAME --place NAME, or --moves FILE")
    if plan_only and fidelity is not Fidelity.ARM:
        raise InputError(f"--plan-only with --fidelity {fidelity.value}; allowed is --fidelity arm")
    chosen = command.read_moves(moves) if moves else [Move(str(pick), str(place))]
    file, world = load_scene_and_config(scene, catalog, config, cell, settings)
    prepare_output_directory(out)
    start = command.settle_scene(file.scene, world, seed)
    if plan_only:
        plans = command.plan_moves(start, chosen, seed, world, out)
        print_result({"plans": plans} if as_json else describe_plans(plans), as_json, f"{out}")
        return
    task = command.execute_moves(start, chosen, seed, world, print_transition, fidelity.value)
    fields = command.write_episode(
        out, task, f"Moves in {scene.name}", "chosen moves", fidelity.value, seed, world
    )
    print_episode(fields, as_json, out)
