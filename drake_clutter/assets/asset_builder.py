"""Building an object class: SDF model, collision geometry, textured visual."""

import os
import re
import secrets
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from xml.sax.saxutils import escape

import numpy as np
import trimesh
from numpy.typing import NDArray

from drake_clutter.assets.contact_properties import proximity_properties_sdf
from drake_clutter.assets.textured_mesh import box_mesh, cylinder_mesh, gltf_text, map_strip_texture
from drake_clutter.assets.textures import draw_texture, encode_png
from drake_clutter.catalog import (
    CATALOG_FILE,
    ObjectClass,
    RestOrientation,
    Shape,
    catalog_path,
    load_catalog,
)
from drake_clutter.files import InputError, write_text
from drake_clutter.resources import resource_path

_SHIPPED_PACKAGE = "drake_clutter_objects"
_BUILT_FILE = re.compile(r"model\.sdf|visual\.gltf|convex_\d{3}\.obj")
"""Names of the files that a build writes."""
_LYING_MESH_RESOLUTION = 0.2
"""Edge length of the contact mesh of a cylinder that may lie, in radii.

Its rim has 32 sides; with fewer it would rest like a prism.
"""
_STANDING_MESH_RESOLUTION = 0.4
"""Edge length of the contact mesh of a cylinder that always stands, in radii.

Its rim has 16 sides, which halves the simulation time of stacks of cans.
"""
_COACD_OPTIONS = {
    "threshold": 0.06,
    "mcts_iterations": 20,
    "mcts_nodes": 10,
    "mcts_max_depth": 2,
    "resolution": 1000,
    "seed": 1,
}
"""Options of CoACD for few pieces, as every piece costs simulation time.

With its default options, CoACD makes 48 pieces of the example's mug.
"""
_CONVEX_VOLUME_RATIO = 0.999
"""A mesh whose volume is at least this fraction of its hull's counts as convex."""

_PACKAGE_XML = """<?xml version="1.0"?>
<package format="2">
  <name>{name}</name>
  <version>0.0.0</version>
  <description>{description}</description>
  <maintainer email="nobody@example.com">drake_clutter authors</maintainer>
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


def _load_centered_mesh(path: Path) -> trimesh.Trimesh:
    """Return a mesh with the center of its bounding box at the origin."""
    mesh = trimesh.load_mesh(path)
    mesh.apply_translation(-mesh.bounds.mean(axis=0))
    return mesh


def _compute_inertial(object_class: ObjectClass, mesh: trimesh.Trimesh | None) -> _Inertial:
    """Return the mass distribution of a solid of uniform density."""
    mass = object_class.mass
    x, y, z = object_class.size
    if mesh is not None:
        density = mass / mesh.volume
        return _Inertial(
            np.asarray(mesh.center_mass, float),
            np.asarray(mesh.moment_inertia, float) * density / mesh.density,
        )
    if object_class.shape is Shape.BOX:
        moments = mass / 12 * np.array([y * y + z * z, x * x + z * z, x * x + y * y])
    else:
        radius = x / 2
        across = mass / 12 * (3 * radius**2 + z**2)
        moments = np.array([across, across, mass / 2 * radius**2])
    return _Inertial(np.zeros(3), np.diag(moments))


def _decompose_convex(mesh: trimesh.Trimesh) -> list[trimesh.Trimesh]:
    """Return convex hulls that cover a mesh; one for a convex mesh.

    The decomposition is CoACD (Wei et al. 2022).
    """
    if mesh.volume > _CONVEX_VOLUME_RATIO * mesh.convex_hull.volume:
        return [mesh.convex_hull]
    import coacd  # here, because it breaks Drake's SDF reader when loaded before Drake

    coacd.set_log_level("error")
    pieces = coacd.run_coacd(coacd.Mesh(mesh.vertices, mesh.faces), **_COACD_OPTIONS)
    low, high = mesh.bounds
    # Clipped, because objects are stacked on the bounding box.
    return [
        trimesh.Trimesh(np.clip(vertices, low, high), faces).convex_hull
        for vertices, faces in pieces
    ]


def _obj_text(mesh: trimesh.Trimesh) -> str:
    """Return a mesh as the content of an OBJ file."""
    lines = ["v {:.7f} {:.7f} {:.7f}".format(*vertex) for vertex in mesh.vertices]
    lines += ["f {} {} {}".format(*(face + 1)) for face in mesh.faces]
    return "\n".join(lines) + "\n"


def _collision_sdf(name: str, geometry: str, hint: float) -> str:
    """Return the SDF element of one collision geometry."""
    return f"""      <collision name="{name}">
        <geometry>
          {geometry}
        </geometry>
{proximity_properties_sdf(hint, compliant=True)}
      </collision>
