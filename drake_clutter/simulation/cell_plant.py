"""The work cell in a plant: robot on its pedestal, gripper, cameras and fixtures.

Frames: T is the support's frame and the world, B the robot's base, F its flange, G a tool of the
gripper.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydrake.geometry import Box, RoleAssign, SceneGraph, Sphere
from pydrake.math import RigidTransform
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph, MultibodyPlant
from pydrake.multibody.tree import Frame, ModelInstanceIndex, PdControllerGains, RigidBody
from pydrake.systems.framework import Context, DiagramBuilder

from drake_clutter.cell.fixture import Fixture
from drake_clutter.cell.work_cell import WorkCell
from drake_clutter.files import InputError
from drake_clutter.robots.model_parsing import parse_model
from drake_clutter.robots.robot_model import load_robot
from drake_clutter.robots.robot_plant import PEDESTAL_NAME, add_robot, filter_collisions
from drake_clutter.simulation.scene_plant import FRICTION, rigid_contact_properties

JOINT_STIFFNESS = 1e5
"""Proportional gain of the joint position control [N m/rad]: stiff, as that of industrial arms."""
JOINT_DAMPING = 2e3
"""Derivative gain of the joint position control [N m s/rad]."""
JAW_STIFFNESS = 4e4
"""Proportional gain of the position control of jaws [N/m]."""
JAW_DAMPING = 200.0
"""Derivative gain of the position control of jaws [N s/m]."""


@dataclass(frozen=True)
class Arm:
    """The arm in a plant, and the bodies around it.

    Attributes:
        robot: Model instance of the robot.
        gripper: Model instance of the gripper.
        joints: Names of the robot's joints, in the order of q.
        bodies: Bodies of robot and gripper.
        fixed: The world, to which the boxes of the cell are fixed, and bodies of fixtures with a
            model.
        flange: Frame F.
        tools: Frame G of each tool, by name; the first is preferred.
    """

    robot: ModelInstanceIndex
    gripper: ModelInstanceIndex
    joints: tuple[str, ...]
    bodies: tuple[RigidBody, ...]
    fixed: tuple[RigidBody, ...]
    flange: Frame
    tools: Mapping[str, Frame]


_PEDESTAL_COLOR = (0.45, 0.46, 0.48, 1.0)
_FIXTURE_PREFIX = "fixtures."
"""Prefix of the model instances of fixtures, which no other model instance has."""
_CAMERA_HOUSING_RADIUS = 0.06
"""Radius of the sphere that represents a camera's housing behind its lens [m]."""


def add_work_cell(
    plant: MultibodyPlant,
    scene_graph: SceneGraph,
    cell: WorkCell,
    *,
    compliant: bool,
    visuals: bool,
) -> Arm:
    """Add everything of a cell but its support to a plant that is not finalized.

    Args:
        plant: The plant.
        scene_graph: Its geometry engine.
        cell: The work cell.
        compliant: Whether the gripper is compliant, see `Gripper.model_sdf`.
        visuals: Whether to add visual geometry, see `add_scene_plant`.

    Raises:
        InputError: A model file cannot be used.
    """
    model = load_robot(cell.robot)
    robot = add_robot(plant, model, visuals=visuals)
    if not any(plant.GetCollisionGeometriesForBody(body) for body in _bodies(plant, robot)):
        problem = f"robot.model: {cell.robot.model!r}: no link has collision geometry"
        raise InputError(f"{problem}; expected a model with collision geometry")
    sdf = cell.gripper.model_sdf(compliant=compliant, actuated=True)
    (gripper,) = Parser(plant).AddModelsFromString(sdf, "sdf")
    flange = plant.GetFrameByName(cell.robot.tool_frame, robot)
    plant.WeldFrames(flange, plant.GetFrameByName("body", gripper))
    fixed = [plant.world_body()]
    for fixture in cell.fixtures:
        if fixture.box is None:
            fixed += _add_model(plant, scene_graph, fixture, visuals=visuals)
        else:
            shape = Box(*fixture.box)
            _add_solid(plant, fixture.name, fixture.pose.transform, shape, fixture.color)
    for name, camera in cell.cameras.items():
        X_TS = camera.X_TC @ RigidTransform([0.0, 0.0, -_CAMERA_HOUSING_RADIUS / 2])
        name = "camera" if len(cell.cameras) == 1 else name
        _add_solid(plant, name, X_TS, Sphere(_CAMERA_HOUSING_RADIUS), None)
    pedestal = cell.pedestal
    if pedestal is not None:
        X_TS, size = pedestal
        _add_solid(plant, PEDESTAL_NAME, X_TS, Box(*size), _PEDESTAL_COLOR)
    filter_collisions(plant, scene_graph, model, robot)
    bodies = _bodies(plant, robot, gripper)
    tools = {
        name: plant.GetFrameByName(tool.frame, gripper) for name, tool in cell.gripper.tools.items()
    }
    return Arm(robot, gripper, model.joint_names, bodies, tuple(fixed), flange, tools)


