"""What a build found out about a user's mesh, so that large meshes are not read again.

The folder of a built class holds `mesh.json` and `surface.npy`. They count only as long as the mesh
file is the one from which they were built.
"""

import hashlib
import json
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from drake_clutter.validation import Finite, NonNegative, Positive, StrictModel

MEASURES_FILE = "mesh.json"
SURFACE_FILE = "surface.npy"


class MeshMeasures(StrictModel):
    """Measures of a mesh, which `mesh.json` holds.

    Attributes:
        sha256: Hash of the mesh file, see `hash_mesh_file`.
        scale: Unit of the file's coordinates [m].
        extents: Extents of the bounding box [m]. Shape (3,).
        repairs: What the build repaired.
        max_bulge: Largest distance of the convex pieces beyond the surface [m].
        max_recess: Largest distance of the convex pieces behind the surface [m].
    """

    sha256: str
    scale: Positive
    extents: tuple[NonNegative, NonNegative, NonNegative]
    repairs: tuple[str, ...]
    max_bulge: Finite
    max_recess: Finite


def hash_mesh_file(path: Path) -> str:
    """Return the SHA-256 of a mesh file, and of the geometry files beside it that a glTF names."""
    content = path.read_bytes()
    digest = hashlib.sha256(content)
    if path.suffix.lower() == ".gltf":
        for uri in _buffer_uris(content):
            if not uri.startswith("data:") and (path.parent / uri).is_file():
                digest.update((path.parent / uri).read_bytes())
    return digest.hexdigest()


def _buffer_uris(gltf: bytes) -> list[str]:
    """Return the addresses of the buffers of a glTF file; an empty list if it is damaged."""
    try:
        buffers = json.loads(gltf.decode(errors="replace"))["buffers"]
        return [str(buffer["uri"]) for buffer in buffers if "uri" in buffer]
    except (ValueError, LookupError, TypeError, RecursionError):
        return []


def read_mesh_measures(folder: Path, mesh: Path, scale: float) -> MeshMeasures | None:
    """Return the measures in the folder of a built class; None if they are not those of the mesh.

    Args:
        folder: The folder of the class.
        mesh: The mesh file.
        scale: Unit of its coordinates [m].
    """
    try:
        text = (folder / MEASURES_FILE).read_text(encoding="utf-8")
        measures = MeshMeasures.model_validate_json(text)
        is_current = measures.sha256 == hash_mesh_file(mesh) and measures.scale == scale
        return measures if is_current else None
    except (OSError, ValueError):
        return None


def read_surface(folder: Path) -> NDArray[np.float64] | None:
    """Return the triangles of a built mesh in O [m], shape (F, 3, 3); None if there are none."""
    try:
        triangles = np.load(folder / SURFACE_FILE)
    except Exception:  # of many types, as NumPy evaluates the header as Python
        return None
    if triangles.ndim != 3 or triangles.shape[1:] != (3, 3) or not np.isfinite(triangles).all():
        return None
    return np.asarray(triangles, float)
