"""The work cell in a plant: robot on its pedestal, gripper, cameras and fixtures.

Frames: T the support, which is the world; B the robot's base; F its flange; G the gripper's cup.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydrake.geometry import Box, CollisionFilterDeclaration, GeometrySet, SceneGraph, Sphere
from pydrake.math import RigidTransform
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import CoulombFriction, MultibodyPlant
from pydrake.multibody.tree import Frame, ModelInstanceIndex, RigidBody
from pydrake.systems.framework import Context

from drake_clutter.cell.epick import epick_sdf
from drake_clutter.cell.kinematics import JOINTS
from drake_clutter.cell.sdf import sdf_text
from drake_clutter.cell.work_cell import WorkCell
from drake_clutter.resources import shipped_path


@dataclass(frozen=True)
class Arm:
    """The arm in a plant.

    Attributes:
        robot: Model instance of the robot.
        tool: Model instance of the gripper.
        bodies: Of both.
        flange: Frame F.
        cup: Frame G.
    """

    robot: ModelInstanceIndex
    tool: ModelInstanceIndex
    bodies: tuple[RigidBody, ...]
    flange: Frame
    cup: Frame


_CLOSE = ("base", "shoulder", "upper_arm", "wrist_1", "wrist_3")
_GREY = np.array([0.45, 0.46, 0.48, 1.0])
_HOUSING = 0.06
"""Radius of the sphere that stands for a camera's housing, behind its lens [m]."""


def add_work_cell(plant: MultibodyPlant, scene_graph: SceneGraph, cell: WorkCell, *, compliant: bool, visuals: bool) -> Arm:
    """Add everything of a cell but its support to a plant that is not finalized.

    Args:
        plant: What to add to.
        scene_graph: Its geometry.
        cell: What to add.
        compliant: Whether the gripper's cup gives way, see `epick_sdf`.
        visuals: Whether cameras are to see the arm, see `add_scene_plant`.
    """
    ur10 = sdf_text(shipped_path("models/ur10.sdf"), visuals=visuals)
    (robot,) = Parser(plant).AddModelsFromString(ur10, "sdf")
    (tool,) = Parser(plant).AddModelsFromString(epick_sdf(cell.gripper, compliant=compliant), "sdf")
    world, X_TB = plant.world_body(), cell.robot.X_TB
    plant.WeldFrames(plant.world_frame(), plant.GetFrameByName("base", robot), X_TB)
    flange = plant.GetFrameByName("flange", robot)
    plant.WeldFrames(flange, plant.GetFrameByName("body", tool))
    for fixture in cell.fixtures:
        assert fixture.box is not None
        shape = Box(*fixture.box)
        _add_solid(plant, fixture.name, fixture.pose.transform, shape, fixture.color)
    for name, camera in cell.cameras.items():
        X_TS = camera.X_TC @ RigidTransform([0.0, 0.0, -_HOUSING / 2])
        _add_solid(plant, "camera" if len(cell.cameras) == 1 else name, X_TS, Sphere(_HOUSING), None)
    pedestal = cell.pedestal
    if pedestal is not None:
        X_TS, size = pedestal
        _add_solid(plant, "pedestal", X_TS, Box(*size), _GREY)
    # Links that cannot meet, though their capsules do; and base and shoulder never leave their place on the pedestal.
    of = {name: GeometrySet(plant.GetCollisionGeometriesForBody(plant.GetBodyByName(name, robot))) for name in _CLOSE}
    of["world"] = GeometrySet(plant.GetCollisionGeometriesForBody(world))
    for first, second in (("base", "upper_arm"), ("wrist_1", "wrist_3"), ("base", "world"), ("shoulder", "world")):
        scene_graph.collision_filter_manager().Apply(CollisionFilterDeclaration().ExcludeBetween(of[first], of[second]))
    bodies = tuple(plant.get_body(index) for model in (robot, tool) for index in plant.GetBodyIndices(model))
    return Arm(robot, tool, bodies, flange, plant.GetFrameByName("cup", tool))


def _add_solid(
    plant: MultibodyPlant,
    name: str,
    X_TS: RigidTransform,
    shape: Box | Sphere,
    color: Sequence[float] | NDArray[np.float64] | None,
) -> None:
    world = plant.world_body()
    plant.RegisterCollisionGeometry(world, X_TS, shape, name, CoulombFriction(0.5, 0.5))
    if color is not None:
        plant.RegisterVisualGeometry(world, X_TS, shape, name, np.asarray(color, float))


def joint_numbers(plant: MultibodyPlant, arm: Arm) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Where q (6,) and v (6,) of the arm lie in the finalized plant's."""
    joints = [plant.GetJointByName(name, arm.robot) for name in JOINTS]
    return np.array([j.position_start() for j in joints]), np.array([j.velocity_start() for j in joints])


def set_joint_angles(plant: MultibodyPlant, context: Context, arm: Arm, q: Sequence[float]) -> None:
    """Puts the arm at q (6,) rad; the rest of the plant stays as it is."""
    positions = plant.GetPositions(context)
    positions[joint_numbers(plant, arm)[0]] = q
    plant.SetPositions(context, positions)
