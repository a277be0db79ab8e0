"""Configurations, work cells and scenes from a command's options."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from drake_clutter.files import input_error

if TYPE_CHECKING:
    from drake_clutter.cell.work_cell import WorkCell
    from drake_clutter.config import ClutterConfig
    from drake_clutter.scenes.scene_file import SceneFile

CELL_FIELDS = frozenset(
    {"robot", "gripper", "support", "cameras", "fixtures", "wrist_camera", "handover"}
)
"""Fields of the work cell, which settings may name without the prefix `cell.`."""
_SUPPORT_FIELDS = (
    "cell.support",
    "layout.tray_side",
    "world.cell.support",
    "world.layout.tray_side",
)
"""Fields of the support in a configuration and, with `world`, in a scenario."""


def qualify_setting(setting: str) -> str:
    """Return FIELD=VALUE with the full name of the field in the configuration."""
    return f"cell.{setting}" if setting.split("=")[0].split(".")[0] in CELL_FIELDS else setting


def check_cell_models(cell: "WorkCell", default: "WorkCell", file: Path | None) -> None:
    """Load the robot and fixture models of a cell, so that errors are reported early.

    Args:
        cell: The cell.
        default: The cell without options; its models are not checked.
        file: File that the cell was read from; None if `--set` changed it.

    Raises:
        InputError: A model cannot be loaded.
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
    """Refuse settings of the support, because the objects of a scene stand on its own support.

    Raises:
        InputError: A setting changes the support.
    """
    for setting in settings or ():
        if qualify_setting(setting).startswith(_SUPPORT_FIELDS):
            raise input_error(
                f"--set {setting}",
                "the support is that of the scene; expected other fields",
            )


def load_config_from_options(
    config_file: Path | None,
    cell_file: Path | None,
    settings: Sequence[str] | None,
    scene_cell: "WorkCell | None" = None,
) -> "ClutterConfig":
    """Return the configuration of a command that reads no single scene.

    Later sources replace fields of earlier ones: the defaults, the cell, the configuration file,
    the settings.

    Args:
        config_file: Configuration file, or None.
        cell_file: Work cell file, or None.
        settings: Single fields, as FIELD=VALUE.
        scene_cell: Cell that replaces the default one; None keeps the default.
    """
    from drake_clutter.cell.work_cell import load_cell
    from drake_clutter.config import ClutterConfig

    default = ClutterConfig() if scene_cell is None else ClutterConfig(cell=scene_cell)
    base = default if cell_file is None else replace(default, cell=load_cell(cell_file))
    config = _override(base, config_file, settings)
    check_cell_models(config.cell, default.cell, cell_file or config_file)
    return config


def load_cell_from_options(
    config_file: Path | None, cell_file: Path, settings: Sequence[str] | None
) -> "WorkCell":
    """Return the work cell of a file with fields replaced; its models are not loaded.

    Args:
        config_file: Configuration file, or None.
        cell_file: Work cell file.
        settings: Single fields, as FIELD=VALUE.
    """
    from drake_clutter.cell.work_cell import load_cell
    from drake_clutter.config import ClutterConfig

    return _override(ClutterConfig(cell=load_cell(cell_file)), config_file, settings).cell


def load_scene_and_config(
    scene: Path,
    catalog: Path | None,
    config_file: Path | None,
    cell_file: Path | None,
    settings: Sequence[str] | None,
) -> tuple["SceneFile", "ClutterConfig"]:
    """Return a scene file and the configuration for it.

    Args:
        scene: Scene file.
        catalog: Asset folder with the user's object classes, or None.
        config_file: Configuration file, or None.
        cell_file: Work cell file; None takes the cell that the scene was made with. The support
            is always the scene's, because the objects stand on it.
        settings: Single fields, as FIELD=VALUE.
    """
    from drake_clutter.catalog import load_catalog
    from drake_clutter.cell.work_cell import load_cell
    from drake_clutter.config import ClutterConfig
    from drake_clutter.scenes.scene_file import load_scene

    file = load_scene(scene, load_catalog(catalog))
    cell = file.cell
    if cell_file is not None:
        cell = load_cell(cell_file).with_support(file.scene.support)
    config = _override(ClutterConfig(cell=cell), config_file, settings)
    check_cell_models(config.cell, file.cell, cell_file or config_file)
    return replace(file, scene=replace(file.scene, support=config.cell.support)), config


def _override(
    base: "ClutterConfig", config_file: Path | None, settings: Sequence[str] | None
) -> "ClutterConfig":
    """Return a configuration with the fields of a file, then of settings, replaced."""
    from drake_clutter.config import upgrade_config
    from drake_clutter.validation import load_config_as

    full_settings = [qualify_setting(setting) for setting in settings or ()]
    return load_config_as(base, config_file, full_settings, upgrade_config)
