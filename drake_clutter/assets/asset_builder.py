"""Building an object class: SDF model, collision geometry, textured visual."""

import io
import math
import os
import re
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree
from xml.sax.saxutils import escape

import numpy as np
import trimesh
from numpy.typing import NDArray

from drake_clutter.assets.contact_properties import (
    hydroelastic_modulus,
    proximity_properties_sdf,
)
from drake_clutter.assets.convex_pieces import decompose_convex, measure_deviation, obj_text
from drake_clutter.assets.mesh_appearance import (
    MAX_VISUAL_TRIANGLES,
    has_appearance,
    simplify_surface,
    textured_parts,
)
from drake_clutter.assets.textured_mesh import box_mesh, cylinder_mesh, gltf_text, map_strip_texture
from drake_clutter.assets.textures import draw_texture, encode_png
from drake_clutter.built_mesh import (
    MEASURES_FILE,
    SURFACE_FILE,
    MeshMeasures,
    hash_mesh_file,
    read_mesh_measures,
)
from drake_clutter.catalog import (
    CATALOG_FILE,
    ObjectClass,
    RestOrientation,
    Shape,
    catalog_path,
    load_catalog,
)
from drake_clutter.files import InputError, temporary_path, write_text
from drake_clutter.mesh_file import (
    MAX_INVERTED_FRACTION,
    MAX_OVERLAP_FRACTION,
    ObjectMesh,
    format_point,
    is_flat,
    load_object_mesh,
    measure_windings,
)
from drake_clutter.outputs import output_folder
from drake_clutter.resources import resource_path

_SHIPPED_PACKAGE = "drake_clutter_objects"
_BUILT_FILE = re.compile(r"model\.sdf|visual\.gltf|convex_\d{3}\.obj|mesh\.json|surface\.npy")
"""Names of the files that a build writes."""
_LYING_MESH_RESOLUTION = 0.2
"""Edge length of the contact mesh of a cylinder that may lie, in radii.

Its rim has 32 sides; with fewer it would rest like a prism.
"""
_STANDING_MESH_RESOLUTION = 0.4
"""Edge length of the contact mesh of a cylinder that always stands, in radii.

Its rim has 16 sides, which halves the simulation time of stacks of cans.
"""
_PACKAGE_XML = """<?xml version="1.0"?>
<package format="2">
  <name>{name}</name>
  <version>0.0.0</version>
  <description>{description}</description>
  <maintainer email="maintainers@example.com">drake_clutter authors</maintainer>
  <license>BSD-3-Clause</license>
</package>
"""

_MODEL_SDF = """<?xml version="1.0"?>
<!-- Built by drake_clutter.assets from {catalog}; size and mass: {source}. -->
<sdf version="1.10" xmlns:drake="drake.mit.edu">
  <model name="{name}">
    <link name="body">
      <inertial>
        <pose>{com} 0 0 0</pose>
        <mass>{mass!r}</mass>
        <inertia>
          <ixx>{ixx!r}</ixx>
          <iyy>{iyy!r}</iyy>
          <izz>{izz!r}</izz>
          <ixy>{ixy!r}</ixy>
          <ixz>{ixz!r}</ixz>
          <iyz>{iyz!r}</iyz>
        </inertia>
      </inertial>
      <visual name="visual">
        <geometry>
          <mesh>
            <uri>visual.gltf</uri>
          </mesh>
        </geometry>
      </visual>
{collisions}    </link>
  </model>
</sdf>
"""


@dataclass(frozen=True)
class _Inertial:
    """Mass distribution of a body with frame O.

    Attributes:
        com: Center of mass p_OBcm [m]. Shape (3,).
        inertia: Inertia about the center of mass, expressed in O [kg m^2]. Shape (3, 3).
    """

    com: NDArray[np.float64]
    inertia: NDArray[np.float64]


def _compute_inertial(object_class: ObjectClass, mesh: trimesh.Trimesh | None) -> _Inertial:
    """Return the mass distribution of a solid of uniform density.

    A center of mass that the catalog states replaces that of the solid; the inertia about it is
    assumed to be the same.
    """
    mass = object_class.mass
    x, y, z = object_class.size
    stated = object_class.stated_center_of_mass
    if mesh is not None:
        density = mass / mesh.volume
        return _Inertial(
            np.asarray(mesh.center_mass if stated is None else stated, float),
            np.asarray(mesh.moment_inertia, float) * density / mesh.density,
        )
    if object_class.shape is Shape.BOX:
        moments = mass / 12 * np.array([y * y + z * z, x * x + z * z, x * x + y * y])
    else:
        radius = x / 2
        across = mass / 12 * (3 * radius**2 + z**2)
        moments = np.array([across, across, mass / 2 * radius**2])
    return _Inertial(np.array(stated or (0.0, 0.0, 0.0)), np.diag(moments))


