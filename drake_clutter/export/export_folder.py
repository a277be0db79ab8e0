"""The folder of an export: written aside, and filled in one go."""

import os
import re
import secrets
import shutil
from enum import Enum
from pathlib import Path

from drake_clutter.export.dmd_writer import write_dmd
from drake_clutter.export.glb_writer import ROOT_NODE, write_glb
from drake_clutter.export.mjcf_writer import write_mjcf
from drake_clutter.export.model_parts import classes_in_scene
from drake_clutter.export.sdf_writer import write_sdf
from drake_clutter.files import InputError
from drake_clutter.scenes.scene import TRAY, Scene

_VALID_NAME = re.compile(r"\w([\w. -]*\w)?")
_RESERVED_NAME = re.compile(
    rf"{TRAY}|{ROOT_NODE}|world|WorldModelInstance|DefaultModelInstance|__.*__"
)


class ExportFormat(Enum):
    """What a scene can be exported as."""

    DMD = "dmd"
    SDF = "sdf"
    MJCF = "mjcf"
    GLB = "glb"


_WRITERS = {
    ExportFormat.DMD: write_dmd,
    ExportFormat.SDF: write_sdf,
    ExportFormat.MJCF: write_mjcf,
    ExportFormat.GLB: write_glb,
}


def export_scene(scene: Scene, format: ExportFormat, out: Path) -> Path:
    """Writes a scene as a folder that refers to nothing outside of it, so that it may be moved or sent.

    The world frame of every format is the tray frame T.

    Args:
        scene: the scene; the tray and every object at its X_TO are written.
        format: of which program.
        out: an existing, empty folder; stays empty when the export fails.

    Returns:
        The file to open: `scene.dmd.yaml`, `scene.sdf`, `scene.xml` or `scene.glb` in `out`.

    Raises:
        InputError: an object's name that not every program could take, or a class without built assets.
    """
    for name in scene.names:
        if not _VALID_NAME.fullmatch(name) or _RESERVED_NAME.fullmatch(name):
            raise InputError(
                f"object {name!r} cannot be exported by this name; allowed are letters, digits, _, and . - or blanks "
                f"between them, and no name that a format reserves ({_RESERVED_NAME.pattern.replace('|', ', ')})"
            )
    for object_class in classes_in_scene(scene):
        _ = object_class.model_path  # says what is wrong before anything is written
    staging = out / f".export.{secrets.token_hex(4)}"
    staging.mkdir()
    try:
        main_file = _WRITERS[format](scene, staging)
        # The file to open comes last: where it is, the export is complete.
        for entry in sorted(staging.iterdir(), key=lambda entry: (entry == main_file, entry.name)):
            os.replace(entry, out / entry.name)
    finally:
        shutil.rmtree(staging)
    return out / main_file.name
