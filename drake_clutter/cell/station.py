"""The work cell as a plant: the UR10 on its pedestal, the EPick, the tray with its objects.

Frames: T the tray, which is the world; B the arm's base; F the flange; G the cup.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from pydrake.geometry import Box, CollisionFilterDeclaration, GeometrySet, SceneGraph, Sphere
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import CoulombFriction, MultibodyPlant
from pydrake.multibody.tree import Frame, ModelInstanceIndex, RigidBody
from pydrake.systems.framework import Context

from drake_clutter.assets.tray import RIM_THICKNESS
from drake_clutter.cell.epick import epick_sdf
from drake_clutter.cell.kinematics import JOINTS
from drake_clutter.cell.sdf import sdf_text
from drake_clutter.cell.suction import SuctionConfig
from drake_clutter.resources import shipped_path

Floats = NDArray[np.float64]


@dataclass
class ArmConfig:
    """The arm in its cell.

    Attributes:
        base: m, m, m, deg: X_TB, a position and a turn about the vertical.
        home: (6,) rad, where a move begins and ends; the camera sees all of the tray then.
        suction: the tool.
        payload: kg, of tool and object together (UR10 data sheet).
    """

    base: list[float] = field(default_factory=lambda: [-0.65, 0.0, 0.30, 0.0])
    home: list[float] = field(default_factory=lambda: [-2.741, -1.766, 2.556, -1.798, -1.349, 0.337])
    suction: SuctionConfig = field(default_factory=SuctionConfig)
    payload: float = 10.0

    @property
    def X_TB(self) -> Floats:
        """(4, 4)."""
        x, y, z, yaw = self.base
        return np.asarray(RigidTransform(RotationMatrix.MakeZRotation(np.radians(yaw)), [x, y, z]).GetAsMatrix4())

    @property
    def X_FG(self) -> Floats:
        """(4, 4), the cup at rest."""
        return np.asarray(RigidTransform([0.0, 0.0, self.suction.length]).GetAsMatrix4())

    def over_tray(self, tray_side: float) -> bool:
        """Whether the pedestal would stand in the tray."""
        return max(abs(self.base[0]), abs(self.base[1])) < tray_side / 2 + RIM_THICKNESS + PEDESTAL_SIDE / 2


@dataclass(frozen=True)
class Arm:
    """The arm in a plant.

    Attributes:
        robot, tool: model instances.
        bodies: of both.
        flange, cup: frames F and G.
    """

    robot: ModelInstanceIndex
    tool: ModelInstanceIndex
    bodies: tuple[RigidBody, ...]
    flange: Frame
    cup: Frame


PEDESTAL_SIDE = 0.16
"""m, of its square section."""
_CLOSE = ("base", "shoulder", "upper_arm", "wrist_1", "wrist_3")
_GREY = np.array([0.45, 0.46, 0.48, 1.0])
_TABLE = (Box(2.4, 2.4, 0.04), RigidTransform([0.0, 0.0, -0.031]))
"""Its upper surface is a millimetre below the tray's floor, which lies on it."""


def add_arm(
    plant: MultibodyPlant,
    scene_graph: SceneGraph,
    config: ArmConfig,
    camera_altitude: float,
    *,
    compliant: bool,
    visuals: bool,
) -> Arm:
    """Adds pedestal, arm, tool, table and the camera's housing to a plant that is not finalized.

    Args:
        plant, scene_graph: what to add to.
        config: the arm.
        camera_altitude: m.
        compliant: see `epick_sdf`.
        visuals: whether cameras are to see the arm, see `add_scene_plant`.
    """
    ur10 = sdf_text(shipped_path("models/ur10.sdf"), visuals=visuals)
    (robot,) = Parser(plant).AddModelsFromString(ur10, "sdf")
    (tool,) = Parser(plant).AddModelsFromString(epick_sdf(config.suction, compliant=compliant), "sdf")
    world, X_TB = plant.world_body(), RigidTransform(config.X_TB)
    plant.WeldFrames(plant.world_frame(), plant.GetFrameByName("base", robot), X_TB)
    flange = plant.GetFrameByName("flange", robot)
    plant.WeldFrames(flange, plant.GetFrameByName("body", tool))
    height = config.base[2] + 0.01
    things = [("table", _TABLE[1], _TABLE[0]), ("camera", RigidTransform([0.0, 0.0, camera_altitude + 0.03]), Sphere(0.06))]
    if height > 0.01:
        pedestal = RigidTransform(X_TB.rotation(), [*config.base[:2], height / 2 - 0.01])
        things.append(("pedestal", pedestal, Box(PEDESTAL_SIDE, PEDESTAL_SIDE, height - 0.002)))
    for name, X_TS, shape in things:
        plant.RegisterCollisionGeometry(world, X_TS, shape, name, CoulombFriction(0.5, 0.5))
        if name == "pedestal":
            plant.RegisterVisualGeometry(world, X_TS, shape, name, _GREY)
    # Links that cannot meet, though their capsules do; and base and shoulder never leave their place on the pedestal.
    of = {name: GeometrySet(plant.GetCollisionGeometriesForBody(plant.GetBodyByName(name, robot))) for name in _CLOSE}
    of["world"] = GeometrySet(plant.GetCollisionGeometriesForBody(world))
    for first, second in (("base", "upper_arm"), ("wrist_1", "wrist_3"), ("base", "world"), ("shoulder", "world")):
        scene_graph.collision_filter_manager().Apply(CollisionFilterDeclaration().ExcludeBetween(of[first], of[second]))
    bodies = tuple(plant.get_body(index) for model in (robot, tool) for index in plant.GetBodyIndices(model))
    return Arm(robot, tool, bodies, flange, plant.GetFrameByName("cup", tool))


def joint_numbers(plant: MultibodyPlant, arm: Arm) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Where q (6,) and v (6,) of the arm lie in the finalized plant's."""
    joints = [plant.GetJointByName(name, arm.robot) for name in JOINTS]
    return np.array([j.position_start() for j in joints]), np.array([j.velocity_start() for j in joints])


def set_joint_angles(plant: MultibodyPlant, context: Context, arm: Arm, q: Sequence[float]) -> None:
    """Puts the arm at q (6,) rad; the rest of the plant stays as it is."""
    positions = plant.GetPositions(context)
    positions[joint_numbers(plant, arm)[0]] = q
    plant.SetPositions(context, positions)
