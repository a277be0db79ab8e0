"""From the depth points of one segmented object to its pose: planes give candidates, the image chooses, ICP and search refine."""

import itertools
import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
import small_gicp
from numpy.typing import NDArray

from drake_clutter.catalog import ObjectClass, Shape
from drake_clutter.cell.camera import Camera
from drake_clutter.perception.pose_candidates import (
    EXTENT_TOLERANCES,
    MIN_POINTS,
    generate_pose_candidates,
    sample_segment_points,
)
from drake_clutter.perception.pose_score import (
    DEPTH_TOLERANCE,
    FINE_RAYS,
    SegmentView,
    pose_consistency,
    pose_objective,
    refine_pose,
    rotate_about_axis,
)
from drake_clutter.scenes.scene import Pose

Floats = NDArray[np.float64]

MAX_POINTS = 400
REST_ANGLE_TOLERANCE = math.radians(3.0)
GOOD_OBJECTIVE = 0.5
MIN_OBJECTIVE = 0.15
"""Of 1,000 segments of an early network, those whose best candidate was worth less took half the time; 2 in 100 came to 0.3."""
MAX_GUESS_ERROR = 0.05
"""m, of the guess to the true centre; pixels of the mask that are too far away are strays."""
MAX_REFINED_CANDIDATES, MAX_OBJECTIVE_GAP = 2, 0.15
"""How many candidates are refined, if not that much worse than the best."""
INITIAL_STEP, NUM_STEP_SIZES = 0.004, 4
"""m, and how often it is halved."""
MODEL_POINT_SPACING = 0.004
ICP_POINTS = 150
ICP_ITERATIONS = 6
ICP_MAX_CORRESPONDENCE_DISTANCE = 0.015


@dataclass(frozen=True)
class FittedPose:
    """A pose found in a depth image.

    Attributes:
        X_TO: the object's pose in the tray frame, one of those that its class's symmetries make alike.
        score: 0 to 1, the share of the pixels that speak for or against the pose which speak for it.
    """

    X_TO: Pose
    score: float


def _snap_to_rest(cylinder: bool, R: Floats) -> Floats | None:
    """R_TO with the axis that is nearly vertical (or a cylinder's that is nearly level) exactly so; None if none is near."""
    axis, up = (
        (2, R[2, 2]) if cylinder else (int(np.abs(R[2]).argmax()), R[2, int(np.abs(R[2]).argmax())])
    )
    vertical = np.array([0.0, 0.0, math.copysign(1.0, up)])
    column = R[:, axis]
    if math.acos(min(abs(up), 1.0)) < REST_ANGLE_TOLERANCE:
        wanted = vertical
    elif cylinder and abs(math.asin(up)) < REST_ANGLE_TOLERANCE:
        wanted = np.array([R[0, 2], R[1, 2], 0.0]) / math.hypot(R[0, 2], R[1, 2])
    else:
        return None
    turn = np.cross(column, wanted)
    sine = float(np.linalg.norm(turn))
    if sine < 1e-12:
        return R
    return np.asarray(rotate_about_axis(R, turn / sine, math.atan2(sine, float(column @ wanted))))


def _sample_surface(object_class: ObjectClass) -> Floats:
    """Points (N, 3) m all over a box's or cylinder's surface, in O."""
    half = np.asarray(object_class.size) / 2
    x, y, z = (np.linspace(-h, h, max(2, math.ceil(2 * h / MODEL_POINT_SPACING))) for h in half)
    if object_class.shape is Shape.BOX:
        grids = (x[[0, -1]], y, z), (x, y[[0, -1]], z), (x, y, z[[0, -1]])
        return np.unique(
            np.vstack([np.stack(np.meshgrid(*axes), -1).reshape(-1, 3) for axes in grids]).round(9),
            axis=0,
        )
    angle = np.linspace(
        0, 2 * math.pi, math.ceil(2 * math.pi * half[0] / MODEL_POINT_SPACING), endpoint=False
    )
    a, h = (grid.ravel() for grid in np.meshgrid(angle, z))
    side = np.column_stack([half[0] * np.cos(a), half[0] * np.sin(a), h])
    ends = np.stack(np.meshgrid(x, y, z[[0, -1]]), -1).reshape(-1, 3)
    return np.vstack([side, ends[np.hypot(ends[:, 0], ends[:, 1]) < half[0] - 0.001]])


