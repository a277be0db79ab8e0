"""The folder of an export, which appears complete or not at all."""

import importlib.util
import os
import re
import shutil
from enum import Enum
from pathlib import Path

from drake_clutter.cell.work_cell import WorkCell
from drake_clutter.export.dmd_writer import write_dmd
from drake_clutter.export.glb_writer import ROOT_NODE, write_glb
from drake_clutter.export.mjcf_writer import write_mjcf
from drake_clutter.export.model_parts import classes_in_scene
from drake_clutter.export.sdf_writer import write_sdf
from drake_clutter.files import InputError, temporary_path
from drake_clutter.scenes.scene import TRAY, Scene

_VALID_NAME = re.compile(r"\w([\w. -]*\w)?")
_RESERVED_NAME = re.compile(
    rf"{TRAY}|{ROOT_NODE}|world|WorldModelInstance|DefaultModelInstance|__.*__"
)


class ExportFormat(Enum):
    """Formats in which a scene can be exported."""

    DMD = "dmd"
    SDF = "sdf"
    MJCF = "mjcf"
    GLB = "glb"
    USD = "usd"


_SCENE_WRITERS = {
    ExportFormat.DMD: write_dmd,
    ExportFormat.SDF: write_sdf,
    ExportFormat.GLB: write_glb,
}


def _write_usd(scene: Scene, folder: Path, cell: WorkCell | None) -> Path:
    """Write a USD stage with usd-core, which is optional."""
    if importlib.util.find_spec("pxr") is None:
        raise InputError("format: usd: needs usd-core; install drake_clutter with [data]")
    from drake_clutter.export.usd_writer import write_usd

    return write_usd(scene, folder, cell)


_CELL_WRITERS = {ExportFormat.MJCF: write_mjcf, ExportFormat.USD: _write_usd}
"""Writers of formats that can hold a work cell, too."""


def export_scene(
    scene: Scene, format: ExportFormat, out: Path, *, cell: WorkCell | None = None
) -> Path:
    """Write a scene to a folder that refers to no files outside of it.

    The world frame of every format is the support's frame T.

    Args:
        scene: The scene: the support, and every object at its X_TO.
        format: The format.
        out: An existing folder, empty or of the same export, whose files are replaced. It stays
            empty if the export fails.
        cell: Work cell to export beside the scene, with arm, gripper, pedestal, cameras and
            fixtures; None for the scene alone, on a table.

    Returns:
        The file to open: `scene.dmd.yaml`, `scene.sdf`, `scene.xml`, `scene.glb` or `scene.usda` in
            `out`.

    Raises:
        InputError: A format does not allow an object's name, or cannot hold a cell; or a class has
            no built assets.
    """
    if cell is not None and format not in _CELL_WRITERS:
        allowed = ", ".join(entry.value for entry in _CELL_WRITERS)
        raise InputError(f"format: {format.value} cannot hold the cell; expected one of {allowed}")
    for name in scene.names:
        if not _VALID_NAME.fullmatch(name) or _RESERVED_NAME.fullmatch(name):
            reserved = _RESERVED_NAME.pattern.replace("|", ", ")
            raise InputError(
                f"object {name!r} cannot be exported by this name; expected letters, digits, _, "
                "and . - or blanks between them, "
                f"and no name that a format reserves ({reserved})"
            )
    for object_class in classes_in_scene(scene):
        _ = object_class.verified_sdf_path  # raises before anything is written
    staging = temporary_path(out / "export")
    staging.mkdir()
    try:
        if format in _CELL_WRITERS:
            main_file = _CELL_WRITERS[format](scene, staging, cell)
        else:
            main_file = _SCENE_WRITERS[format](scene, staging)
        # The file to open is moved last, so that its presence means a complete export.
        for entry in sorted(staging.iterdir(), key=lambda entry: (entry == main_file, entry.name)):
            target = out / entry.name
            if target.is_dir():  # of the same export, which was killed
                shutil.rmtree(target)
            os.replace(entry, target)
    finally:
        shutil.rmtree(staging)
    return out / main_file.name
