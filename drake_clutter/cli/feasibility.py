"""`drake-clutter feasibility`."""

from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Any

import typer

from drake_clutter.cli.options import (
    CatalogOption,
    ConfigOption,
    JsonOption,
    SeedOption,
    SetOption,
    WorkersOption,
)
from drake_clutter.cli.output import progress_bar, show
from drake_clutter.cli.world import load_scene_and_world, load_world, refuse_support
from drake_clutter.files import InputError

PLACE = "X,Y,Z,YAW"


def _numbers(option: str, text: str) -> list[float]:
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
        typer.Option(metavar=PLACE, help="Place of the arm's base in T; may be repeated."),
    ] = None,
    tray: Annotated[
        list[str] | None,
        typer.Option(
            metavar=PLACE, help="Instead: the tray's place, seen from the base; may be repeated."
        ),
    ] = None,
    arm: Annotated[
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
    from drake_clutter.commands import feasibility as command

    refuse_support(settings)
    files = command.scene_files(scenes)
    _, world = load_scene_and_world(files[0], catalog, config, None, settings)
    command.check_names("--cell, --arm", [*(cell or []), *(arm or [])])
    support = world.cell.support
    cells = {
        path.stem: load_world(config, path, settings).cell.with_support(support)
        for path in cell or []
    }
    setups = command.setups(
        [_numbers("--base", text) for text in base or []],
        [_numbers("--tray", text) for text in tray or []],
        arm or [],
        next(iter(cells.values()), world.cell),
    )
    if cells:
        setups = cells | {name: other for name, other in setups.items() if name != "default"}
    asked = command.read_targets(targets) if targets else ()
    job = command.FeasibilityJob(files, setups, asked, seed, world, catalog)

    def progress(made: Iterable[Any], done: int, total: int) -> Iterable[Any]:
        return progress_bar("parts", made, done, total)

    summary = command.feasibility(job, out, workers, progress)
    words = {
        name: f"{found['planned']} of {found['moves']} planned; "
        + ", ".join(f"{n} {why}" for why, n in found["results"].items() if why != "planned")
        for name, found in summary["setups"].items()
    }
    show(summary if as_json else words | {"report": str(out / command.REPORT)}, as_json, f"{out}")