class PoseFitter:
    """Fits boxes and cylinders to what a camera sees of them."""

    def __init__(self, camera: Camera) -> None:
        """Makes a fitter for the camera's images."""
        self.camera = camera
        self._models: dict[ObjectClass, tuple[Any, Any]] = {}

    def fit(
        self,
        object_class: ObjectClass,
        mask: NDArray[np.bool_],
        depth: NDArray[np.float32],
        p_TO_guess: Floats,
    ) -> FittedPose | None:
        """The pose of a segmented object; None if too little of it was measured, or nothing fits.

        Args:
            object_class: a box or a cylinder.
            mask: (height, width), the object's pixels.
            depth: (height, width) m along the camera's axis; inf, 0 or NaN where nothing was measured.
            p_TO_guess: (3,) m, where its centre is about; it decides what the image leaves open.

        Raises:
            ValueError: the class is a mesh, or an image has not the camera's size.
        """
        if object_class.shape is Shape.MESH:
            raise ValueError(
                f"class {object_class.name} is a mesh; allowed are boxes and cylinders"
            )
        size = (self.camera.height, self.camera.width)
        if mask.shape != size or depth.shape != size:
            raise ValueError(
                f"mask {mask.shape} and depth {depth.shape}; allowed is the camera's size, {size}"
            )
        guess = np.ascontiguousarray(p_TO_guess, float)
        window = self._mask_bounds(object_class, mask, guess)
        if window is None:
            return None
        depth, mask = np.ascontiguousarray(depth, np.float32), np.ascontiguousarray(mask, bool)
        view = SegmentView(depth, mask, window, guess, self.camera.pinhole)
        points, edges = sample_segment_points(view, MAX_POINTS)
        if len(points) < MIN_POINTS:
            return None
        cylinder, half = object_class.shape is Shape.CYLINDER, np.asarray(object_class.size) / 2
        for slack in EXTENT_TOLERANCES:
            R, p, value = generate_pose_candidates(cylinder, half, points, edges, view, slack)
            if len(value) and value[0] > GOOD_OBJECTIVE:
                break
        if not len(value) or value[0] < MIN_OBJECTIVE:
            return None
        chosen = self._select_distinct(object_class, R, p, value)
        found = [
            self._refine(object_class, cylinder, half, R[k], p[k], points, view) for k in chosen
        ]
        _, R_TO, p_TO = max(found, key=lambda one: one[0])
        score = float(
            pose_consistency(cylinder, half, R_TO, p_TO, view, FINE_RAYS, DEPTH_TOLERANCE)
        )
        return FittedPose(Pose.from_rotation(R_TO, p_TO), score) if score > 0 else None

    def _mask_bounds(
        self, object_class: ObjectClass, mask: NDArray[np.bool_], p_TO_guess: Floats
    ) -> tuple[int, int, int, int] | None:
        """First row, end row, first column, end column of the mask near the guess; None if it is empty there."""
        reach = float(np.linalg.norm(object_class.size)) / 2 + MAX_GUESS_ERROR
        radius = (
            self.camera.focal_length
            * reach
            / max(self.camera.depth(p_TO_guess[None])[0] - reach, 0.1)
        )
        u, v = self.camera.project(p_TO_guess[None])[0]
        top, bottom = max(0, math.floor(v - radius)), max(0, math.ceil(v + radius) + 1)
        left, right = max(0, math.floor(u - radius)), max(0, math.ceil(u + radius) + 1)
        near = mask[top:bottom, left:right]
        rows, columns = np.flatnonzero(near.any(axis=1)), np.flatnonzero(near.any(axis=0))
        if not len(rows):
            return None
        return (
            top + int(rows[0]),
            top + int(rows[-1]) + 1,
            left + int(columns[0]),
            left + int(columns[-1]) + 1,
        )

    @staticmethod
    def _select_distinct(
        object_class: ObjectClass, R: Floats, p: Floats, value: Floats
    ) -> list[int]:
        """The first few candidates that are not much the same as an earlier one."""
        chosen: list[int] = []
        for k in np.flatnonzero(value >= value[:1] - MAX_OBJECTIVE_GAP).tolist():
            if all(
                np.linalg.norm(p[k] - p[c]) > 0.01
                or _rotation_error(object_class, R[k], R[c]) > 0.15
                for c in chosen
            ):
                chosen.append(k)
            if len(chosen) == MAX_REFINED_CANDIDATES:
                break
        return chosen

    def _refine(
        self,
        object_class: ObjectClass,
        cylinder: bool,
        half: Floats,
        R: Floats,
        p: Floats,
        points: Floats,
        view: SegmentView,
    ) -> tuple[float, Floats, Floats]:
        """Value, R_TO and p_TO (3,) m after ICP and search, at rest exactly if that is better."""
        start = [(R, p), self._align_by_icp(object_class, R, p, points)]
        R, p = max(
            start,
            key=lambda one: float(
                pose_objective(cylinder, half, one[0], one[1], view, FINE_RAYS, DEPTH_TOLERANCE)
            ),
        )
        resting = _snap_to_rest(cylinder, R)
        if resting is None:
            best = refine_pose(cylinder, half, R, p, view, INITIAL_STEP, NUM_STEP_SIZES, False)
            resting = _snap_to_rest(cylinder, best[1])
            if resting is None:
                return best  # type: ignore[no-any-return]
            level = refine_pose(
                cylinder, half, resting, best[2], view, INITIAL_STEP / 2, NUM_STEP_SIZES - 1, True
            )
            return max(best, level, key=lambda one: float(one[0]))  # type: ignore[no-any-return]
        level = refine_pose(cylinder, half, resting, p, view, INITIAL_STEP, NUM_STEP_SIZES, True)
        free = refine_pose(cylinder, half, level[1], level[2], view, INITIAL_STEP / 4, 1, False)
        return free if free[0] > level[0] + 0.01 else level  # type: ignore[no-any-return]

    def _align_by_icp(
        self, object_class: ObjectClass, R: Floats, p: Floats, points: Floats
    ) -> tuple[Floats, Floats]:
        """R_TO and p_TO after ICP, point to plane, of the points to the class's surface."""
        if object_class not in self._models:
            cloud = small_gicp.PointCloud(_sample_surface(object_class))
            tree = small_gicp.KdTree(cloud, num_threads=1)
            small_gicp.estimate_normals(cloud, tree, num_neighbors=10, num_threads=1)
            self._models[object_class] = cloud, tree
        cloud, tree = self._models[object_class]
        X_OT = np.eye(4)
        X_OT[:3, :3], X_OT[:3, 3] = R.T, -R.T @ p
        found = small_gicp.align(
            cloud,
            small_gicp.PointCloud(points[:: max(1, len(points) // ICP_POINTS)]),
            tree,
            X_OT,
            registration_type="PLANE_ICP",
            max_correspondence_distance=ICP_MAX_CORRESPONDENCE_DISTANCE,
            num_threads=1,
            max_iterations=ICP_ITERATIONS,
        ).T_target_source
        if not np.isfinite(found).all():
            return R, p
        R_TO = np.ascontiguousarray(found[:3, :3].T)
        return R_TO, -R_TO @ found[:3, 3]


@lru_cache(maxsize=4096)
def _symmetry_rotations(object_class: ObjectClass) -> Floats:
    """The rotations, (n, 3, 3), that leave a box as it was: half turns about its axes, and quarter turns of a square one."""
    if object_class.shape is not Shape.BOX:
        return np.eye(3)[None]
    size = np.asarray(object_class.size)
    found = []
    for order in itertools.permutations(range(3)):
        for signs in itertools.product((1.0, -1.0), repeat=3):
            R = np.diag(signs)[list(order)]
            if np.linalg.det(R) > 0 and np.allclose(np.abs(R) @ size, size):
                found.append(R)
    return np.array(found)


def _rotation_error(object_class: ObjectClass, R_TA: Floats, R_TB: Floats) -> float:
    """The least angle, rad, that turns one orientation into one that looks like the other."""
    if object_class.shape is Shape.CYLINDER:
        return math.atan2(
            float(np.linalg.norm(np.cross(R_TA[:, 2], R_TB[:, 2]))),
            abs(float(R_TA[:, 2] @ R_TB[:, 2])),
        )
    cosine = (
        float(np.einsum("ij,nji->n", R_TA.T @ R_TB, _symmetry_rotations(object_class)).max()) - 1
    ) / 2
    return math.acos(min(max(cosine, -1.0), 1.0))


def pose_error(object_class: ObjectClass, X_TO: Pose, X_TO_true: Pose) -> tuple[float, float]:
    """How far a pose is off: m, and rad, the least over the class's symmetries.

    A box may be given half turns about its axes, a cylinder any turn about its axis and upside down; a mesh has no symmetry.
    """
    return float(np.linalg.norm(X_TO.p - X_TO_true.p)), _rotation_error(
        object_class, X_TO.rotation, X_TO_true.rotation
    )
