"""A scene as one SDFormat world, for PyBullet, Gazebo and Drake."""

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
    """Drake's own friction element moves to the standard one, which Drake reads too; it refuses to have both."""
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
    model = ElementTree.fromstring(text).find("model")
    assert model is not None
    model.set("name", name)
    for collision in model.iter("collision"):
        _use_standard_friction(collision)
    return model


def _pose_text(pose: Pose) -> str:
    X_AB = rigid_transform(pose)
    return format_numbers([*X_AB.translation(), *RollPitchYaw(X_AB.rotation()).vector()])


def write_sdf(scene: Scene, folder: Path) -> Path:
    """Writes `scene.sdf`, a world in which every object is a model of its own, and a folder of meshes per class."""
    ElementTree.register_namespace(
        "drake", _DRAKE
    )  # else the prefix is renamed, and Drake no longer knows it
    for object_class in classes_in_scene(scene):
        write_class_meshes(object_class, folder)
    root = ElementTree.Element("sdf", version="1.10")
    world = ElementTree.SubElement(root, "world", name="scene")
    tray = _model(support_sdf(scene.support), TRAY)
    static = ElementTree.Element("static")
    static.text = "1"  # PyBullet knows no "true"
    tray.insert(0, static)
    world.append(tray)
    for scene_object in scene.objects:
        object_class = scene_object.object_class
        model = _model(object_class.model_path.read_text(encoding="utf-8"), scene_object.name)
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