"""


def _collisions_sdf(object_class: ObjectClass, num_pieces: int) -> str:
    """Return the SDF elements of a class's collision geometry."""
    x, y, z = object_class.size
    if object_class.shape is Shape.BOX:
        return _collision_sdf("box", f"<box><size>{x!r} {y!r} {z!r}</size></box>", max(x, y, z))
    if object_class.shape is Shape.CYLINDER:
        radius = x / 2
        geometry = f"<cylinder><radius>{radius!r}</radius><length>{z!r}</length></cylinder>"
        return _collision_sdf(
            "cylinder",
            geometry,
            radius
            * (
                _STANDING_MESH_RESOLUTION
                if object_class.only_rest is RestOrientation.UPRIGHT
                else _LYING_MESH_RESOLUTION
            ),
        )
    names = [f"convex_{index:03d}" for index in range(num_pieces)]
    return "".join(
        _collision_sdf(
            name, f"<mesh><uri>{name}.obj</uri><drake:declare_convex/></mesh>", max(x, y, z)
        )
        for name in names
    )


def _make_asset_files(object_class: ObjectClass) -> dict[str, str]:
    """Return the contents of every file of a class, by file name."""
    mesh = _load_centered_mesh(object_class.mesh) if object_class.mesh else None
    texture = draw_texture(object_class)
    if mesh is not None:
        surface = map_strip_texture(mesh, texture.regions["side"])
    elif object_class.shape is Shape.BOX:
        surface = box_mesh(object_class.size, texture.regions)
    else:
        surface = cylinder_mesh(object_class.size, texture.regions)
    pieces = _decompose_convex(mesh) if mesh is not None else []
    files = {f"convex_{index:03d}.obj": _obj_text(piece) for index, piece in enumerate(pieces)}
    files["visual.gltf"] = gltf_text(surface, encode_png(texture.image))
    inertial = _compute_inertial(object_class, mesh)
    files["model.sdf"] = _MODEL_SDF.format(
        name=object_class.name,
        catalog=CATALOG_FILE,
        source=_comment_text(object_class.source or "not stated"),
        com=" ".join(repr(float(value)) for value in inertial.com),
        mass=object_class.mass,
        collisions=_collisions_sdf(object_class, len(pieces)),
        **{
            f"i{'xyz'[i]}{'xyz'[j]}": float(inertial.inertia[i, j])
            for i in range(3)
            for j in range(i, 3)
        },
    )
    return files


def _comment_text(text: str) -> str:
    """Return text that can stand in an XML comment, which may not contain "--"."""
    return re.sub(r"-{2,}", "-", text).rstrip("-")  # XML comments may not hold two hyphens


def build_class(object_class: ObjectClass, folder: Path) -> Path:
    """Build a class into `<folder>/<class>/`, replacing an earlier build.

    Returns:
        The folder of the class, with `model.sdf`, `visual.gltf` and, for a mesh,
        `convex_000.obj`, ...

    Raises:
        InputError: The folder holds other files, or the label cannot be drawn.
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
    files = _make_asset_files(object_class)
    staging = folder / f".{object_class.name}.{secrets.token_hex(4)}"
    staging.mkdir(parents=True)
    try:
        for name, text in files.items():
            (staging / name).write_text(text, encoding="utf-8")
        shutil.rmtree(target, ignore_errors=True)
        os.replace(staging, target)
    finally:
        shutil.rmtree(staging, ignore_errors=True)
    return target


def build_assets(folder: Path, names: Sequence[str] | None = None) -> list[Path]:
    """Build the classes of an asset folder's own catalog, and its `package.xml`.

    Args:
        folder: The asset folder, which holds `catalog.yaml`.
        names: Names of the classes to build, or None for all.

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
    built = [
        build_class(entry, folder)
        for name, entry in own_classes.items()
        if names is None or name in names
    ]
    package = _SHIPPED_PACKAGE if folder == resource_path("sdf_assets") else folder.name
    description = "Object classes of drake_clutter: one folder per class."
    write_text(
        folder / "package.xml", _PACKAGE_XML.format(name=escape(package), description=description)
    )
    return built
