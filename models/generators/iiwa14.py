"""SDF model of the KUKA LBR iiwa 14 R820, `models/robots/iiwa14.sdf`.

Frames: B is the base, z up; L1 to L7 are the links, with z along the axis of the joint that moves
them, placed as in the URDF of the Bullet project (`kuka_iiwa/model.urdf` in `pybullet_data`, BSD).

Sources: Lengths, ranges and speeds: ROS-Industrial's `lbr_iiwa_14_r820.urdf`, after KUKA's
specification. Masses and centers of mass: Bullet's URDF, whose meshes the capsules cover; KUKA
publishes no masses of the links. The torques are assumptions, close to KUKA's specification.
"""

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from arm_sdf import ArmLink, arm_sdf
from drake_clutter.cell.primitives import LinkPrimitive

_ORANGE = "0.90 0.45 0.12 1"
_GREY = "0.62 0.63 0.65 1"
_RANGES_DEG = (170.0, 120.0, 170.0, 120.0, 170.0, 120.0, 175.0)
"""Position limits of the joints in both directions [deg]."""
_SPEEDS_DEG = (85.0, 85.0, 100.0, 75.0, 130.0, 135.0, 135.0)
"""Velocity limits of the joints [deg/s]."""
_TORQUES = (320.0, 320.0, 176.0, 176.0, 110.0, 40.0, 40.0)
"""Torque limits of the joints [N m]."""
_MASSES = (5.0, 4.0, 4.0, 3.0, 2.7, 1.7, 1.8, 0.3)
"""Masses of the links, base first [kg]."""
_CENTERS_OF_MASS = (
    (-0.1, 0.0, 0.07),
    (0.0, -0.03, 0.12),
    (0.0003, 0.059, 0.042),
    (0.0, 0.03, 0.13),
    (0.0, 0.067, 0.034),
    (0.0001, 0.021, 0.076),
    (0.0, 0.0006, 0.0004),
    (0.0, 0.0, 0.02),
)
"""Centers of mass of the links, base first [m]."""
_IDENTITY_RPY = (0, 0, 0)
_TWIST_RPY = (90, 0, 180)
_BEND_RPY = (90, 0, 0)
_FLIP_RPY = (-90, 180, 0)
_LINK_POSES = (
    ((0.0, 0.0, 0.1575), _IDENTITY_RPY),
    ((0.0, 0.0, 0.2025), _TWIST_RPY),
    ((0.0, 0.2045, 0.0), _TWIST_RPY),
    ((0.0, 0.0, 0.2155), _BEND_RPY),
    ((0.0, 0.1845, 0.0), _FLIP_RPY),
    ((0.0, 0.0, 0.2155), _BEND_RPY),
    ((0.0, 0.081, 0.0), _FLIP_RPY),
)
"""Pose of each moving link in its parent: position [m] and roll, pitch, yaw [deg]."""
FLANGE = 0.045
"""Distance from the frame of the last link to the flange [m]."""
COLLISION_GEOMETRY = (
    (LinkPrimitive((-0.037, 0.0001, 0.0673), (0.0002, 0.0, 0.0554), 0.134),),
    (LinkPrimitive((0.0001, -0.0003, 0.0293), (-0.0001, -0.0301, 0.2035), 0.092),),
    (
        LinkPrimitive((0.0005, 0.1857, 0.0), (0.0005, 0.1045, 0.0443), 0.072),
        LinkPrimitive((0.0003, 0.0, 0.0383), (0.0008, 0.0179, 0.0436), 0.095),
    ),
    (LinkPrimitive((0.0, 0.0404, 0.2168), (-0.0001, 0.0001, 0.0391), 0.079),),
    (
        LinkPrimitive((-0.0001, 0.1707, -0.0002), (-0.0002, 0.1146, 0.0408), 0.070),
        LinkPrimitive((0.0, 0.0278, 0.0475), (0.0, -0.0008, 0.033), 0.077),
    ),
    (
        LinkPrimitive((0.0, 0.0643, 0.2155), (-0.0005, 0.058, 0.1338), 0.052),
        LinkPrimitive((0.0, -0.0003, 0.0241), (0.0007, 0.026, 0.0609), 0.073),
    ),
    (LinkPrimitive((0.0001, 0.0226, 0.0), (0.0001, -0.0199, -0.0029), 0.079),),
    (LinkPrimitive((-0.0001, 0.0, 0.0065), (0.0002, 0.0, 0.0066), 0.053),),
)
"""Capsules that cover each link, base first."""
_VISUAL_GEOMETRY = (
    (LinkPrimitive((0.0, 0.0, 0.0), (0.0, 0.0, 0.1500), 0.093, _GREY),),
    (
        LinkPrimitive((0.0, 0.0, 0.0), (0.0, 0.0, 0.2025), 0.063, _GREY),
        LinkPrimitive((0.0, 0.035, 0.2025), (0.0, -0.090, 0.2025), 0.062, _ORANGE),
    ),
    (
        LinkPrimitive((0.0, 0.0, -0.030), (0.0, 0.0, 0.105), 0.060, _ORANGE),
        LinkPrimitive((0.0, 0.0, 0.0), (0.0, 0.2045, 0.0), 0.058, _GREY),
    ),
    (
        LinkPrimitive((0.0, 0.0, 0.010), (0.0, 0.0, 0.1900), 0.050, _GREY),
        LinkPrimitive((0.0, 0.090, 0.2155), (0.0, -0.012, 0.2155), 0.052, _ORANGE),
    ),
    (
        LinkPrimitive((0.0, 0.0, -0.022), (0.0, 0.0, 0.090), 0.050, _ORANGE),
        LinkPrimitive((0.0, 0.02, 0.004), (0.0, 0.1845, 0.004), 0.046, _GREY),
    ),
    (
        LinkPrimitive((0.0, 0.0, 0.0), (0.0, 0.0, 0.060), 0.052, _GREY),
        LinkPrimitive((0.0, 0.060, 0.060), (0.0, 0.060, 0.2455), 0.036, _GREY),
    ),
    (
        LinkPrimitive((0.0, 0.0, -0.050), (0.0, 0.0, 0.050), 0.052, _ORANGE),
        LinkPrimitive((0.0, 0.0, 0.0), (0.0, 0.071, 0.0), 0.052, _GREY),
    ),
    (LinkPrimitive((0.0, 0.0, 0.0), (0.0, 0.0, FLANGE), 0.032, _GREY),),
)
"""Cylinders of the visual geometry of each link, base first."""


