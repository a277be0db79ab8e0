"""Arms of Universal Robots as models, from their Denavit-Hartenberg parameters.

Frames: B the base as the controller has it, z up; L1 to L6 the links, L(i) being frame i - 1 of the
convention turned by q(i), whose z is the axis of joint i. Frame `flange` is frame 6.
"""

import math
from dataclasses import dataclass

import numpy as np

from arm_sdf import ArmLink, arm_sdf
from drake_clutter.cell.primitives import Point, Rod
from drake_clutter.robots.ur_kinematics import (
    UR_JOINT_NAMES,
    DenavitHartenberg,
    fixed_link_transform,
)

JOINT_RANGE = 2 * math.pi
"""Greatest angle of all joints, either way [rad] (data sheets)."""
TUBE, JOINT, CAP = "0.75 0.76 0.78 1", "0.58 0.60 0.63 1", "0.36 0.55 0.74 1"
"""Colors."""


@dataclass(frozen=True)
class Link:
    """A moving link.

    Attributes:
        name: As in the model.
        mass: [kg].
        p_DhCm: Center of mass in the frame of the convention that moves with the link [m].
        torque: Of the joint before it [N m].
        speed: Of the joint before it [rad/s].
        outline: Capsules that cover it, in its frame L.
        looks: Cylinders that it is drawn with, in its frame L.
    """

    name: str
    mass: float
    p_DhCm: Point
    torque: float
    speed: float
    outline: tuple[Rod, ...]
    looks: tuple[Rod, ...]


@dataclass(frozen=True)
class UrArm:
    """An arm of the family.

    Attributes:
        name: Of the model.
        parameters: Denavit-Hartenberg parameters.
        links: From the shoulder to wrist 3.
        base_outline: Capsules that cover the base.
        base_looks: Cylinders that the base is drawn with.
        base_mass: [kg].
        written_by: Module that has these numbers.
    """

    name: str
    parameters: DenavitHartenberg
    links: tuple[Link, ...]
    base_outline: tuple[Rod, ...]
    base_looks: tuple[Rod, ...]
    base_mass: float
    written_by: str


def ur_sdf(arm: UrArm) -> str:
    """Return the SDF model of an arm, as text."""
    p_BCm = np.array([0.0, 0.0, arm.base_looks[-1].end[2] / 2])
    made = [ArmLink("base", arm.base_mass, p_BCm, arm.base_outline, arm.base_looks)]
    X_PL = np.eye(4)
    for number, (joint, link) in enumerate(zip(UR_JOINT_NAMES, arm.links, strict=True)):
        X_LDh = fixed_link_transform(arm.parameters, number)
        p_LCm = X_LDh[:3, :3] @ np.array(link.p_DhCm) + X_LDh[:3, 3]
        shape = link.mass, p_LCm, link.outline, link.looks
        made.append(ArmLink(link.name, *shape, joint, X_PL, JOINT_RANGE, link.torque, link.speed))
        X_PL = X_LDh
    return arm_sdf(arm.name, arm.written_by, made, X_PL)
