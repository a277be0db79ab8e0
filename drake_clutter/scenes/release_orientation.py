"""Orientations in which a picked object can be put down, with their footprints."""

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from drake_clutter.catalog import ObjectClass, RestOrientation, Shape
from drake_clutter.scenes.free_space import Footprint, make_footprint
from drake_clutter.scenes.scene import Pose

_MAX_RESTING_TILT = np.radians(5.0)
"""An object that is tilted by less counts as resting, and keeps its orientation [rad]."""
_YAW_STEPS_DEG = ((0, 90), tuple(yaw for yaw in range(15, 180, 15) if yaw != 90))
"""Rotations of the picked object about the vertical [deg].

The later ones are tried where none of the first finds room.
"""


@lru_cache(maxsize=4096)
def resting_quaternion(
    object_class: ObjectClass, quaternion: tuple[float, float, float, float]
) -> tuple[float, float, float, float]:
    """Return the orientation at rest that is closest to an orientation.

    An object that is nearly at rest keeps its orientation, and so does a mesh, whose faces are not
    known here. A can is put upright, a marker on its side.

    Args:
        object_class: Class of the object.
        quaternion: Quaternion of R_TO.
    """
    R_TO = Pose((0.0, 0.0, 0.0), quaternion).rotation
    if object_class.shape is Shape.MESH:
        return quaternion
    is_upright = abs(R_TO[2, 2]) > np.cos(np.pi / 4)
    if object_class.only_rest is not None:
        is_upright = object_class.only_rest is RestOrientation.UPRIGHT
    if object_class.shape is Shape.CYLINDER and not is_upright:
        level = R_TO[:, 2] * [1.0, 1.0, 0.0]
        turn = _rotation_between(R_TO[:, 2], level)
    else:
        is_can = object_class.shape is Shape.CYLINDER
        axis = 2 if is_can else int(np.argmax(np.abs(R_TO[2])))
        turn = _rotation_between(R_TO[:, axis], [0.0, 0.0, np.sign(R_TO[2, axis])])
    if turn.magnitude() < _MAX_RESTING_TILT:
        return quaternion
    return Pose.from_rotation(turn.as_matrix() @ R_TO, (0.0, 0.0, 0.0)).quaternion


def _rotation_between(start: ArrayLike, end: ArrayLike) -> Rotation:
    """Return the smallest rotation that turns a direction (3,) into another one (3,)."""
    a, b = (np.asarray(v, float) / np.linalg.norm(v) for v in (start, end))
    axis = np.cross(a, b)
    sine = float(np.linalg.norm(axis))
    angle = np.arctan2(sine, a @ b)
    return Rotation.from_rotvec(axis * (angle / sine) if sine > 0 else np.zeros(3))


class OrientedObject(NamedTuple):
    """A picked object in the orientation in which it is placed.

    Attributes:
        quaternion: Quaternion of R_TO; unchanged if the object is not rotated.
        lowest: Height of its lowest point relative to its origin (negative) [m].
        height: Height of the object [m].
        center_of_mass: Horizontal position of the center of mass relative to the origin [m]. Shape
            (2,).
        footprint: Grid cells that must be free.
    """

    quaternion: tuple[float, float, float, float]
    lowest: float
    height: float
    center_of_mass: NDArray[np.float64]
    footprint: Footprint


@lru_cache(maxsize=4096)
def orient_object(
    object_class: ObjectClass,
    quaternion: tuple[float, float, float, float],
    yaw_deg: float,
    clearance: float,
) -> OrientedObject:
    """Return an object rotated about the vertical, with its footprint and clearance."""
    yaw = math.radians(yaw_deg)
    R_yaw = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
    R_TO = np.array(Pose((0.0, 0.0, 0.0), quaternion).rotation)
    center_of_mass = R_TO @ object_class.center_of_mass
    corners = object_class.corners @ R_TO.T
    sides = ConvexHull(corners[:, :2] - center_of_mass[:2]).equations
    sides[:, :2] = sides[:, :2] @ R_yaw.T
    if yaw_deg:
        R_TO[:2] = R_yaw @ R_TO[:2]
        quaternion = Pose.from_rotation(R_TO, (0.0, 0.0, 0.0)).quaternion
    return OrientedObject(
        quaternion,
        float(corners[:, 2].min()),
        float(np.ptp(corners[:, 2])),
        R_yaw @ center_of_mass[:2],
        make_footprint(sides, clearance),
    )


def yaw_steps(
    object_class: ObjectClass, quaternion: tuple[float, float, float, float]
) -> tuple[tuple[int, ...], ...]:
    """Return the rotations that are tried, by rank [deg].

    Half a turn leaves the outline of boxes and cylinders as it is, and so does any rotation of a
    cylinder that stands upright.
    """
    R_TO = Pose((0.0, 0.0, 0.0), quaternion).rotation
    if object_class.shape is Shape.CYLINDER and abs(R_TO[2, 2]) > np.cos(np.pi / 4):
        return ((0,),)
    if object_class.shape is not Shape.MESH:
        return _YAW_STEPS_DEG
    return tuple((*yaws, *(yaw + 180 for yaw in yaws)) for yaws in _YAW_STEPS_DEG)
