"""Export of a scene as an SDFormat world, for PyBullet, Gazebo and Drake."""

import math
import xml.etree.ElementTree as ElementTree
from pathlib import Path

from pydrake.math import RollPitchYaw

from drake_clutter.assets.contact_properties import ROLLING_FRICTION, SURFACE_FRICTION
from drake_clutter.cell.support_sdf import support_sdf
from drake_clutter.export.model_parts import (
    can_roll,
    classes_in_scene,
    deflate_convex_mesh,
    format_numbers,
    write_class_meshes,
    write_xml,
)
from drake_clutter.scenes.scene import TRAY, Pose, Scene
from drake_clutter.simulation.scene_plant import rigid_transform

_DRAKE = "drake.mit.edu"
PYBULLET_FILE = "scene_pybullet.sdf"
"""Name of the file for PyBullet.

PyBullet reads friction from an element of its own only, which strict readers of SDFormat reject.
"""
_PYBULLET_MARGIN = 0.001
"""Distance by which PyBullet inflates cylinders and meshes that it reads from a file [m].

It is `gUrdfDefaultCollisionMargin` in Bullet's `BulletUrdfImporter.cpp`. Boxes keep their size.
"""


def _use_standard_friction(collision: ElementTree.Element, rolling_friction: float) -> None:
    """Replace Drake's friction element by the standard ones.

    Drake reads the standard element, too, but does not allow both. SDFormat has rolling friction in
    the element of the Bullet engine only.

    Args:
        collision: Element of a collision geometry, which is changed.
        rolling_friction: Coefficient of rolling friction [m]; 0: none.
    """
    properties = collision.find(f"{{{_DRAKE}}}proximity_properties")
    assert properties is not None
    surface = ElementTree.SubElement(collision, "surface")
    friction = ElementTree.SubElement(surface, "friction")
    ode = ElementTree.SubElement(friction, "ode")
    for drake_name, name in (("mu_static", "mu"), ("mu_dynamic", "mu2")):
        element = properties.find(f"{{{_DRAKE}}}{drake_name}")
        assert element is not None
        properties.remove(element)
        ElementTree.SubElement(ode, name).text = element.text
    if rolling_friction:
        bullet = ElementTree.SubElement(friction, "bullet")
        ElementTree.SubElement(bullet, "friction").text = repr(SURFACE_FRICTION)
        ElementTree.SubElement(bullet, "friction2").text = repr(SURFACE_FRICTION)
        ElementTree.SubElement(bullet, "rolling_friction").text = repr(rolling_friction)


def _add_pybullet_friction(model: ElementTree.Element) -> None:
    """Add the element from which PyBullet reads friction to a model.

    PyBullet multiplies the friction of two bodies, and the rolling friction of each by the friction
    of the other. The coefficients are such that the results are those of the other formats.
    """
    link = model.find("link")
    assert link is not None
    contact = ElementTree.SubElement(link, "contact")
    friction = math.sqrt(SURFACE_FRICTION)
    ElementTree.SubElement(contact, "lateral_friction").text = repr(friction)
    rolling_friction = link.findtext("collision/surface/friction/bullet/rolling_friction")
    if rolling_friction is not None:
        scaled = float(rolling_friction) / friction
        ElementTree.SubElement(contact, "rolling_friction").text = repr(scaled)


def _deflate(model: ElementTree.Element, folder: Path) -> None:
    """Make the cylinders and meshes of a model smaller by PyBullet's margin, which lifts stacks.

    Args:
        model: Element of a model, which is changed.
        folder: Folder of the export, which receives the smaller meshes.
    """
    for uri in model.iterfind("link/collision/geometry/mesh/uri"):
        original = folder / (uri.text or "")
        deflated = original.with_stem(f"{original.stem}_pybullet")
        if not deflated.exists():
            deflate_convex_mesh(original, deflated, _PYBULLET_MARGIN)
        uri.text = deflated.relative_to(folder).as_posix()
    for cylinder in model.iterfind("link/collision/geometry/cylinder"):
        for name, margins in (("radius", 1), ("length", 2)):
            element = cylinder.find(name)
            assert element is not None
            size = float(element.text or "") - margins * _PYBULLET_MARGIN
            if size > 0:  # else it is thinner than the margin, and stays inflated
                element.text = repr(size)


def _model(text: str, name: str, rolling_friction: float = 0.0) -> ElementTree.Element:
    """Return the model of an SDF document under another name, with standard friction."""
    model = ElementTree.fromstring(text).find("model")
    assert model is not None
    model.set("name", name)
    for collision in model.iter("collision"):
        _use_standard_friction(collision, rolling_friction)
    return model


def _pose_text(pose: Pose) -> str:
    """Return a pose as translation and roll, pitch, yaw."""
    X_AB = rigid_transform(pose)
    return format_numbers([*X_AB.translation(), *RollPitchYaw(X_AB.rotation()).vector()])


def write_sdf(scene: Scene, folder: Path) -> Path:
    """Write a world with one model per object, and meshes per class.

    `scene_pybullet.sdf` is `scene.sdf` with friction, cylinders and meshes as PyBullet reads them.
    Returns the path of `scene.sdf`.
    """
    # Without this, the prefix would be renamed, and Drake would not recognize it.
    ElementTree.register_namespace("drake", _DRAKE)
    for object_class in classes_in_scene(scene):
        write_class_meshes(object_class, folder)
    root = ElementTree.Element("sdf", version="1.10")
    world = ElementTree.SubElement(root, "world", name="scene")
    tray = _model(support_sdf(scene.support, table=True), TRAY)
    static = ElementTree.Element("static")
    static.text = "1"  # PyBullet does not accept "true"
    tray.insert(0, static)
    world.append(tray)
    for scene_object in scene.objects:
        object_class = scene_object.object_class
        text = object_class.verified_sdf_path.read_text(encoding="utf-8")
        rolling_friction = ROLLING_FRICTION if can_roll(object_class) else 0.0
        model = _model(text, scene_object.name, rolling_friction)
        for uri in model.iter("uri"):
            # PyBullet reads no glTF.
            uri.text = f"{object_class.name}/{uri.text}".replace(".gltf", ".obj")
        pose = ElementTree.Element("pose")
        pose.text = _pose_text(scene_object.X_TO)
        model.insert(0, pose)
        world.append(model)
    path = folder / "scene.sdf"
    write_xml(path, root)
    for model in world.iter("model"):
        _add_pybullet_friction(model)
        _deflate(model, folder)
    write_xml(folder / PYBULLET_FILE, root)
    return path
