"""Inverse reachability map: which base poses reach given poses of a tool.

The map is built once for a robot with its tool. It answers for a pose of the base in microseconds,
where the planner takes milliseconds (Zacharias, Borst and Hirzinger 2007, "Capturing robot
workspace structure: representing robot capabilities"; Vahrenkamp, Asfour and Dillmann 2013, "Robot
placement based on reachability inversion").

Frames: T is the support, B is the robot's base, G is a tool of the gripper, pointing down.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drake_clutter.cell.gripper import Grasp
from drake_clutter.cell.pose_spec import PoseSpec
from drake_clutter.cell.work_cell import WorkCell
from drake_clutter.compilation import njit
from drake_clutter.feasibility.arm_clearance import (
    ArmGeometry,
    ObstacleTops,
    collides_with_itself,
    collides_with_objects,
    lowest_point,
    place_capsules,
)
from drake_clutter.files import atomic_write, reading_file
from drake_clutter.planning.collision_model import CollisionModel
from drake_clutter.planning.planner_config import PlannerConfig
from drake_clutter.planning.tool_kinematics import (
    ToolKinematics,
    downward_pose,
    is_sideways,
    is_vertical,
    retreat_along_axis,
    turn_about_axis,
)
from drake_clutter.robots.robot_model import load_robot
from drake_clutter.robots.ur_kinematics import solve_branch
from drake_clutter.scenes.scene import Pose, SceneObject
from drake_clutter.simulation.scene_plant import rigid_transform

Floats = NDArray[np.float64]

SPACING = 0.02
"""Spacing of the map in radius and height [m]."""
NUM_YAWS = 24
"""Number of yaws of the tool relative to the radial direction."""
NUM_SIDE_YAWS = 4
"""Number of yaws of a tool about its axis on a side of an object."""
_FAR_AWAY = 50.0
"""Distance of the base from the support while the map is built [m]: nothing but itself is near."""
_MAX_SOLUTIONS = 8


@dataclass(frozen=True, eq=False)
class InverseReachabilityMap:
    """Reachability of a vertical tool over radius, height and yaw relative to the base.

    Solutions are grouped by inverse kinematics branch, or for robots without branches by the eighth
    of a turn in which their first joint is.

    Attributes:
        heights: Heights of G in B [m]. Shape (n_z,).
        solutions: Bits of the solutions without self-collision. Shape (n_r, n_z, NUM_YAWS).
        lowest: Height in B of the lowest point of the links in each solution [m]. Shape (n_r, n_z,
            NUM_YAWS, 8).
        turns: Position of the first joint in each solution, with the tool along x of B [rad]. Shape
            (n_r, n_z, NUM_YAWS, 8).
        turn_limits: Limits of the first joint [rad]. Shape (2,).
        arm: Geometry of the arm, for checks at exact poses.
    """

    heights: Floats
    solutions: NDArray[np.uint8]
    lowest: NDArray[np.float32]
    turns: NDArray[np.float32]
    turn_limits: Floats
    arm: ArmGeometry

    def find_reachable(
        self, moves: "MovePoses", bases: Floats, table_height: float, tops: ObstacleTops
    ) -> NDArray[np.bool_]:
        """Return which moves are reachable from each base.

        Args:
            moves: The moves.
            bases: x, y, z [m] and yaw [rad] of upright bases in T. Shape (m, 4).
            table_height: Height of the table in T [m].
            tops: Obstacles of the arm at the grasp and at the place.

        Returns:
            Whether each move is reachable from each base. Shape (m, k).
        """
        return np.asarray(
            _find_reachable(
                (self.solutions, self.lowest, self.turns, self.turn_limits, self.heights[0]),
                tuple(getattr(self.arm, field.name) for field in fields(ArmGeometry)),
                tuple(getattr(tops, field.name) for field in fields(ObstacleTops)),
                tuple(getattr(moves, field.name) for field in fields(MovePoses)),
                np.ascontiguousarray(bases, float),
                table_height,
                PlannerConfig().min_distance,
            )
        )


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


def load_inverse_reachability(path: Path) -> InverseReachabilityMap:
    """Return a map that `save_inverse_reachability` wrote.

    Raises:
        InputError: The file is not such a map.
    """
    with reading_file(path, "an inverse reachability map"), np.load(path) as arrays:
        names = [field.name for field in fields(ArmGeometry)]
        arm = ArmGeometry(**{name: arrays[f"arm.{name}"] for name in names})
        names = [field.name for field in fields(InverseReachabilityMap) if field.name != "arm"]
        found = InverseReachabilityMap(**{name: arrays[name] for name in names}, arm=arm)
        _check_arrays(found)
        return found


def _check_arrays(found: InverseReachabilityMap) -> None:
    """Check the arrays of a map, which compiled functions index without checks.

    Raises:
        ValueError: One has another shape or type, or holds an index out of range.
    """
    arm = found.arm
    num_radii, num_heights = len(found.solutions), len(found.heights)
    cells = num_radii, num_heights, NUM_YAWS
    num_joints, num_capsules = max(len(arm.fixed) - 1, 0), len(arm.depths)
    is_closed_form = len(arm.lengths) > 0
    expected: list[tuple[NDArray[Any], type[np.generic], tuple[int, ...]]] = [
        (found.heights, np.float64, (num_heights,)),
        (found.solutions, np.uint8, cells),
        (found.lowest, np.float32, (*cells, _MAX_SOLUTIONS)),
        (found.turns, np.float32, (*cells, _MAX_SOLUTIONS)),
        (found.turn_limits, np.float64, (2,)),
        (arm.fixed, np.float64, (num_joints + is_closed_form, 4, 4)),
        (arm.lengths, np.float64, (6 * is_closed_form,)),
        (arm.X_0B, np.float64, (4, 4) if is_closed_form else (0, 4)),
        (arm.X_G6, np.float64, (4, 4) if is_closed_form else (0, 4)),
        (arm.limits, np.float64, (num_joints, 2)),
        (arm.depths, np.int64, (num_capsules,)),
        (arm.ends, np.float64, (num_capsules, 2, 3)),
        (arm.radii, np.float64, (num_capsules,)),
        (arm.may_touch, np.bool_, (num_capsules,)),
        (arm.pairs, np.int64, (len(arm.pairs), 2)),
    ]
    for array, dtype, shape in expected:
        if array.shape != shape or array.dtype != dtype:
            raise ValueError(f"an array {array.dtype}{array.shape}, not {dtype.__name__}{shape}")
    for indices, end in ((arm.depths, num_joints + 1), (arm.pairs, num_capsules)):
        if indices.size and not 0 <= indices.min() <= indices.max() < end:
            raise ValueError(f"indices that are not from 0 to {end - 1}")
    if not (num_heights and np.isfinite(found.heights).all()):
        raise ValueError("heights that are no numbers")


def save_inverse_reachability(path: Path, reachability: InverseReachabilityMap) -> None:
    """Write a map as a NumPy archive."""
    arrays = dict(vars(reachability))
    arm: ArmGeometry = arrays.pop("arm")
    arrays |= {f"arm.{name}": array for name, array in vars(arm).items()}
    with atomic_write(path) as temporary:
        np.savez_compressed(temporary, **arrays)


def build_inverse_reachability(cell: WorkCell, tool_name: str) -> InverseReachabilityMap:
    """Return the inverse reachability map of a robot with a tool.

    Args:
        cell: Work cell; only robot and gripper count.
        tool_name: Name of the tool.
    """
    limits = load_robot(cell.robot).position_limits
    turn_limits = limits[0].copy()
    limits[0] = min(turn_limits[0], -math.pi), max(turn_limits[1], math.pi)
    update = {
        "base": PoseSpec(translation=(-_FAR_AWAY, 0.0, 2.0)),
        "limits": cell.robot.limits.model_copy(
            update={"position": tuple(map(tuple, limits.tolist()))}
        ),
    }
    robot_spec = cell.robot.model_copy(update=update)
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
    found = np.zeros(shape, np.uint8)
    lowest = np.full((*shape, _MAX_SOLUTIONS), -np.inf, np.float32)
    turns = np.zeros(lowest.shape, np.float32)
    close_pairs = set[tuple[int, int]]()
    p_TB = np.array(robot_spec.base.translation)
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
        near = model.distances_along(solutions, PlannerConfig().min_distance)
        close_pairs |= {(first, second) for first, second in near.pairs.tolist()}
        is_blocked = np.zeros(len(index), bool)
        is_blocked[near.rows] = True
        low = model.lowest_points(solutions) - p_TB[2]
        first = solutions[~is_blocked, 0]
        bits = index[~is_blocked, 1]
        if not has_branches:
            bits = (np.floor(first / (2 * math.pi / _MAX_SOLUTIONS)) % _MAX_SOLUTIONS).astype(int)
        for (pose, _), bit, height, turn in zip(
            index[~is_blocked].tolist(),
            bits.tolist(),
            low[~is_blocked].tolist(),
            first.tolist(),
            strict=True,
        ):
            cell_index = i, rows[pose // NUM_YAWS], pose % NUM_YAWS
            found[cell_index] |= 1 << bit
            if height > lowest[*cell_index, bit]:
                lowest[*cell_index, bit], turns[*cell_index, bit] = height, turn
    arm = ArmGeometry.from_model(
        ToolKinematics(cell, tool_name), cell.gripper.tools[tool_name], model, close_pairs
    )
    if arm.is_exact:
        # The exact pose decides: no branch may be missing that a neighbor has.
        found = _dilate(found)
    return InverseReachabilityMap(heights, found, lowest, turns, turn_limits, arm)


def _dilate(solutions: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return the bits of each point of a map and of its neighbors."""
    for axis in range(3):
        pad = np.zeros_like(solutions.take([0], axis))
        before, after = np.split(solutions, [1], axis)[1], np.split(solutions, [-1], axis)[0]
        ends = (solutions.take([0], axis), solutions.take([-1], axis)) if axis == 2 else (pad, pad)
        solutions = (
            solutions
            | np.concatenate([before, ends[0]], axis)
            | np.concatenate([ends[1], after], axis)
        )
    return solutions


