"""A scene as a MultibodyPlant diagram: the tray welded to the world, every object a free body."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from pydrake.geometry import SceneGraph
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import AddMultibodyPlant, MultibodyPlant, MultibodyPlantConfig
from pydrake.multibody.tree import QuaternionFloatingJoint, RigidBody
from pydrake.systems.framework import Context, DiagramBuilder

from drake_clutter.catalog import ObjectClass, RestOrientation, Shape
from drake_clutter.cell.sdf_text import read_sdf_text
from drake_clutter.cell.support import Support
from drake_clutter.cell.support_sdf import support_sdf
from drake_clutter.scenes.scene import Pose, SceneObject

ROLLING_DAMPING_TIME = 0.05
"""s, time constant with which a free cylinder that may lie stops rolling: a real marker has a clip and a soft barrel, while
an ideal cylinder rocks on the facets of its contact mesh for seconds. The damping is far too weak to hold up a fall."""


def rigid_transform(pose: Pose) -> RigidTransform:
    """The pose as Drake's type."""
    return RigidTransform(RotationMatrix(pose.rotation), pose.p)


def pose_from_transform(X_AB: RigidTransform) -> Pose:
    """Drake's type as a pose."""
    return Pose.from_rotation(X_AB.rotation().matrix(), X_AB.translation())


@dataclass(frozen=True)
class ScenePlant:
    """A plant with objects on a tray, not finalized.

    Attributes:
        plant: the world frame W is the tray frame T.
        scene_graph: Drake's geometry engine.
        bodies: the free body of each object, by name.
    """

    plant: MultibodyPlant
    scene_graph: SceneGraph
    bodies: dict[str, RigidBody]

    def set_poses(self, context: Context, objects: Sequence[SceneObject]) -> None:
        """Puts the objects at their X_TO, in the plant's context; velocities are untouched."""
        for scene_object in objects:
            self.plant.SetFreeBodyPose(
                context, self.bodies[scene_object.name], rigid_transform(scene_object.X_TO)
            )

    def poses(self, context: Context, names: Iterable[str] | None = None) -> dict[str, Pose]:
        """X_TO of all objects, or of those that are named, by name; from the plant's context."""
        return {
            n: pose_from_transform(self.bodies[n].EvalPoseInWorld(context))
            for n in (self.bodies if names is None else names)
        }

    def speeds(self, context: Context, names: Iterable[str]) -> dict[str, float]:
        """Speed of the origin of each object that is named, m/s."""
        return {
            n: float(
                np.linalg.norm(self.bodies[n].EvalSpatialVelocityInWorld(context).translational())
            )
            for n in names
        }


def get_support_body(plant: MultibodyPlant) -> RigidBody:
    """The support's body; others may have its name in models of their own."""
    return plant.GetBodyByName("tray", plant.GetModelInstanceByName("tray"))


def add_scene_plant(
    builder: DiagramBuilder,
    objects: Sequence[tuple[str, ObjectClass]],
    support: Support,
    time_step: float,
    *,
    visuals: bool,
    jointed: str = "",
) -> ScenePlant:
    """Adds a plant with the tray and the named objects to a diagram.

    Args:
        builder: the diagram's.
        objects: (name, class) of each.
        support: what the objects stand on.
        time_step: s; hydroelastic contact, lagged approximation, as DRAKE_NOTES found to be the truth.
        visuals: whether the textured meshes are added, for cameras and Meshcat.
        jointed: the name of an object that the caller gives a joint.
    """
    config = MultibodyPlantConfig(
        time_step=time_step,
        contact_model="hydroelastic_with_fallback",
        discrete_contact_approximation="lagged",
    )
    plant, scene_graph = AddMultibodyPlant(config, builder)
    return add_objects(plant, scene_graph, objects, support, visuals=visuals, jointed=jointed)


def add_objects(
    plant: MultibodyPlant,
    scene_graph: SceneGraph,
    objects: Sequence[tuple[str, ObjectClass]],
    support: Support,
    *,
    visuals: bool,
    jointed: str = "",
) -> ScenePlant:
    """Adds the tray and the named objects to a plant; arguments as of `add_scene_plant`."""
    (tray,) = Parser(plant).AddModelsFromString(support_sdf(support), "sdf")
    plant.WeldFrames(plant.world_frame(), plant.GetFrameByName("tray", tray))
    bodies = {}
    for name, object_class in objects:
        text = read_sdf_text(object_class.model_path, visuals=visuals)
        (instance,) = Parser(plant, model_name_prefix=name).AddModelsFromString(text, "sdf")
        bodies[name] = plant.GetBodyByName("body", instance)
        if (
            name != jointed
            and object_class.shape is Shape.CYLINDER
            and object_class.only_rest is not RestOrientation.UPRIGHT
        ):
            radius = object_class.size[0] / 2
            rolling_inertia = (
                1.5 * object_class.mass * radius**2
            )  # of a solid cylinder about its line of contact
            plant.AddJoint(
                QuaternionFloatingJoint(
                    f"{name}_floating",
                    plant.world_frame(),
                    bodies[name].body_frame(),
                    rolling_inertia / ROLLING_DAMPING_TIME,
                )
            )
    return ScenePlant(plant, scene_graph, bodies)
