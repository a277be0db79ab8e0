"""Export of a scene as a binary glTF file."""

# trimesh is typed in part only.
# mypy: allow-untyped-calls

from pathlib import Path

import numpy as np
import trimesh

from drake_clutter.cell.support import Support
from drake_clutter.export.model_parts import (
    classes_in_scene,
    load_visual,
    support_boxes,
)
from drake_clutter.mesh_file import Y_UP_TO_Z_UP
from drake_clutter.scenes.scene import TRAY, Scene
from drake_clutter.simulation.scene_plant import rigid_transform

ROOT_NODE = "tray_frame"
"""Name of the node of the support's frame T."""


def _add_tray(picture: trimesh.Scene, support: Support) -> None:
    """Add the support as a node with one child for each of its boxes."""
    picture.graph.update(frame_to=TRAY, frame_from=ROOT_NODE, matrix=np.eye(4))
    for tray_box in support_boxes(support, table=False):
        box = trimesh.creation.box(tray_box.size)
        # A glTF material is metallic by default.
        material = trimesh.visual.material.PBRMaterial(
            baseColorFactor=tray_box.color, metallicFactor=0.0, roughnessFactor=0.8
        )
        box.visual = trimesh.visual.TextureVisuals(material=material)
        name = f"{TRAY}/{tray_box.name}"
        picture.geometry[name] = box
        matrix = trimesh.transformations.translation_matrix(tray_box.p_TG)
        picture.graph.update(frame_to=name, frame_from=TRAY, matrix=matrix, geometry=name)


def write_glb(scene: Scene, folder: Path) -> Path:
    """Write `scene.glb` with a named node for the support and for every object.

    The nodes are below the node `tray_frame`, in which the pose of an object's node is X_TO. The y
    axis of glTF points up; `tray_frame` maps T's z axis to it. Returns the path of `scene.glb`.
    """
    picture = trimesh.Scene()
    picture.graph.update(frame_to=ROOT_NODE, matrix=np.linalg.inv(Y_UP_TO_Z_UP))
    for object_class in classes_in_scene(scene):
        picture.geometry[object_class.name] = load_visual(object_class)
    _add_tray(picture, scene.support)
    for scene_object in scene.objects:
        picture.graph.update(
            frame_to=scene_object.name,
            frame_from=ROOT_NODE,
            matrix=rigid_transform(scene_object.X_TO).GetAsMatrix4(),
            geometry=scene_object.object_class.name,
        )
    path = folder / "scene.glb"
    path.write_bytes(picture.export(file_type="glb"))
    return path
