"""Grasp of a move that is planned, and what may touch at its endpoints.

Frames: T is the support, G is a tool of the gripper, O is the picked object.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform

from drake_clutter.cell.gripper import Payload
from drake_clutter.planning.tool_kinematics import has_same_tilt, is_sideways, is_vertical

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class GraspCandidate:
    """Grasp at one yaw, with an inverse kinematics solution at each endpoint.

    Attributes:
        tool: Name of the tool.
        payload: Load after the grasp.
        X_TG_pick: Pose of the tool at the grasp. Shape (4, 4).
        X_TG_place: Pose of the tool at the place pose. Shape (4, 4).
        X_OG: Pose of the tool in the object.
        insertion: Distance by which the tool reaches below the top of the object [m].
        joints_open: Positions of the gripper's joints without the object, see `Grasp` [m].
        joints_held: Positions of the gripper's joints with the object, see `Grasp` [m].
        q_pick: Joint positions at the grasp [rad]. Shape (n,).
        q_place: Joint positions at the place pose [rad]. Shape (n,).
        load_distance: Distance that the held object keeps in addition to
            `PlannerConfig.min_distance` [m].
    """

    tool: str
    payload: Payload
    X_TG_pick: Floats
    X_TG_place: Floats
    X_OG: RigidTransform
    insertion: float
    joints_open: tuple[float, ...]
    joints_held: tuple[float, ...]
    q_pick: Floats
    q_place: Floats
    load_distance: float

    @property
    def is_sideways(self) -> bool:
        """Whether the tool grasps a side of the object, or releases it from a side."""
        return is_sideways(self.X_TG_pick) or is_sideways(self.X_TG_place)

    @property
    def is_tilted(self) -> bool:
        """Whether the tool does not point down at the grasp or at the place pose."""
        return not (is_vertical(self.X_TG_pick) and is_vertical(self.X_TG_place))

    @property
    def level_axis(self) -> Floats | None:
        """Axis in the tool that points down all the way; None if the tool turns. Shape (3,)."""
        if not self.is_tilted:
            return np.array([0.0, 0.0, 1.0])
        is_level = has_same_tilt(self.X_TG_pick, self.X_TG_place)
        return -self.X_TG_pick[2, :3] if is_level else None


@dataclass(frozen=True)
class EndpointContext:
    """Distances that are allowed near the pick or the place pose.

    Attributes:
        tool: Name of the tool that grasps the object.
        p_TG_xy: Horizontal position of the tool at the endpoint [m]. Shape (2,).
        allowed_distances: Allowed distance of pairs at the endpoint [m]: between the attached
            object and each body that it touches there, and between the gripper and each body below
            a thin object, by names.
        load_distance: See `GraspCandidate`.
    """

    tool: str
    p_TG_xy: Floats
    allowed_distances: Mapping[tuple[str, str], float]
    load_distance: float
