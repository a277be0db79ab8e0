"""Poses of a tool through which moves go, for each of their grasps.

Frames: T is the support, O is the picked object, G is a tool of the gripper.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from drake_clutter.cell.gripper import Grasp
from drake_clutter.planning.planner_config import PlannerConfig
from drake_clutter.planning.tool_kinematics import (
    is_sideways,
    is_vertical,
    retreat_along_axis,
    turn_about_axis,
)
from drake_clutter.scenes.scene import Pose, SceneObject
from drake_clutter.simulation.scene_plant import rigid_transform

Floats = NDArray[np.float64]

NUM_SIDE_YAWS = 4
"""Number of yaws of a tool about its axis on a side of an object."""


@dataclass(frozen=True, eq=False)
class MovePoses:
    """Poses of a tool through which moves go, for each grasp and yaw of each move.

    Attributes:
        ends: X_TG at the grasp, then at the place. Shape (l, 2, 4, 4).
        yaws: Yaw of a tool that points down at the grasp, then at the place [rad]; NaN for a tool
            on a side of the object. Shape (l, 2).
        heights: Height of the tool between the two [m]. Shape (l,).
        starts: Index of the first row of each move, and the number of all. Shape (k + 1,).
        picked: Index in the scene of the object that each move picks. Shape (k,).
    """

    ends: Floats
    yaws: Floats
    heights: Floats
    starts: NDArray[np.int64]
    picked: NDArray[np.int64]

    @staticmethod
    def join(moves: Sequence["MovePoses"]) -> "MovePoses":
        """Return the poses of several moves."""
        ends, yaws, heights, picked = (
            np.concatenate([getattr(move, name) for move in moves])
            for name in ("ends", "yaws", "heights", "picked")
        )
        starts = np.cumsum([0, *(len(move.heights) for move in moves)])
        return MovePoses(ends, yaws, heights, starts, picked)


def find_move_poses(
    picked: SceneObject,
    index: int,
    X_TO_place: Pose,
    grasps: Iterable[Grasp],
    config: PlannerConfig,
) -> MovePoses:
    """Return the poses of a tool through which a move goes.

    Args:
        picked: Object to pick.
        index: Its index in the scene.
        X_TO_place: Pose at which it is released.
        grasps: Its grasps with one tool, from above or on its sides; those from above with a tilted
            tool are left out.
        config: Parameters of the planner.
    """
    bottoms = picked.bounds_T[0][2], replace(picked, X_TO=X_TO_place).bounds_T[0][2]
    transfer_bottom = max(bottoms) + config.lift_height
    X_moved = (
        rigid_transform(X_TO_place).GetAsMatrix4()
        @ rigid_transform(picked.X_TO).inverse().GetAsMatrix4()
    )
    ends, yaws, heights = list[list[Floats]](), list[list[float]](), list[float]()
    for grasp in grasps:
        X_pick = retreat_along_axis(grasp.X_TG.GetAsMatrix4(), config.lip_gap)
        X_place = X_moved @ X_pick
        points_down = is_vertical(X_pick) and is_vertical(X_place)
        number = grasp.num_angles or config.num_yaws
        if not points_down:
            if not is_sideways(X_pick):
                continue
            number = NUM_SIDE_YAWS
        for turn in np.arange(number) * (2 * math.pi / number):
            poses = [turn_about_axis(X, turn) for X in (X_pick, X_place)]
            ends.append(poses)
            yaws.append([math.atan2(X[1, 0], X[0, 0]) if points_down else math.nan for X in poses])
            heights.append(float(X_pick[2, 3]) - bottoms[0] + transfer_bottom)
    return MovePoses(
        np.array(ends).reshape(-1, 2, 4, 4),
        np.array(yaws).reshape(-1, 2),
        np.array(heights),
        np.array([0, len(heights)]),
        np.array([index]),
    )
