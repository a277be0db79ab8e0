"""Inverse reachability map: which base poses reach given poses of a tool.

The map is built once for a robot with its tool. It answers for a pose of the base in microseconds,
where the planner takes milliseconds (Zacharias, Borst and Hirzinger 2007, "Capturing robot
workspace structure: representing robot capabilities"; Vahrenkamp, Asfour and Dillmann 2013, "Robot
placement based on reachability inversion").

Frames: T is the support, B is the robot's base, G is a tool of the gripper, pointing down.
"""

import math
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drake_clutter.cell.pose_spec import PoseSpec
from drake_clutter.cell.work_cell import WorkCell
from drake_clutter.feasibility.arm_clearance import ArmGeometry, ObstacleTops
from drake_clutter.feasibility.move_poses import MovePoses
from drake_clutter.feasibility.reachability_query import SPACING, find_reachable
from drake_clutter.files import atomic_write, reading_file
from drake_clutter.planning.collision_model import CollisionModel
from drake_clutter.planning.planner_config import PlannerConfig
from drake_clutter.planning.tool_kinematics import ToolKinematics, downward_pose
from drake_clutter.robots.robot_model import load_robot

Floats = NDArray[np.float64]

NUM_YAWS = 24
"""Number of yaws of the tool relative to the radial direction."""
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
        self, moves: MovePoses, bases: Floats, table_height: float, tops: ObstacleTops
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
            find_reachable(
                (self.solutions, self.lowest, self.turns, self.turn_limits, self.heights[0]),
                tuple(getattr(self.arm, field.name) for field in fields(ArmGeometry)),
                self.arm.X_GJ,
                tuple(getattr(tops, field.name) for field in fields(ObstacleTops)),
                tuple(getattr(moves, field.name) for field in fields(MovePoses)),
                np.ascontiguousarray(bases, float),
                table_height,
                PlannerConfig().min_distance,
            )
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
