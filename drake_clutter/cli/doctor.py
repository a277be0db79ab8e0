"""`drake-clutter doctor`."""

import dataclasses
import json

import typer
from rich.table import Table

from drake_clutter.cli.options import JsonOption
from drake_clutter.cli.output import escape_markup, out_console


def doctor(as_json: JsonOption = False) -> None:
    """Check Drake, EGL, solvers, torch and cores, and report how to mend what is missing."""
    from drake_clutter.installation_check import run_checks

    found = run_checks()
    if as_json:
        print(json.dumps([dataclasses.asdict(check) for check in found], indent=2))
    else:
        table = Table("", "check", "found", "how to mend it")
        for check in found:
            remedy = "" if check.ok else escape_markup(check.remedy)
            table.add_row(
                "[green]ok" if check.ok else "[red]no",
                check.name,
                escape_markup(check.detail),
                remedy,
            )
        out_console.print(table)
    if not all(check.ok for check in found):
        raise typer.Exit(1)
