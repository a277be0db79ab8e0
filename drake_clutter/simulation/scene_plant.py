"""A scene as a MultibodyPlant: the support is fixed, every object is free."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydrake.geometry import (
    AddContactMaterial,
    AddRigidHydroelasticProperties,
    Box,
    ProximityProperties,
    SceneGraph,
)
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import (
    AddMultibodyPlant,
    CoulombFriction,
    MultibodyPlant,
    MultibodyPlantConfig,
)
from pydrake.multibody.tree import QuaternionFloatingJoint, RigidBody
from pydrake.systems.framework import Context, DiagramBuilder

from drake_clutter.assets.contact_properties import (
    DISSIPATION,
    FIXTURE_RESOLUTION,
    SURFACE_FRICTION,
)
from drake_clutter.catalog import ObjectClass, RestOrientation, Shape
from drake_clutter.cell.sdf_text import read_sdf_text
from drake_clutter.cell.support import Support
from drake_clutter.cell.support_sdf import support_sdf, table_box
from drake_clutter.files import reading_file
from drake_clutter.scenes.scene import Pose, SceneObject

ROLLING_DAMPING_TIME = 0.05
"""Time constant with which a cylinder that may lie stops rolling [s].

A real marker has a clip and a soft barrel, while an ideal cylinder rocks on the facets of its
contact mesh for seconds. The damping is far too weak to hold up a fall.
"""


def rigid_transform(pose: Pose) -> RigidTransform:
    """Return a pose as a Drake `RigidTransform`."""
    return RigidTransform(RotationMatrix(pose.rotation), pose.p)


def pose_from_transform(X_AB: RigidTransform) -> Pose:
    """Return a Drake `RigidTransform` as a pose."""
    return Pose.from_rotation(X_AB.rotation().matrix(), X_AB.translation())


@dataclass(frozen=True)
class ScenePlant:
    """A plant with objects on a support, not yet finalized.

    Attributes:
        plant: The plant; its world frame is the support's frame T.
        scene_graph: The geometry engine.
        bodies: Free body of each object, by name.
    """

    plant: MultibodyPlant
    scene_graph: SceneGraph
    bodies: dict[str, RigidBody]

    def set_poses(self, context: Context, objects: Sequence[SceneObject]) -> None:
        """Set the poses of objects in the plant's context; velocities are unchanged."""
        for scene_object in objects:
            self.plant.SetFreeBodyPose(
                context, self.bodies[scene_object.name], rigid_transform(scene_object.X_TO)
            )

    def poses(self, context: Context, names: Iterable[str] | None = None) -> dict[str, Pose]:
        """Return X_TO of all or of the named objects, by name.

        Args:
            context: Context of the plant.
            names: Names of objects, or None for all.
        """
        return {
            n: pose_from_transform(self.bodies[n].EvalPoseInWorld(context))
            for n in (self.bodies if names is None else names)
        }

    def positions(self, context: Context, names: Iterable[str]) -> dict[str, NDArray[np.float64]]:
        """Return the positions of the origins of the named objects [m]. Shapes (3,)."""
        return {n: self.bodies[n].EvalPoseInWorld(context).translation() for n in names}

    def speeds(self, context: Context, names: Iterable[str]) -> dict[str, float]:
        """Return the speeds of the origins of the named objects [m/s]."""
        return {
            n: float(
                np.linalg.norm(self.bodies[n].EvalSpatialVelocityInWorld(context).translational())
            )
            for n in names
        }


FRICTION = CoulombFriction(SURFACE_FRICTION, SURFACE_FRICTION)
"""Friction of every surface."""


def rigid_contact_properties(friction: CoulombFriction) -> ProximityProperties:
    """Return the contact properties of fixed geometry.

    Objects are compliant. Without hydroelastic properties on the other side, their contact has a
    single point, through which a box sinks while it rocks.

    Args:
        friction: Friction of the surface.
    """
    properties = ProximityProperties()
    AddRigidHydroelasticProperties(FIXTURE_RESOLUTION, properties)
    AddContactMaterial(dissipation=DISSIPATION, friction=friction, properties=properties)
    return properties


