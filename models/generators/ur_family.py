"""SDF models of Universal Robots arms from their Denavit-Hartenberg parameters.

Frames: B is the base as in the controller, z up; L1 to L6 are the links, where L(i) is
Denavit-Hartenberg frame i - 1 rotated by q(i) about its z axis, the axis of joint i. Frame `flange`
is frame 6.
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
"""Position limit of the joints in both directions [rad] (data sheets)."""
ELBOW_JOINT = "elbow_joint"
ELBOW_RANGE = math.pi
"""Position limit of the elbow in both directions [rad]: half of the data sheets', as in
ur_description. Nearer to a full turn, the forearm would have to pass through the upper arm."""
TUBE_COLOR = "0.75 0.76 0.78 1"
JOINT_COLOR = "0.58 0.60 0.63 1"
CAP_COLOR = "0.36 0.55 0.74 1"


@dataclass(frozen=True)
class UrLink:
    """Moving link of a Universal Robots arm.

    Attributes:
        name: Name of the link.
        mass: Mass [kg].
        p_DhCm: Center of mass in the Denavit-Hartenberg frame that moves with the link [m].
        max_torque: Torque limit of the joint that moves the link [N m].
        max_speed: Velocity limit of that joint [rad/s].
        collision_geometry: Capsules that cover the link, in its frame L.
        visual_geometry: Cylinders of the visual geometry, in frame L.
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
    """Universal Robots arm.

    Attributes:
        name: Name of the model.
        parameters: Denavit-Hartenberg parameters.
        links: Moving links, from the shoulder to wrist 3.
        base_collision_geometry: Capsules that cover the base.
        base_visual_geometry: Cylinders of the visual geometry of the base.
        base_mass: Mass of the base [kg].
        written_by: Module with these numbers and their sources.
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
    links = [
        ArmLink(
            name="base",
            mass=arm.base_mass,
            p_LCm=p_BCm,
            collision_geometry=arm.base_collision_geometry,
            visual_geometry=arm.base_visual_geometry,
        )
    ]
    X_PL = np.eye(4)
    for number, (joint, link) in enumerate(zip(UR_JOINT_NAMES, arm.links, strict=True)):
        X_LDh = fixed_link_transform(arm.parameters, number)
        links.append(
            ArmLink(
                name=link.name,
                mass=link.mass,
                p_LCm=X_LDh[:3, :3] @ np.array(link.p_DhCm) + X_LDh[:3, 3],
                collision_geometry=link.collision_geometry,
                visual_geometry=link.visual_geometry,
                joint=joint,
                X_PL=X_PL,
                max_angle=ELBOW_RANGE if joint == ELBOW_JOINT else JOINT_RANGE,
                max_torque=link.max_torque,
                max_speed=link.max_speed,
            )
        )
        X_PL = X_LDh
    return arm_sdf(arm.name, arm.written_by, links, X_PL)
