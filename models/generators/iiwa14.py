"""The KUKA LBR iiwa 14 R820, an arm with seven joints, as a model: `models/robots/iiwa14.sdf`.

Frames: B the base, z up; L1 to L7 the links, z the axis of the joint before each, placed as in the
URDF of the Bullet project (`kuka_iiwa/model.urdf` in `pybullet_data`, BSD).

Sources: lengths, ranges and speeds, ROS-Industrial's `lbr_iiwa_14_r820.urdf`, after KUKA's
specification; torques, from memory of that specification; masses and centers of mass, Bullet's
URDF, whose meshes the capsules cover. KUKA publishes no masses of the links.
"""

import math

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from arm_sdf import ArmLink, arm_sdf
from drake_clutter.cell.primitives import LinkPrimitive

_ORANGE, _GREY = "0.90 0.45 0.12 1", "0.62 0.63 0.65 1"
_RANGES_DEG = (170.0, 120.0, 170.0, 120.0, 170.0, 120.0, 175.0)
_SPEEDS_DEG = (85.0, 85.0, 100.0, 75.0, 130.0, 135.0, 135.0)
_TORQUES = (320.0, 320.0, 176.0, 176.0, 110.0, 40.0, 40.0)
_MASSES = (5.0, 4.0, 4.0, 3.0, 2.7, 1.7, 1.8, 0.3)
"""Base first [kg]."""
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
"""Centers of mass, base first [m]."""
_IDENTITY_RPY, _TWIST_RPY, _BEND_RPY, _FLIP_RPY = (0, 0, 0), (90, 0, 180), (90, 0, 0), (-90, 180, 0)
_LINK_POSES = (
    ((0.0, 0.0, 0.1575), _IDENTITY_RPY),
    ((0.0, 0.0, 0.2025), _TWIST_RPY),
    ((0.0, 0.2045, 0.0), _TWIST_RPY),
    ((0.0, 0.0, 0.2155), _BEND_RPY),
    ((0.0, 0.1845, 0.0), _FLIP_RPY),
    ((0.0, 0.0, 0.2155), _BEND_RPY),
    ((0.0, 0.081, 0.0), _FLIP_RPY),
)
"""Of each link in the one before: position [m], and roll, pitch, yaw [deg]."""
FLANGE = 0.045
"""From the last link's frame to the flange [m]."""
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
"""Base first."""
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


def _pose(place: tuple[tuple[float, ...], tuple[int, ...]]) -> NDArray[np.float64]:
    X = np.eye(4)
    X[:3, :3] = np.round(Rotation.from_euler("xyz", place[1], degrees=True).as_matrix())
    X[:3, 3] = place[0]
    return X


def iiwa14_sdf() -> str:
    """Return the SDF model, as text."""
    base = ArmLink(
        "link_0",
        _MASSES[0],
        np.array(_CENTERS_OF_MASS[0]),
        COLLISION_GEOMETRY[0],
        _VISUAL_GEOMETRY[0],
    )
    links = [base]
    for k, place in enumerate(_LINK_POSES):
        shape = (
            _MASSES[k + 1],
            np.array(_CENTERS_OF_MASS[k + 1]),
            COLLISION_GEOMETRY[k + 1],
            _VISUAL_GEOMETRY[k + 1],
        )
        drive = math.radians(_RANGES_DEG[k]), _TORQUES[k], math.radians(_SPEEDS_DEG[k])
        links.append(ArmLink(f"link_{k + 1}", *shape, f"joint_{k + 1}", _pose(place), *drive))
    X_LF = _pose(((0.0, 0.0, FLANGE), _IDENTITY_RPY))
    return arm_sdf("iiwa14", "models/generators/iiwa14.py", links, X_LF)
