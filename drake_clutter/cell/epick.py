"""SDF model of the Robotiq EPick vacuum gripper with tube and suction cup.

Frames: F is the flange, z out of the arm; G is the gripper, its origin at the center of the lip.

Sources: Dimensions of the body as in PickNik's `epick_description` (BSD). The masses of tube and
cup are assumptions.
"""

import numpy as np
from scipy.spatial.transform import Rotation

from drake_clutter.cell.primitives import LinkPrimitive, sdf_link, sdf_pose

EPICK_LENGTH = 0.1023
"""Length of the body [m]."""
EPICK_RADIUS = 0.044
"""Radius of the body [m]."""
EPICK_MASS = 0.71
"""Mass of the body [kg]."""
TUBE_RADIUS = 0.010
"""Radius of the extension tube [m]."""
TUBE_MASS = 0.05
"""Mass of the extension tube [kg]; an assumption."""
CUP_MASS = 0.02
"""Mass of the suction cup [kg]; an assumption."""
_BODY_COLOR = "0.20 0.21 0.23 1"
_METAL_COLOR = "0.70 0.71 0.73 1"
_RUBBER_COLOR = "0.12 0.12 0.13 1"
_DAMPING_RATIO = 2.0
"""Damping ratio of the bellows with `_REFERENCE_LOAD`: overdamped, as rubber is."""
_REFERENCE_LOAD = 0.5
"""Load for which the damping ratio holds [kg]; about that of a sugar box."""


def epick_sdf(
    *,
    extension: float,
    cup_diameter: float,
    cup_length: float,
    stroke: float,
    stiffness: float,
    compliant: bool,
) -> str:
    """Return the SDF model; link `body` has frame F, link `cup` has frame G.

    Args:
        extension: Length of the tube between body and cup [m].
        cup_diameter: Diameter of the lip [m].
        cup_length: Length of the cup without load [m].
        stroke: Range of the joint `bellows` between body and cup, in either direction [m].
        stiffness: Stiffness of that joint [N/m].
        compliant: Whether the cup can move; else it is fixed to the body.
    """
    body = LinkPrimitive((0.0, 0.0, 0.0), (0.0, 0.0, EPICK_LENGTH), EPICK_RADIUS, _BODY_COLOR)
    tube = EPICK_LENGTH + extension
    stem = LinkPrimitive((0.0, 0.0, EPICK_LENGTH), (0.0, 0.0, tube), TUBE_RADIUS, _METAL_COLOR)
    bellows = LinkPrimitive(
        (0.0, 0.0, -cup_length), (0.0, 0.0, 0.0), cup_diameter / 2, _RUBBER_COLOR
    )
    parts = (body, stem) if extension else (body,)
    mass = EPICK_MASS + TUBE_MASS
    moment = EPICK_MASS * EPICK_LENGTH / 2 + TUBE_MASS * (EPICK_LENGTH + tube) / 2
    p_FCm = np.array([0.0, 0.0, moment / mass])
    p_GCm = np.array([0.0, 0.0, -cup_length / 2])
    body_link = sdf_link("body", "", mass, p_FCm, parts, parts, "cylinder")
    cup = (bellows,)
    p_FG = np.array([0.0, 0.0, tube + cup_length])
    cup_pose = "\n      " + sdf_pose(p_FG, Rotation.identity(), "body")
    cup_link = sdf_link("cup", cup_pose, CUP_MASS, p_GCm, cup, cup, "cylinder")
    lower = f"<lower>{-stroke:g}</lower>"
    damping = f"<damping>{_DAMPING_RATIO * 2 * (stiffness * _REFERENCE_LOAD) ** 0.5:.6g}</damping>"
    axis = f"""
      <axis>
        <xyz>0 0 1</xyz>
        <limit>{lower}<upper>{stroke:g}</upper><effort>0</effort></limit>
        <dynamics>{damping}<spring_stiffness>{stiffness:g}</spring_stiffness></dynamics>
      </axis>"""
    return f"""<?xml version="1.0"?>
<!-- Written by drake_clutter.cell.epick, which names the sources. -->
<sdf version="1.10">
  <model name="epick">{body_link}{cup_link}
    <joint name="bellows" type="{"prismatic" if compliant else "fixed"}">
      <parent>body</parent>
      <child>cup</child>{axis if compliant else ""}
    </joint>
  </model>
</sdf>
"""