def set_position_gains(plant: MultibodyPlant, arm: Arm) -> None:
    """Give the actuators of arm and jaws position control, before the plant is finalized."""
    gains = {
        arm.robot: PdControllerGains(p=JOINT_STIFFNESS, d=JOINT_DAMPING),
        arm.gripper: PdControllerGains(p=JAW_STIFFNESS, d=JAW_DAMPING),
    }
    for index in plant.GetJointActuatorIndices():
        actuator = plant.get_joint_actuator(index)
        if actuator.model_instance() in gains:
            actuator.set_controller_gains(gains[actuator.model_instance()])


def fixture_name(plant: MultibodyPlant, body: RigidBody) -> str:
    """Return the name of the fixture whose model a body belongs to."""
    return str(plant.GetModelInstanceName(body.model_instance())).removeprefix(_FIXTURE_PREFIX)


def validate_models(cell: WorkCell) -> None:
    """Parse all models of a cell.

    Raises:
        InputError: A model cannot be used, or does not fit the cell's description of it.
    """
    plant, scene_graph = AddMultibodyPlantSceneGraph(DiagramBuilder(), 0.001)
    add_work_cell(plant, scene_graph, cell, compliant=False, visuals=True)


def _bodies(plant: MultibodyPlant, *models: ModelInstanceIndex) -> tuple[RigidBody, ...]:
    """Return the bodies of model instances."""
    return tuple(plant.get_body(i) for model in models for i in plant.GetBodyIndices(model))


def _add_solid(
    plant: MultibodyPlant,
    name: str,
    X_TS: RigidTransform,
    shape: Box | Sphere,
    color: Sequence[float] | None,
) -> None:
    """Add a shape that is fixed to the world, with visual geometry if it has a color."""
    world = plant.world_body()
    plant.RegisterCollisionGeometry(world, X_TS, shape, name, rigid_contact_properties(FRICTION))
    if color is not None:
        plant.RegisterVisualGeometry(world, X_TS, shape, name, np.array(color))


def _add_model(
    plant: MultibodyPlant, scene_graph: SceneGraph, fixture: Fixture, *, visuals: bool
) -> tuple[RigidBody, ...]:
    """Add a fixture's model, fixed to the world, and return its bodies.

    `fixture_name` returns the fixture's name for each of these bodies.
    """
    field = f"fixtures.{fixture.name}.model"
    instance = parse_model(plant, fixture.model, visuals=visuals, field=field)
    plant.RenameModelInstance(instance, f"{_FIXTURE_PREFIX}{fixture.name}")
    bodies = _bodies(plant, instance)
    joints = [plant.get_joint(index) for index in plant.GetJointIndices(instance)]
    if any(joint.parent_body().index() == plant.world_body().index() for joint in joints):
        problem = f"{field}: {fixture.model!r} is fixed to the world"
        raise InputError(f"{problem}; expected a model without joints to the world")
    has_model_frame = plant.HasFrameNamed("__model__", instance)
    frame = (
        plant.GetFrameByName("__model__", instance) if has_model_frame else bodies[0].body_frame()
    )
    plant.WeldFrames(plant.world_frame(), frame, fixture.pose.transform)
    joints = [plant.get_joint(index) for index in plant.GetJointIndices(instance)]
    if len(joints) != len(bodies) or any(joint.num_positions() for joint in joints):
        raise InputError(f"{field}: {fixture.model!r} has movable joints; expected a rigid model")
    _complete_contact_properties(plant, scene_graph, bodies)
    return bodies


def _complete_contact_properties(
    plant: MultibodyPlant, scene_graph: SceneGraph, bodies: Sequence[RigidBody]
) -> None:
    """Make geometry of fixed bodies rigid hydroelastic where the model does not declare it."""
    inspector = scene_graph.model_inspector()
    for body in bodies:
        for geometry in plant.GetCollisionGeometriesForBody(body):
            own = inspector.GetProximityProperties(geometry)
            if own.HasProperty("hydroelastic", "compliance_type"):
                continue
            friction = own.GetProperty("material", "coulomb_friction")
            properties = rigid_contact_properties(friction)
            scene_graph.AssignRole(plant.get_source_id(), geometry, properties, RoleAssign.kReplace)


def joint_state_indices(
    plant: MultibodyPlant, arm: Arm
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the indices of the arm's q (n,) and v (n,) in the plant's state."""
    joints = [plant.GetJointByName(name, arm.robot) for name in arm.joints]
    return np.array([j.position_start() for j in joints]), np.array(
        [j.velocity_start() for j in joints]
    )


def set_joint_angles(plant: MultibodyPlant, context: Context, arm: Arm, q: Sequence[float]) -> None:
    """Set the arm's joint angles q (n,) [rad]; the rest of the plant is unchanged."""
    positions = plant.GetPositions(context)
    positions[joint_state_indices(plant, arm)[0]] = q
    plant.SetPositions(context, positions)
