"""`drake-clutter doctor`."""

import dataclasses

import typer
from rich.table import Table

from drake_clutter.cli.options import JsonOption
from drake_clutter.cli.output import escape_markup, out_console, print_json


def doctor(as_json: JsonOption = False) -> None:
    """Check the installation and report missing components.

    Exits with code 1 if a check fails. An extra that is not installed is no failure.
    """
    from drake_clutter.installation_check import run_checks

    checks = run_checks()
    if as_json:
        print_json([dataclasses.asdict(check) for check in checks])
    else:
        table = Table("", "check", "found", "remedy")
        for check in checks:
            failure = "[red]failed" if check.required else "[yellow]optional"
            status = "[green]ok" if check.ok else failure
            table.add_row(
                status, check.name, escape_markup(check.detail), escape_markup(check.remedy)
            )
        out_console.print(table)
    if not all(check.ok for check in checks if check.required):
        raise typer.Exit(1)
