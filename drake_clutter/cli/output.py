"""Output of the commands: tables, JSON, progress and live views."""

import json
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, redirect_stdout, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

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
from drake_clutter.outputs import output_file
from drake_clutter.reports.terminal_text import describe_episode

if TYPE_CHECKING:
    from drake_clutter.cell.work_cell import WorkCell
    from drake_clutter.scenes.interfaces import MotionSample
    from drake_clutter.scenes.scene import Scene
    from drake_clutter.tasks.exploration_task import Transition

Item = TypeVar("Item")

out_console = Console()
err_console = Console(stderr=True)


def escape_markup(text: str) -> str:
    """Return text that Rich prints unchanged."""
    return text.replace("[", "\\[")


def print_line(text: str) -> None:
    """Print a line on standard output as it is, since it may contain a path."""
    out_console.print(text, markup=False, soft_wrap=True)


def print_json(document: Any) -> None:
    """Print a document as JSON on standard output."""
    print(json.dumps(document, indent=2))


def print_result(
    document: Mapping[str, Any], rows: Mapping[str, str], as_json: bool, title: str
) -> None:
    """Print a result, as a table or as JSON.

    Args:
        document: The result, for JSON.
        rows: The result in words: texts by label.
        as_json: Whether to print the document instead of the table.
        title: Title of the table.
    """
    if as_json:
        print_json(document)
        return
    table = Table("", "", title=escape_markup(title), show_header=False)
    for label, text in rows.items():
        table.add_row(escape_markup(label), escape_markup(text))
    out_console.print(table)


def print_transition(transition: "Transition") -> None:
    """Print the result of a move on standard error."""
    text = f"{transition.move}: {transition.outcome.result.value}"
    causes = (transition.outcome.instability, transition.outcome.detail)
    if reasons := [str(cause) for cause in causes if cause]:
        text += f" ({'; '.join(reasons)})"
    if transition.newly_found:
        text += f", found {', '.join(transition.newly_found)}"
    err_console.print(text, highlight=False)


def print_episode(episode: Mapping[str, Any], as_json: bool, out: Path) -> None:
    """Print the content of `episode.json`, as a table or as JSON."""
    rows = describe_episode(episode) | {"page": str(out / "index.html")}
    print_result(episode, rows, as_json, f"{out}")


def progress_bar(
    description: str,
    items: Iterable[Item],
    num_done: int,
    total: int,
    status: Callable[[Item], str] = lambda item: "",
) -> Iterator[Item]:
    """Yield items while a progress bar on standard error counts them.

    Meanwhile standard output is redirected to standard error: Ray prints messages there, and
    `--json` must print nothing but its result.

    Args:
        description: What is counted, such as "scenes".
        items: The items; the bar appears when the first is requested.
        num_done: Number of items that an earlier run has finished.
        total: Number of items, including those.
        status: Returns the text beside the bar after an item.
    """
    with redirect_stdout(sys.stderr), _progress(description) as bar:
        task = bar.add_task("", total=total, completed=num_done, status="")
        for item in items:
            yield item
            bar.update(task, advance=1, status=status(item))


@contextmanager
def counter(description: str, most: int) -> Iterator[Callable[[], None]]:
    """Yield a function whose calls a progress bar on standard error counts.

    Args:
        description: What is counted, such as "moves evaluated".
        most: Number of calls at most.
    """
    with _progress(description) as bar:
        task = bar.add_task("", total=most, status="")
        yield lambda: bar.advance(task)


def _progress(description: str) -> Progress:
    """Return an empty progress bar on standard error."""
    columns = (
        TextColumn(description),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
        TextColumn("{task.fields[status]}"),
    )
    return Progress(*columns, console=err_console)


@contextmanager
def locked_files(files: Mapping[str, Path | None]) -> Iterator[None]:
    """Lock output files while their content is computed and written.

    Args:
        files: The files by the options that name them; None for an option that is not given.

    Raises:
        InputError: A file cannot be written, or another run writes it.
    """
    with ExitStack() as locks:
        for option, path in files.items():
            if path is not None:
                locks.enter_context(output_file(path, option))
        yield


@contextmanager
def writing_file(path: Path, option: str) -> Iterator[None]:
    """Turn the errors of writing a file into an `InputError`.

    Args:
        path: The file, which is locked.
        option: Option that names it.

    Raises:
        InputError: The file cannot be written.
    """
    try:
        yield
    except OSError as error:
        problem = f"cannot be written ({error.strerror}); expected a writable path"
        raise InputError(f"{option} {path}: {problem}") from error


def show_recording(
    name: Path,
    scene: "Scene",
    frames: Sequence["MotionSample"],
    cell: "WorkCell",
    html_file: Path | None,
) -> None:
    """Show a motion in the browser until it is interrupted, or write it to one HTML file.

    Args:
        name: File that is shown, for the message.
        scene: The objects.
        frames: Poses over time; a single frame is a still scene.
        cell: The work cell, whose arm is shown where the frames contain joint positions.
        html_file: The HTML file, which is locked; None serves a live view.

    Raises:
        InputError: The HTML file cannot be written.
    """
    from drake_clutter.reports.recording import serve_recording, write_recording

    if html_file is not None:
        with writing_file(html_file, "--html"):
            write_recording(html_file, scene, frames, cell)
        print_line(f"Wrote {html_file}.")
        return
    meshcat = serve_recording(scene, frames, cell)
    print_line(f"Showing {name} at {meshcat.web_url()}; press Ctrl-C to stop.")
    with suppress(KeyboardInterrupt):
        while True:
            time.sleep(1)
