"""A module imports only from its own floor and the ones below, as CONTRIBUTING.md lists them."""

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

import drake_clutter

PACKAGE = Path(drake_clutter.__file__).parent
FLOORS = {
    0: {
        *("assets", "built_mesh", "catalog", "compilation", "files", "learning", "limits"),
        *("mesh_file", "outputs", "records", "resources", "seeding", "statistics"),
        *("validation", "visual_mesh", "workers", "yaml_io"),
    },
    1: {"cell", "config", "grammar"},
    2: {"rendering", "robots", "scenes", "stability"},
    3: {"belief", "export", "simulation"},
    4: {"perception", "planning"},
    5: {"tasks"},
    6: {"station"},
    7: {"agents", "feasibility"},
    8: {"recording", "systems"},
    9: {"__main__", "cli", "commands", "installation_check", "reports"},
}
FLOOR_OF = {room: floor for floor, rooms in FLOORS.items() for room in rooms}
MODULES = sorted(
    path.relative_to(PACKAGE) for path in PACKAGE.rglob("*.py") if "_shipped" not in path.parts
)


def room_of(module: Path) -> str:
    """Return a module's first name below the package, such as "grammar"; "" for the package."""
    return "" if module == Path("__init__.py") else module.with_suffix("").parts[0]


def imported_rooms(source: str) -> Iterator[tuple[int, str]]:
    """Line and room of every import from the package, also of those inside functions."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"line {node.lineno}: a relative import"
            names = [f"{node.module}.{alias.name}" for alias in node.names]
        else:
            continue
        for name in names:
            package, _, below = name.partition(".")
            if package == PACKAGE.name and below:
                yield node.lineno, below.partition(".")[0]


def test_the_reader_of_imports() -> None:
    source = """
import numpy, drake_clutter.tasks.generation_task
from drake_clutter import files
def late():
    from drake_clutter.scenes.layout import lay_out
"""
    assert sorted(imported_rooms(source)) == [(2, "tasks"), (3, "files"), (5, "scenes")]


@pytest.mark.parametrize("module", MODULES, ids=str)
def test_imports_go_down(module: Path) -> None:
    room = room_of(module)
    assert room == "" or room in FLOOR_OF, f"{module} is on no floor; give {room!r} one in FLOORS"
    floor = FLOOR_OF.get(
        room, -1
    )  # the package's own file imports nothing, so that every module stays quick to import
    for line, imported in imported_rooms((PACKAGE / module).read_text()):
        assert imported in FLOOR_OF, f"{module}:{line} imports {imported!r}, which is on no floor"
        assert FLOOR_OF[imported] <= floor, (
            f"{module}:{line}: floor {floor} imports {imported!r} of floor {FLOOR_OF[imported]}"
        )
