"""STL meshes as OBJ files: Drake takes only the latter, while most URDF models come with STL."""

import os
import re
import tempfile
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from drake_clutter.files import InputError, sha256_of, write_text

_HEADER = 84
"""Bytes before the triangles of a binary file; the last four are their number."""
_TRIANGLE = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])


def stl_as_obj(path: Path) -> Path:
    """Return an OBJ file with the triangles of an STL file, in the folder for temporary files.

    Raises:
        InputError: The file is no STL.
    """
    folder = Path(tempfile.gettempdir()) / f"drake_clutter_meshes_{os.getuid()}"
    made = folder / f"{path.stem}_{sha256_of(path)[:16]}.obj"
    if not made.is_file():
        points = _triangles(path).reshape(-1, 3)
        corners, which = np.unique(points, axis=0, return_inverse=True)
        lines = [f"v {x:.9g} {y:.9g} {z:.9g}" for x, y, z in corners]
        lines += [f"f {a} {b} {c}" for a, b, c in which.reshape(-1, 3) + 1]
        folder.mkdir(parents=True, exist_ok=True)
        write_text(made, "\n".join(lines) + "\n")
    return made


def _triangles(path: Path) -> NDArray[np.float64]:
    """Return corners (F, 3, 3) [m]."""
    content = path.read_bytes()
    count = int.from_bytes(content[_HEADER - 4 : _HEADER], "little")
    if len(content) == _HEADER + count * _TRIANGLE.itemsize and count:
        return np.frombuffer(content, _TRIANGLE, count, _HEADER)["corners"].astype(float)
    numbers = re.findall(rb"vertex\s+(\S+)\s+(\S+)\s+(\S+)", content)
    if not numbers or len(numbers) % 3:
        raise InputError(f"{path}: is no STL mesh; allowed are OBJ, glTF, VTK and STL")
    return np.array(numbers, float).reshape(-1, 3, 3)
