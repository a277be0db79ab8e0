"""Parts of built models and of the support that the exporters share."""

# trimesh is typed in part only.
# mypy: allow-untyped-calls

import shutil
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray
from pydrake.geometry import Convex, Mesh
from scipy.optimize import linprog
from scipy.spatial import ConvexHull, HalfspaceIntersection

from drake_clutter.catalog import ObjectClass, Shape
from drake_clutter.cell.support import Support
from drake_clutter.cell.support_sdf import support_sdf
from drake_clutter.files import reading_file
from drake_clutter.mesh_file import Y_UP_TO_Z_UP
from drake_clutter.scenes.scene import Scene
from drake_clutter.visual_mesh import check_visual_mesh

Floats = NDArray[np.float64]
"""An array of floats."""
_MIN_BALL_RADIUS = 1e-5
"""Radius of the largest ball in a mesh below which the mesh counts as flat [m]."""


@dataclass(frozen=True)
class Inertial:
    """Mass properties of a body with frame O.

    Attributes:
        mass: Mass [kg].
        com: Center of mass p_OBcm [m]. Shape (3,).
        inertia: ixx, iyy, izz, ixy, ixz, iyz about the center of mass, expressed in O [kg m^2].
    """

    mass: float
    com: tuple[float, ...]
    inertia: tuple[float, ...]


@dataclass(frozen=True)
class SupportBox:
    """One of the boxes that make up the support.

    Attributes:
        name: Unique name in the support.
        size: Extents [m]. Shape (3,).
        p_TG: Center; the axes are those of T [m]. Shape (3,).
        color: Red, green, blue and alpha in [0, 1]. Shape (4,).
    """

    name: str
    size: Floats
    p_TG: Floats
    color: Floats


def classes_in_scene(scene: Scene) -> list[ObjectClass]:
    """Return the classes of a scene, each once, ordered by name."""
    return sorted(
        {scene_object.object_class for scene_object in scene.objects}, key=lambda entry: entry.name
    )


def can_roll(object_class: ObjectClass) -> bool:
    """Return whether objects of a class may roll: cylinders, and meshes, which may be round."""
    return object_class.shape is not Shape.BOX


def format_numbers(numbers: Iterable[float]) -> str:
    """Return numbers with all their digits, separated by spaces."""
    return " ".join(repr(float(number)) for number in numbers)


def write_xml(path: Path, root: ElementTree.Element) -> None:
    """Write an indented XML document."""
    ElementTree.indent(root)
    ElementTree.ElementTree(root).write(path, encoding="utf-8", xml_declaration=True)


def load_inertial(object_class: ObjectClass) -> Inertial:
    """Return the mass properties in the built model of a class."""
    inertial = ElementTree.parse(object_class.verified_sdf_path).find("model/link/inertial")
    assert inertial is not None, f"{object_class.sdf_path} was not built by drake_clutter"
    moments = (
        float(inertial.findtext(f"inertia/{entry}", "nan"))
        for entry in ("ixx", "iyy", "izz", "ixy", "ixz", "iyz")
    )
    com = (float(value) for value in inertial.findtext("pose", "").split()[:3])
    return Inertial(float(inertial.findtext("mass", "nan")), tuple(com), tuple(moments))


def load_visual(object_class: ObjectClass) -> Any:
    """Return the textured mesh of a class in O.

    It is a `trimesh.Trimesh` whose material is a `PBRMaterial` with the label as its texture.
    """
    path = object_class.folder / "visual.gltf"
    check_visual_mesh(path)
    with reading_file(path, "a model as `drake-clutter assets build` writes it"):
        parts = trimesh.load_scene(path).geometry.values()
        mesh = trimesh.util.concatenate(list(parts))  # packs the textures of several parts into one
        mesh.apply_transform(Y_UP_TO_Z_UP)
    return mesh


def support_boxes(support: Support, *, table: bool) -> list[SupportBox]:
    """Return the boxes of a support."""
    boxes = []
    for visual in ElementTree.fromstring(support_sdf(support, table=table)).iter("visual"):
        pose, size, color = (
            np.array([float(value) for value in visual.findtext(path, "").split()])
            for path in ("pose", "geometry/box/size", "material/diffuse")
        )
        boxes.append(SupportBox(visual.get("name", ""), size, pose[:3], color))
    return boxes


def deflate_convex_mesh(path: Path, deflated: Path, margin: float) -> None:
    """Write a convex mesh whose faces lie deeper by a margin.

    A mesh that is thinner than twice the margin is copied.

    Args:
        path: The mesh.
        deflated: The file to write.
        margin: Distance of the faces from those of the mesh [m].
    """
    # Each row is a face: outer normal n and offset d with n @ p + d <= 0 inside.
    with reading_file(path, "a convex piece as `drake-clutter assets build` writes it"):
        faces = ConvexHull(trimesh.load_mesh(path).vertices).equations
    faces[:, 3] += margin
    # The center and radius of the largest ball between the faces.
    ball = linprog(
        [0, 0, 0, -1],
        A_ub=np.column_stack([faces[:, :3], np.ones(len(faces))]),
        b_ub=-faces[:, 3],
        bounds=[(None, None)] * 3 + [(None, None)],
    ).x
    if ball[3] < _MIN_BALL_RADIUS:
        shutil.copyfile(path, deflated)
        return
    corners = HalfspaceIntersection(faces, ball[:3]).intersections
    text = trimesh.exchange.obj.export_obj(trimesh.Trimesh(corners).convex_hull)
    deflated.write_text(text, encoding="utf-8")


def load_shape_mesh(shape: Mesh | Convex) -> Any:
    """Return the mesh of a shape, a `trimesh.Trimesh` in the scale and axes of the shape."""
    path = shape.source().path()
    with reading_file(path, "a mesh"):
        mesh = trimesh.load_mesh(path)
    if path.suffix == ".gltf":
        mesh.apply_transform(Y_UP_TO_Z_UP)
    mesh.apply_scale(shape.scale3())
    return mesh


def write_shape_mesh(shape: Mesh | Convex, path: Path) -> None:
    """Write the mesh of a shape as an OBJ file."""
    text = trimesh.exchange.obj.export_obj(load_shape_mesh(shape), include_texture=False)
    path.write_text(text, encoding="utf-8")


def write_class_meshes(object_class: ObjectClass, folder: Path) -> list[str]:
    """Write the meshes of a class to `<folder>/<class>/`.

    These are `visual.obj` with its MTL and PNG files, and the convex pieces. Simulators other than
    Drake read no glTF.

    Returns:
        Names of the convex pieces without `.obj`, in order; none for a box or a cylinder.
    """
    target = folder / object_class.name
    target.mkdir()
    visual = load_visual(object_class)
    # White, because some simulators multiply the texture by the material's color.
    visual.visual.material = trimesh.visual.material.SimpleMaterial(
        image=visual.visual.material.baseColorTexture.convert("RGB"),
        diffuse=[255] * 4,
        name="label",
    )
    text, files = trimesh.exchange.obj.export_obj(
        visual, include_normals=True, return_texture=True, mtl_name="visual.mtl"
    )
    for name, data in files.items():
        (target / name).write_bytes(data)
    (target / "visual.obj").write_text(text, encoding="utf-8")
    pieces = sorted(object_class.folder.glob("convex_*.obj"))
    for piece in pieces:
        shutil.copyfile(piece, target / piece.name)
    return [piece.stem for piece in pieces]
