"""Inverse reachability map: which base poses reach given poses of a vertical tool.

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

from drake_clutter.cell.gripper import Grasp, Tool
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
    solve_downward,
)
from drake_clutter.files import atomic_write, reading_file
from drake_clutter.planning.collision_model import CollisionModel
from drake_clutter.planning.planner_config import PlannerConfig
from drake_clutter.planning.tool_kinematics import (
    ToolKinematics,
    downward_pose,
    is_vertical,
    retreat_along_axis,
)
from drake_clutter.robots.robot_model import load_robot
from drake_clutter.scenes.scene import Pose, SceneObject
from drake_clutter.simulation.scene_plant import rigid_transform

Floats = NDArray[np.float64]

SPACING = 0.02
"""Spacing of the map in radius and height [m]."""
NUM_YAWS = 24
"""Number of yaws of the tool relative to the radial direction."""
NUM_YAWS_ON_AXIS = 4
"""Number of yaws of a round tool on the flange's axis, about which only the gripper turns."""
MIN_GRASP_DISTANCE = 0.03
"""Of grasps that are closer to each other, the first stands for the others [m]."""
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
                (moves.poses, moves.starts, moves.picked),
                np.ascontiguousarray(bases, float),
                table_height + PlannerConfig().min_distance,
                PlannerConfig().min_distance,
            )
        )


@dataclass(frozen=True, eq=False)
class MovePoses:
    """Poses of a vertical tool through which moves go, for each grasp and yaw of each move.

    Attributes:
        poses: x, y [m] and yaw [rad] at the grasp, then at the place; heights at the grasp, at the
            place, and in between [m]. Shape (l, 9).
        starts: Index of the first row of each move, and the number of all. Shape (k + 1,).
        picked: Index in the scene of the object that each move picks. Shape (k,).
    """

    poses: Floats
    starts: NDArray[np.int64]
    picked: NDArray[np.int64]

    @staticmethod
    def join(moves: Sequence[Floats], picked: Sequence[int]) -> "MovePoses":
        """Return the poses of moves from those of each, see `find_move_poses`."""
        starts = np.cumsum([0, *map(len, moves)])
        return MovePoses(np.vstack([np.empty((0, 9)), *moves]), starts, np.array(picked, np.int64))


