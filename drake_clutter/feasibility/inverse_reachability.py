"""Inverse reachability map: which base poses reach given poses of a vertical tool.

The map is built once for a robot with its tool. It answers for a pose of the base in microseconds,
where the planner takes milliseconds (Zacharias, Borst and Hirzinger 2007, "Capturing robot
workspace structure: representing robot capabilities"; Vahrenkamp, Asfour and Dillmann 2013, "Robot
placement based on reachability inversion").

Frames: T is the support, B is the robot's base, G is a tool of the gripper, pointing down.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from drake_clutter.cell.gripper import Grasp
from drake_clutter.cell.pose_spec import PoseSpec
from drake_clutter.cell.work_cell import WorkCell
from drake_clutter.compilation import njit
from drake_clutter.files import atomic_write
from drake_clutter.planning.collision_model import CollisionModel
from drake_clutter.planning.planner_config import PlannerConfig
from drake_clutter.planning.tool_kinematics import (
    ToolKinematics,
    downward_pose,
    is_vertical,
    retreat_along_axis,
)
from drake_clutter.scenes.scene import Pose, SceneObject
from drake_clutter.simulation.scene_plant import rigid_transform

Floats = NDArray[np.float64]

SPACING = 0.02
"""Spacing of the map in radius and height [m]."""
NUM_YAWS = 24
"""Number of yaws of the tool relative to the radial direction."""
_FAR_AWAY = 50.0
"""Distance of the base from the support while the map is built [m]: nothing but itself is near."""
_MAX_BRANCHES = 8


@dataclass(frozen=True, eq=False)
class InverseReachabilityMap:
    """Reachability of a vertical tool over radius, height and yaw relative to the base.

    Attributes:
        heights: Heights of G in B [m]. Shape (n_z,).
        branches: Bits of the inverse kinematics branches without self-collision; for robots without
            branches, bit 0 stands for all. Shape (n_r, n_z, NUM_YAWS).
        lowest: Height in B of the lowest point of the links on each branch [m]. Shape (n_r, n_z,
            NUM_YAWS, 8).
    """

    heights: Floats
    branches: NDArray[np.uint8]
    lowest: NDArray[np.float32]

    def find_reachable(
        self, moves: "MovePoses", bases: Floats, table_height: float
    ) -> NDArray[np.bool_]:
        """Return which moves are reachable from each base.

        Args:
            moves: The moves.
            bases: x, y, z of upright bases in T [m]; the yaw does not count, as long as the first
                joint turns freely. Shape (m, 3) or more columns.
            table_height: Height of the table in T [m].

        Returns:
            Whether each move is reachable from each base. Shape (m, k).
        """
        return np.asarray(
            _find_reachable(
                self.branches,
                self.lowest,
                self.heights[0],
                moves.poses,
                moves.starts,
                np.ascontiguousarray(bases, float),
                table_height + PlannerConfig().min_distance,
            )
        )


@dataclass(frozen=True, eq=False)
class MovePoses:
    """Poses of a vertical tool through which moves go, for each grasp and yaw of each move.

    Attributes:
        poses: x, y [m] and yaw [rad] at the grasp, then at the place; heights at the grasp, at the
            place, and in between [m]. Shape (l, 9).
        starts: Index of the first row of each move, and the number of all. Shape (k + 1,).
    """

    poses: Floats
    starts: NDArray[np.int64]

    @staticmethod
    def join(moves: Sequence[Floats]) -> "MovePoses":
        """Return the poses of moves from those of each, see `find_move_poses`."""
        starts = np.cumsum([0, *map(len, moves)])
        return MovePoses(np.vstack([np.empty((0, 9)), *moves]), starts)


def find_move_poses(
    picked: SceneObject, X_TO_place: Pose, grasps: Iterable[Grasp], config: PlannerConfig
) -> Floats:
    """Return the poses of a vertical tool through which a move goes.

    Args:
        picked: Object to pick.
        X_TO_place: Pose at which it is released.
        grasps: Its grasps; those with a tilted tool are left out.
        config: Parameters of the planner.

    Returns:
        Rows of `MovePoses`. Shape (l, 9).
    """
    bottoms = picked.bounds_T[0][2], replace(picked, X_TO=X_TO_place).bounds_T[0][2]
    transfer_bottom = max(bottoms) + config.lift_height
    X_moved = (
        rigid_transform(X_TO_place).GetAsMatrix4()
        @ rigid_transform(picked.X_TO).inverse().GetAsMatrix4()
    )
    rows = []
    for grasp in grasps:
        X_pick = retreat_along_axis(grasp.X_TG.GetAsMatrix4(), config.lip_gap)
        X_place = X_moved @ X_pick
        if not (is_vertical(X_pick) and is_vertical(X_place)):
            continue
        number = grasp.num_angles or config.num_yaws
        turns = np.arange(number) * (2 * math.pi / number)
        heights = X_pick[2, 3], X_place[2, 3], X_pick[2, 3] - bottoms[0] + transfer_bottom
        ends = [
            (X[0, 3], X[1, 3], math.atan2(X[1, 0], X[0, 0]) + turn)
            for turn in turns
            for X in (X_pick, X_place)
        ]
        rows += [
            (*pick, *place, *heights) for pick, place in zip(ends[::2], ends[1::2], strict=True)
        ]
    return np.array(rows).reshape(-1, 9)


def load_inverse_reachability(path: Path) -> InverseReachabilityMap:
    """Return a map that `save_inverse_reachability` wrote."""
    with np.load(path) as arrays:
        return InverseReachabilityMap(**{name: arrays[name] for name in arrays.files})


def save_inverse_reachability(path: Path, reachability: InverseReachabilityMap) -> None:
    """Write a map as a NumPy archive."""
    with atomic_write(path) as temporary:
        np.savez_compressed(temporary, **vars(reachability))


def build_inverse_reachability(cell: WorkCell, tool_name: str) -> InverseReachabilityMap:
    """Return the inverse reachability map of a robot with a tool.

    Args:
        cell: Work cell; only robot and gripper count.
        tool_name: Name of the tool.
    """
    base = PoseSpec(translation=(-_FAR_AWAY, 0.0, 2.0))
    robot_spec = cell.robot.model_copy(update={"base": base})
    apart = cell.model_copy(update={"robot": robot_spec, "fixtures": ()})
    tool = ToolKinematics(apart, tool_name)
    robot = tool.robot
    model = CollisionModel(apart, ())
    # Beyond the stretched arm with its tool nothing is reachable.
    X_FG = cell.gripper.tools[tool_name].X_FG
    reach = float(np.linalg.norm(robot.chain.fixed[:, :3, 3], axis=1).sum())
    reach += float(np.linalg.norm(X_FG.translation()))
    radii = np.arange(0.0, reach, SPACING)
    heights = np.arange(-reach, reach, SPACING)
    yaws = np.arange(NUM_YAWS) * (2 * math.pi / NUM_YAWS)
    has_branches = robot.ur_fit is not None
    shape = len(radii), len(heights), NUM_YAWS
    branches = np.zeros(shape, np.uint8)
    lowest = np.full((*shape, _MAX_BRANCHES), -np.inf, np.float32)
    p_TB = np.array(base.translation)
    for i, radius in enumerate(radii.tolist()):
        # The pose is out of reach where the tool's tip is outside the sphere of the arm.
        rows = np.flatnonzero(radius**2 + heights**2 < reach**2)
        poses = np.array(
            [
                downward_pose(yaw, p_TB + np.array([radius, 0.0, z]))
                for z in heights[rows].tolist()
                for yaw in yaws
            ]
        )
        q = robot.unwrap(tool.solve_ik(poses), robot.home)
        index = np.argwhere(np.isfinite(q[..., 0]))
        if not len(index):
            continue
        solutions = q[index[:, 0], index[:, 1]]
        is_free = np.ones(len(index), bool)
        is_free[model.distances_along(solutions, PlannerConfig().min_distance).rows] = False
        low = model.lowest_points(solutions) - p_TB[2]
        for (pose, branch), height in zip(index[is_free], low[is_free], strict=True):
            j, yaw = rows[pose // NUM_YAWS], pose % NUM_YAWS
            bit = branch if has_branches else 0
            branches[i, j, yaw] |= 1 << bit
            lowest[i, j, yaw, bit] = max(lowest[i, j, yaw, bit], height)
    return InverseReachabilityMap(heights, branches, lowest)


@njit(cache=True, nogil=True)
def _find_reachable(branches, lowest, first_height, poses, starts, bases, table):  # type: ignore[no-untyped-def]
    """Return whether each move is reachable from each base, shape (m, k).

    A move is reachable if one branch reaches the grasp, the place, the two points above them and
    the one halfway between these, with the links above the table.
    """
    num_radii, num_heights, num_yaws = branches.shape
    found = np.zeros((len(bases), len(starts) - 1), np.bool_)
    cells = np.empty((5, 3), np.int64)
    for b in range(len(bases)):
        x, y, z = bases[b, 0], bases[b, 1], bases[b, 2]
        for move in range(len(starts) - 1):
            for row in range(starts[move], starts[move + 1]):
                turn = poses[row, 5] - poses[row, 2]
                turn -= 2 * np.pi * np.floor(turn / (2 * np.pi) + 0.5)
                common = 255
                # The grasp and the point above it, halfway, the point above the place, the place.
                for point in range(5):
                    s = min(max((point - 1) / 2, 0.0), 1.0)
                    dx = (1 - s) * poses[row, 0] + s * poses[row, 3] - x
                    dy = (1 - s) * poses[row, 1] + s * poses[row, 4] - y
                    i = int(np.sqrt(dx * dx + dy * dy) / SPACING + 0.5)
                    relative = (poses[row, 2] + s * turn - np.arctan2(dy, dx)) / (2 * np.pi)
                    k = int(np.floor(relative * num_yaws + 0.5)) % num_yaws
                    height = poses[row, 8]
                    if point == 0:
                        height = poses[row, 6]
                    elif point == 4:
                        height = poses[row, 7]
                    j = int(np.floor((height - z - first_height) / SPACING + 0.5))
                    if i >= num_radii or j < 0 or j >= num_heights:
                        common = 0
                        break
                    common &= branches[i, j, k]
                    if common == 0:
                        break
                    cells[point, 0], cells[point, 1], cells[point, 2] = i, j, k
                bit = 0
                while common and not found[b, move]:
                    if common & 1:
                        clear = True
                        for c in range(5):
                            low = lowest[cells[c, 0], cells[c, 1], cells[c, 2], bit]
                            if low + z < table:
                                clear = False
                        if clear:
                            found[b, move] = True
                    common >>= 1
                    bit += 1
                if found[b, move]:
                    break
    return found
