"""Meshes and poses of everything in a recorded episode, for 3-D viewers.

Frames: T is the support and the world, B is a body, O is an object.
"""

# trimesh is typed in part only.
# mypy: allow-untyped-calls

from dataclasses import dataclass
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray
from pydrake.geometry import (
    Box,
    Capsule,
    Convex,
    Cylinder,
    Ellipsoid,
    Mesh,
    Role,
    SceneGraphInspector,
    Shape,
    Sphere,
)
from pydrake.multibody.tree import BodyIndex, RigidBody
from pydrake.systems.framework import DiagramBuilder

from drake_clutter.cell.work_cell import WorkCell
from drake_clutter.export.model_parts import load_visual
from drake_clutter.mesh_file import Y_UP_TO_Z_UP
from drake_clutter.recording.recorded_episode import RecordedEpisode
from drake_clutter.scenes.action_samples import ActionSamples
from drake_clutter.scenes.scene import Scene
from drake_clutter.simulation.cell_plant import add_work_cell, joint_state_indices
from drake_clutter.simulation.scene_plant import add_scene_plant

WORLD = "cell"
"""Name of the body of everything that is fixed: support, pedestal and fixtures."""
TOOL = "tool"
"""Name of the tool's frame."""
_ROUGHNESS = 0.8
_DEFAULT_COLOR = (0.6, 0.6, 0.6, 1.0)
"""Color of geometry without one."""
_NUM_SECTIONS = 32
"""Number of sides of a cylinder's mesh."""


@dataclass(frozen=True, eq=False)
class VisualBody:
    """Visual geometry of a body.

    Attributes:
        name: Unique name: `cell`, `robot/LINK`, `gripper/LINK` or `objects/OBJECT`.
        parts: Meshes in B; each has a `PBRMaterial`, with a texture or one color.
    """

    name: str
    parts: tuple[trimesh.Trimesh, ...]


class EpisodeBodies:
    """Bodies of an episode.

    Attributes:
        bodies: All bodies with visual geometry: what is fixed, links of robot and gripper, objects.
    """

    def __init__(self, episode: RecordedEpisode) -> None:
        """Read the models of an episode's cell and objects."""
        cell, scene = episode.cell, episode.initial_scene
        self._cell = _CellBodies(cell, scene)
        self._objects = scene.objects
        self._home = np.array(cell.robot.home)
        objects = (
            VisualBody(f"objects/{o.name}", (load_visual(o.object_class),)) for o in scene.objects
        )
        self.bodies = (*self._cell.bodies, *objects)

    def poses(self, samples: ActionSamples) -> dict[str, NDArray[np.float64]]:
        """Return X_TB of every body that is not fixed, as `POSE_COLUMNS`. Shape of each (m, 7).

        `TOOL` is the frame G of the tool that the action uses. A file of version 1 does not hold
        it, nor the joints of the gripper, which are shown at 0.
        """
        poses = self._cell.link_poses(samples.q, np.nan_to_num(samples.gripper))
        for index, o in enumerate(self._objects):
            poses[f"objects/{o.name}"] = samples.X_TO[:, index]
        if np.isfinite(samples.X_TG).all():
            poses[TOOL] = samples.X_TG
        return poses

    def initial_poses(self) -> dict[str, NDArray[np.float64]]:
        """Return X_TB at the start of the episode, with the arm at home. Shape of each (1, 7)."""
        gripper = np.zeros((1, self._cell.num_gripper_joints))
        poses = self._cell.link_poses(self._home[None], gripper)
        for o in self._objects:
            poses[f"objects/{o.name}"] = np.array([[*o.X_TO.quaternion, *o.X_TO.translation]])
        return poses

    def commanded_tool_path(self, samples: ActionSamples, tool: str) -> NDArray[np.float64]:
        """Return the positions of a tool at the commanded joint positions, in T [m]. Shape (m, 3).

        The springs of a compliant gripper are relaxed. Unknown commands are those of the measured
        positions.
        """
        q = np.where(np.isnan(samples.q_commanded), samples.q, samples.q_commanded)
        return self._cell.tool_positions(q, tool)


