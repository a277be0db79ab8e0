"""Clearance of an arm at a pose of its tool, compiled: links as capsules, objects by their tops.

It answers in about a microsecond, for arms with inverse kinematics in closed form.

Frames: T is the support, B is the robot's base, F is its flange, G is the tool, J is the frame of a
joint, 0 and 6 are Denavit-Hartenberg frames of the UR family.
"""

from collections.abc import Collection
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

from drake_clutter.cell.gripper import Tool
from drake_clutter.cell.support_sdf import FLOOR, support_boxes
from drake_clutter.compilation import njit
from drake_clutter.planning.collision_model import CollisionModel
from drake_clutter.planning.tool_kinematics import ToolKinematics, invert_pose
from drake_clutter.robots.inverse_kinematics import UrInverseKinematics
from drake_clutter.robots.serial_chain import SerialChain, chain_frames
from drake_clutter.robots.ur_kinematics import UR10_PARAMETERS, forward_kinematics
from drake_clutter.scenes.scene import Scene

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

CELL_SIZE = 0.005
"""Spacing of the grid over the support [m]."""
_BORDER = 0.2
"""Width beside the support that the grid covers [m]."""
_NO_OBJECT = -1


@dataclass(frozen=True, eq=False)
class ArmGeometry:
    """An arm with inverse kinematics in closed form, and its links as capsules.

    All arrays are empty for other arms.

    Attributes:
        fixed: See `SerialChain`. Shape (n + 1, 4, 4).
        lengths: Denavit-Hartenberg parameters d1, a2, a3, d4, d5, d6 [m]. Shape (6,).
        X_0B: Pose of the base in frame 0. Shape (4, 4).
        X_G6: Pose of frame 6 in the tool. Shape (4, 4).
        limits: Position limits of the joints [rad]. Shape (n, 2).
        depths: Number of joints that move each capsule. Shape (c,).
        ends: Ends of their axes in J [m]. Shape (c, 2, 3).
        radii: Radii of the capsules [m]. Shape (c,).
        may_touch: Whether a capsule is of the tool, which touches the picked object. Shape (c,).
        pairs: Indices of capsules that may collide with each other. Shape (p, 2).
    """

    fixed: Floats
    lengths: Floats
    X_0B: Floats
    X_G6: Floats
    limits: Floats
    depths: Integers
    ends: Floats
    radii: Floats
    may_touch: NDArray[np.bool_]
    pairs: Integers

    @staticmethod
    def without_closed_form() -> "ArmGeometry":
        """Return the geometry of an arm without inverse kinematics in closed form."""
        X = np.empty((0, 4, 4))
        none = np.empty(0, np.int64)
        none_of_tool, pairs = np.empty(0, bool), none.reshape(0, 2)
        return ArmGeometry(
            *(X, np.empty(0), X[:, 0], X[:, 0], np.empty((0, 2))),
            *(none, np.empty((0, 2, 3)), np.empty(0), none_of_tool, pairs),
        )

    @property
    def is_exact(self) -> bool:
        """Whether the arm has inverse kinematics in closed form."""
        return len(self.limits) > 0

    @property
    def X_GJ(self) -> Floats:
        """Pose of the last joint's frame in the tool; empty for other arms. Shape (4, 4)."""
        if not self.is_exact:
            return np.empty((0, 4))
        d1, a2, a3, d4, d5, d6 = self.lengths.tolist()
        parameters = replace(
            UR10_PARAMETERS, a=(0.0, a2, a3, 0.0, 0.0, 0.0), d=(d1, 0.0, 0.0, d4, d5, d6)
        )
        zero = np.zeros(len(self.limits))
        chain = SerialChain(self.fixed, np.ones(len(zero), bool))
        X_6B = invert_pose(forward_kinematics(zero, parameters)) @ self.X_0B
        X_GF = self.X_G6 @ X_6B @ chain.forward_kinematics(zero)
        return np.asarray(X_GF @ invert_pose(self.fixed[-1]))

    @staticmethod
    def from_model(
        kinematics: ToolKinematics,
        tool: Tool,
        model: CollisionModel,
        close_pairs: Collection[tuple[int, int]],
    ) -> "ArmGeometry":
        """Return the geometry of an arm.

        Args:
            kinematics: Kinematics of the arm with the tool.
            tool: The tool.
            model: Collision model of the arm.
            close_pairs: Pairs of shapes that may collide, see `FoundDistances.pairs`.
        """
        ik = kinematics.robot.ik
        if not isinstance(ik, UrInverseKinematics):
            return ArmGeometry.without_closed_form()
        capsules = model.moving_capsules()
        index = {shape: k for k, shape in enumerate(capsules.shapes.tolist())}
        pairs = [
            (index[first], index[second])
            for first, second in close_pairs
            if first in index and second in index
        ]
        d, a = ik.parameters.d, ik.parameters.a
        X_GF = tool.X_FG.inverse().GetAsMatrix4()
        return ArmGeometry(
            kinematics.robot.chain.fixed,
            np.array([d[0], a[1], a[2], d[3], d[4], d[5]]),
            np.eye(4) if ik.X_0B is None else ik.X_0B,
            X_GF if ik.X_F6 is None else X_GF @ ik.X_F6,
            kinematics.robot.position_limits,
            capsules.depths,
            capsules.ends,
            capsules.radii,
            np.array([model.owner_name(shape) in tool.contact_links for shape in index]),
            np.array(pairs, np.int64).reshape(-1, 2),
        )


