"""Command-line skeleton of the scripts in `training/` and `benchmarks/`.

A script is a module with a function `main` of typed options and, at its end,

    if __name__ == "__main__":
        run_script(main)
"""

import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import nullcontext
from functools import wraps
from pathlib import Path
from typing import Annotated, Any, TypeVar, get_type_hints

import typer
from rich.console import Console
from rich.progress import track
from rich.table import Table

from drake_clutter.files import cli_error_handler
from drake_clutter.limits import MAX_SEED, MAX_WORKERS
from drake_clutter.outputs import output_file

Item = TypeVar("Item")

ROOT = Path(__file__).parents[1]
"""Folder of the checkout."""
RESULTS = ROOT / "training/results"
"""Published results of the trainings."""
SCENES = ROOT / "training/scenes"
"""Shipped scene datasets."""

ConfigOption = Annotated[
    Path | None,
    typer.Option("--config", metavar="FILE", help="YAML file with fields of the configuration."),
]
SettingsOption = Annotated[
    list[str] | None,
    typer.Option(
        "--set", metavar="FIELD=VALUE", help="Set a field, over the file's. May be repeated."
    ),
]
CatalogOption = Annotated[
    Path | None,
    typer.Option("--catalog", metavar="DIR", help="Asset folder with your own object classes."),
]
ResultsOption = Annotated[
    Path | None, typer.Option("--out", metavar="FILE", help="Results file to write (JSON).")
]
WorkersOption = Annotated[
    int, typer.Option("--workers", min=1, max=MAX_WORKERS, help="Number of processes.")
]
SeedOption = Annotated[
    int,
    typer.Option("--seed", min=0, max=MAX_SEED, help="Seed. The same seed gives the same results."),
]


def settings_with_catalog(settings: Sequence[str] | None, catalog: Path | None) -> list[str]:
    """Return the settings of a configuration, with its field `catalog` set by `--catalog`.

    Args:
        settings: Settings `FIELD=VALUE`.
        catalog: The asset folder; None keeps the field.
    """
    folder = [] if catalog is None else [f"catalog={json.dumps(str(catalog))}"]
    return [*folder, *(settings or [])]


def run_script(*commands: Callable[..., None]) -> None:
    """Run a script.

    A misuse is reported in one line, with exit code 2. Meanwhile the file that an option `--out
    FILE` names is locked; a folder is locked by what writes to it.

    Args:
        commands: The functions whose parameters are the script's options. Of several, each is a
            command of its own.
    """
    app = typer.Typer(add_completion=False, no_args_is_help=len(commands) > 1)
    for command in commands:
        app.command()(_with_locked_output(command))
    with cli_error_handler():
        app()


def _with_locked_output(command: Callable[..., None]) -> Callable[..., None]:
    """Return a command that keeps its output file locked."""
    annotation = get_type_hints(command, include_extras=True).get("out")
    options = getattr(annotation, "__metadata__", ())
    if not any(option.metavar == "FILE" for option in options):
        return command

    @wraps(command)
    def run(**values: Any) -> None:
        out: Path | None = values["out"]
        with output_file(out) if out else nullcontext():
            command(**values)

    return run


def progress(
    items: Iterable[Item], label: str, total: int | None = None, done: int = 0
) -> Iterable[Item]:
    """Yield the items, with a progress bar on standard error.

    Args:
        items: The items that remain.
        label: Text before the bar.
        total: Number of items with those already done. By default the length of `items`.
        done: Number of items already done.
    """
    return track(items, label, total, done, console=Console(stderr=True))


def format_number(value: float | None, digits: int = 2) -> str:
    """Return a number with a fixed number of decimals; a dash for None."""
    return "-" if value is None else f"{value:.{digits}f}"


def print_table(rows: Sequence[Mapping[str, Any]], title: str | None = None) -> None:
    """Print a table on standard output.

    Args:
        rows: The cells by column title; all rows have the columns of the first.
        title: Title of the table.
    """
    if not rows:
        return
    table = Table(*rows[0], title=title)
    for row in rows:
        table.add_row(*map(str, row.values()))
    Console(width=max(100, Console().width)).print(table)
