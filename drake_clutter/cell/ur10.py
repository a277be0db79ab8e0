"""The UR10 as a model: masses, limits, outlines. `models/ur10.sdf` is what `ur10_sdf` writes.

Frames: B the base, z up, as in `kinematics`; L1 to L6 the links, L(i) being frame i - 1 of the convention turned by q(i): its z
is the joint's axis.

Sources: masses, centres of mass and torques, Universal Robots, "DH parameters for calculations of kinematics and dynamics" and
"Max. joint torques"; speeds and ranges, the UR10 data sheet (120 deg/s for the two shoulder joints, 180 deg/s for the others, all
turn by 360 deg both ways). The outlines' radii and lengths were measured on the collision meshes of ROS-Industrial's
`ur_description` (BSD), which the capsules cover.
"""

import math
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from drake_clutter.cell.kinematics import JOINTS, UR10, after_joint
from drake_clutter.cell.rods import Point, Rod, sdf_link, sdf_pose


@dataclass(frozen=True)
class Link:
    """A moving link.

    Attributes:
        name: as in the model.
        mass: kg.
        p_DhCm: (3,) m, centre of mass in the frame of the convention that moves with the link.
        torque: N m, of the joint before it; speed: rad/s.
        outline: capsules that cover it.
        looks: cylinders that it is drawn with.
    """

    name: str
    mass: float
    p_DhCm: Point
    torque: float
    speed: float
    outline: tuple[Rod, ...]
    looks: tuple[Rod, ...]


TUBE, JOINT, CAP = "0.75 0.76 0.78 1", "0.58 0.60 0.63 1", "0.36 0.55 0.74 1"
_SHOULDER_SPEED, _SPEED = math.radians(120), math.radians(180)
LINKS = (
    Link(
        "shoulder",
        7.1,
        (0.021, 0.0, 0.027),
        330.0,
        _SHOULDER_SPEED,
        (Rod((0.0, 0.0, 0.1124), (0.0, -0.0122, 0.1287), 0.107),),
        (
            Rod((0.0, 0.0, 0.0385), (0.0, 0.0, 0.185), 0.0750, JOINT),
            Rod((0.0, 0.0, 0.185), (0.0, 0.0, 0.2150), 0.0700, CAP),
            Rod((0.0, 0.0, 0.1273), (0.0, -0.0855, 0.1273), 0.0750, JOINT),
        ),
    ),
    Link(
        "upper_arm",
        12.7,
        (0.38, 0.0, 0.158),
        330.0,
        _SHOULDER_SPEED,
        (
            Rod((-0.0384, 0.0, 0.1743), (-0.0054, 0.0, 0.1658), 0.114),
            Rod((-0.13, 0.0, 0.1754), (-0.56, 0.0, 0.1784), 0.067),
            Rod((-0.609, 0.0, 0.1699), (-0.5929, 0.0, 0.1775), 0.084),
        ),
        (
            Rod((0.0, 0.0, 0.0865), (0.0, 0.0, 0.232), 0.0745, JOINT),
            Rod((0.0, 0.0, 0.232), (0.0, 0.0, 0.2625), 0.0700, CAP),
            Rod((0.0, 0.0, 0.1760), (-0.612, 0.0, 0.1760), 0.0540, TUBE),
            Rod((-0.612, 0.0, 0.1165), (-0.612, 0.0, 0.218), 0.0600, JOINT),
            Rod((-0.612, 0.0, 0.218), (-0.612, 0.0, 0.2430), 0.0560, CAP),
        ),
    ),
    Link(
        "forearm",
        4.27,
        (0.24, 0.0, 0.068),
        150.0,
        _SPEED,
        (
            Rod((-0.0067, 0.0, 0.0589), (-0.0551, 0.0, 0.0472), 0.088),
            Rod((-0.11, 0.0, 0.0483), (-0.52, 0.0, 0.0481), 0.048),
            Rod((-0.5456, 0.0, 0.0471), (-0.5732, 0.0, 0.0558), 0.072),
        ),
        (
            Rod((0.0, 0.0, -0.0195), (0.0, 0.0, 0.005), 0.0560, CAP),
            Rod((0.0, 0.0, 0.005), (0.0, 0.0, 0.1160), 0.0595, JOINT),
            Rod((0.0, 0.0, 0.0480), (-0.5723, 0.0, 0.0480), 0.0430, TUBE),
            Rod((-0.5723, 0.0, -0.0085), (-0.5723, 0.0, 0.012), 0.0420, CAP),
            Rod((-0.5723, 0.0, 0.012), (-0.5723, 0.0, 0.1095), 0.0450, JOINT),
        ),
    ),
    Link(
        "wrist_1",
        2.0,
        (0.0, 0.007, 0.018),
        56.0,
        _SPEED,
        (Rod((0.0, -0.0142, 0.1639), (0.0, 0.0009, 0.1569), 0.067),),
        (
            Rod((0.0, 0.0, 0.1100), (0.0, 0.0, 0.188), 0.0450, JOINT),
            Rod((0.0, 0.0, 0.188), (0.0, 0.0, 0.2095), 0.0420, CAP),
            Rod((0.0, 0.0, 0.1639), (0.0, -0.0615, 0.1639), 0.0450, JOINT),
        ),
    ),
    Link(
        "wrist_2",
        2.0,
        (0.0, 0.007, 0.018),
        56.0,
        _SPEED,
        (Rod((0.0, -0.0014, 0.109), (0.0, 0.014, 0.1161), 0.067),),
        (
            Rod((0.0, 0.0, 0.0620), (0.0, 0.0, 0.140), 0.0450, JOINT),
            Rod((0.0, 0.0, 0.140), (0.0, 0.0, 0.1615), 0.0420, CAP),
            Rod((0.0, 0.0, 0.1157), (0.0, 0.0615, 0.1157), 0.0450, JOINT),
        ),
    ),
    Link(
        "wrist_3",
        0.365,
        (0.0, 0.0, -0.026),
        56.0,
        _SPEED,
        (Rod((0.0, -0.001, 0.0690), (0.0, -0.001, 0.0712), 0.047),),
        (Rod((0.0, 0.0, 0.0620), (0.0, 0.0, 0.0920), 0.0450, TUBE),),
    ),
)
BASE_MASS = 4.0
BASE_OUTLINE = (Rod((0.0, -0.0247, 0.0091), (0.0, 0.0245, 0.0083), 0.0825),)
BASE_LOOKS = (Rod((0.0, 0.0, 0.0), (0.0, 0.0, 0.0380), 0.0750, JOINT),)
JOINT_RANGE = 2 * math.pi
"""rad, either way."""


