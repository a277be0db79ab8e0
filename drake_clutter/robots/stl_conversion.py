"""Conversion of STL meshes, which Drake does not read, to OBJ."""

from pathlib import Path

from drake_clutter.files import InputError, atomic_write, file_sha256, private_temporary_folder


def convert_stl_to_obj(path: Path) -> Path:
    """Return the path of an OBJ file with the triangles of an STL file.

    It is in the folder for temporary files, and reused as long as the STL file does not change.

    Args:
        path: STL file.

    Raises:
        InputError: The file is not an STL mesh.
    """
    name = f"{path.stem}_{file_sha256(path)[:16]}_normals.obj"
    obj_path = private_temporary_folder("meshes") / name
    if obj_path.is_file():
        return obj_path
    import trimesh  # imported late: it takes long, and few models need it

    try:
        mesh = trimesh.load_mesh(path, file_type="stl")
        is_empty = not len(mesh.faces)
    except Exception:  # trimesh raises exceptions of many types for invalid files
        is_empty = True
    if is_empty:
        raise InputError(f"{path}: is not an STL mesh; expected OBJ, glTF, VTK or STL")
    with atomic_write(obj_path) as temporary:
        mesh.export(temporary, file_type="obj", include_normals=True)  # which VTK needs
    return obj_path
