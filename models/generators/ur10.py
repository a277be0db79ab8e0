"""SDF model of the UR10 (CB series), `models/robots/ur10.sdf`.

Frames: see `ur_family`.

Sources: Masses, centers of mass and torques: Universal Robots, "DH parameters for calculations of
kinematics and dynamics" and "Max. joint torques". Speeds: UR10 data sheet, 120 deg/s for the two
shoulder joints, 180 deg/s for the others. Capsules: they cover the collision meshes of
ROS-Industrial's `ur_description` (BSD). The mass of the base is an assumption.
"""

import math

from drake_clutter.cell.primitives import LinkPrimitive
from drake_clutter.robots.ur_kinematics import UR10_PARAMETERS
from ur_family import CAP_COLOR, JOINT_COLOR, TUBE_COLOR, UrArm, UrLink, ur_sdf
from ur_family import JOINT_RANGE as JOINT_RANGE

_SHOULDER_SPEED = math.radians(120)
"""Velocity limit of the two shoulder joints [rad/s]."""
_WRIST_SPEED = math.radians(180)
"""Velocity limit of the other joints [rad/s]."""
LINKS = (
    UrLink(
        name="shoulder",
        mass=7.1,
        p_DhCm=(0.021, 0.0, 0.027),
        max_torque=330.0,
        max_speed=_SHOULDER_SPEED,
        collision_geometry=(LinkPrimitive((0.0, 0.0, 0.1124), (0.0, -0.0122, 0.1287), 0.107),),
        visual_geometry=(
            LinkPrimitive((0.0, 0.0, 0.0385), (0.0, 0.0, 0.185), 0.0750, JOINT_COLOR),
            LinkPrimitive((0.0, 0.0, 0.185), (0.0, 0.0, 0.2150), 0.0700, CAP_COLOR),
            LinkPrimitive((0.0, 0.0, 0.1273), (0.0, -0.0855, 0.1273), 0.0750, JOINT_COLOR),
        ),
    ),
    UrLink(
        name="upper_arm",
        mass=12.7,
        p_DhCm=(0.38, 0.0, 0.158),
        max_torque=330.0,
        max_speed=_SHOULDER_SPEED,
        collision_geometry=(
            LinkPrimitive((-0.0384, 0.0, 0.1743), (-0.0054, 0.0, 0.1658), 0.114),
            LinkPrimitive((-0.13, 0.0, 0.1754), (-0.56, 0.0, 0.1784), 0.067),
            LinkPrimitive((-0.609, 0.0, 0.1699), (-0.5929, 0.0, 0.1775), 0.084),
        ),
        visual_geometry=(
            LinkPrimitive((0.0, 0.0, 0.0865), (0.0, 0.0, 0.232), 0.0745, JOINT_COLOR),
            LinkPrimitive((0.0, 0.0, 0.232), (0.0, 0.0, 0.2625), 0.0700, CAP_COLOR),
            LinkPrimitive((0.0, 0.0, 0.1760), (-0.612, 0.0, 0.1760), 0.0540, TUBE_COLOR),
            LinkPrimitive((-0.612, 0.0, 0.1165), (-0.612, 0.0, 0.218), 0.0600, JOINT_COLOR),
            LinkPrimitive((-0.612, 0.0, 0.218), (-0.612, 0.0, 0.2430), 0.0560, CAP_COLOR),
        ),
    ),
    UrLink(
        name="forearm",
        mass=4.27,
        p_DhCm=(0.24, 0.0, 0.068),
        max_torque=150.0,
        max_speed=_WRIST_SPEED,
        collision_geometry=(
            LinkPrimitive((-0.0067, 0.0, 0.0589), (-0.0551, 0.0, 0.0472), 0.088),
            LinkPrimitive((-0.11, 0.0, 0.0483), (-0.52, 0.0, 0.0481), 0.048),
            LinkPrimitive((-0.5456, 0.0, 0.0471), (-0.5732, 0.0, 0.0558), 0.072),
        ),
        visual_geometry=(
            LinkPrimitive((0.0, 0.0, -0.0195), (0.0, 0.0, 0.005), 0.0560, CAP_COLOR),
            LinkPrimitive((0.0, 0.0, 0.005), (0.0, 0.0, 0.1160), 0.0595, JOINT_COLOR),
            LinkPrimitive((0.0, 0.0, 0.0480), (-0.5723, 0.0, 0.0480), 0.0430, TUBE_COLOR),
            LinkPrimitive((-0.5723, 0.0, -0.0085), (-0.5723, 0.0, 0.012), 0.0420, CAP_COLOR),
            LinkPrimitive((-0.5723, 0.0, 0.012), (-0.5723, 0.0, 0.1095), 0.0450, JOINT_COLOR),
        ),
    ),
    UrLink(
        name="wrist_1",
        mass=2.0,
        p_DhCm=(0.0, 0.007, 0.018),
        max_torque=56.0,
        max_speed=_WRIST_SPEED,
        collision_geometry=(LinkPrimitive((0.0, -0.0142, 0.1639), (0.0, 0.0009, 0.1569), 0.067),),
        visual_geometry=(
            LinkPrimitive((0.0, 0.0, 0.1100), (0.0, 0.0, 0.188), 0.0450, JOINT_COLOR),
            LinkPrimitive((0.0, 0.0, 0.188), (0.0, 0.0, 0.2095), 0.0420, CAP_COLOR),
            LinkPrimitive((0.0, 0.0, 0.1639), (0.0, -0.0615, 0.1639), 0.0450, JOINT_COLOR),
        ),
    ),
    UrLink(
        name="wrist_2",
        mass=2.0,
        p_DhCm=(0.0, 0.007, 0.018),
        max_torque=56.0,
        max_speed=_WRIST_SPEED,
        collision_geometry=(LinkPrimitive((0.0, -0.0014, 0.109), (0.0, 0.014, 0.1161), 0.067),),
        visual_geometry=(
            LinkPrimitive((0.0, 0.0, 0.0620), (0.0, 0.0, 0.140), 0.0450, JOINT_COLOR),
            LinkPrimitive((0.0, 0.0, 0.140), (0.0, 0.0, 0.1615), 0.0420, CAP_COLOR),
            LinkPrimitive((0.0, 0.0, 0.1157), (0.0, 0.0615, 0.1157), 0.0450, JOINT_COLOR),
        ),
    ),
    UrLink(
        name="wrist_3",
        mass=0.365,
        p_DhCm=(0.0, 0.0, -0.026),
        max_torque=56.0,
        max_speed=_WRIST_SPEED,
        collision_geometry=(LinkPrimitive((0.0, -0.001, 0.0690), (0.0, -0.001, 0.0712), 0.047),),
        visual_geometry=(
            LinkPrimitive((0.0, 0.0, 0.0620), (0.0, 0.0, 0.0920), 0.0450, TUBE_COLOR),
        ),
    ),
)
BASE_COLLISION_GEOMETRY = (LinkPrimitive((0.0, -0.0247, 0.0091), (0.0, 0.0245, 0.0083), 0.0825),)
BASE_VISUAL_GEOMETRY = (LinkPrimitive((0.0, 0.0, 0.0), (0.0, 0.0, 0.0380), 0.0750, JOINT_COLOR),)
UR10_ARM = UrArm(
    name="ur10",
    parameters=UR10_PARAMETERS,
    links=LINKS,
    base_collision_geometry=BASE_COLLISION_GEOMETRY,
    base_visual_geometry=BASE_VISUAL_GEOMETRY,
    base_mass=4.0,
    written_by="models/generators/ur10.py",
)


def ur10_sdf() -> str:
    """Return the SDF model of the UR10, as text."""
    return ur_sdf(UR10_ARM)