@njit(cache=True, nogil=True)
def _is_within(turn, lower, upper):  # type: ignore[no-untyped-def]
    """Return whether an angle or one that differs by full turns is within limits."""
    return lower + (turn - lower) % (2 * np.pi) <= upper


@njit(cache=True, nogil=True)
def _is_reached_exactly(poses, floor, branch, arm, tops, base, gap, picked, work):  # type: ignore[no-untyped-def]
    """Return whether a branch reaches the points of a move without collision.

    Between the points above the grasp and the place the arm moves on a straight line in joint
    space; its middle is checked.

    Args:
        poses: Poses of frame 6 in frame 0 at the grasp, above it, above the place and at the place.
            Shape (4, 4, 4).
        floor: Smallest height of the links in B [m].
        branch: Branch of the inverse kinematics.
        arm: Arrays of `ArmGeometry`.
        tops: Arrays of `ObstacleTops`.
        base: x, y, z [m] and yaw [rad] of the base.
        gap: Smallest distance of links from each other [m].
        picked: Index of the picked object.
        work: Arrays for intermediate results.
    """
    fixed, lengths, _, _, limits, depths, ends, radii, may_touch, pairs = arm
    d1, a2, a3, d4, d5, d6 = lengths
    q, revolute, frames, moved, placed, ignores = work
    for point in (0, 3, 1, 2):
        if not solve_branch(poses[point], branch, 0.0, d1, a2, a3, d4, d5, d6, q[point]):
            return False
        for joint in range(len(limits)):
            if not _is_within(q[point, joint], limits[joint, 0], limits[joint, 1]):
                return False
    for joint in range(len(limits)):
        change = q[2, joint] - q[1, joint]
        if limits[joint, 1] - limits[joint, 0] > 2 * np.pi:
            change -= 2 * np.pi * np.floor(change / (2 * np.pi) + 0.5)
        q[4, joint] = q[1, joint] + change / 2
    # The grasp and the place first, where the arm is lowest.
    for point in (0, 3, 4, 1, 2):
        place_capsules(fixed, revolute, depths, ends, q[point], frames, moved, placed)
        if lowest_point(placed, radii) < floor:
            return False
        if collides_with_itself(placed, radii, pairs, gap):
            return False
        # At the place pose, the picked object has left its pick pose.
        if (point == 0 or point == 3) and collides_with_objects(
            placed, radii, base, tops, may_touch if point == 0 else ignores, picked
        ):
            return False
    return True


