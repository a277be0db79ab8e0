"""`drake-clutter run` and `demo`."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from drake_clutter.cli.options import (
    CellOption,
    JsonOption,
    NodesOption,
    OutOption,
    SeedOption,
    SetOption,
)
from drake_clutter.cli.output import report_step, show_episode
from drake_clutter.cli.world import check_cell, in_world, refuse_support
from drake_clutter.files import prepare_output_directory

if TYPE_CHECKING:
    from drake_clutter.systems.scenario import Scenario

_WORLD_FIELDS = frozenset({"layout", "settle", "exploration", "cell", "camera"})


def _in_scenario(setting: str) -> str:
    name = in_world(setting)
    return f"world.{name}" if name.split("=")[0].split(".")[0] in _WORLD_FIELDS else name


def _load_scenario(
    file: Path | None, cell: Path | None, settings: Sequence[str] | None
) -> "Scenario":
    """Return a scenario; its cell is that of --cell, else of its scene file, under the fields that are named."""
    from drake_clutter.catalog import load_catalog
    from drake_clutter.cell.work_cell import load_cell
    from drake_clutter.config import upgrade
    from drake_clutter.scenes.scene_file import load_scene
    from drake_clutter.systems.scenario import Scenario
    from drake_clutter.validation import load_config_as

    names = [_in_scenario(setting) for setting in settings or ()]
    which_scene = [name for name in names if name.startswith(("scene=", "catalog=", "catalogue="))]
    base, named = Scenario(), load_config_as(Scenario(), file, which_scene, upgrade)
    if named.scene:
        refuse_support(names)
        catalog = load_catalog(Path(named.catalog) if named.catalog else None)
        base = replace(
            base, world=replace(base.world, cell=load_scene(Path(named.scene), catalog).cell)
        )
    scenario = load_config_as(base, file, upgrade=upgrade)
    if cell is not None:
        given = load_cell(cell)
        if named.scene:  # the objects stand on its support
            given = given.with_support(base.world.cell.support)
        scenario = replace(scenario, world=replace(scenario.world, cell=given))
    scenario = load_config_as(scenario, settings=names, upgrade=upgrade)
    check_cell(scenario.world.cell, base.world.cell, cell or file)
    return scenario


def run(
    scenario: Annotated[
        Path | None, typer.Option(metavar="FILE", help="YAML with fields of Scenario.")
    ] = None,
    cell: CellOption = None,
    settings: Annotated[
        list[str] | None,
        typer.Option(
            "--set",
            metavar="FIELD=VALUE",
            help="A field of Scenario, of its world or cell; may be repeated.",
        ),
    ] = None,
    out: OutOption = Path("out/run"),
    as_json: JsonOption = False,
) -> None:
    """Play the closed loop: camera images in, arm motion out, until nothing is hidden; writes episode.json and a page."""
    from drake_clutter.commands import run as command

    given = _load_scenario(scenario, cell, settings)
    prepare_output_directory(out)
    show_episode(command.run(given, out, report_step), as_json, out)


def demo(
    out: OutOption,
    seed: SeedOption = 0,
    nodes: NodesOption = 25,
    cell: CellOption = None,
    settings: SetOption = None,
    as_json: JsonOption = False,
) -> None:
    """SG* makes a scene, and the arm searches it until everything is found; write a page to watch."""
    from drake_clutter.commands import run as command

    given = replace(
        _load_scenario(None, cell, settings), seed=seed, nodes=nodes, perception="depth"
    )
    prepare_output_directory(out)
    show_episode(command.demo(given, out, report_step), as_json, out)