def add_table(plant: MultibodyPlant, support: Support) -> None:
    """Add the table under a support, where objects lie that left it, to a plant without a cell."""
    name, size, p_TG = table_box(support)
    plant.RegisterCollisionGeometry(
        plant.world_body(),
        RigidTransform(p_TG),
        Box(*size),
        name,
        rigid_contact_properties(FRICTION),
    )


def get_support_body(plant: MultibodyPlant) -> RigidBody:
    """Return the body of the support; models may have other bodies of the same name."""
    return plant.GetBodyByName("tray", plant.GetModelInstanceByName("tray"))


def add_scene_plant(
    builder: DiagramBuilder,
    objects: Sequence[tuple[str, ObjectClass]],
    support: Support,
    time_step: float,
    *,
    visuals: bool,
    object_with_joint: str = "",
) -> ScenePlant:
    """Add a plant with the support and the named objects to a diagram.

    Contact is hydroelastic where possible, with Drake's lagged discrete contact approximation.

    Args:
        builder: The diagram's builder.
        objects: Name and class of each object.
        support: Support of the objects.
        time_step: Time step of the simulation [s].
        visuals: Whether to add the textured meshes, for cameras and Meshcat.
        object_with_joint: Name of an object to which the caller adds a joint of its own.
    """
    config = MultibodyPlantConfig(
        time_step=time_step,
        contact_model="hydroelastic_with_fallback",
        discrete_contact_approximation="lagged",
    )
    plant, scene_graph = AddMultibodyPlant(config, builder)
    return add_objects(
        plant, scene_graph, objects, support, visuals=visuals, object_with_joint=object_with_joint
    )


def add_fixed_objects(
    plant: MultibodyPlant, objects: Iterable[SceneObject]
) -> dict[str, RigidBody]:
    """Add objects that are fixed at their poses to a plant, and return their bodies by name.

    They collide with other bodies, but have no state.

    Args:
        plant: The plant.
        objects: Objects at their poses.
    """
    bodies = {}
    for o in objects:
        text = read_sdf_text(o.object_class.verified_sdf_path, visuals=False)
        (instance,) = Parser(plant, model_name_prefix=o.name).AddModelsFromString(text, "sdf")
        bodies[o.name] = plant.GetBodyByName("body", instance)
        plant.WeldFrames(plant.world_frame(), bodies[o.name].body_frame(), rigid_transform(o.X_TO))
    return bodies


def add_objects(
    plant: MultibodyPlant,
    scene_graph: SceneGraph,
    objects: Sequence[tuple[str, ObjectClass]],
    support: Support,
    *,
    visuals: bool,
    object_with_joint: str = "",
) -> ScenePlant:
    """Add the support and the named objects to a plant.

    Args:
        plant: The plant.
        scene_graph: Its geometry engine.
        objects: See `add_scene_plant`.
        support: See `add_scene_plant`.
        visuals: See `add_scene_plant`.
        object_with_joint: See `add_scene_plant`.
    """
    (tray,) = Parser(plant).AddModelsFromString(support_sdf(support, table=False), "sdf")
    plant.WeldFrames(plant.world_frame(), plant.GetFrameByName("tray", tray))
    bodies = {}
    for name, object_class in objects:
        path = object_class.verified_sdf_path
        with reading_file(path, "a model as `drake-clutter assets build` writes it"):
            text = read_sdf_text(path, visuals=visuals)
            (instance,) = Parser(plant, model_name_prefix=name).AddModelsFromString(text, "sdf")
            bodies[name] = plant.GetBodyByName("body", instance)
        if (
            name != object_with_joint
            and object_class.shape is Shape.CYLINDER
            and object_class.only_rest is not RestOrientation.UPRIGHT
        ):
            # Inertia of a solid cylinder about its line of contact.
            radius = object_class.size[0] / 2
            rolling_inertia = 1.5 * object_class.mass * radius**2
            plant.AddJoint(
                QuaternionFloatingJoint(
                    f"{name}_floating",
                    plant.world_frame(),
                    bodies[name].body_frame(),
                    rolling_inertia / ROLLING_DAMPING_TIME,
                )
            )
    return ScenePlant(plant, scene_graph, bodies)