@njit(cache=True, nogil=True)
def _find_reachable(grid, arm, tops, moves, bases, table, gap):  # type: ignore[no-untyped-def]
    """Return whether each move is reachable from each base, shape (m, k).

    A move is reachable if one branch reaches the grasp, the place, the points above them and what
    is between these. For arms with inverse kinematics in closed form, the map says which branches
    of a tool that points down come into question, and the solutions at the exact poses decide. For
    others it is the map with the point halfway, and links above the table.

    Args:
        grid: Arrays of the map, and its first height.
        arm: Arrays of `ArmGeometry`.
        tops: Arrays of `ObstacleTops`.
        moves: Arrays of `MovePoses`.
        bases: x, y, z [m] and yaw [rad] of the bases. Shape (m, 4).
        table: Height of the table in T [m].
        gap: Smallest distance of links from each other and from the table [m].
    """
    ends, yaws, heights, starts, picked = moves
    X_0B, X_G6, num_joints, num_capsules = arm[2], arm[3], len(arm[4]), len(arm[5])
    is_exact = num_joints > 0
    found = np.zeros((len(bases), len(starts) - 1), np.bool_)
    work = (
        np.empty((5, num_joints)),
        np.ones(num_joints, np.bool_),
        np.empty((num_joints + 1, 4, 4)),
        np.empty((num_joints, 3, 4)),
        np.empty((num_capsules, 2, 3)),
        np.ones(num_capsules, np.bool_),
    )
    X_BT, X_0T, poses = np.eye(4), np.eye(4), np.empty((4, 4, 4))
    of_frame_6 = np.empty_like(ends)
    if is_exact:
        for row in range(len(ends)):
            for end in range(2):
                of_frame_6[row, end] = ends[row, end] @ X_G6
    for b in range(len(bases)):
        x, y, z, yaw = bases[b]
        c, s = np.cos(yaw), np.sin(yaw)
        X_BT[0, 0], X_BT[0, 1], X_BT[0, 3] = c, s, -c * x - s * y
        X_BT[1, 0], X_BT[1, 1], X_BT[1, 3] = -s, c, s * x - c * y
        X_BT[2, 3] = -z
        if is_exact:
            X_0T = X_0B @ X_BT
        for move in range(len(starts) - 1):
            for row in range(starts[move], starts[move + 1]):
                is_sideways = np.isnan(yaws[row, 0])
                if is_sideways and not is_exact:
                    continue
                usable = np.int64(255)
                if not is_sideways:
                    usable = _usable_branches(
                        grid, ends[row], yaws[row], heights[row], bases[b], table + gap, is_exact
                    )
                if usable == 0:
                    continue
                if not is_exact:
                    found[b, move] = True
                    break
                for point in range(4):
                    end = point // 2
                    rise = 0.0
                    if point == 1 or point == 2:
                        rise = heights[row] - ends[row, end, 2, 3]
                    for i in range(3):
                        for j in range(4):
                            poses[point, i, j] = X_0T[i, 3] + rise * X_0T[i, 2] if j == 3 else 0.0
                            for k in range(3):
                                poses[point, i, j] += X_0T[i, k] * of_frame_6[row, end, k, j]
                # A tool on a side may touch the floor of the support.
                floor = (max(table, 0.0) if is_sideways else table) + gap - z
                for branch in range(8):
                    if usable >> branch & 1 and _is_reached_exactly(
                        poses, floor, branch, arm, tops, bases[b], gap, picked[move], work
                    ):
                        found[b, move] = True
                        break
                if found[b, move]:
                    break
    return found


