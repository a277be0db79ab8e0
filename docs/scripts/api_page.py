"""The pages docs/reference/api.md, of the public names, and docs/reference/api/, by package."""

import ast
from pathlib import Path

import drake_clutter

PACKAGE = Path(drake_clutter.__file__).parent
STUB = PACKAGE / "__init__.pyi"
SHIPPED = "_shipped"
"""Folder of an installed package that holds data."""


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
        "are first used: `from drake_clutter import load_scene`. Other modules may change between "
        "versions; they are documented by package: "
        + ", ".join(f"[{name}](api/{name}.md)" for name in packages())
        + ".\n"
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


def packages() -> list[str]:
    """Return the names of the packages below `drake_clutter`."""
    found = (path.parent.name for path in PACKAGE.glob("*/__init__.py"))
    return sorted(name for name in found if name != SHIPPED)


def package_page(name: str) -> str:
    """Return the page of a package: each module with its members, filled in by mkdocstrings."""
    modules = sorted(path.stem for path in (PACKAGE / name).glob("[!_]*.py"))
    parts = [f"# {name}\n\nModules of `drake_clutter.{name}`.\n"]
    for module in modules:
        parts.append(f"::: drake_clutter.{name}.{module}\n    options:\n      heading_level: 2\n")
    return "\n".join(parts)
