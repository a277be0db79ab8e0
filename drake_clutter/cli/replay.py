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
            metavar="FILE.h5", help="Recorded motions, as `--fidelity arm` writes them."
        ),
    ],
    html: HtmlOption = None,
    catalog: CatalogOption = None,
) -> None:
    """Show the arm's recorded motions in the browser (Meshcat), or write them to one HTML file."""
    from drake_clutter.catalog import load_catalog
    from drake_clutter.reports.recording import concatenate_motions
    from drake_clutter.station.trajectory_file import read_trajectories

    scene, cell, moves = read_trajectories(file, load_catalog(catalog))
    if not moves:
        raise InputError(f"{file}: holds no motion; allowed is a file with at least one move")
    for number, (move, motion) in enumerate(moves, start=1):
        out_console.print(f"{number}. {move}: {motion[-1].time:.1f} s", highlight=False)
    show_recording(file, scene, concatenate_motions([motion for _, motion in moves]), cell, html)
