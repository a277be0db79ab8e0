"""`drake-clutter feasibility`."""

from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Any

import typer

from drake_clutter.cli.config_from_options import (
    load_config_from_options,
    load_scene_and_config,
    reject_support_settings,
)
from drake_clutter.cli.options import (
    CatalogOption,
    ConfigOption,
    JsonOption,
    SeedOption,
    SetOption,
    WorkersOption,
)
from drake_clutter.cli.output import print_result, progress_bar
from drake_clutter.files import InputError

POSE_METAVAR = "X,Y,Z,YAW"


def _parse_pose(option: str, text: str) -> list[float]:
    try:
        values = [float(part) for part in text.split(",")]
    except ValueError:
        values = []
    if len(values) != 4 or not all(abs(value) <= 360 for value in values):
        raise InputError(f"{option} {text}; allowed is X,Y,Z,YAW in m, m, m and degrees")
    return values


def feasibility(
    scenes: Annotated[
        list[Path], typer.Argument(metavar="SCENES...", help="Scene files, or folders of them.")
    ],
    out: Annotated[
        Path,
        typer.Option(
            "--out",
            metavar="DIR",
            help="Folder for the results; one of the same study is taken up.",
        ),
    ],
    cell: Annotated[
        list[Path] | None,
        typer.Option("--cell", metavar="FILE", help="Work cell to study; may be repeated."),
    ] = None,
    settings: SetOption = None,
    base: Annotated[
        list[str] | None,
        typer.Option(metavar=POSE_METAVAR, help="Place of the arm's base in T; may be repeated."),
    ] = None,
    tray: Annotated[
        list[str] | None,
        typer.Option(
            metavar=POSE_METAVAR,
            help="Instead: the tray's place, seen from the base; may be repeated.",
        ),
    ] = None,
    cell_override: Annotated[
        list[Path] | None,
        typer.Option(metavar="FILE", help="YAML with single fields of the cell; may be repeated."),
    ] = None,
    targets: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="YAML list of {name, translation, quaternion}: cup poses to ask about.",
        ),
    ] = None,
    seed: SeedOption = 0,
    workers: WorkersOption = 1,
    catalog: CatalogOption = None,
    config: ConfigOption = None,
    as_json: JsonOption = False,
) -> None:
    """Ask an arm about every legal move of scenes: tables, pictures and a report. A study that was stopped goes on."""
    from drake_clutter.commands import feasibility_job as command

    reject_support_settings(settings)
    files = command.collect_scene_files(scenes)
    _, world = load_scene_and_config(files[0], catalog, config, None, settings)
    command.check_unique_names("--cell, --cell-override", [*(cell or []), *(cell_override or [])])
    support = world.cell.support
    cells = {
        path.stem: load_config_from_options(config, path, settings).cell.with_support(support)
        for path in cell or []
    }
    setups = command.make_setups(
        [_parse_pose("--base", text) for text in base or []],
        [_parse_pose("--tray", text) for text in tray or []],
        cell_override or [],
        next(iter(cells.values()), world.cell),
    )
    if cells:
        setups = cells | {name: other for name, other in setups.items() if name != "default"}
    asked = command.read_targets(targets) if targets else ()
    job = command.FeasibilityJob(files, setups, asked, seed, world, catalog)

    def progress(made: Iterable[Any], done: int, total: int) -> Iterable[Any]:
        return progress_bar("parts", made, done, total)

    summary = command.run_feasibility_study(job, out, workers, progress)
    lines = {
        name: f"{found['planned']} of {found['moves']} planned; "
        + ", ".join(f"{n} {why}" for why, n in found["results"].items() if why != "planned")
        for name, found in summary["setups"].items()
    }
    print_result(
        summary if as_json else lines | {"report": str(out / command.REPORT_FILE)},
        as_json,
        f"{out}",
    )
