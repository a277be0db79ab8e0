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

if TYPE_CHECKING:
    from drake_clutter.systems.scenario import Scenario

_CONFIG_FIELDS = frozenset({"layout", "settle", "exploration", "cell", "camera"})
"""Fields of the configuration, which settings of a scenario may name without its field."""


def _qualify_scenario_setting(setting: str) -> str:
    """Return FIELD=VALUE with the full name of the field in the scenario."""
    setting = qualify_setting(setting)
    field = setting.split("=")[0].split(".")[0]
    return f"world.{setting}" if field in _CONFIG_FIELDS else setting


def _load_scenario(
    file: Path | None, cell_file: Path | None, settings: Sequence[str] | None
) -> "Scenario":
    """Return a scenario from a command's options.

    Later sources replace fields of earlier ones: the defaults, the cell of the scenario's scene
    file, the scenario file, the cell file, the settings.

    Args:
        file: Scenario file, or None.
        cell_file: Work cell file, or None. The support stays that of the scene file.
        settings: Single fields, as FIELD=VALUE.
    """
    from drake_clutter.catalog import load_catalog
    from drake_clutter.cell.work_cell import load_cell
    from drake_clutter.config import upgrade_config
    from drake_clutter.scenes.scene_file import load_scene
    from drake_clutter.systems.scenario import Scenario
    from drake_clutter.validation import load_config_as

    full_settings = [_qualify_scenario_setting(setting) for setting in settings or ()]
    scene_settings = [
        setting
        for setting in full_settings
        if setting.startswith(("scene=", "catalog=", "catalogue="))
    ]
    defaults = Scenario()
    with_scene = load_config_as(defaults, file, scene_settings, upgrade_config)
    if with_scene.scene:
        reject_support_settings(full_settings)
        catalog = load_catalog(Path(with_scene.catalog) if with_scene.catalog else None)
        scene_cell = load_scene(Path(with_scene.scene), catalog).cell
        defaults = replace(defaults, world=replace(defaults.world, cell=scene_cell))
    scenario = load_config_as(defaults, file, upgrade=upgrade_config)
    if cell_file is not None:
        cell = load_cell(cell_file)
        if with_scene.scene:
            cell = cell.with_support(defaults.world.cell.support)
        scenario = replace(scenario, world=replace(scenario.world, cell=cell))
    scenario = load_config_as(scenario, settings=full_settings, upgrade=upgrade_config)
    check_cell_models(scenario.world.cell, defaults.world.cell, cell_file or file)
    return scenario


def run(
    scenario_file: Annotated[
        Path | None,
        typer.Option(
            "--scenario", metavar="FILE", help="YAML file with the scenario fields to change."
        ),
    ] = None,
    cell_file: CellOption = None,
    settings: Annotated[
        list[str] | None,
        typer.Option(
            "--set",
            metavar="FIELD=VALUE",
            help="Set one field of the scenario, its configuration or its cell, such as "
            "`agent=random`. May be repeated.",
        ),
    ] = None,
    out: OutOption = Path("out/run"),
    as_json: JsonOption = False,
) -> None:
    """Run closed-loop exploration: camera images in, simulated arm motion out.

    Writes `scenario.yaml`, `scene.yaml`, `episode.json`, `trajectory.h5` and the web page
    `index.html`.
    """
    from drake_clutter.commands.run_scenario import run_scenario

    scenario = _load_scenario(scenario_file, cell_file, settings)
    print_episode(run_scenario(scenario, out, print_transition), as_json, out)


def demo(
    out: OutOption,
    seed: SeedOption = 0,
    nodes: NodesOption = 25,
    cell_file: CellOption = None,
    settings: SetOption = None,
    as_json: JsonOption = False,
) -> None:
    """Generate a scene with SG* and explore it in closed loop from depth images.

    Tries up to five scenes until all objects of one are found. Writes the same files as `run`.
    """
    from drake_clutter.commands.run_scenario import run_demo

    scenario = _load_scenario(None, cell_file, settings)
    scenario = replace(scenario, seed=seed, nodes=nodes, perception="depth")
    print_episode(run_demo(scenario, out, print_transition), as_json, out)