def _collision_sdf(name: str, geometry: str, hint: float, modulus: float) -> str:
    """Return the SDF element of one collision geometry."""
    return f"""      <collision name="{name}">
        <geometry>
          {geometry}
        </geometry>
{proximity_properties_sdf(hint, modulus)}
      </collision>
"""


def _center_depth(piece: trimesh.Trimesh) -> float:
    """Return the distance from the centroid of a convex piece to its nearest face [m]."""
    arms = np.asarray(piece.triangles[:, 0] - piece.center_mass)
    return float((arms * np.asarray(piece.face_normals)).sum(axis=1).min())


def _collisions_sdf(object_class: ObjectClass, pieces: Sequence[trimesh.Trimesh]) -> str:
    """Return the SDF elements of a class's collision geometry."""
    x, y, z = object_class.size
    smallest, middle, largest = sorted(object_class.size)
    if object_class.shape is Shape.BOX:
        modulus = hydroelastic_modulus(object_class.mass, middle * largest, smallest / 2)
        geometry = f"<box><size>{x!r} {y!r} {z!r}</size></box>"
        return _collision_sdf("box", geometry, largest, modulus)
    if object_class.shape is Shape.CYLINDER:
        radius = x / 2
        modulus = hydroelastic_modulus(object_class.mass, math.pi * radius**2, smallest / 2)
        geometry = f"<cylinder><radius>{radius!r}</radius><length>{z!r}</length></cylinder>"
        resolution = (
            _STANDING_MESH_RESOLUTION
            if object_class.only_rest is RestOrientation.UPRIGHT
            else _LYING_MESH_RESOLUTION
        )
        return _collision_sdf("cylinder", geometry, radius * resolution, modulus)
    return "".join(
        _collision_sdf(
            f"convex_{index:03d}",
            f"<mesh><uri>convex_{index:03d}.obj</uri><drake:declare_convex/></mesh>",
            largest,
            hydroelastic_modulus(object_class.mass, middle * largest, _center_depth(piece)),
        )
        for index, piece in enumerate(pieces)
    )


def _mesh_where(object_class: ObjectClass) -> str:
    """Return the field of the catalog that names a class's mesh, for error messages."""
    return f"{catalog_path(object_class.folder.parent)}: classes.{object_class.name}.mesh"


def _load_checked_mesh(object_class: ObjectClass, repair: bool) -> ObjectMesh | None:
    """Return the mesh of a class, or None for a box or a cylinder.

    Args:
        object_class: The class.
        repair: Whether small holes may be closed.

    Raises:
        InputError: The mesh has holes, or bodies that overlap or are inside out.
    """
    if object_class.mesh is None:
        return None
    where = f"{_mesh_where(object_class)}: {object_class.mesh}"
    scale = object_class.mesh_unit.scale
    mesh = load_object_mesh(object_class.mesh, _mesh_where(object_class), scale)
    if mesh.holes and not repair:
        raise InputError(
            f"{where}: is not watertight: {mesh.holes[0]}; "
            "close it, or run `drake-clutter assets build --repair`"
        )
    inverted, overlap = measure_windings(mesh.solid)
    for defect, limit, text in (
        (inverted, MAX_INVERTED_FRACTION, "is inside out"),
        (overlap, MAX_OVERLAP_FRACTION, "is covered twice, which counts twice in the inertia"),
    ):
        if defect.fraction > limit:
            raise InputError(
                f"{where}: {defect.fraction:.1%} of its volume {text}, as at "
                f"{format_point(defect.place + mesh.center)}; unite bodies that overlap, "
                "and remove surfaces that intersect"
            )
    return mesh


