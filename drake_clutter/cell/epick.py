"""SDF model of the Robotiq EPick vacuum gripper with suction cups on tubes.

Frames: F is the flange, z out of the arm; G is a cup, its origin at the center of the lip.

Sources: Dimensions of the body as in PickNik's `epick_description` (BSD). Section and material of
the bars that carry cups beside the axis are assumptions.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from drake_clutter.cell.primitives import (
    LinkPrimitive,
    Point,
    sdf_inertial,
    sdf_link,
    sdf_pose,
)
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
        compliant: Whether the bellows of the cups can give and bend; else the cups are fixed to the
            body.
    """
    parts, masses, centers = _rigid_parts(cups)
    mass = sum(masses)
    p_FCm = np.array(masses) @ np.array(centers) / mass
    links = [sdf_link("body", "", mass, p_FCm, parts, parts, "cylinder")]
    joints = list[str]()
    for cup in cups:
        parts_of_cup = _moving_cup(cup) if compliant else _fixed_cup(cup)
        links += parts_of_cup[0]
        joints += parts_of_cup[1]
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


def _fixed_cup(cup: SuctionCup) -> tuple[list[str], list[str]]:
    """Return links and joints of a cup that is fixed to the body."""
    return [_cup_link(cup, cup.link, cup.mass)], [_joint(cup.bellows, "fixed", "body", cup.link)]


def _moving_cup(cup: SuctionCup) -> tuple[list[str], list[str]]:
    """Return links and joints of a cup whose bellows give along their axis and bend.

    The mass is shared equally: every link between the joints needs an inertia.
    """
    slide, gimbal = f"{cup.name}_slide", f"{cup.name}_gimbal"
    links = [
        _cup_link(cup, slide, cup.link_mass, has_shape=False),
        _cup_link(cup, gimbal, cup.link_mass, has_shape=False),
        _cup_link(cup, cup.link, cup.link_mass),
    ]
    about_x, about_y = cup.bending_joints
    limit = f"<lower>{-cup.stroke:g}</lower><upper>{cup.stroke:g}</upper>"
    bending = (cup.hinge_stiffness, cup.bending_damping)
    hinge = f"<pose>0 0 {-cup.hinge_distance:.12g} 0 0 0</pose>"
    return links, [
        _joint(
            cup.bellows,
            "prismatic",
            "body",
            slide,
            _axis("0 0 1", limit, cup.stiffness, cup.damping),
        ),
        _joint(about_x, "revolute", slide, gimbal, hinge + _axis("1 0 0", "", *bending)),
        _joint(about_y, "revolute", gimbal, cup.link, hinge + _axis("0 1 0", "", *bending)),
    ]


def _cup_link(cup: SuctionCup, name: str, mass: float, *, has_shape: bool = True) -> str:
    """Return a link of a cup with frame G."""
    X_FG = cup.X_FG.transform
    rotation = Rotation.from_matrix(X_FG.rotation().matrix())
    pose = "\n      " + sdf_pose(X_FG.translation(), rotation, "body")
    bellows = LinkPrimitive(
        (0.0, 0.0, -cup.length), (0.0, 0.0, 0.0), cup.diameter / 2, _RUBBER_COLOR
    )
    p_GCm = np.array([0.0, 0.0, -cup.length / 2])
    if has_shape:
        return sdf_link(name, pose, mass, p_GCm, (bellows,), (bellows,), "cylinder")
    return f"""
    <link name="{name}">{pose}{sdf_inertial(mass, p_GCm, bellows)}
    </link>"""


def _axis(direction: str, limit: str, stiffness: float, damping: float) -> str:
    """Return an SDF axis element of a joint with a spring."""
    dynamics = f"<damping>{damping:.6g}</damping><spring_stiffness>{stiffness:g}</spring_stiffness>"
    return f"""
      <axis>
        <xyz>{direction}</xyz>
        <limit>{limit}<effort>0</effort></limit>
        <dynamics>{dynamics}</dynamics>
      </axis>"""


def _joint(name: str, kind: str, parent: str, child: str, elements: str = "") -> str:
    """Return an SDF joint element."""
    return f"""
    <joint name="{name}" type="{kind}">
      <parent>{parent}</parent>
      <child>{child}</child>{elements}
    </joint>"""
