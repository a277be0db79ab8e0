"""How the commands show results and progress."""

import json
import sys
import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import redirect_stdout
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.table import Table

from drake_clutter.files import InputError

if TYPE_CHECKING:
    from drake_clutter.cell.work_cell import WorkCell
    from drake_clutter.scenes.interfaces import MotionSample
    from drake_clutter.scenes.scene import Scene
    from drake_clutter.tasks.exploration_task import Transition

out_console, err_console = Console(), Console(stderr=True)


def escape_markup(text: str) -> str:
    """Return text that Rich takes as it is."""
    return text.replace("[", "\\[")


def print_result(fields: dict[str, Any], as_json: bool, title: str) -> None:
    """Print a result, as a table or as JSON."""
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
        table.add_row(key.replace("_", " "), escape_markup(str(value)))
    out_console.print(table)


def print_transition(transition: "Transition") -> None:
    """Print how a move went, on standard error."""
    found = f", found {', '.join(transition.newly_found)}" if transition.newly_found else ""
    reasons = [
        str(reason)
        for reason in (transition.outcome.instability, transition.outcome.detail)
        if reason
    ]
    why = f" ({'; '.join(reasons)})" if reasons else ""
    err_console.print(
        f"{transition.move}: {transition.outcome.result.value}{why}{found}", highlight=False
    )


def print_episode(fields: dict[str, Any], as_json: bool, out: Path) -> None:
    """Print what `episode.json` holds."""
    if as_json:
        print_result(fields, True, "")
        return
    shown = {
        key: fields[key]
        for key in ("success", "ended", "objects", "hidden_at_start", "found", "total_reward")
    }
    print_result(
        shown | {"moves": len(fields["moves"]), "page": str(out / "index.html")}, False, f"{out}"
    )


def progress_bar(
    description: str, items: Iterable[Any], num_done: int, total: int
) -> Iterator[Any]:
    """Yield the items, with a progress bar that appears with the first of them.

    While they are made, standard output goes to standard error: Ray writes its messages there, and --json's result has to
    stay alone.
    """
    columns = (
        TextColumn(description),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
    )
    with redirect_stdout(sys.stderr), Progress(*columns, console=err_console) as bar:
        yield from bar.track(items, total=total, completed=num_done)


def show_recording(
    name: Path,
    scene: "Scene",
    frames: Sequence["MotionSample"],
    cell: "WorkCell",
    html_file: Path | None,
) -> None:
    """Show frames in the browser until it is interrupted, or write them to one HTML file."""
    from drake_clutter.reports.recording import serve_recording, write_recording

    if html_file is not None:
        try:
            write_recording(html_file, scene, frames, cell)
        except OSError as error:
            raise InputError(
                f"--html {html_file}: cannot be written ({error.strerror}); allowed is a place you may write"
            ) from error
        out_console.print(f"wrote {html_file}")
        return
    meshcat = serve_recording(scene, frames, cell)
    out_console.print(f"{name} is at {meshcat.web_url()}; Ctrl-C ends it")
    while True:
        time.sleep(1)
