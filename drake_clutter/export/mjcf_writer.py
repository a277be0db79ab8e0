"""Export of a scene as an MJCF model for MuJoCo."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from xml.etree.ElementTree import Element, SubElement

from drake_clutter.assets.contact_properties import ROLLING_FRICTION, SURFACE_FRICTION
from drake_clutter.catalog import ObjectClass, Shape
from drake_clutter.cell.support import Support
from drake_clutter.cell.work_cell import WorkCell
from drake_clutter.export.cell_reader import read_cell_model
from drake_clutter.export.mjcf_cell import CellWriter
from drake_clutter.export.model_parts import (
    can_roll,
    classes_in_scene,
    format_numbers,
    load_inertial,
    support_boxes,
    write_class_meshes,
    write_xml,
)
from drake_clutter.scenes.scene import TRAY, Scene, SceneObject
from drake_clutter.simulation.scene_plant import rigid_transform

_TORSIONAL_FRICTION = 0.005
"""MuJoCo's default coefficient of torsional friction [m]."""
_DEFAULT_ROLLING_FRICTION = 1e-4
"""MuJoCo's default coefficient of rolling friction [m], which acts on contacts of condim 6 only."""
_TIME_STEP = 0.001
"""Time step of the simulation [s].

Contacts can only be as stiff as it allows: with MuJoCo's default of 0.002 s, the tallest stacks
lean until they fall.
"""
_CONTACT_TIME_CONSTANT = 2 * _TIME_STEP
"""Time constant of the contacts [s]: the stiffest that MuJoCo allows with this time step.

Under MuJoCo's default of 0.02 s, tall stacks on two lying markers lean and fall.
"""
_FRICTION_IMPEDANCE_RATIO = 100.0
"""How much harder contacts are along the surface than along the normal, see `impratio`.

With MuJoCo's default of 1, the objects of a stack creep sideways until it falls.
"""


def _add_defaults(root: Element) -> None:
    """Add the default classes of visual, collision and rolling collision geometry."""
    default = SubElement(root, "default")
    # Masses come from the inertials. The shell inertia avoids an error for meshes that are not
    # closed.
    SubElement(default, "mesh", inertia="shell")
    visual = SubElement(default, "default", {"class": "visual"})
    SubElement(visual, "geom", type="mesh", group="2", contype="0", conaffinity="0")
    collision = SubElement(default, "default", {"class": "collision"})
    # A contact gets the larger friction and the larger condim of its two geoms.
    SubElement(
        collision,
        "geom",
        group="3",
        friction=_friction(_DEFAULT_ROLLING_FRICTION),
        solref=format_numbers([_CONTACT_TIME_CONSTANT, 1.0]),
    )
    rolling = SubElement(collision, "default", {"class": "rolling_collision"})
    SubElement(rolling, "geom", condim="6", friction=_friction(ROLLING_FRICTION))


def _friction(rolling: float) -> str:
    """Return MuJoCo's sliding, torsional and rolling coefficients."""
    return format_numbers([SURFACE_FRICTION, _TORSIONAL_FRICTION, rolling])


def _add_assets(asset: Element, object_class: ObjectClass, pieces: Sequence[str]) -> None:
    """Add texture, material and meshes of a class."""
    name = object_class.name
    SubElement(asset, "texture", name=name, type="2d", file=f"{name}/label.png")
    SubElement(asset, "material", name=name, texture=name)
    SubElement(asset, "mesh", name=name, file=f"{name}/visual.obj")
    for piece in pieces:
        SubElement(asset, "mesh", name=f"{name}/{piece}", file=f"{name}/{piece}.obj")


def _add_tray(worldbody: Element, support: Support, *, table: bool) -> None:
    """Add the support, and optionally the table under it, as a fixed body."""
    tray = SubElement(worldbody, "body", name=TRAY)
    for box in support_boxes(support, table=table):
        geometry = {
            "type": "box",
            "size": format_numbers(box.size / 2),
            "pos": format_numbers(box.p_TG),
            "rgba": format_numbers(box.color),
        }
        # The geometry is visible, too, so it is in the group of the visuals.
        SubElement(
            tray,
            "geom",
            {"class": "collision", "name": f"{TRAY}/{box.name}", "group": "2"} | geometry,
        )


def _add_object(worldbody: Element, scene_object: SceneObject, pieces: Sequence[str]) -> None:
    """Add an object as a body with a free joint."""
    object_class, X_TO = scene_object.object_class, scene_object.X_TO
    inertial = load_inertial(object_class)
    body = SubElement(
        worldbody,
        "body",
        name=scene_object.name,
        pos=format_numbers(X_TO.translation),
        quat=format_numbers(X_TO.quaternion),
    )
    SubElement(body, "freejoint", name=scene_object.name)
    SubElement(
        body,
        "inertial",
        pos=format_numbers(inertial.com),
        mass=repr(inertial.mass),
        fullinertia=format_numbers(inertial.inertia),
    )
    SubElement(
        body, "geom", {"class": "visual", "mesh": object_class.name, "material": object_class.name}
    )
    x, y, z = object_class.size
    if object_class.shape is Shape.BOX:
        geometries = [{"type": "box", "size": format_numbers([x / 2, y / 2, z / 2])}]
    elif object_class.shape is Shape.CYLINDER:
        geometries = [{"type": "cylinder", "size": format_numbers([x / 2, z / 2])}]
    else:
        geometries = [{"type": "mesh", "mesh": f"{object_class.name}/{piece}"} for piece in pieces]
    collision = "rolling_collision" if can_roll(object_class) else "collision"
    for geometry in geometries:
        SubElement(body, "geom", {"class": collision} | geometry)


def write_mjcf(scene: Scene, folder: Path, cell: WorkCell | None) -> Path:
    """Write `scene.xml` and a folder of meshes for each class.

    Visuals are in group 2, collision geometry is in group 3.

    Args:
        scene: Scene.
        folder: Folder to write to.
        cell: Work cell to write beside the scene; None for the scene alone, on a table.

    Returns:
        Path of `scene.xml`.
    """
    root = Element("mujoco", model="scene")
    SubElement(root, "compiler", angle="radian", inertiafromgeom="false")
    option = SubElement(
        root,
        "option",
        timestep=repr(_TIME_STEP),
        cone="elliptic",
        impratio=repr(_FRICTION_IMPEDANCE_RATIO),
    )
    # Flat faces need several contact points; earlier versions of MuJoCo find one by default.
    SubElement(option, "flag", multiccd="enable")
    _add_defaults(root)
    asset = SubElement(root, "asset")
    pieces: Mapping[str, Sequence[str]] = {
        entry.name: write_class_meshes(entry, folder) for entry in classes_in_scene(scene)
    }
    for object_class in classes_in_scene(scene):
        _add_assets(asset, object_class, pieces[object_class.name])
    worldbody = SubElement(root, "worldbody")
    SubElement(worldbody, "light", pos="0 0 2", dir="0 0 -1", directional="true")
    _add_tray(worldbody, scene.support, table=cell is None)
    cell_writer = cell and CellWriter(read_cell_model(cell), root, folder)
    if cell_writer:
        cell_writer.add()
    for scene_object in scene.objects:
        _add_object(worldbody, scene_object, pieces[scene_object.object_class.name])
    if cell_writer:
        cell_writer.add_home({o.name: rigid_transform(o.X_TO) for o in scene.objects})
    path = folder / "scene.xml"
    write_xml(path, root)
    return path