def _pose(place: tuple[tuple[float, ...], tuple[int, ...]]) -> NDArray[np.float64]:
    """Return a pose of position [m] and roll, pitch, yaw, multiples of 90 [deg]."""
    position, rpy_deg = place
    X = np.eye(4)
    X[:3, :3] = np.round(Rotation.from_euler("xyz", rpy_deg, degrees=True).as_matrix())
    X[:3, 3] = position
    return X


def iiwa14_sdf() -> str:
    """Return the SDF model, as text."""
    links = []
    for k, mass in enumerate(_MASSES):
        link = ArmLink(
            name=f"link_{k}",
            mass=mass,
            p_LCm=np.array(_CENTERS_OF_MASS[k]),
            collision_geometry=COLLISION_GEOMETRY[k],
            visual_geometry=_VISUAL_GEOMETRY[k],
        )
        if k:
            link = replace(
                link,
                joint=f"joint_{k}",
                X_PL=_pose(_LINK_POSES[k - 1]),
                max_angle=math.radians(_RANGES_DEG[k - 1]),
                max_torque=_TORQUES[k - 1],
                max_speed=math.radians(_SPEEDS_DEG[k - 1]),
            )
        links.append(link)
    X_LF = _pose(((0.0, 0.0, FLANGE), _IDENTITY_RPY))
    return arm_sdf("iiwa14", "models/generators/iiwa14.py", links, X_LF)
