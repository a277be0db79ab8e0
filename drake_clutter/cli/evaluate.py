"""`drake-clutter evaluate`."""

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.box import SIMPLE
from rich.table import Table

from drake_clutter.cli.config_from_options import load_config_from_options, reject_support_settings
from drake_clutter.cli.options import (
    CatalogOption,
    CellOption,
    ConfigOption,
    Fidelity,
    FidelityOption,
    JsonOption,
    MaxMovesOption,
    RayOption,
    SeedOption,
    SetOption,
    WorkersOption,
)
from drake_clutter.cli.output import out_console, progress_bar
from drake_clutter.files import InputError


def evaluate(
    source: Annotated[
        str | None,
        typer.Argument(metavar="SCENES", help="The same as --scenes.", show_default=False),
    ] = None,
    scenes: Annotated[
        str | None,
        typer.Option(
            help="A frozen set (sg_star_25, ...) or its file, or a folder of scene files that were judged."
        ),
    ] = None,
    agents: Annotated[
        list[str] | None,
        typer.Option(
            "--agents",
            "--agent",
            metavar="NAME,...",
            help="As for `explore`, or full-knowledge; may be repeated.",
            show_default="those without learning",
        ),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="JSON to write, with the rows and every episode."),
    ] = None,
    max_moves: MaxMovesOption = None,
    fidelity: FidelityOption = Fidelity.SETTLE,
    max_scenes: Annotated[
        int | None, typer.Option(min=1, help="Evaluate only the first N scenes.")
    ] = None,
    seed: SeedOption = 0,
    workers: WorkersOption = 1,
    ray: RayOption = None,
    catalog: CatalogOption = None,
    config: ConfigOption = None,
    cell: CellOption = None,
    settings: SetOption = None,
    as_json: JsonOption = False,
) -> None:
    """Compare explorers on scenes that hide something."""
    from drake_clutter.agents.explorers import BASELINE_POLICIES
    from drake_clutter.commands import evaluate_explorers as command
    from drake_clutter.reports.terminal_text import evaluation_table_rows

    scenes_source = scenes or source
    if scenes_source is None or None not in (scenes, source):
        raise InputError(
            "--scenes: give it once; allowed are a frozen set, its file, and a folder of scene files that were judged"
        )
    reject_support_settings(settings)
    evaluation_scenes = command.load_evaluation_scenes(scenes_source, catalog)[:max_scenes]
    world = load_config_from_options(
        config, cell, settings, None if cell else command.common_cell(evaluation_scenes)
    )
    names = [name for some in agents or BASELINE_POLICIES for name in some.split(",")]
    limit = max_moves or world.exploration.max_moves

    def progress(results: Iterable[Any], total: int) -> Iterable[Any]:
        return progress_bar("episodes", results, 0, total)

    rows = command.evaluate_explorers(
        evaluation_scenes,
        names,
        limit,
        fidelity.value,
        seed,
        world,
        catalog,
        workers,
        out,
        progress,
        ray,
    )
    if as_json:
        print(json.dumps(rows, indent=2))
        return
    shown = [
        {"agent": row["agent"]} | cells
        for row in rows
        for cells in evaluation_table_rows(row, command.move_limits(limit))
    ]
    title = f"{scenes_source}: {rows[0]['episodes']} scenes, {rows[0]['hidden']:.1f} objects hidden"
    table = Table(
        *shown[0],
        title=title,
        box=SIMPLE,
        padding=(0, 1, 0, 0),
        caption="in: so many moves; moves: of those who found all",
    )
    for cells in shown:
        table.add_row(*cells.values())
    out_console.print(table)
