"""STL meshes as OBJ files: Drake takes only the latter, while most URDF models come with STL."""

import os
import tempfile
from pathlib import Path

import trimesh

from drake_clutter.files import InputError, atomic_write, file_sha256


def convert_stl_to_obj(path: Path) -> Path:
    """Return an OBJ file with the triangles of an STL file, in the folder for temporary files.

    Raises:
        InputError: The file is no STL.
    """
    folder = Path(tempfile.gettempdir()) / f"drake_clutter_meshes_{os.getuid()}"
    obj_path = folder / f"{path.stem}_{file_sha256(path)[:16]}.obj"
    if obj_path.is_file():
        return obj_path
    try:
        mesh = trimesh.load_mesh(path, file_type="stl")
        empty = not len(mesh.faces)
    except Exception:  # trimesh raises many kinds for damaged files
        empty = True
    if empty:
        raise InputError(f"{path}: is no STL mesh; allowed are OBJ, glTF, VTK and STL")
    folder.mkdir(parents=True, exist_ok=True)
    with atomic_write(obj_path) as temporary:
        mesh.export(temporary, file_type="obj")
    return obj_path
