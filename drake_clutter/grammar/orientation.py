"""The ten terminal orientations: how an object rests, and its yaw."""

from enum import Enum
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from drake_clutter.catalog import ObjectClass, RestOrientation, Shape


class Orientation(Enum):
    """Orientation of an object, the kind of a terminal edge.

    The value is the resting orientation and the yaw in degrees. At yaw 0, the longer horizontal
    axis is along the tray's x axis. Kumar et al. (2022) have the same ten orientations.
    """

    FLAT_0 = ("flat", 0)
    FLAT_30 = ("flat", 30)
    FLAT_60 = ("flat", 60)
    FLAT_90 = ("flat", 90)
    FLAT_120 = ("flat", 120)
    FLAT_150 = ("flat", 150)
    UPRIGHT_0 = ("upright", 0)
    UPRIGHT_90 = ("upright", 90)
    SIDE_0 = ("side", 0)
    SIDE_90 = ("side", 90)

    @property
    def rest(self) -> RestOrientation:
        """Which axis points up."""
        return RestOrientation(self.value[0])

    @property
    def yaw(self) -> float:
        """Yaw about the tray's z axis [rad]."""
        return float(np.radians(self.value[1]))


def _resting_axes(object_class: ObjectClass, rest: RestOrientation) -> tuple[int, int]:
    """Return the indices of O's axes that point along the tray's x axis, and up."""
    # A mesh keeps its axes: it is modeled standing on its z axis, whatever its extents.
    by_extent = (
        range(3)
        if object_class.shape is Shape.MESH
        else np.argsort(object_class.size, kind="stable")
    )
    short, middle, long = (int(axis) for axis in by_extent)
    rest = object_class.only_rest or rest
    return {
        RestOrientation.FLAT: (long, short),
        RestOrientation.SIDE: (long, middle),
        RestOrientation.UPRIGHT: (middle, long),
    }[rest]


@lru_cache(maxsize=4096)
def _cached_rotation(object_class: ObjectClass, orientation: Orientation) -> NDArray[np.float64]:
    """Return R_TO (3, 3), see `resting_rotation`."""
    along_x, up = _resting_axes(object_class, orientation.rest)
    R_AO = np.zeros((3, 3))  # A is the tray's frame before the yaw
    R_AO[0, along_x] = R_AO[2, up] = 1.0
    R_AO[1] = np.cross(R_AO[2], R_AO[0])
    cosine, sine = np.cos(orientation.yaw), np.sin(orientation.yaw)
    R_TO = np.array([[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1]]) @ R_AO
    R_TO.setflags(write=False)
    return R_TO


def resting_rotation(object_class: ObjectClass, orientation: Orientation) -> NDArray[np.float64]:
    """Return R_TO (3, 3) of an object of a class that rests in an orientation."""
    return _cached_rotation(object_class, orientation)


def symmetry_key(object_class: ObjectClass, orientation: Orientation) -> tuple[int, ...]:
    """Return a key that is equal for orientations that look the same.

    Objects look the same up to the symmetry of their class: that of a box, of a cylinder, or none.
    """
    R_TO = resting_rotation(object_class, orientation)
    if object_class.shape is Shape.CYLINDER:
        axis = R_TO[:, 2]
        description = np.outer(axis, axis)  # identifies the axis up to its sign
    elif object_class.shape is Shape.BOX:
        # The second moments identify the orientation up to the symmetry of a box.
        description = R_TO @ np.diag(np.square(object_class.size)) @ R_TO.T
    else:
        description = R_TO
    return tuple(int(value) for value in np.round(description * 1e6).ravel())
