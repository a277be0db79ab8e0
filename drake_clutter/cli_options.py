"""What the commands of the command line share: options, and how results are shown."""

import json
import sys
import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import redirect_stdout
from enum import Enum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.table import Table

from drake_clutter.files import InputError

if TYPE_CHECKING:
    from drake_clutter.cell.work_cell import WorkCell
    from drake_clutter.scenes.interfaces import Frame
    from drake_clutter.scenes.scene import Scene
    from drake_clutter.scenes.scene_file import SceneFile

out_console, err_console = Console(), Console(stderr=True)


class Fidelity(Enum):
    """How moves are carried out."""

    FAST = "fast"
    SETTLE = "settle"
    ARM = "arm"


SceneArgument = Annotated[Path, typer.Argument(metavar="SCENE.yaml", help="A scene file.")]
OutOption = Annotated[Path, typer.Option("--out", metavar="DIR", help="Folder for the results; new or empty.")]
SeedOption = Annotated[int, typer.Option("--seed", min=0, help="Same seed, same result.")]
HtmlOption = Annotated[Path | None, typer.Option("--html", metavar="FILE", help="Write a page instead of showing it live.")]
JsonOption = Annotated[bool, typer.Option("--json", help="Print the result as JSON on standard output.")]
CatalogueOption = Annotated[
    Path | None, typer.Option("--catalogue", metavar="DIR", help="An asset folder with object classes of your own.")
]
ConfigOption = Annotated[
    Path | None, typer.Option("--config", metavar="FILE", help="YAML with the config's fields that differ from the defaults.")
]
ObjectsOption = Annotated[str, typer.Option("--objects", help="Object set: ycb7, pantry14, or one of your catalogue's.")]
MaxMovesOption = Annotated[
    int | None, typer.Option(min=1, help="Moves after which a search ends; the config's (10) if not given.")
]
ExplorerOption = Annotated[
    str,
    typer.Option(
        "--agent",
        help="Who chooses the moves: random, largest-first, largest-clear; student, student-dagger, student-14, student-rg, "
        "teacher (trained); or the file of a checkpoint that you trained.",
    ),
]
WorkersOption = Annotated[int, typer.Option("--workers", min=1, help="Processes; the result is the same for any number.")]
RayOption = Annotated[
    str | None, typer.Option("--ray", metavar="ADDRESS", help="Put the workers on this Ray cluster, e.g. auto, instead of here.")
]
FidelityOption = Annotated[
    Fidelity,
    typer.Option(
        help="arm: the UR10 carries every move out. Else objects are teleported; settle: Drake settles what a move touched; "
        "fast: by equilibrium, Drake in doubt."
    ),
]
NodesOption = Annotated[int, typer.Option("--nodes", help="Size of the graph, all kinds of nodes counted; 3 or more.")]


def plain(text: str) -> str:
    """Text that Rich takes as it is."""
    return text.replace("[", "\\[")


def show(fields: dict[str, Any], as_json: bool, title: str) -> None:
    """Prints a result, as a table or as JSON."""
    if as_json:
        print(json.dumps(fields, indent=2))
        return
    table = Table("", "", title=title, show_header=False)
    for key, value in fields.items():
        if isinstance(value, float):
            value = f"{value:.4g}"
        elif isinstance(value, list | tuple) and value and isinstance(value[0], float):
            value = " to ".join(f"{v:.4g}" for v in value)
        elif isinstance(value, list | tuple):
            value = ", ".join(str(v) for v in value) or "none"
        elif isinstance(value, dict):
            value = ", ".join(f"{v} {k}" for k, v in value.items()) or "none"
        table.add_row(key.replace("_", " "), plain(str(value)))
    out_console.print(table)


def load(scene: Path, catalogue: Path | None) -> "SceneFile":
    """The scene file."""
    from drake_clutter.catalogue import load_catalogue
    from drake_clutter.scenes.scene_file import load_scene

    return load_scene(scene, load_catalogue(catalogue))


def tracked(what: str, items: Iterable[Any], done: int, total: int) -> Iterator[Any]:
    """The items, with a progress bar that appears with the first of them.

    While they are made, standard output goes to standard error: Ray writes what it has to say there, and --json's result has to
    stay alone.
    """
    columns = (TextColumn(what), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), TimeRemainingColumn())
    with redirect_stdout(sys.stderr), Progress(*columns, console=err_console) as bar:
        yield from bar.track(items, total=total, completed=done)


def watch(name: Path, scene: "Scene", frames: Sequence["Frame"], cell: "WorkCell", html: Path | None) -> None:
    """Shows frames in the browser until it is interrupted, or writes them to one HTML file."""
    from drake_clutter.reports.recording import serve, write_recording

    if html is not None:
        try:
            write_recording(html, scene, frames, cell)
        except OSError as error:
            raise InputError(f"--html {html}: cannot be written ({error.strerror}); allowed is a place you may write") from error
        out_console.print(f"wrote {html}")
        return
    meshcat = serve(scene, frames, cell)
    out_console.print(f"{name} is at {meshcat.web_url()}; Ctrl-C ends it")
    while True:
        time.sleep(1)