def ur10_sdf() -> str:
    """The SDF model, as text. Link `base` is B; frame `flange` is frame 6 of the convention."""
    parts = [sdf_link("base", "", BASE_MASS, np.array([0.0, 0.0, 0.019]), BASE_OUTLINE, BASE_LOOKS)]
    parent, X_PL = "base", np.eye(4)
    for number, (joint, link) in enumerate(zip(JOINTS, LINKS, strict=True)):
        X_LDh = after_joint(UR10, number)
        p_LCm = X_LDh[:3, :3] @ np.array(link.p_DhCm) + X_LDh[:3, 3]
        pose = "\n      " + sdf_pose(X_PL[:3, 3], Rotation.from_matrix(X_PL[:3, :3]), parent)
        parts.append(sdf_link(link.name, pose, link.mass, p_LCm, link.outline, link.looks))
        parts.append(f"""
    <joint name="{joint}" type="revolute">
      <parent>{parent}</parent>
      <child>{link.name}</child>
      <axis>
        <xyz>0 0 1</xyz>
        <limit>
          <lower>{-JOINT_RANGE:.12g}</lower><upper>{JOINT_RANGE:.12g}</upper>
          <effort>{link.torque:g}</effort><velocity>{link.speed:.6g}</velocity>
        </limit>
      </axis>
    </joint>""")
        parent, X_PL = link.name, X_LDh
    return f"""<?xml version="1.0"?>
<!-- Written by drake_clutter.cell.ur10, which names the sources. -->
<sdf version="1.10">
  <model name="ur10">{"".join(parts)}
    <frame name="flange" attached_to="{parent}">
      {sdf_pose(X_PL[:3, 3], Rotation.from_matrix(X_PL[:3, :3]))}
    </frame>
  </model>
</sdf>
"""
