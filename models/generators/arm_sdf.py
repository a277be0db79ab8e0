"""SDF models of serial arms: base, links on revolute joints, and the flange frame."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from drake_clutter.cell.primitives import LinkPrimitive, sdf_link, sdf_pose

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class ArmLink:
    """Link L, with the joint between its parent P and itself about the z axis of L.

    Attributes:
        name: Name of the link.
        mass: Mass [kg].
        p_LCm: Center of mass in L [m]. Shape (3,).
        collision_geometry: Capsules that cover the link.
        visual_geometry: Cylinders of the visual geometry.
        joint: Name of the joint; "" for the base.
        X_PL: Pose of L in P when the joint is at 0; None for the base. Shape (4, 4).
        max_angle: Limit of the joint position in both directions [rad].
        max_torque: Torque limit of the joint [N m].
        max_speed: Velocity limit of the joint [rad/s].
    """

    name: str
    mass: float
    p_LCm: Floats
    collision_geometry: tuple[LinkPrimitive, ...]
    visual_geometry: tuple[LinkPrimitive, ...]
    joint: str = ""
    X_PL: Floats | None = None
    max_angle: float = 0.0
    max_torque: float = 0.0
    max_speed: float = 0.0


def arm_sdf(name: str, written_by: str, links: Sequence[ArmLink], X_LF: Floats) -> str:
    """Return the SDF model of an arm, as text.

    Args:
        name: Name of the model.
        written_by: Module with the numbers and their sources.
        links: Links, base first.
        X_LF: Pose of the frame `flange` in the frame of the last link. Shape (4, 4).
    """
    parts = list[str]()
    parent = ""
    for link in links:
        X = link.X_PL
        pose = ""
        if X is not None:
            pose = "\n      " + sdf_pose(X[:3, 3], Rotation.from_matrix(X[:3, :3]), parent)
        parts.append(
            sdf_link(
                link.name,
                pose,
                link.mass,
                link.p_LCm,
                link.collision_geometry,
                link.visual_geometry,
            )
        )
        if link.joint:
            parts.append(_joint_sdf(link, parent))
        parent = link.name
    return f"""<?xml version="1.0"?>
<!-- Written by {written_by}, which names the sources. -->
<sdf version="1.10">
  <model name="{name}">{"".join(parts)}
    <frame name="flange" attached_to="{parent}">
      {sdf_pose(X_LF[:3, 3], Rotation.from_matrix(X_LF[:3, :3]))}
    </frame>
  </model>
</sdf>
"""


def _joint_sdf(link: ArmLink, parent: str) -> str:
    return f"""
    <joint name="{link.joint}" type="revolute">
      <parent>{parent}</parent>
      <child>{link.name}</child>
      <axis>
        <xyz>0 0 1</xyz>
        <limit>
          <lower>{-link.max_angle:.12g}</lower><upper>{link.max_angle:.12g}</upper>
          <effort>{link.max_torque:g}</effort><velocity>{link.max_speed:.6g}</velocity>
        </limit>
      </axis>
    </joint>"""