class _CellBodies:
    """Bodies of a work cell.

    Attributes:
        bodies: What is fixed, then the links.
        num_gripper_joints: Number of joints of the gripper.
    """

    def __init__(self, cell: WorkCell, scene: Scene) -> None:
        builder = DiagramBuilder()
        scene_plant = add_scene_plant(builder, [], scene.support, 0.01, visuals=True)
        plant = self._plant = scene_plant.plant
        self._arm = add_work_cell(
            plant,
            scene_plant.scene_graph,
            cell.with_support(scene.support),
            compliant=True,
            visuals=True,
        )
        plant.Finalize()
        self._context = plant.GetMyMutableContextFromRoot(builder.Build().CreateDefaultContext())
        self._q_indices, _ = joint_state_indices(plant, self._arm)
        self.num_gripper_joints = plant.num_positions(self._arm.gripper)
        inspector = scene_plant.scene_graph.model_inspector()
        moving = {body.index() for body in self._arm.bodies}
        fixed = list[trimesh.Trimesh]()
        links = list[VisualBody]()
        self._links: dict[str, RigidBody] = {}
        for index in map(BodyIndex, range(plant.num_bodies())):
            body = plant.get_body(index)
            parts = _visual_parts(inspector, plant.GetBodyFrameIdOrThrow(index))
            if index in moving:
                part = "robot" if body.model_instance() == self._arm.robot else "gripper"
                name = f"{part}/{body.name()}"
                if parts:
                    self._links[name] = body
                    links.append(VisualBody(name, tuple(parts)))
            else:
                X_TB = body.EvalPoseInWorld(self._context).GetAsMatrix4()
                fixed += [mesh.apply_transform(X_TB) for mesh in parts]
        self.bodies = (VisualBody(WORLD, tuple(fixed)), *links)

    def link_poses(
        self, q: NDArray[np.float64], gripper: NDArray[np.float64]
    ) -> dict[str, NDArray[np.float64]]:
        """Return X_TB of the links for joint positions (m, n) and (m, k). Shape of each (m, 7)."""
        poses = {name: np.zeros((len(q), 7)) for name in self._links}
        positions = self._plant.GetPositions(self._context)
        for row, (q_row, gripper_row) in enumerate(zip(q, gripper, strict=True)):
            positions[self._q_indices] = q_row
            self._plant.SetPositions(self._context, positions)
            self._plant.SetPositions(self._context, self._arm.gripper, gripper_row)
            for name, body in self._links.items():
                X_TB = body.EvalPoseInWorld(self._context)
                poses[name][row, :4] = X_TB.rotation().ToQuaternion().wxyz()
                poses[name][row, 4:] = X_TB.translation()
        return poses

    def tool_positions(self, q: NDArray[np.float64], tool: str) -> NDArray[np.float64]:
        """Return the positions of a tool for joint positions (m, n) [m]. Shape (m, 3)."""
        positions = np.zeros(self._plant.num_positions())
        points = np.zeros((len(q), 3))
        for row, q_row in enumerate(q):
            positions[self._q_indices] = q_row
            self._plant.SetPositions(self._context, positions)
            X_TG = self._arm.tools[tool].CalcPoseInWorld(self._context)
            points[row] = X_TG.translation()
        return points


def _visual_parts(inspector: SceneGraphInspector, frame: Any) -> list[trimesh.Trimesh]:
    """Return the meshes of a frame's visual geometry, in the frame."""
    parts = list[trimesh.Trimesh]()
    for geometry in inspector.GetGeometries(frame, Role.kIllustration):
        properties = inspector.GetIllustrationProperties(geometry)
        rgba = properties.GetPropertyOrDefault("phong", "diffuse", None)
        color = _DEFAULT_COLOR if rgba is None else (rgba.r(), rgba.g(), rgba.b(), rgba.a())
        X_BG = inspector.GetPoseInFrame(geometry).GetAsMatrix4()
        parts += [
            mesh.apply_transform(X_BG) for mesh in shape_meshes(inspector.GetShape(geometry), color)
        ]
    return parts


def shape_meshes(shape: Shape, color: tuple[float, ...]) -> list[trimesh.Trimesh]:
    """Return the meshes of a shape; those of a file keep their own materials."""
    create = trimesh.creation
    match shape:
        case Box():
            mesh = create.box(shape.size())
        case Cylinder():
            mesh = create.cylinder(shape.radius(), shape.length(), sections=_NUM_SECTIONS)
        case Sphere():
            mesh = create.icosphere(radius=shape.radius())
        case Capsule():
            mesh = create.capsule(shape.length(), shape.radius())
            mesh.apply_translation(-mesh.bounds.mean(axis=0))
        case Ellipsoid():
            mesh = create.icosphere()
            mesh.apply_scale([shape.a(), shape.b(), shape.c()])
        case Mesh() | Convex():
            return _file_meshes(shape, color)
        case _:
            return []
    return [_paint(mesh, color)]


def _file_meshes(shape: Mesh | Convex, color: tuple[float, ...]) -> list[trimesh.Trimesh]:
    """Return the meshes of a mesh file."""
    source = shape.source()
    if not source.is_path():
        return []
    loaded = trimesh.load_scene(source.path())
    meshes = [mesh for mesh in loaded.dump() if isinstance(mesh, trimesh.Trimesh)]
    for mesh in meshes:
        if shape.extension() in (".gltf", ".glb"):
            mesh.apply_transform(Y_UP_TO_Z_UP)
        mesh.apply_scale(shape.scale3())
        if not isinstance(mesh.visual, trimesh.visual.TextureVisuals):
            _paint(mesh, color)
        elif not isinstance(mesh.visual.material, trimesh.visual.material.PBRMaterial):
            mesh.visual.material = mesh.visual.material.to_pbr()
    return meshes


def _paint(mesh: trimesh.Trimesh, color: tuple[float, ...]) -> trimesh.Trimesh:
    """Give a mesh one color, and return it."""
    # A glTF material is metallic by default.
    material = trimesh.visual.material.PBRMaterial(
        baseColorFactor=[round(255 * c) for c in color],
        metallicFactor=0.0,
        roughnessFactor=_ROUGHNESS,
    )
    mesh.visual = trimesh.visual.TextureVisuals(material=material)
    return mesh
