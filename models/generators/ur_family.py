"""Arms of Universal Robots as models, from their Denavit-Hartenberg parameters.

Frames: B the base as the controller has it, z up; L1 to L6 the links, L(i) being frame i - 1 of the
convention turned by q(i), whose z is the axis of joint i. Frame `flange` is frame 6.
"""

import math
from dataclasses import dataclass

import numpy as np

from arm_sdf import ArmLink, arm_sdf
from drake_clutter.cell.primitives import LinkPrimitive, Point
from drake_clutter.robots.ur_kinematics import (
    UR_JOINT_NAMES,
    DenavitHartenberg,
    fixed_link_transform,
)

JOINT_RANGE = 2 * math.pi
"""Greatest angle of all joints, either way [rad] (data sheets)."""
TUBE_COLOR, JOINT_COLOR, CAP_COLOR = "0.75 0.76 0.78 1", "0.58 0.60 0.63 1", "0.36 0.55 0.74 1"
"""Colors."""


@dataclass(frozen=True)
class UrLink:
    """A moving link.

    Attributes:
        name: As in the model.
        mass: [kg].
        p_DhCm: Center of mass in the frame of the convention that moves with the link [m].
        max_torque: Of the joint before it [N m].
        max_speed: Of the joint before it [rad/s].
        collision_geometry: Capsules that cover it, in its frame L.
        visual_geometry: Cylinders that it is drawn with, in its frame L.
    """

    name: str
    mass: float
    p_DhCm: Point
    max_torque: float
    max_speed: float
    collision_geometry: tuple[LinkPrimitive, ...]
    visual_geometry: tuple[LinkPrimitive, ...]


@dataclass(frozen=True)
class UrArm:
    """An arm of the family.

    Attributes:
        name: Of the model.
        parameters: Denavit-Hartenberg parameters.
        links: From the shoulder to wrist 3.
        base_collision_geometry: Capsules that cover the base.
        base_visual_geometry: Cylinders that the base is drawn with.
        base_mass: [kg].
        written_by: Module that has these numbers.
    """

    name: str
    parameters: DenavitHartenberg
    links: tuple[UrLink, ...]
    base_collision_geometry: tuple[LinkPrimitive, ...]
    base_visual_geometry: tuple[LinkPrimitive, ...]
    base_mass: float
    written_by: str


def ur_sdf(arm: UrArm) -> str:
    """Return the SDF model of an arm, as text."""
    p_BCm = np.array([0.0, 0.0, arm.base_visual_geometry[-1].end[2] / 2])
    made = [
        ArmLink("base", arm.base_mass, p_BCm, arm.base_collision_geometry, arm.base_visual_geometry)
    ]
    X_PL = np.eye(4)
    for number, (joint, link) in enumerate(zip(UR_JOINT_NAMES, arm.links, strict=True)):
        X_LDh = fixed_link_transform(arm.parameters, number)
        p_LCm = X_LDh[:3, :3] @ np.array(link.p_DhCm) + X_LDh[:3, 3]
        shape = link.mass, p_LCm, link.collision_geometry, link.visual_geometry
        made.append(
            ArmLink(link.name, *shape, joint, X_PL, JOINT_RANGE, link.max_torque, link.max_speed)
        )
        X_PL = X_LDh
    return arm_sdf(arm.name, arm.written_by, made, X_PL)
