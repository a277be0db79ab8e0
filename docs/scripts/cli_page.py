"""The page docs/reference/cli.md, from the Typer application."""

import re
from typing import Any

import typer.main

from drake_clutter.cli import app
from markdown_text import table

PROGRAM = "drake-clutter"
_FACTS = re.compile(r"\s*\[([^\[\]]*)\]$")
"""End of a parameter's help, where Typer puts default, range and whether it is required."""

EXIT_CODES = [
    ["0", "done; what a search, an evaluation or a study finds does not change the exit code"],
    ["1", "`doctor`, `inspect`: a check failed; `move`: a move has no plan or is not carried out"],
    ["2", "a mistake in an option or a file, or a file cannot be written"],
    ["130", "interrupted"],
]
"""Exit codes of all commands, with their meaning."""


def page() -> str:
    """Return the page."""
    group: Any = typer.main.get_command(app)
    context = group.make_context(PROGRAM, [], resilient_parsing=True)
    commands = list(_commands(group, context, PROGRAM))
    overview = [
        [f"[`{name}`](#{_anchor(name)})", _cell((command.help or "").split("\n\n")[0])]
        for name, command, _ in commands
    ]
    return (
        "# Command line\n\n"
        f"`{PROGRAM}` is installed with the package. Every command has `--help`. A mistake in an "
        "option or a file is one line on standard error that names the field and the allowed "
        "values.\n\n"
        + table(["exit code", "meaning"], EXIT_CODES)
        + "\n"
        + table(["command", "purpose"], overview)
        + "".join(_section(name, command, context) for name, command, context in commands)
    )


def _commands(group: Any, context: Any, prefix: str) -> Any:
    """Yield name, command and context of each command, those of groups below included."""
    for name in group.list_commands(context):
        command = group.get_command(context, name)
        below = command.make_context(name, [], parent=context, resilient_parsing=True)
        if hasattr(command, "list_commands"):
            yield from _commands(command, below, f"{prefix} {name}")
        else:
            yield f"{prefix} {name}", command, below


def _section(name: str, command: Any, context: Any) -> str:
    usage = " ".join([name, *command.collect_usage_pieces(context)])
    rows = []
    for parameter in command.get_params(context):
        record = parameter.get_help_record(context)
        if record is not None and parameter.name != "help":
            declaration, text = record
            facts = _FACTS.search(text)
            meaning = text[: facts.start()] if facts else text
            code = " ".join(declaration.split())  # a "|" in code does not separate columns
            rows.append([f"`{code}`", _cell(meaning), facts[1] if facts else ""])
    heading = f"\n## {name}\n\n{command.help}\n\n```text\n{usage}\n```\n\n"
    return heading + table(["parameter", "meaning", "default, range"], rows)


def _anchor(name: str) -> str:
    return name.replace(" ", "-")


def _cell(text: str) -> str:
    """Return a text for a cell of a table: one line, without column separators."""
    return " ".join(text.split()).replace("|", "\\|")