@njit(cache=True, nogil=True)
def _usable_branches(grid, ends, yaws, height, base, table, is_exact):  # type: ignore[no-untyped-def]
    """Return the bits of the branches that reach a move with a tool that points down, by the map.

    Args:
        grid: Arrays of the map, and its first height.
        ends: X_TG at the grasp and at the place. Shape (2, 4, 4).
        yaws: Yaw of the tool there [rad]. Shape (2,).
        height: Height of the tool between the two [m].
        base: x, y, z [m] and yaw [rad] of the base.
        table: Smallest height of the links in T [m].
        is_exact: Whether solutions at the exact poses are checked later, so that all points need
            the same branch; for other arms, a bit is no branch, and only the latest points count.
    """
    solutions, lowest, turns, turn_limits, first_height = grid
    num_radii, num_heights, num_yaws = solutions.shape
    common = np.int64(255)
    # The grasp and the place, the points above them, and for other arms the one halfway.
    for point in range(4 if is_exact else 5):
        end = point % 2
        dx, dy, yaw = ends[end, 0, 3] - base[0], ends[end, 1, 3] - base[1], yaws[end]
        if point == 4:
            turn = yaws[1] - yaws[0]
            turn -= 2 * np.pi * np.floor(turn / (2 * np.pi) + 0.5)
            dx = (ends[0, 0, 3] + ends[1, 0, 3]) / 2 - base[0]
            dy = (ends[0, 1, 3] + ends[1, 1, 3]) / 2 - base[1]
            yaw = yaws[0] + turn / 2
        z = (ends[end, 2, 3] if point < 2 else height) - base[2]
        azimuth = np.arctan2(dy, dx)
        i = int(np.sqrt(dx * dx + dy * dy) / SPACING + 0.5)
        j = int(np.floor((z - first_height) / SPACING + 0.5))
        k = int(np.floor((yaw - azimuth) / (2 * np.pi) * num_yaws + 0.5)) % num_yaws
        if i >= num_radii or j < 0 or j >= num_heights:
            return np.int64(0)
        usable = np.int64(solutions[i, j, k])
        if is_exact:
            common &= usable
        else:
            common = usable
            for bit in range(8):
                if usable >> bit & 1 and (
                    lowest[i, j, k, bit] + base[2] < table
                    or not _is_within(
                        turns[i, j, k, bit] + azimuth - base[3], turn_limits[0], turn_limits[1]
                    )
                ):
                    common ^= 1 << bit
        if common == 0:
            break
    return common
