"""`drake-clutter replay`."""

from pathlib import Path
from typing import Annotated

import typer

from drake_clutter.cli.options import CatalogOption, HtmlOption
from drake_clutter.cli.output import out_console, show_recording
from drake_clutter.files import InputError


def replay(
    file: Annotated[
        Path,
        typer.Argument(
            metavar="FILE.h5", help="Recorded motions (`trajectory.h5`) of `--fidelity arm`."
        ),
    ],
    html_file: HtmlOption = None,
    catalog: CatalogOption = None,
) -> None:
    """Replay recorded arm motions in the browser (Meshcat)."""
    from drake_clutter.catalog import load_catalog
    from drake_clutter.reports.recording import concatenate_motions
    from drake_clutter.station.trajectory_file import read_trajectories

    scene, cell, moves = read_trajectories(file, load_catalog(catalog))
    if not moves:
        raise InputError(f"{file}: holds no motion; expected a file with at least one move")
    for number, (move, motion) in enumerate(moves, start=1):
        out_console.print(f"{number}. {move}: {motion[-1].time:.1f} s", highlight=False)
    recording = concatenate_motions([motion for _, motion in moves])
    show_recording(file, scene, recording, cell, html_file)
