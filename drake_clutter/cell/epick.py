"""SDF model of the Robotiq EPick vacuum gripper with suction cups on tubes.

Frames: F is the flange, z out of the arm; G is a cup, its origin at the center of the lip.

Sources: Dimensions of the body as in PickNik's `epick_description` (BSD). Section and material of
the bars that carry cups beside the axis are assumptions.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from drake_clutter.cell.primitives import LinkPrimitive, Point, sdf_link, sdf_pose
from drake_clutter.cell.suction_cup import SuctionCup

Floats = NDArray[np.float64]

EPICK_LENGTH = 0.1023
"""Length of the body [m]."""
EPICK_RADIUS = 0.044
"""Radius of the body [m]."""
EPICK_MASS = 0.71
"""Mass of the body [kg]."""
BAR_RADIUS = 0.008
"""Radius of the bar between the body and the tube of a cup beside the axis [m]; an assumption."""
_BAR_DENSITY = 2700.0
"""Density of the bar, of aluminum [kg/m^3]; an assumption."""
_MIN_BAR_LENGTH = 1e-6
"""A tube that starts closer to the end of the body needs no bar [m]."""
_BODY_COLOR = "0.20 0.21 0.23 1"
_METAL_COLOR = "0.70 0.71 0.73 1"
_RUBBER_COLOR = "0.12 0.12 0.13 1"


def epick_sdf(cups: Sequence[SuctionCup], *, compliant: bool) -> str:
    """Return the SDF model; link `body` has frame F, and the link of each cup its frame G.

    Args:
        cups: Cups; a bar connects the tube of each with the end of the body.
        compliant: Whether the cups can move along their bellows; else they are fixed to the body.
    """
    parts, masses, centers = _rigid_parts(cups)
    mass = sum(masses)
    p_FCm = np.array(masses) @ np.array(centers) / mass
    links = [sdf_link("body", "", mass, p_FCm, parts, parts, "cylinder")]
    for cup in cups:
        X_FG = cup.X_FG.transform
        rotation = Rotation.from_matrix(X_FG.rotation().matrix())
        pose = "\n      " + sdf_pose(X_FG.translation(), rotation, "body")
        bellows = LinkPrimitive(
            (0.0, 0.0, -cup.length), (0.0, 0.0, 0.0), cup.diameter / 2, _RUBBER_COLOR
        )
        p_GCm = np.array([0.0, 0.0, -cup.length / 2])
        links.append(sdf_link(cup.link, pose, cup.mass, p_GCm, (bellows,), (bellows,), "cylinder"))
    joints = [_bellows_joint(cup, compliant=compliant) for cup in cups]
    return f"""<?xml version="1.0"?>
<!-- Written by drake_clutter.cell.epick, which names the sources. -->
<sdf version="1.10">
  <model name="epick">{"".join(links)}{"".join(joints)}
  </model>
</sdf>
"""


def epick_mass(cups: Sequence[SuctionCup]) -> float:
    """Return the mass of body, bars, tubes and cups [kg]."""
    return sum(_rigid_parts(cups)[1]) + sum(cup.mass for cup in cups)


def _rigid_parts(
    cups: Sequence[SuctionCup],
) -> tuple[tuple[LinkPrimitive, ...], list[float], list[Floats]]:
    """Return primitives, masses [kg] and centers of mass [m] of body, bars and tubes, in F."""
    end = np.array([0.0, 0.0, EPICK_LENGTH])
    parts = [LinkPrimitive((0.0, 0.0, 0.0), _point(end), EPICK_RADIUS, _BODY_COLOR)]
    masses = [EPICK_MASS]
    centers = [end / 2]
    for cup in cups:
        upper, lower = cup.p_FTube
        # The bar leaves the body at a right angle, below its end, if the tube starts there.
        length = float(np.linalg.norm(upper - end))
        bar_mass = _BAR_DENSITY * np.pi * BAR_RADIUS**2 * length
        for start, stop, radius, mass in (
            (end, upper, BAR_RADIUS, bar_mass),
            (upper, lower, cup.tube_radius, cup.tube_mass),
        ):
            if np.linalg.norm(stop - start) > _MIN_BAR_LENGTH:
                parts.append(LinkPrimitive(_point(start), _point(stop), radius, _METAL_COLOR))
                masses.append(float(mass))
                centers.append((start + stop) / 2)
    return tuple(parts), masses, centers


def _point(p: Floats) -> Point:
    x, y, z = p.tolist()
    return x, y, z


def _bellows_joint(cup: SuctionCup, *, compliant: bool) -> str:
    axis = f"""
      <axis>
        <xyz>0 0 1</xyz>
        <limit><lower>{-cup.stroke:g}</lower><upper>{cup.stroke:g}</upper><effort>0</effort></limit>
        <dynamics><damping>{cup.damping:.6g}</damping><spring_stiffness>{cup.stiffness:g}</spring_stiffness></dynamics>
      </axis>"""
    return f"""
    <joint name="{cup.bellows}" type="{"prismatic" if compliant else "fixed"}">
      <parent>body</parent>
      <child>{cup.link}</child>{axis if compliant else ""}
    </joint>"""
