"""Export of a scene as an SDFormat world, for PyBullet, Gazebo and Drake."""

import xml.etree.ElementTree as ElementTree
from pathlib import Path

from pydrake.math import RollPitchYaw

from drake_clutter.cell.support_sdf import support_sdf
from drake_clutter.export.model_parts import (
    classes_in_scene,
    format_numbers,
    write_class_meshes,
    write_xml,
)
from drake_clutter.scenes.scene import TRAY, Pose, Scene
from drake_clutter.simulation.scene_plant import rigid_transform

_DRAKE = "drake.mit.edu"


def _use_standard_friction(collision: ElementTree.Element) -> None:
    """Replace Drake's friction element by the standard one.

    Drake reads the standard element, too, but does not allow both.
    """
    properties = collision.find(f"{{{_DRAKE}}}proximity_properties")
    assert properties is not None
    surface = ElementTree.SubElement(collision, "surface")
    ode = ElementTree.SubElement(ElementTree.SubElement(surface, "friction"), "ode")
    for drake_name, name in (("mu_static", "mu"), ("mu_dynamic", "mu2")):
        element = properties.find(f"{{{_DRAKE}}}{drake_name}")
        assert element is not None
        properties.remove(element)
        ElementTree.SubElement(ode, name).text = element.text


def _model(text: str, name: str) -> ElementTree.Element:
    """Return the model of an SDF document under another name, with standard friction."""
    model = ElementTree.fromstring(text).find("model")
    assert model is not None
    model.set("name", name)
    for collision in model.iter("collision"):
        _use_standard_friction(collision)
    return model


def _pose_text(pose: Pose) -> str:
    """Return a pose as translation and roll, pitch, yaw."""
    X_AB = rigid_transform(pose)
    return format_numbers([*X_AB.translation(), *RollPitchYaw(X_AB.rotation()).vector()])


def write_sdf(scene: Scene, folder: Path) -> Path:
    """Write `scene.sdf`, a world with one model per object, and meshes per class.

    Returns the path of `scene.sdf`.
    """
    # Without this, the prefix would be renamed, and Drake would not recognize it.
    ElementTree.register_namespace("drake", _DRAKE)
    for object_class in classes_in_scene(scene):
        write_class_meshes(object_class, folder)
    root = ElementTree.Element("sdf", version="1.10")
    world = ElementTree.SubElement(root, "world", name="scene")
    tray = _model(support_sdf(scene.support), TRAY)
    static = ElementTree.Element("static")
    static.text = "1"  # PyBullet does not accept "true"
    tray.insert(0, static)
    world.append(tray)
    for scene_object in scene.objects:
        object_class = scene_object.object_class
        model = _model(
            object_class.verified_sdf_path.read_text(encoding="utf-8"), scene_object.name
        )
        for uri in model.iter("uri"):
            # PyBullet reads no glTF.
            uri.text = f"{object_class.name}/{uri.text}".replace(".gltf", ".obj")
        pose = ElementTree.Element("pose")
        pose.text = _pose_text(scene_object.X_TO)
        model.insert(0, pose)
        world.append(model)
    path = folder / "scene.sdf"
    write_xml(path, root)
    return path