@dataclass(frozen=True, eq=False)
class ObstacleTops:
    """Smallest heights of a ball's center above the objects and walls of a scene, over x and y.

    Attributes:
        first: Height for each radius of balls [m]; minus infinity beside all objects. Shape (k,
            n_x, n_y).
        owners: Index of the object that determines it; -1 for walls. Shape (k, n_x, n_y).
        second: Height without this object [m]. Shape (k, n_x, n_y).
        corner: x and y of the first grid point in T [m]. Shape (2,).
        highest: Greatest height for each radius [m]. Shape (k,).
    """

    first: Floats
    owners: Integers
    second: Floats
    corner: Floats
    highest: Floats

    @staticmethod
    def from_scene(scene: Scene, radii: Floats) -> "ObstacleTops":
        """Return the heights above the objects of a scene, which count as prisms.

        Args:
            scene: The scene.
            radii: Radii of the balls [m]. Shape (k,).
        """
        corner = -scene.support.half_size - _BORDER
        counts = np.round(-2 * corner / CELL_SIZE).astype(int) + 1
        first, second = np.full((2, len(radii), *counts), -np.inf)
        owners = np.full(first.shape, _NO_OBJECT)
        solids = [(k, o.corners_T[:, :2], o.top_height) for k, o in enumerate(scene.objects)]
        for name, size, center in support_boxes(scene.support):
            if name != FLOOR:
                signs = np.array([(-1, -1), (-1, 1), (1, -1), (1, 1)])
                xy = np.array(center[:2]) + signs * np.array(size[:2]) / 2
                solids.append((_NO_OBJECT, xy, center[2] + size[2] / 2))
        for owner, xy, top in solids:
            outline = xy[ConvexHull(xy).vertices]  # counter-clockwise
            _raise_tops(outline, top, owner, radii, corner, first, owners, second)
        return ObstacleTops(first, owners, second, corner, first.max(axis=(1, 2)))


@njit(cache=True, nogil=True)
def _raise_tops(outline, top, owner, radii, corner, first, owners, second):  # type: ignore[no-untyped-def]
    """Raise the heights of `ObstacleTops` to those above a prism with a convex outline (m, 2)."""
    reach = radii.max() if len(radii) else 0.0
    start, end = np.empty(2, np.int64), np.empty(2, np.int64)
    for i in range(2):
        low, high = outline[:, i].min() - reach, outline[:, i].max() + reach
        start[i] = max(0, int(np.floor((low - corner[i]) / CELL_SIZE)))
        end[i] = min(first.shape[i + 1], int(np.ceil((high - corner[i]) / CELL_SIZE)) + 1)
    for i in range(start[0], end[0]):
        for j in range(start[1], end[1]):
            x, y = corner[0] + i * CELL_SIZE, corner[1] + j * CELL_SIZE
            squared = np.inf
            is_inside = True
            for k in range(len(outline)):
                p, q = outline[k - 1], outline[k]
                ax, ay, dx, dy = q[0] - p[0], q[1] - p[1], x - p[0], y - p[1]
                if ax * dy - ay * dx < 0:
                    is_inside = False
                t = min(max((dx * ax + dy * ay) / (ax * ax + ay * ay), 0.0), 1.0)
                squared = min(squared, (dx - t * ax) ** 2 + (dy - t * ay) ** 2)
            if is_inside:
                squared = 0.0
            for k in range(len(radii)):
                if squared > radii[k] * radii[k]:
                    continue
                height = top + np.sqrt(radii[k] * radii[k] - squared)
                if height > first[k, i, j]:
                    second[k, i, j] = first[k, i, j]
                    first[k, i, j], owners[k, i, j] = height, owner
                elif height > second[k, i, j]:
                    second[k, i, j] = height


