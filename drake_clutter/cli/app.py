"""The command-line application.

Commands import Drake when they run, so that `doctor` also works where Drake cannot be imported.
"""

import gc

import typer

from drake_clutter.cli.assets import assets_app
from drake_clutter.cli.doctor import doctor
from drake_clutter.cli.evaluate import evaluate
from drake_clutter.cli.explore import explore
from drake_clutter.cli.export import export
from drake_clutter.cli.feasibility import feasibility
from drake_clutter.cli.generate import generate
from drake_clutter.cli.inspect import inspect
from drake_clutter.cli.move import move
from drake_clutter.cli.record import record
from drake_clutter.cli.renamed import RenamingCommand
from drake_clutter.cli.render import render
from drake_clutter.cli.replay import replay
from drake_clutter.cli.run import demo, run
from drake_clutter.cli.solve import solve
from drake_clutter.cli.view import view
from drake_clutter.files import cli_error_handler

MAX_YOUNG_OBJECTS = 50_000
"""Number of new objects after which garbage is collected. The default, 700, makes Python examine
the imported modules again and again: 8 % of the time of a short command."""

app = typer.Typer(
    help="Generate and explore cluttered tabletop scenes in Drake.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode="markdown",
)
for command in (
    generate,
    explore,
    evaluate,
    move,
    solve,
    run,
    demo,
    record,
    feasibility,
    inspect,
    replay,
    view,
    render,
    export,
    doctor,
):
    app.command(cls=RenamingCommand)(command)
app.add_typer(assets_app, name="assets")


def main() -> None:
    """Run the console script; a user error is one line on standard error and exit code 2."""
    gc.set_threshold(MAX_YOUNG_OBJECTS)
    with cli_error_handler():
        app()
