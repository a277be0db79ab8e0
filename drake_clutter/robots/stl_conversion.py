"""Conversion of STL meshes, which Drake does not read, to OBJ."""

import os
import tempfile
from pathlib import Path

import trimesh

from drake_clutter.files import InputError, atomic_write, file_sha256


def convert_stl_to_obj(path: Path) -> Path:
    """Return the path of an OBJ file with the triangles of an STL file.

    It is in the folder for temporary files, and reused as long as the STL file does not change.

    Args:
        path: STL file.

    Raises:
        InputError: The file is not an STL mesh.
    """
    folder = Path(tempfile.gettempdir()) / f"drake_clutter_meshes_{os.getuid()}"
    obj_path = folder / f"{path.stem}_{file_sha256(path)[:16]}.obj"
    if obj_path.is_file():
        return obj_path
    try:
        mesh = trimesh.load_mesh(path, file_type="stl")
        is_empty = not len(mesh.faces)
    except Exception:  # trimesh raises exceptions of many types for invalid files
        is_empty = True
    if is_empty:
        raise InputError(f"{path}: is not an STL mesh; expected OBJ, glTF, VTK or STL")
    folder.mkdir(parents=True, exist_ok=True)
    with atomic_write(obj_path) as temporary:
        mesh.export(temporary, file_type="obj")
    return obj_path
