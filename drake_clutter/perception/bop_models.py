"""Object models and the camera of a dataset in the BOP format (https://bop.felk.cvut.cz).

Files in the folder of a dataset:

    camera.json                Camera: fx, fy, cx, cy [px], width, height, depth_scale.
    models/obj_000001.ply      Mesh of a class in its frame O [mm], with normals and texture.
    models/obj_000001.png      Its texture.
    models/models_info.json    Per class: diameter, bounding box and symmetries [mm].

The number of a class is its obj_id: its index in the catalog plus 1.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import ConvexHull
from scipy.spatial.distance import pdist

from drake_clutter.catalog import ObjectClass, Shape
from drake_clutter.cell.camera import Camera
from drake_clutter.export.model_parts import load_visual
from drake_clutter.files import write_json
from drake_clutter.perception.image_dataset import DEPTH_UNIT
from drake_clutter.perception.pose_fit import symmetry_rotations

DATASET_CAMERA_FILE = "camera.json"
MODELS_FOLDER = "models"
MODELS_INFO_FILE = "models_info.json"
_HALF_TURN = np.diag([1.0, -1.0, -1.0])
"""Half turn about the x axis."""


def write_dataset_camera(folder: Path, camera: Camera) -> None:
    """Write `camera.json` to the folder of a dataset."""
    cx, cy = camera.principal_point
    entry = {"fx": camera.focal_length, "fy": camera.focal_length, "cx": cx, "cy": cy}
    size = {"width": camera.width, "height": camera.height}
    write_json(folder / DATASET_CAMERA_FILE, entry | size | {"depth_scale": 1000 * DEPTH_UNIT})


def write_models(folder: Path, classes: Sequence[ObjectClass]) -> None:
    """Write the models of all classes of a catalog, in its order, to the folder of a dataset."""
    models = folder / MODELS_FOLDER
    models.mkdir(exist_ok=True)
    info = {}
    for obj_id, object_class in enumerate(classes, start=1):
        visual = load_visual(object_class)
        texture_name = f"obj_{obj_id:06d}.png"
        visual.visual.material.baseColorTexture.convert("RGB").save(models / texture_name)
        vertices = 1000 * np.asarray(visual.vertices)
        path = models / f"obj_{obj_id:06d}.ply"
        path.write_text(_ply_text(visual, vertices, texture_name), encoding="ascii")
        info[str(obj_id)] = _model_info(object_class, vertices)
    write_json(models / MODELS_INFO_FILE, info)


def _ply_text(visual: Any, vertices: np.ndarray[Any, Any], texture_name: str) -> str:
    """Return a textured mesh as an ASCII PLY document.

    Args:
        visual: The mesh, a `trimesh.Trimesh` with a texture.
        vertices: Its vertices in the unit of the document. Shape (n, 3).
        texture_name: File of the texture.
    """
    columns = ("x", "y", "z", "nx", "ny", "nz", "texture_u", "texture_v")
    header = [
        "ply",
        "format ascii 1.0",
        f"comment TextureFile {texture_name}",
        f"element vertex {len(vertices)}",
        *(f"property float {name}" for name in columns),
        f"element face {len(visual.faces)}",
        "property list uchar int vertex_indices",
        "end_header",
    ]
    rows = np.hstack([vertices, visual.vertex_normals, visual.visual.uv])
    lines = [" ".join(f"{value:.6f}" for value in row) for row in rows]
    faces = ["3 {} {} {}".format(*face) for face in visual.faces]
    return "\n".join([*header, *lines, *faces]) + "\n"


def _model_info(object_class: ObjectClass, vertices: np.ndarray[Any, Any]) -> dict[str, Any]:
    """Return BOP's description of a model, with the symmetries of its shape.

    Args:
        object_class: The class.
        vertices: Vertices of its mesh [mm]. Shape (n, 3).
    """
    lower = vertices.min(axis=0)
    size = np.ptp(vertices, axis=0)
    # The two points of largest distance are corners of the convex hull.
    corners = vertices[ConvexHull(vertices).vertices]
    info: dict[str, Any] = {"diameter": float(pdist(corners).max())}
    info |= {f"min_{axis}": float(value) for axis, value in zip("xyz", lower, strict=True)}
    info |= {f"size_{axis}": float(value) for axis, value in zip("xyz", size, strict=True)}
    rotations = list(symmetry_rotations(object_class))
    if object_class.shape is Shape.CYLINDER:
        rotations.append(_HALF_TURN)
        info["symmetries_continuous"] = [{"axis": [0, 0, 1], "offset": [0, 0, 0]}]
    transforms = []
    for rotation in rotations:
        if not np.allclose(rotation, np.eye(3)):
            transform = np.eye(4)
            transform[:3, :3] = rotation
            transforms.append(transform.ravel().tolist())
    if transforms:
        info["symmetries_discrete"] = transforms
    return info
