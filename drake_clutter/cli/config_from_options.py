"""Scenes and worlds from a command's options."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from drake_clutter.files import input_error

if TYPE_CHECKING:
    from drake_clutter.cell.work_cell import WorkCell
    from drake_clutter.config import ClutterConfig
    from drake_clutter.scenes.scene_file import SceneFile

CELL_FIELDS = frozenset({"robot", "gripper", "support", "cameras", "fixtures"})
"""Fields of the work cell, which settings name without its own name."""


def qualify_setting(setting: str) -> str:
    """Return FIELD=VALUE with the field's full name in the world."""
    return f"cell.{setting}" if setting.split("=")[0].split(".")[0] in CELL_FIELDS else setting


def check_cell_models(cell: "WorkCell", default: "WorkCell", file: Path | None) -> None:
    """Read the models of a cell, before anything is done with it.

    Args:
        cell: The cell.
        default: What it was without options: what the models are then, a command may do without.
        file: Which file it is from; None: from --set.

    Raises:
        InputError: The file, the field and what is allowed.
    """
    from drake_clutter.files import InputError
    from drake_clutter.simulation.cell_plant import validate_models

    if (cell.robot, cell.fixtures) == (default.robot, default.fixtures):
        return
    try:
        validate_models(cell)
    except InputError as error:
        raise InputError(f"{file or '--set'}: {error}") from error


def reject_support_settings(settings: Sequence[str] | None) -> None:
    """Refuse settings of the support, on which the objects of scenes stand already.

    Raises:
        InputError: There is one.
    """
    for setting in settings or ():
        if qualify_setting(setting).startswith(
            ("cell.support", "layout.tray_side", "world.cell.support", "world.layout.tray_side")
        ):
            raise input_error(
                f"--set {setting}",
                "the objects stand on their scene's support; allowed are other fields",
            )


def load_config_from_options(
    config: Path | None,
    cell: Path | None,
    settings: Sequence[str] | None,
    scene_cell: "WorkCell | None" = None,
) -> "ClutterConfig":
    """Return the world: the defaults with the cell, over them the config's fields, and single fields.

    Args:
        config: File of the config.
        cell: File of the cell.
        settings: Single fields.
        scene_cell: Stands for the default cell; or None.
    """
    from drake_clutter.cell.work_cell import load_cell
    from drake_clutter.config import ClutterConfig, upgrade
    from drake_clutter.validation import load_config_as

    default = ClutterConfig() if scene_cell is None else ClutterConfig(cell=scene_cell)
    base = default if cell is None else replace(default, cell=load_cell(cell))
    loaded = load_config_as(base, config, upgrade=upgrade)
    loaded = load_config_as(
        loaded, settings=[qualify_setting(setting) for setting in settings or ()], upgrade=upgrade
    )
    check_cell_models(loaded.cell, default.cell, cell or config)
    return loaded


def load_scene_and_config(
    scene: Path,
    catalog: Path | None,
    config: Path | None,
    cell: Path | None,
    settings: Sequence[str] | None,
) -> tuple["SceneFile", "ClutterConfig"]:
    """Return a scene file and the world for it.

    The cell is that of --cell, else the one that the scene was made with; its support is the scene's, as the objects stand
    on it. Fields of --config and --set go over it.
    """
    from drake_clutter.catalog import load_catalog
    from drake_clutter.cell.work_cell import load_cell
    from drake_clutter.config import ClutterConfig, upgrade
    from drake_clutter.scenes.scene_file import load_scene
    from drake_clutter.validation import load_config_as

    file = load_scene(scene, load_catalog(catalog))
    scene_cell = load_cell(cell).with_support(file.scene.support) if cell is not None else file.cell
    loaded = load_config_as(replace(ClutterConfig(), cell=scene_cell), config, upgrade=upgrade)
    loaded = load_config_as(
        loaded, settings=[qualify_setting(setting) for setting in settings or ()], upgrade=upgrade
    )
    check_cell_models(loaded.cell, file.cell, cell or config)
    return replace(file, scene=replace(file.scene, support=loaded.cell.support)), loaded
