"""The EPick vacuum gripper with tube and cup as a model.

Frames: F the flange that it is screwed to, z out of the arm; G the cup, see `suction`.

Sources: see `suction`; the masses of tube and cup are assumed.
"""

import numpy as np
from scipy.spatial.transform import Rotation

from drake_clutter.cell.primitives import LinkPrimitive, sdf_link, sdf_pose

EPICK_LENGTH = 0.1023
EPICK_RADIUS = 0.044
EPICK_MASS = 0.71
"""Of the gripper's body [m, m, kg]."""
TUBE_RADIUS, TUBE_MASS, CUP_MASS = 0.010, 0.05, 0.02
"""m, kg, kg."""
_BODY, _METAL, _RUBBER = "0.20 0.21 0.23 1", "0.70 0.71 0.73 1", "0.12 0.12 0.13 1"
_DAMPING_RATIO = 2.0
"""Damping of the bellows, in units of what a load of `_LOAD` would need not to swing."""
_REFERENCE_LOAD = 0.5
"""kg."""


def epick_sdf(
    *,
    extension: float,
    cup_diameter: float,
    cup_length: float,
    stroke: float,
    stiffness: float,
    compliant: bool,
) -> str:
    """Return the SDF model: link `body` has frame F, link `cup` has frame G.

    Args:
        extension: Length of the tube between body and cup [m].
        cup_diameter: Of the lip [m].
        cup_length: Of the cup without a load [m].
        stroke: By which the joint `bellows` between body and cup moves, either way [m].
        stiffness: Of that joint [N/m].
        compliant: False for a cup that is fixed to the body, as planning uses it.
    """
    body = LinkPrimitive((0.0, 0.0, 0.0), (0.0, 0.0, EPICK_LENGTH), EPICK_RADIUS, _BODY)
    tube = EPICK_LENGTH + extension
    stem = LinkPrimitive((0.0, 0.0, EPICK_LENGTH), (0.0, 0.0, tube), TUBE_RADIUS, _METAL)
    bellows = LinkPrimitive((0.0, 0.0, -cup_length), (0.0, 0.0, 0.0), cup_diameter / 2, _RUBBER)
    rods = (body, stem) if extension else (body,)
    mass = EPICK_MASS + TUBE_MASS
    moment = EPICK_MASS * EPICK_LENGTH / 2 + TUBE_MASS * (EPICK_LENGTH + tube) / 2
    p_FCm = np.array([0.0, 0.0, moment / mass])
    p_GCm = np.array([0.0, 0.0, -cup_length / 2])
    body_link = sdf_link("body", "", mass, p_FCm, rods, rods, "cylinder")
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
