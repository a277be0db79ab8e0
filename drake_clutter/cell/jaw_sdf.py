"""SDF model of a parallel-jaw gripper: a palm and two jaws on straight guides.

Frames: F is the flange, z out of the arm; G is the tool, midway between the centers of the pads.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform

from drake_clutter.assets.contact_properties import DISSIPATION
from drake_clutter.cell.primitives import LinkPrimitive, sdf_link

Floats = NDArray[np.float64]

_LENGTH = 0.1628
"""Distance from the flange to the tips of the closed jaws [m]; Robotiq 2F-85, manual."""
_PALM_LENGTH = 0.100
"""Distance from the flange to the end of the palm [m]; an assumption."""
_PALM_RADIUS = 0.0375
"""Radius of the palm [m]: half of the diameter of the coupling, 75 mm; Robotiq 2F-85, manual."""
_PAD_WIDTH = 0.022
"""Width of a pad, along x of G [m]; an assumption."""
_PAD_HEIGHT = 0.0375
"""Height of a pad, along z of G [m]; an assumption."""
_JAW_THICKNESS = 0.012
"""Thickness of a jaw with its pad, along y of G [m]; an assumption."""
_JAW_MASS = 0.05
"""Mass of a jaw [kg]; an assumption."""
_COLORS = ("0.20 0.21 0.23 1", "0.70 0.71 0.73 1")
_JAW_LINKS = ("left_jaw", "right_jaw")
_JAW_JOINTS = ("left_jaw_guide", "right_jaw_guide")


@dataclass(frozen=True)
class JawGeometry:
    """Dimensions of a parallel-jaw gripper.

    Attributes:
        stroke: Largest opening of the jaws [m].
        force: Largest force of a jaw [N].
        mass: Mass of the gripper [kg].
        pad_friction: Friction coefficient of the pads.
    """

    stroke: float
    force: float
    mass: float
    pad_friction: float

    @property
    def X_FG(self) -> RigidTransform:
        """Pose of G in the flange."""
        return RigidTransform([0.0, 0.0, _LENGTH - _PAD_HEIGHT / 2])

    @property
    def jaw_links(self) -> tuple[str, str]:
        """Links of the left and the right jaw."""
        return _JAW_LINKS

    @property
    def jaw_joints(self) -> tuple[str, str]:
        """Joints of the left and the right jaw."""
        return _JAW_JOINTS

    @property
    def pad_size(self) -> Floats:
        """Extents of a jaw between the tips and the end of the pad, in G [m]. Shape (3,)."""
        return np.array([_PAD_WIDTH, _JAW_THICKNESS, _PAD_HEIGHT])

    @property
    def palm_distance(self) -> float:
        """Distance from G to the palm [m]."""
        return _LENGTH - _PAD_HEIGHT / 2 - _PALM_LENGTH


def jaw_sdf(geometry: JawGeometry, *, coupled: bool, movable: bool) -> str:
    """Return the SDF model; link `body` has frame F, frame `jaws` is G.

    Args:
        geometry: Dimensions.
        coupled: Whether one jaw mimics the other, as the linkage of the gripper enforces; only a
            simulation in discrete time can.
        movable: Whether the jaws can move; else they are fixed to the palm, opened.
    """
    palm = LinkPrimitive((0.0, 0.0, 0.0), (0.0, 0.0, _PALM_LENGTH), _PALM_RADIUS, _COLORS[0])
    p_FCm = np.array([0.0, 0.0, _PALM_LENGTH / 2])
    body = sdf_link("body", "", geometry.mass - 2 * _JAW_MASS, p_FCm, (palm,), (palm,), "cylinder")
    jaws = "".join(
        _jaw_link(geometry, side) + _jaw_joint(geometry, side, coupled=coupled, movable=movable)
        for side in (0, 1)
    )
    z = _LENGTH - _PAD_HEIGHT / 2
    return f"""<?xml version="1.0"?>
<!-- Written by drake_clutter.cell.jaw_sdf, which names the sources. -->
<sdf version="1.10" xmlns:drake="drake.mit.edu">
  <model name="parallel_jaw">{body}{jaws}
    <frame name="jaws" attached_to="body"><pose>0 0 {z:.9g} 0 0 0</pose></frame>
  </model>
</sdf>
"""


def _jaw_link(geometry: JawGeometry, side: int) -> str:
    """Return the link of a jaw; its origin is at the center of the opened jaw."""
    size = np.array([_PAD_WIDTH, _JAW_THICKNESS, _LENGTH - _PALM_LENGTH])
    sign = (1, -1)[side]
    y = sign * (geometry.stroke / 2 + _JAW_THICKNESS / 2)
    z = (_PALM_LENGTH + _LENGTH) / 2
    extents = " ".join(f"{value:.9g}" for value in size)
    ixx, iyy, izz = _JAW_MASS / 12 * (np.sum(size**2) - size**2)
    shape = f"<geometry><box><size>{extents}</size></box></geometry>"
    return f"""
    <link name="{_JAW_LINKS[side]}">
      <pose relative_to="body">0 {y:.9g} {z:.9g} 0 0 0</pose>
      <inertial>
        <mass>{_JAW_MASS:g}</mass>
        <inertia><ixx>{ixx:.6g}</ixx><ixy>0</ixy><ixz>0</ixz><iyy>{iyy:.6g}</iyy><iyz>0</iyz><izz>{izz:.6g}</izz></inertia>
      </inertial>
      <collision name="jaw">
        {shape}
        <drake:proximity_properties>
          <drake:rigid_hydroelastic/>
          <drake:mesh_resolution_hint>1</drake:mesh_resolution_hint>
          <drake:hunt_crossley_dissipation>{DISSIPATION:g}</drake:hunt_crossley_dissipation>
          <drake:mu_static>{geometry.pad_friction:g}</drake:mu_static>
          <drake:mu_dynamic>{geometry.pad_friction:g}</drake:mu_dynamic>
        </drake:proximity_properties>
      </collision>
      <visual name="jaw">
        {shape}
        <material><diffuse>{_COLORS[1]}</diffuse></material>
      </visual>
    </link>"""


def _jaw_joint(geometry: JawGeometry, side: int, *, coupled: bool, movable: bool) -> str:
    """Return the joint of a jaw; its position is the distance from the opened jaw [m]."""
    link = _JAW_LINKS[side]
    mimic = ""
    if coupled and side == 1:
        mimic = f"""
        <mimic joint="{_JAW_JOINTS[0]}">
          <multiplier>1</multiplier><offset>0</offset><reference>0</reference>
        </mimic>"""
    axis = f"""
      <axis>
        <xyz expressed_in="body">0 {(-1, 1)[side]} 0</xyz>
        <limit>
          <lower>0</lower>
          <upper>{geometry.stroke / 2:.9g}</upper>
          <effort>{geometry.force:g}</effort>
        </limit>{mimic}
      </axis>"""
    return f"""
    <joint name="{_JAW_JOINTS[side]}" type="{"prismatic" if movable else "fixed"}">
      <parent>body</parent>
      <child>{link}</child>{axis if movable else ""}
    </joint>"""