@njit(cache=True, nogil=True)
def place_capsules(fixed, revolute, depths, ends, q, frames, moved, placed):  # type: ignore[no-untyped-def]
    """Write the ends of capsules in B, shape (c, 2, 3), at joint positions q."""
    chain_frames(fixed, revolute, q, frames, moved)
    for k in range(len(depths)):
        M = moved[depths[k] - 1]
        for end in range(2):
            p = ends[k, end]
            for i in range(3):
                placed[k, end, i] = M[i, 0] * p[0] + M[i, 1] * p[1] + M[i, 2] * p[2] + M[i, 3]


@njit(cache=True, nogil=True)
def collides_with_itself(placed, radii, pairs, distance):  # type: ignore[no-untyped-def]
    """Return whether two capsules of a pair are closer than a distance [m]."""
    for k in range(len(pairs)):
        A, B = pairs[k]
        limit = radii[A] + radii[B] + distance
        if _squared_distance(placed[A], placed[B]) < limit * limit:
            return True
    return False


@njit(cache=True, nogil=True)
def _squared_distance(A, B):  # type: ignore[no-untyped-def]
    """Return the squared distance of two segments (Ericson 2005, Real-Time Collision Detection)."""
    aa = bb = ab = ad = bd = 0.0
    for i in range(3):
        a, b, d = A[1, i] - A[0, i], B[1, i] - B[0, i], A[0, i] - B[0, i]
        aa += a * a
        bb += b * b
        ab += a * b
        ad += a * d
        bd += b * d
    determinant = aa * bb - ab * ab
    s = 0.0
    if determinant > 1e-12:
        s = min(max((ab * bd - ad * bb) / determinant, 0.0), 1.0)
    t = (ab * s + bd) / bb if bb > 1e-12 else 0.0
    if t < 0.0 or t > 1.0 or bb <= 1e-12:
        t = min(max(t, 0.0), 1.0)
        s = min(max((ab * t - ad) / aa, 0.0), 1.0) if aa > 1e-12 else 0.0
    squared = 0.0
    for i in range(3):
        along = A[0, i] + s * (A[1, i] - A[0, i]) - B[0, i] - t * (B[1, i] - B[0, i])
        squared += along * along
    return squared


@njit(cache=True, nogil=True)
def lowest_point(placed, radii):  # type: ignore[no-untyped-def]
    """Return the height in B of the lowest point of capsules [m]."""
    lowest = np.inf
    for k in range(len(radii)):
        lowest = min(lowest, placed[k, 0, 2] - radii[k], placed[k, 1, 2] - radii[k])
    return lowest


@njit(cache=True, nogil=True)
def collides_with_objects(placed, radii, base, tops, may_touch, picked):  # type: ignore[no-untyped-def]
    """Return whether a capsule is in an object or a wall.

    Args:
        placed: Ends of the capsules in B [m]. Shape (c, 2, 3).
        radii: Their radii [m]. Shape (c,).
        base: x, y, z [m] and yaw [rad] of the base.
        tops: Arrays of `ObstacleTops`.
        may_touch: Whether the object does not count for a capsule. Shape (c,).
        picked: Index of the object.
    """
    first, owners, second, corner, highest = tops
    c, s = np.cos(base[3]), np.sin(base[3])
    _, num_x, num_y = first.shape
    for k in range(len(radii)):
        if min(placed[k, 0, 2], placed[k, 1, 2]) + base[2] >= highest[k]:
            continue
        length = 0.0
        for i in range(3):
            length += (placed[k, 1, i] - placed[k, 0, i]) ** 2
        count = 1 + int(np.ceil(np.sqrt(length) / max(radii[k], CELL_SIZE)))
        for ball in range(count):
            t = ball / (count - 1) if count > 1 else 0.0
            x = placed[k, 0, 0] + t * (placed[k, 1, 0] - placed[k, 0, 0])
            y = placed[k, 0, 1] + t * (placed[k, 1, 1] - placed[k, 0, 1])
            z = placed[k, 0, 2] + t * (placed[k, 1, 2] - placed[k, 0, 2]) + base[2]
            i = int(np.floor((base[0] + c * x - s * y - corner[0]) / CELL_SIZE + 0.5))
            j = int(np.floor((base[1] + s * x + c * y - corner[1]) / CELL_SIZE + 0.5))
            if i < 0 or j < 0 or i >= num_x or j >= num_y:
                continue
            height = first[k, i, j]
            if may_touch[k] and owners[k, i, j] == picked:
                height = second[k, i, j]
            if z < height:
                return True
    return False
