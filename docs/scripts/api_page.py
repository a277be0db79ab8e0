"""The page docs/reference/api.md, from the public names of `drake_clutter/__init__.pyi`."""

import ast
from pathlib import Path

import drake_clutter

STUB = Path(drake_clutter.__file__).with_suffix(".pyi")


def page() -> str:
    """Return the page: one section for each comment of the stub, filled in by mkdocstrings."""
    text = STUB.read_text(encoding="utf-8")
    titles = {
        number: line.removeprefix("# ").rstrip(".")
        for number, line in enumerate(text.splitlines(), start=1)
        if line.startswith("# ") and not line.startswith("# ruff")
    }
    page = (
        "# Python API\n\nThe names below are exported by `drake_clutter` and imported when they "
        "are "
        "first used: `from drake_clutter import load_scene`. Other modules may change between "
        "versions.\n"
    )
    for statement in ast.parse(text).body:
        if not isinstance(statement, ast.ImportFrom):
            continue
        above = [number for number in titles if number < statement.lineno]
        if above:
            page += f"\n## {titles.pop(max(above))}\n"
            for number in above[:-1]:
                titles.pop(number)
        for alias in statement.names:
            page += f"\n::: drake_clutter.{alias.name}\n"
    return page
