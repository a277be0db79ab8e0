"""Compiled queries of an inverse reachability map.

Frames: T is the support, B is the robot's base, G is a tool of the gripper, 0 and 6 are
Denavit-Hartenberg frames of the UR family.
"""

import numpy as np

from drake_clutter.compilation import njit
from drake_clutter.feasibility.arm_clearance import (
    collides_with_itself,
    collides_with_objects,
    lowest_point,
    place_capsules,
)
from drake_clutter.robots.ur_kinematics import solve_branch

SPACING = 0.02
"""Spacing of the map in radius and height [m]."""


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
def _is_tool_clear(ends, X_GJ, floor, arm, tops, picked, work):  # type: ignore[no-untyped-def]
    """Return whether the links behind the last joint are clear at the grasp and at the place.

    Their poses follow from that of the tool, wherever the base is.

    Args:
        ends: X_TG at the grasp and at the place. Shape (2, 4, 4).
        X_GJ: See `ArmGeometry.X_GJ`. Shape (4, 4).
        floor: Smallest height of the links in T [m].
        arm: Arrays of `ArmGeometry`.
        tops: Arrays of `ObstacleTops`.
        picked: Index of the picked object.
        work: Arrays for intermediate results.
    """
    _, _, _, _, limits, depths, axes, radii, may_touch, _ = arm
    _, _, _, _, placed, ignores = work
    at_support = np.zeros(4)
    for end in range(2):
        X_TJ = ends[end] @ X_GJ
        placed[:] = np.inf  # the other links are out of the way
        for k in range(len(depths)):
            if depths[k] < len(limits):
                continue
            for side in range(2):
                p = axes[k, side]
                for i in range(3):
                    placed[k, side, i] = (
                        X_TJ[i, 0] * p[0] + X_TJ[i, 1] * p[1] + X_TJ[i, 2] * p[2] + X_TJ[i, 3]
                    )
        if lowest_point(placed, radii) < floor:
            return False
        may = may_touch if end == 0 else ignores
        if collides_with_objects(placed, radii, at_support, tops, may, picked):
            return False
    return True


@njit(cache=True, nogil=True)
def find_reachable(grid, arm, X_GJ, tops, moves, bases, table, gap):  # type: ignore[no-untyped-def]
    """Return whether each move is reachable from each base, shape (m, k).

    A move is reachable if one branch reaches the grasp, the place, the points above them and what
    is between these. For arms with inverse kinematics in closed form, the map says which branches
    of a tool that points down come into question, and the solutions at the exact poses decide. For
    others it is the map with the point halfway, and links above the table.

    Args:
        grid: Arrays of the map, and its first height.
        arm: Arrays of `ArmGeometry`.
        X_GJ: See `ArmGeometry.X_GJ`.
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
    is_clear = np.ones(len(ends), np.bool_)
    if is_exact:
        for move in range(len(picked)):
            for row in range(starts[move], starts[move + 1]):
                for end in range(2):
                    of_frame_6[row, end] = ends[row, end] @ X_G6
                floor = _lowest_allowed(yaws[row], table) + gap
                is_clear[row] = _is_tool_clear(
                    ends[row], X_GJ, floor, arm, tops, picked[move], work
                )
    latest = np.zeros(len(picked), np.int64)
    for b in range(len(bases)):
        x, y, z, yaw = bases[b]
        c, s = np.cos(yaw), np.sin(yaw)
        X_BT[0, 0], X_BT[0, 1], X_BT[0, 3] = c, s, -c * x - s * y
        X_BT[1, 0], X_BT[1, 1], X_BT[1, 3] = -s, c, s * x - c * y
        X_BT[2, 3] = -z
        if is_exact:
            X_0T = X_0B @ X_BT
        for move in range(len(picked)):
            number = starts[move + 1] - starts[move]
            for step in range(number):
                # The row by which the base before reached it comes first.
                row = starts[move] + (latest[move] + step) % number
                if not is_clear[row]:
                    continue
                usable = np.int64(255)
                if not np.isnan(yaws[row, 0]):
                    usable = _usable_branches(
                        grid, ends[row], yaws[row], heights[row], bases[b], table + gap, is_exact
                    )
                elif not is_exact:
                    continue
                if usable and is_exact:
                    _write_points(X_0T, of_frame_6[row], ends[row], heights[row], poses)
                    floor = _lowest_allowed(yaws[row], table) + gap - z
                    usable = _first_reaching(
                        poses, floor, usable, arm, tops, bases[b], gap, picked[move], work
                    )
                if usable:
                    found[b, move] = True
                    latest[move] = row - starts[move]
                    break
    return found


@njit(cache=True, nogil=True)
def _lowest_allowed(yaws, table):  # type: ignore[no-untyped-def]
    """Return the height that links stay above; a tool on a side may touch the floor of the support.

    Args:
        yaws: Yaws of the tool, NaN on a side. Shape (2,).
        table: Height of the table in T [m].
    """
    return max(table, 0.0) if np.isnan(yaws[0]) else table


@njit(cache=True, nogil=True)
def _write_points(X_0T, of_frame_6, ends, height, poses):  # type: ignore[no-untyped-def]
    """Write the poses of frame 6 at the points of a move, see `_is_reached_exactly`.

    Args:
        X_0T: Pose of the support in frame 0. Shape (4, 4).
        of_frame_6: Poses of frame 6 in T at the grasp and at the place. Shape (2, 4, 4).
        ends: X_TG there. Shape (2, 4, 4).
        height: Height of the tool between the two [m].
        poses: Poses in frame 0 at the grasp, above it, above the place and at the place. Shape (4,
            4, 4).
    """
    for point in range(4):
        end = point // 2
        rise = height - ends[end, 2, 3] if point == 1 or point == 2 else 0.0
        for i in range(3):
            for j in range(4):
                poses[point, i, j] = X_0T[i, 3] + rise * X_0T[i, 2] if j == 3 else 0.0
                for k in range(3):
                    poses[point, i, j] += X_0T[i, k] * of_frame_6[end, k, j]


@njit(cache=True, nogil=True)
def _first_reaching(poses, floor, usable, arm, tops, base, gap, picked, work):  # type: ignore[no-untyped-def]
    """Return the bit of the first of the usable branches that reaches a move; 0 if none does.

    See `_is_reached_exactly` for the arguments.
    """
    for branch in range(8):
        if usable >> branch & 1 and _is_reached_exactly(
            poses, floor, branch, arm, tops, base, gap, picked, work
        ):
            return np.int64(1 << branch)
    return np.int64(0)


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