def find_move_poses(
    picked: SceneObject,
    X_TO_place: Pose,
    tool: Tool,
    grasps: Iterable[Grasp],
    config: PlannerConfig,
) -> Floats:
    """Return the poses of a vertical tool through which a move goes.

    Args:
        picked: Object to pick.
        X_TO_place: Pose at which it is released.
        tool: Tool that holds it.
        grasps: Its grasps with this tool; those with a tilted tool are left out.
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
    is_on_axis = bool(np.allclose(tool.X_FG.translation()[:2], 0.0))
    rows = []
    positions = list[Floats]()
    for grasp in grasps:
        X_pick = retreat_along_axis(grasp.X_TG.GetAsMatrix4(), config.lip_gap)
        X_place = X_moved @ X_pick
        if not (is_vertical(X_pick) and is_vertical(X_place)):
            continue
        p_TG = X_pick[:3, 3]
        if any(np.linalg.norm(p_TG - other) < MIN_GRASP_DISTANCE for other in positions):
            continue
        positions.append(p_TG)
        number = grasp.num_angles or (NUM_YAWS_ON_AXIS if is_on_axis else config.num_yaws)
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
def _is_reached_exactly(points, branch, arm, tops, base, table, gap, picked, work):  # type: ignore[no-untyped-def]
    """Return whether a branch reaches the points of a move without collision.

    Between the points above the grasp and the place the arm moves on a straight line in joint
    space; its middle is checked.

    Args:
        points: x, y, z [m] and yaw [rad] of the tool in B at the grasp, above it, above the place
            and at the place. Shape (4, 4).
        branch: Branch of the inverse kinematics.
        arm: Arrays of `ArmGeometry`.
        tops: Arrays of `ObstacleTops`.
        base: x, y, z [m] and yaw [rad] of the base.
        table: Smallest height of the links in T [m].
        gap: Smallest distance of links from each other [m].
        picked: Index of the picked object.
        work: Arrays for intermediate results.
    """
    fixed, lengths, X_0B, X_G6, limits, depths, ends, radii, may_touch, pairs = arm
    X, q, revolute, frames, moved, placed, ignores = work
    for point in (0, 3, 1, 2):
        if not solve_downward(lengths, X_0B, X_G6, points[point], branch, X, q[point]):
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
        if lowest_point(placed, radii) + base[2] < table:
            return False
        if collides_with_itself(placed, radii, pairs, gap):
            return False
        # At the place the picked object is no longer where it was.
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
    come into question, and the solutions at the exact poses decide. For others it is the map with
    the point halfway, and links above the table.

    Args:
        grid: Arrays of the map, and its first height.
        arm: Arrays of `ArmGeometry`.
        tops: Arrays of `ObstacleTops`.
        moves: Arrays of `MovePoses`.
        bases: x, y, z [m] and yaw [rad] of the bases. Shape (m, 4).
        table: Smallest height of the links in T [m].
        gap: Smallest distance of links from each other [m].
    """
    solutions, lowest, turns, turn_limits, first_height = grid
    poses, starts, picked = moves
    num_joints, num_capsules = len(arm[4]), len(arm[5])
    is_exact = num_joints > 0
    num_points = 4 if is_exact else 5
    num_radii, num_heights, num_yaws = solutions.shape
    found = np.zeros((len(bases), len(starts) - 1), np.bool_)
    work = (
        np.empty((2, 4, 4)),
        np.empty((5, num_joints)),
        np.ones(num_joints, np.bool_),
        np.empty((num_joints + 1, 4, 4)),
        np.empty((num_joints, 3, 4)),
        np.empty((num_capsules, 2, 3)),
        np.ones(num_capsules, np.bool_),
    )
    points = np.empty((4, 4))
    for b in range(len(bases)):
        x, y, z, base_yaw = bases[b]
        c, sine = np.cos(base_yaw), np.sin(base_yaw)
        for move in range(len(starts) - 1):
            for row in range(starts[move], starts[move + 1]):
                common = np.int64(255)
                # The grasp and the point above it, the point above the place, the place, halfway.
                for point in range(num_points):
                    if point == 4:
                        turn = poses[row, 5] - poses[row, 2]
                        turn -= 2 * np.pi * np.floor(turn / (2 * np.pi) + 0.5)
                        dx = (poses[row, 0] + poses[row, 3]) / 2 - x
                        dy = (poses[row, 1] + poses[row, 4]) / 2 - y
                        yaw = poses[row, 2] + turn / 2
                    else:
                        end = 0 if point < 2 else 3
                        dx, dy = poses[row, end] - x, poses[row, end + 1] - y
                        yaw = poses[row, end + 2]
                    height = poses[row, 8]
                    if point == 0:
                        height = poses[row, 6]
                    elif point == 3:
                        height = poses[row, 7]
                    azimuth = np.arctan2(dy, dx)
                    i = int(np.sqrt(dx * dx + dy * dy) / SPACING + 0.5)
                    k = int(np.floor((yaw - azimuth) / (2 * np.pi) * num_yaws + 0.5)) % num_yaws
                    j = int(np.floor((height - z - first_height) / SPACING + 0.5))
                    usable = np.int64(0)
                    if i < num_radii and 0 <= j < num_heights:
                        usable = np.int64(solutions[i, j, k])
                    if is_exact:
                        points[point, 0] = c * dx + sine * dy
                        points[point, 1] = c * dy - sine * dx
                        points[point, 2], points[point, 3] = height - z, yaw - base_yaw
                        common &= usable
                    else:
                        for bit in range(8):
                            if usable >> bit & 1 and (
                                lowest[i, j, k, bit] + z < table
                                or not _is_within(
                                    turns[i, j, k, bit] + azimuth - base_yaw,
                                    turn_limits[0],
                                    turn_limits[1],
                                )
                            ):
                                usable ^= 1 << bit
                        common = usable
                    if common == 0:
                        break
                if not is_exact:
                    found[b, move] = common != 0
                else:
                    for bit in range(8):
                        if common >> bit & 1 and _is_reached_exactly(
                            points, bit, arm, tops, bases[b], table, gap, picked[move], work
                        ):
                            found[b, move] = True
                            break
                if found[b, move]:
                    break
    return found