def _visual_mesh(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """Return a mesh with at most `MAX_VISUAL_TRIANGLES` triangles."""
    points, triangles, _ = simplify_surface(
        np.asarray(mesh.vertices, float),
        np.asarray(mesh.faces, np.int64),
        np.zeros((len(mesh.faces), 3, 0)),
        MAX_VISUAL_TRIANGLES,
    )
    return trimesh.Trimesh(points, triangles, process=False)


def _make_asset_files(object_class: ObjectClass, object_mesh: ObjectMesh | None) -> dict[str, str]:
    """Return the contents of every file of a class, by file name."""
    mesh = object_mesh.solid if object_mesh is not None else None
    texture = draw_texture(object_class)
    pieces = decompose_convex(mesh, _mesh_where(object_class)) if mesh is not None else []
    files = {f"convex_{index:03d}.obj": obj_text(piece) for index, piece in enumerate(pieces)}
    if object_mesh is not None and object_class.mesh and has_appearance(object_mesh):
        parts = textured_parts(object_mesh, object_class.mesh)
        files["visual.gltf"] = gltf_text(parts, repeat=True)
    else:
        if mesh is not None:
            surface = map_strip_texture(_visual_mesh(mesh), texture.regions["side"])
        elif object_class.shape is Shape.BOX:
            surface = box_mesh(object_class.size, texture.regions)
        else:
            surface = cylinder_mesh(object_class.size, texture.regions)
        files["visual.gltf"] = gltf_text([(surface, encode_png(texture.image))])
    inertial = _compute_inertial(object_class, mesh)
    if object_mesh is not None and object_class.mesh:
        x, y, z = object_mesh.solid.extents.tolist()
        max_bulge, max_recess = measure_deviation(object_mesh.solid, pieces)
        files[MEASURES_FILE] = MeshMeasures(
            sha256=hash_mesh_file(object_class.mesh),
            scale=object_class.mesh_unit.scale,
            extents=(x, y, z),
            repairs=_repair_texts(object_mesh),
            max_bulge=max_bulge,
            max_recess=max_recess,
        ).model_dump_json(indent=2)
    files["model.sdf"] = _MODEL_SDF.format(
        name=object_class.name,
        catalog=CATALOG_FILE,
        source=_comment_text(object_class.source or "not stated"),
        com=" ".join(repr(float(value)) for value in inertial.com),
        mass=object_class.mass,
        collisions=_collisions_sdf(object_class, pieces),
        **{
            f"i{'xyz'[i]}{'xyz'[j]}": float(inertial.inertia[i, j])
            for i in range(3)
            for j in range(i, 3)
        },
    )
    return files


def _check_built_files(object_class: ObjectClass, files: dict[str, str]) -> None:
    """Raise an error unless the written model is physical and has the size of its class.

    Raises:
        InputError: A moment of inertia is not that of a solid, a convex piece has no volume, or the
            pieces do not fill the bounding box.
    """
    where = f"{object_class.folder}"
    inertial = ElementTree.fromstring(files["model.sdf"]).find("model/link/inertial")
    assert inertial is not None
    mass = float(inertial.findtext("mass", "nan"))
    if not math.isclose(mass, object_class.mass, rel_tol=1e-9):
        raise InputError(f"{where}/model.sdf: mass: {mass}; expected {object_class.mass:g} kg")
    entry = {
        name: float(inertial.findtext(f"inertia/{name}", "nan"))
        for name in ("ixx", "iyy", "izz", "ixy", "ixz", "iyz")
    }
    matrix = np.array(
        [
            [entry["ixx"], entry["ixy"], entry["ixz"]],
            [entry["ixy"], entry["iyy"], entry["iyz"]],
            [entry["ixz"], entry["iyz"], entry["izz"]],
        ]
    )
    moments = np.linalg.eigvalsh(matrix) if np.isfinite(matrix).all() else np.zeros(3)
    # Each principal moment is positive and at most the sum of the other two.
    if not 0 < moments[0] <= moments[2] <= (moments[0] + moments[1]) * (1 + 1e-9):
        raise InputError(
            f"{where}/model.sdf: inertia: principal moments {format_point(moments)} kg m^2 are not "
            "those of a solid; check the mesh for surfaces that intersect"
        )
    if object_class.shape is not Shape.MESH:
        return
    corners = []
    for name in sorted(files):
        if name.endswith(".obj"):
            piece = trimesh.load_mesh(io.StringIO(files[name]), file_type="obj")
            if not piece.is_watertight or is_flat(np.asarray(piece.vertices)) or piece.volume <= 0:
                raise InputError(f"{where}/{name}: is not a convex solid; simplify the mesh")
            corners.append(np.asarray(piece.vertices))
    extents = np.ptp(np.vstack(corners), axis=0) if corners else np.zeros(3)
    if not np.allclose(extents, object_class.size, rtol=0.02, atol=1e-4):
        raise InputError(
            f"{where}: the convex pieces measure {format_point(extents)} m; "
            f"expected {format_point(np.asarray(object_class.size))} m; simplify the mesh"
        )


def _comment_text(text: str) -> str:
    """Return text that can stand in an XML comment, which may not contain "--"."""
    return re.sub(r"-{2,}", "-", text).rstrip("-")  # XML comments may not hold two hyphens


def build_class(object_class: ObjectClass, folder: Path, *, repair: bool = False) -> Path:
    """Build a class into `<folder>/<class>/`, replacing an earlier build.

    Args:
        object_class: The class.
        folder: The asset folder.
        repair: Whether small holes of a mesh are closed.

    Returns:
        The folder of the class, with `model.sdf`, `visual.gltf` and, for a mesh,
        `convex_000.obj`, ...

    Raises:
        InputError: The folder holds other files, the label cannot be drawn, or the mesh has a
            defect.
    """
    target = folder / object_class.name
    if target.exists():
        foreign_files = (
            [entry.name for entry in target.iterdir() if not _BUILT_FILE.fullmatch(entry.name)]
            if target.is_dir()
            else [target.name]
        )
        if foreign_files:
            raise InputError(
                f"{target}: holds {sorted(foreign_files)[0]}; "
                "expected a folder that only `assets build` fills"
            )
    mesh = _load_checked_mesh(object_class, repair)
    files = _make_asset_files(object_class, mesh)
    _check_built_files(object_class, files)
    staging = temporary_path(target)
    staging.mkdir(parents=True)
    try:
        for name, text in files.items():
            (staging / name).write_text(text, encoding="utf-8")
        if mesh is not None:
            # Single precision, in which most mesh files store coordinates.
            np.save(staging / SURFACE_FILE, np.asarray(mesh.solid.triangles, np.float32))
        shutil.rmtree(target, ignore_errors=True)
        os.replace(staging, target)
    finally:
        shutil.rmtree(staging, ignore_errors=True)
    return target


def _repair_texts(mesh: ObjectMesh) -> tuple[str, ...]:
    """Return what a build repairs in a mesh."""
    return mesh.repairs + tuple(f"closed {hole}" for hole in mesh.holes)


def describe_built_mesh(object_class: ObjectClass) -> tuple[str, ...]:
    """Return what a build repaired in the mesh of a class, and how its convex pieces deviate."""
    if object_class.mesh is None:
        return ()
    measures = read_mesh_measures(
        object_class.folder, object_class.mesh, object_class.mesh_unit.scale
    )
    if measures is None:
        return ()
    counts = [len(piece) for piece in object_class.convex_pieces]
    number = f"{len(counts)} convex pieces" if len(counts) > 1 else "1 convex piece"
    return (
        *measures.repairs,
        f"{number} of at most {max(counts)} corners, up to {1000 * measures.max_bulge:.2g} mm "
        f"beyond and {1000 * measures.max_recess:.2g} mm behind the surface",
    )


def build_assets(
    folder: Path, names: Sequence[str] | None = None, *, repair: bool = False
) -> list[Path]:
    """Build the classes of an asset folder's own catalog, and its `package.xml`.

    Args:
        folder: The asset folder, which holds `catalog.yaml`.
        names: Names of the classes to build, or None for all.
        repair: Whether small holes of meshes are closed.

    Returns:
        The folders of the classes, in the order of the catalog.

    Raises:
        InputError: The catalog is invalid, does not hold a class, or the folder is not writable.
    """
    folder = folder.resolve()
    own_classes = {
        name: entry
        for name, entry in load_catalog(folder).classes.items()
        if entry.folder.parent == folder
    }
    unknown = sorted(set(names or ()) - set(own_classes))
    if unknown:
        raise InputError(
            f"{catalog_path(folder)}: classes: no {unknown[0]}; expected {', '.join(own_classes)}"
        )
    if not os.access(folder, os.W_OK):
        raise InputError(f"{folder}: is not writable; give an asset folder that you may write")
    package = _SHIPPED_PACKAGE if folder == resource_path("sdf_assets") else folder.name
    description = "Object classes of drake_clutter: one folder per class."
    package_xml = _PACKAGE_XML.format(name=escape(package), description=description)
    with output_folder(folder):
        built = [
            build_class(entry, folder, repair=repair)
            for name, entry in own_classes.items()
            if names is None or name in names
        ]
        write_text(folder / "package.xml", package_xml)
    return built
