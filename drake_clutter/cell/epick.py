"""The EPick vacuum gripper with tube and cup as a model.

Frames: F the flange that it is screwed to, z out of the arm; G the cup, see `suction`. Sources: see `suction`; the masses of tube
and cup are ours.
"""

import numpy as np
from scipy.spatial.transform import Rotation

from drake_clutter.cell.rods import Rod, sdf_link, sdf_pose
from drake_clutter.cell.suction import EPICK_LENGTH, EPICK_MASS, EPICK_RADIUS, SuctionGripper

TUBE_RADIUS, TUBE_MASS, CUP_MASS = 0.010, 0.05, 0.02
"""m, kg, kg."""
_BODY, _METAL, _RUBBER = "0.20 0.21 0.23 1", "0.70 0.71 0.73 1", "0.12 0.12 0.13 1"
_CRITICAL = 2.0
"""Damping of the bellows, in units of what a load of `_LOAD` would need not to swing."""
_LOAD = 0.5
"""kg."""


def epick_sdf(config: SuctionGripper, *, compliant: bool = True) -> str:
    """The SDF model, as text: link `body` (its frame is F), link `cup` (its frame is G), on the sliding joint `bellows`.

    Args:
        config: the tool.
        compliant: False for a cup that is fixed, as a planner takes it.
    """
    body, tube = Rod((0.0, 0.0, 0.0), (0.0, 0.0, EPICK_LENGTH), EPICK_RADIUS, _BODY), EPICK_LENGTH + config.extension
    stem = Rod((0.0, 0.0, EPICK_LENGTH), (0.0, 0.0, tube), TUBE_RADIUS, _METAL)
    bellows = Rod((0.0, 0.0, -config.cup_length), (0.0, 0.0, 0.0), config.cup_diameter / 2, _RUBBER)
    rods = (body, stem) if config.extension else (body,)
    mass = EPICK_MASS + TUBE_MASS
    p_FCm = np.array([0.0, 0.0, (EPICK_MASS * EPICK_LENGTH / 2 + TUBE_MASS * (EPICK_LENGTH + tube) / 2) / mass])
    cup_pose = "\n      " + sdf_pose(np.array([0.0, 0.0, config.length]), Rotation.identity(), "body")
    damping = _CRITICAL * 2 * (config.stiffness * _LOAD) ** 0.5
    axis = f"""
      <axis>
        <xyz>0 0 1</xyz>
        <limit><lower>{-config.stroke:g}</lower><upper>{config.stroke:g}</upper><effort>0</effort></limit>
        <dynamics><damping>{damping:.6g}</damping><spring_stiffness>{config.stiffness:g}</spring_stiffness></dynamics>
      </axis>"""
    return f"""<?xml version="1.0"?>
<!-- Written by drake_clutter.cell.epick, which names the sources. -->
<sdf version="1.10">
  <model name="epick">{sdf_link("body", "", mass, p_FCm, rods, rods, "cylinder")}{
        sdf_link("cup", cup_pose, CUP_MASS, np.array([0.0, 0.0, -config.cup_length / 2]), (bellows,), (bellows,), "cylinder")
    }
    <joint name="bellows" type="{"prismatic" if compliant else "fixed"}">
      <parent>body</parent>
      <child>cup</child>{axis if compliant else ""}
    </joint>
  </model>
</sdf>
"""
