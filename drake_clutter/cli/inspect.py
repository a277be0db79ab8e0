"""`drake-clutter inspect`."""

from pathlib import Path
from typing import Annotated

import typer

from drake_clutter.cli.options import CatalogOption, JsonOption
from drake_clutter.cli.output import (
    locked_files,
    print_line,
    print_result,
    progress_bar,
    writing_file,
)

MAX_LINES = 20
"""Number of outliers and of problems that are printed."""


def inspect(
    dataset: Annotated[
        Path,
        typer.Argument(
            metavar="DATASET",
            help="Folder of recorded episodes that `record` writes, or a single file of it.",
        ),
    ],
    plot: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE.png",
            help="Picture: results, classes, durations, lengths, speeds against limits, and where "
            "objects were picked and placed.",
        ),
    ] = None,
    as_json: JsonOption = False,
    catalog: CatalogOption = None,
) -> None:
    """Print, plot and check recorded episodes.

    Checks time stamps, numbers, joint limits, rest at both ends, objects between moves, and where
    images show objects. Exits with code 1 if something is wrong.
    """
    from drake_clutter.catalog import load_catalog
    from drake_clutter.commands.inspect_dataset import (
        describe_inspection,
        inspect_files,
        inspection_document,
    )
    from drake_clutter.recording.dataset_check import find_episode_files
    from drake_clutter.reports.dataset_figures import plot_dataset

    files = find_episode_files(dataset)
    with locked_files({"--plot": plot}):
        inspection = inspect_files(
            progress_bar("episodes", files, 0, len(files)), load_catalog(catalog)
        )
        if plot is not None and inspection.episodes:
            with writing_file(plot, "--plot"):
                plot_dataset(plot, inspection.episodes)
    document = inspection_document(inspection)
    print_result(document, describe_inspection(document), as_json, str(dataset))
    if not as_json:
        _print_lines("outlier", document["outliers"])
        _print_lines("problem", document["problems"])
        if plot is not None and inspection.episodes:
            print_line(f"Wrote {plot}.")
    if inspection.problems:
        raise typer.Exit(1)


def _print_lines(label: str, lines: list[str]) -> None:
    """Print the first lines, and how many there are besides."""
    for line in lines[:MAX_LINES]:
        print_line(f"{label} {line}")
    if len(lines) > MAX_LINES:
        print_line(f"{len(lines) - MAX_LINES} more: see --json")
