"""`drake-clutter evaluate`."""

from collections.abc import Iterable
from pathlib import Path
from typing import Annotated

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
from drake_clutter.cli.output import (
    Item,
    escape_markup,
    out_console,
    print_json,
    progress_bar,
)
from drake_clutter.files import InputError


def evaluate(
    source: Annotated[
        str | None,
        typer.Argument(metavar="SCENES", help="The same as `--scenes`.", show_default=False),
    ] = None,
    scenes: Annotated[
        str | None,
        typer.Option(
            help="Shipped scene dataset, such as sg_star_25; scene dataset file; scene file with "
            "verdict, or folder of them, such as the `scenes` folder that `generate` writes."
        ),
    ] = None,
    agents: Annotated[
        list[str] | None,
        typer.Option(
            "--agents",
            "--agent",
            metavar="NAME,...",
            help="Exploration policies, as for `explore`, or full-knowledge (optimal plans from "
            "the true scene). May be repeated.",
            show_default="random,largest-first,largest-clear",
        ),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="JSON file for statistics and all episodes: new, or of the same evaluation, "
            "which is resumed.",
        ),
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
    config_file: ConfigOption = None,
    cell_file: CellOption = None,
    settings: SetOption = None,
    as_json: JsonOption = False,
) -> None:
    """Compare exploration policies on scenes with hidden objects."""
    from drake_clutter.agents.explorers import BASELINE_POLICIES
    from drake_clutter.commands.evaluate_explorers import (
        ExplorerEvaluation,
        common_cell,
        evaluate_explorers,
        load_evaluation_scenes,
        move_limits,
    )
    from drake_clutter.reports.terminal_text import EVALUATION_CAPTION, evaluation_table_rows

    scenes_source = scenes or source
    if scenes_source is None or None not in (scenes, source):
        allowed = (
            "a shipped scene dataset, a scene dataset file, "
            "or a folder of scene files with verdicts"
        )
        raise InputError(f"--scenes: expected once, with {allowed}")
    reject_support_settings(settings)
    evaluation_scenes = load_evaluation_scenes(scenes_source, catalog)[:max_scenes]
    scene_cell = None if cell_file else common_cell(evaluation_scenes)
    config = load_config_from_options(config_file, cell_file, settings, scene_cell)
    limit = max_moves or config.exploration.max_moves

    evaluation = ExplorerEvaluation(
        evaluation_scenes,
        [name for names in agents or BASELINE_POLICIES for name in names.split(",")],
        limit,
        fidelity.value,
        seed,
        config,
        catalog,
    )

    def progress(results: Iterable[Item], num_done: int, total: int) -> Iterable[Item]:
        return progress_bar("episodes", results, num_done, total)

    rows = evaluate_explorers(evaluation, workers, out, progress, ray)
    if as_json:
        print_json(rows)
        return
    table_rows = [
        {"agent": row["agent"]} | cells
        for row in rows
        for cells in evaluation_table_rows(row, move_limits(limit))
    ]
    hidden = f"{rows[0]['hidden']:.1f} hidden objects per scene"
    table = Table(
        *table_rows[0],
        title=f"{escape_markup(scenes_source)}: {rows[0]['episodes']} scenes, {hidden}",
        box=SIMPLE,
        padding=(0, 1, 0, 0),
        caption=EVALUATION_CAPTION,
        caption_justify="left",
    )
    for cells in table_rows:
        table.add_row(*cells.values())
    out_console.print(table)
