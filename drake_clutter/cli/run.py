"""`drake-clutter run` and `demo`."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from drake_clutter.cli.config_from_options import (
    check_cell_models,
    qualify_setting,
    reject_support_settings,
)
from drake_clutter.cli.options import (
    CellOption,
    JsonOption,
    NodesOption,
    OutOption,
    SeedOption,
    SetOption,
)
from drake_clutter.cli.output import print_episode, print_transition
from drake_clutter.files import prepare_output_directory

if TYPE_CHECKING:
    from drake_clutter.systems.scenario import Scenario

_CONFIG_FIELDS = frozenset({"layout", "settle", "exploration", "cell", "camera"})


def _qualify_scenario_setting(setting: str) -> str:
    name = qualify_setting(setting)
    return f"world.{name}" if name.split("=")[0].split(".")[0] in _CONFIG_FIELDS else name


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

    names = [_qualify_scenario_setting(setting) for setting in settings or ()]
    scene_settings = [
        name for name in names if name.startswith(("scene=", "catalog=", "catalogue="))
    ]
    defaults, named = Scenario(), load_config_as(Scenario(), file, scene_settings, upgrade)
    if named.scene:
        reject_support_settings(names)
        catalog = load_catalog(Path(named.catalog) if named.catalog else None)
        defaults = replace(
            defaults,
            world=replace(defaults.world, cell=load_scene(Path(named.scene), catalog).cell),
        )
    scenario = load_config_as(defaults, file, upgrade=upgrade)
    if cell is not None:
        loaded_cell = load_cell(cell)
        if named.scene:  # the objects stand on its support
            loaded_cell = loaded_cell.with_support(defaults.world.cell.support)
        scenario = replace(scenario, world=replace(scenario.world, cell=loaded_cell))
    scenario = load_config_as(scenario, settings=names, upgrade=upgrade)
    check_cell_models(scenario.world.cell, defaults.world.cell, cell or file)
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
    from drake_clutter.commands import run_scenario as command

    given = _load_scenario(scenario, cell, settings)
    prepare_output_directory(out)
    print_episode(command.run_scenario(given, out, print_transition), as_json, out)


def demo(
    out: OutOption,
    seed: SeedOption = 0,
    nodes: NodesOption = 25,
    cell: CellOption = None,
    settings: SetOption = None,
    as_json: JsonOption = False,
) -> None:
    """SG* makes a scene, and the arm searches it until everything is found; write a page to watch."""
    from drake_clutter.commands import run_scenario as command

    given = replace(
        _load_scenario(None, cell, settings), seed=seed, nodes=nodes, perception="depth"
    )
    prepare_output_directory(out)
    print_episode(command.run_demo(given, out, print_transition), as_json, out)
