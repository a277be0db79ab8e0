"""The command line's part about the arm."""

from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Any

import typer

from drake_clutter.cli_options import (
    CatalogueOption,
    ConfigOption,
    HtmlOption,
    JsonOption,
    SeedOption,
    WorkersOption,
    out_console,
    show,
    tracked,
    watch,
)
from drake_clutter.files import InputError


def replay(
    file: Annotated[Path, typer.Argument(metavar="FILE.h5", help="Recorded motions, as `--fidelity arm` writes them.")],
    html: HtmlOption = None,
    catalogue: CatalogueOption = None,
) -> None:
    """Show the arm's recorded motions in the browser (Meshcat), or write them to one HTML file."""
    from drake_clutter.catalogue import load_catalogue
    from drake_clutter.reports.recording import joined
    from drake_clutter.station.trajectory_file import read_trajectories

    scene, cell, moves = read_trajectories(file, load_catalogue(catalogue))
    if not moves:
        raise InputError(f"{file}: holds no motion; allowed is a file with at least one move")
    for number, (move, motion) in enumerate(moves, start=1):
        out_console.print(f"{number}. {move}: {motion[-1].time:.1f} s", highlight=False)
    watch(file, scene, joined([motion for _, motion in moves]), cell, html)


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
    scenes: Annotated[list[Path], typer.Argument(metavar="SCENES...", help="Scene files, or folders of them.")],
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="Folder for the results; one of the same study is taken up.")],
    base: Annotated[list[str] | None, typer.Option(metavar=PLACE, help="Place of the arm's base in T; may be repeated.")] = None,
    tray: Annotated[
        list[str] | None, typer.Option(metavar=PLACE, help="Instead: the tray's place, seen from the base; may be repeated.")
    ] = None,
    arm: Annotated[
        list[Path] | None, typer.Option(metavar="FILE", help="YAML with fields of ArmConfig (tool, payload...); may be repeated.")
    ] = None,
    targets: Annotated[
        Path | None, typer.Option(metavar="FILE", help="YAML list of {name, translation, quaternion}: cup poses to ask about.")
    ] = None,
    seed: SeedOption = 0,
    workers: WorkersOption = 1,
    catalogue: CatalogueOption = None,
    config: ConfigOption = None,
    as_json: JsonOption = False,
) -> None:
    """Ask an arm about every legal move of scenes: tables, pictures and a report. A study that was stopped goes on."""
    from drake_clutter.commands import feasibility as command
    from drake_clutter.config import load_config

    world = load_config(config)
    job = command.FeasibilityJob(
        command.scene_files(scenes),
        command.setups(
            [_numbers("--base", text) for text in base or []],
            [_numbers("--tray", text) for text in tray or []],
            arm or [],
            world.cell,
        ),
        command.read_targets(targets) if targets else (),
        seed,
        world,
        catalogue,
    )

    def progress(made: Iterable[Any], done: int, total: int) -> Iterable[Any]:
        return tracked("parts", made, done, total)

    summary = command.feasibility(job, out, workers, progress)
    words = {
        name: f"{found['planned']} of {found['moves']} planned; "
        + ", ".join(f"{n} {why}" for why, n in found["results"].items() if why != "planned")
        for name, found in summary["setups"].items()
    }
    show(summary if as_json else words | {"report": str(out / command.REPORT)}, as_json, f"{out}")
