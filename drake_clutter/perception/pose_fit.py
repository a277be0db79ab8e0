"""Fit of object poses to segments of a depth image.

Planes and edges of a segment's points yield candidates, which are ranked by comparing their
rendered depth with the measured one, and refined by ICP and a pattern search.
"""

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
from drake_clutter.perception.mesh_pose_fit import POINT_SPACING, fit_mesh, surface_points
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
"""Approximate largest number of points from which candidates are made."""
REST_ANGLE_TOLERANCE = math.radians(3.0)
"""Largest inclination of an axis that is taken for vertical, or horizontal [rad]."""
GOOD_OBJECTIVE = 0.5
"""Objective of a candidate at which the larger extent tolerance is not tried."""
MIN_OBJECTIVE = 0.15
"""Smallest objective of a candidate that is refined.

Of 1,000 segments of an early network, those with a smaller objective took half of the time, and
2 % of them reached a score of 0.3.
"""
MAX_GUESS_ERROR = 0.05
"""Largest error of the guessed center [m]; pixels of the mask farther away are ignored."""
MAX_REFINED_CANDIDATES = 2
"""Largest number of candidates that are refined."""
MAX_OBJECTIVE_GAP = 0.15
"""Candidates are not refined if their objective is lower than the best one by more."""
INITIAL_STEP = 0.004
"""First step of the pattern search [m]."""
NUM_STEP_SIZES = 4
"""Number of step sizes of the pattern search, each half of the one before."""
MODEL_POINT_SPACING = 0.004
"""Spacing of the model's surface points for ICP [m]."""
ICP_POINTS = 150
"""Approximate largest number of measured points for ICP."""
ICP_ITERATIONS = 6
"""Largest number of iterations of ICP."""
ICP_MAX_CORRESPONDENCE_DISTANCE = 0.015
"""Largest distance of corresponding points in ICP [m]."""


@dataclass(frozen=True)
class FittedPose:
    """Pose of an object, fitted to a depth image.

    Attributes:
        X_TO: Pose in the tray frame, one of those that the class's symmetries make equivalent.
        score: Consistency of the pose with the image, from 0 to 1; see `pose_consistency`.
    """

    X_TO: Pose
    score: float


def _snap_to_rest(cylinder: bool, R_TO: Floats) -> Floats | None:
    """Rotate an almost resting object so that it rests exactly.

    Returns:
        The orientation with the almost vertical axis vertical, or with a cylinder's almost
        horizontal axis horizontal; None if there is no such axis.
    """
    axis = 2 if cylinder else int(np.abs(R_TO[2]).argmax())
    up = R_TO[2, axis]
    vertical = np.array([0.0, 0.0, math.copysign(1.0, up)])
    column = R_TO[:, axis]
    if math.acos(min(abs(up), 1.0)) < REST_ANGLE_TOLERANCE:
        target = vertical
    elif cylinder and abs(math.asin(up)) < REST_ANGLE_TOLERANCE:
        target = np.array([R_TO[0, 2], R_TO[1, 2], 0.0]) / math.hypot(R_TO[0, 2], R_TO[1, 2])
    else:
        return None
    rotation_vector = np.cross(column, target)
    sine = float(np.linalg.norm(rotation_vector))
    if sine < 1e-12:
        return R_TO
    angle = math.atan2(sine, float(column @ target))
    return np.asarray(rotate_about_axis(R_TO, rotation_vector / sine, angle))


def _sample_surface(object_class: ObjectClass) -> Floats:
    """Return points on the whole surface of an object in its frame [m]. Shape (N, 3)."""
    if object_class.shape is Shape.MESH:
        points = surface_points(object_class)
        return points[:: max(1, round((MODEL_POINT_SPACING / POINT_SPACING) ** 2))]
    half = np.asarray(object_class.size) / 2
    x, y, z = (np.linspace(-h, h, max(2, math.ceil(2 * h / MODEL_POINT_SPACING))) for h in half)
    if object_class.shape is Shape.BOX:
        grids = (x[[0, -1]], y, z), (x, y[[0, -1]], z), (x, y, z[[0, -1]])
        faces = [np.stack(np.meshgrid(*axes), -1).reshape(-1, 3) for axes in grids]
        return np.unique(np.vstack(faces).round(9), axis=0)
    num_angles = math.ceil(2 * math.pi * half[0] / MODEL_POINT_SPACING)
    angle = np.linspace(0, 2 * math.pi, num_angles, endpoint=False)
    a, h = (grid.ravel() for grid in np.meshgrid(angle, z))
    side = np.column_stack([half[0] * np.cos(a), half[0] * np.sin(a), h])
    ends = np.stack(np.meshgrid(x, y, z[[0, -1]]), -1).reshape(-1, 3)
    return np.vstack([side, ends[np.hypot(ends[:, 0], ends[:, 1]) < half[0] - 0.001]])


class PoseFitter:
    """Fit the poses of objects to segments of a depth image."""

    def __init__(self, camera: Camera) -> None:
        """Create a fitter for a camera's images."""
        self.camera = camera
        self._models: dict[ObjectClass, tuple[Any, Any]] = {}

    def fit(
        self,
        object_class: ObjectClass,
        mask: NDArray[np.bool_],
        depth: NDArray[np.float32],
        p_TO_guess: Floats,
    ) -> FittedPose | None:
        """Fit the pose of one segmented object.

        Args:
            object_class: Class of the object.
            mask: Pixels of the segment. Shape (H, W).
            depth: Measured depth [m]; inf, 0 or NaN where there is no measurement. Shape (H, W).
            p_TO_guess: Rough position of the center [m]; it decides what the image leaves open.
                Shape (3,).

        Returns:
            The best pose; None if too few points were measured or no candidate is good enough.

        Raises:
            ValueError: An image does not have the camera's size.
        """
        size = (self.camera.height, self.camera.width)
        if mask.shape != size or depth.shape != size:
            raise ValueError(
                f"mask {mask.shape} and depth {depth.shape}; expected the camera's size, {size}"
            )
        guess = np.ascontiguousarray(p_TO_guess, float)
        window = self._mask_bounds(object_class, mask, guess)
        if window is None:
            return None
        depth = np.ascontiguousarray(depth, np.float32)
        mask = np.ascontiguousarray(mask, bool)
        view = SegmentView(depth, mask, window, guess, self.camera.pinhole)
        points, edge_points = sample_segment_points(view, MAX_POINTS)
        if len(points) < MIN_POINTS:
            return None
        if object_class.shape is Shape.MESH:
            R_TO, p_TO, score = fit_mesh(
                object_class,
                points,
                view,
                self.camera,
                lambda R, p: self._align_by_icp(object_class, R, p, points),
            )
            return FittedPose(Pose.from_rotation(R_TO, p_TO), score) if score > 0 else None
        cylinder = object_class.shape is Shape.CYLINDER
        half = np.asarray(object_class.size) / 2
        for tolerance in EXTENT_TOLERANCES:
            R, p, value = generate_pose_candidates(
                cylinder, half, points, edge_points, view, tolerance
            )
            if len(value) and value[0] > GOOD_OBJECTIVE:
                break
        if not len(value) or value[0] < MIN_OBJECTIVE:
            return None
        refined = [
            self._refine(object_class, cylinder, half, R[k], p[k], points, view)
            for k in self._select_distinct(object_class, R, p, value)
        ]
        _, R_TO, p_TO = max(refined, key=lambda result: result[0])
        score = float(
            pose_consistency(cylinder, half, R_TO, p_TO, view, FINE_RAYS, DEPTH_TOLERANCE)
        )
        return FittedPose(Pose.from_rotation(R_TO, p_TO), score) if score > 0 else None

    def _mask_bounds(
        self, object_class: ObjectClass, mask: NDArray[np.bool_], p_TO_guess: Floats
    ) -> tuple[int, int, int, int] | None:
        """Return the bounds of the part of a mask that is near the guessed center.

        Returns:
            First row, end row, first column and end column; None if there are no such pixels.
        """
        reach = float(np.linalg.norm(object_class.size)) / 2 + MAX_GUESS_ERROR
        nearest_depth = max(self.camera.depth(p_TO_guess[None])[0] - reach, 0.1)
        radius = self.camera.focal_length * reach / nearest_depth
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
        """Return the indices of the best candidates that differ from each other."""
        selected: list[int] = []
        for k in np.flatnonzero(value >= value[:1] - MAX_OBJECTIVE_GAP).tolist():
            if all(
                np.linalg.norm(p[k] - p[c]) > 0.01
                or _rotation_error(object_class, R[k], R[c]) > 0.15
                for c in selected
            ):
                selected.append(k)
            if len(selected) == MAX_REFINED_CANDIDATES:
                break
        return selected

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
        """Refine a candidate by ICP and pattern search, exactly at rest if that is better.

        Returns:
            Objective, R_TO and p_TO.
        """

        def objective(pose: tuple[Floats, Floats]) -> float:
            R, p = pose
            value = pose_objective(cylinder, half, R, p, view, FINE_RAYS, DEPTH_TOLERANCE)
            return float(value)

        R, p = max([(R, p), self._align_by_icp(object_class, R, p, points)], key=objective)
        resting_R = _snap_to_rest(cylinder, R)
        if resting_R is None:
            best = refine_pose(cylinder, half, R, p, view, INITIAL_STEP, NUM_STEP_SIZES, False)
            resting_R = _snap_to_rest(cylinder, best[1])
            if resting_R is None:
                return best  # type: ignore[no-any-return]
            resting = refine_pose(
                cylinder,
                half,
                resting_R,
                best[2],
                view,
                INITIAL_STEP / 2,
                NUM_STEP_SIZES - 1,
                True,
            )
            return max(best, resting, key=lambda result: float(result[0]))  # type: ignore[no-any-return]
        resting = refine_pose(
            cylinder, half, resting_R, p, view, INITIAL_STEP, NUM_STEP_SIZES, True
        )
        _, rest_R, rest_p = resting
        free = refine_pose(cylinder, half, rest_R, rest_p, view, INITIAL_STEP / 4, 1, False)
        return free if free[0] > resting[0] + 0.01 else resting  # type: ignore[no-any-return]

    def _align_by_icp(
        self, object_class: ObjectClass, R: Floats, p: Floats, points: Floats
    ) -> tuple[Floats, Floats]:
        """Return R_TO and p_TO after point-to-plane ICP of the points to the model's surface."""
        if object_class not in self._models:
            cloud = small_gicp.PointCloud(_sample_surface(object_class))
            tree = small_gicp.KdTree(cloud, num_threads=1)
            small_gicp.estimate_normals(cloud, tree, num_neighbors=10, num_threads=1)
            self._models[object_class] = cloud, tree
        cloud, tree = self._models[object_class]
        X_OT = np.eye(4)
        X_OT[:3, :3] = R.T
        X_OT[:3, 3] = -R.T @ p
        X_OT = small_gicp.align(
            cloud,
            small_gicp.PointCloud(points[:: max(1, len(points) // ICP_POINTS)]),
            tree,
            X_OT,
            registration_type="PLANE_ICP",
            max_correspondence_distance=ICP_MAX_CORRESPONDENCE_DISTANCE,
            num_threads=1,
            max_iterations=ICP_ITERATIONS,
        ).T_target_source
        if not np.isfinite(X_OT).all():
            return R, p
        R_TO = np.ascontiguousarray(X_OT[:3, :3].T)
        return R_TO, -R_TO @ X_OT[:3, 3]


@lru_cache(maxsize=4096)
def symmetry_rotations(object_class: ObjectClass) -> Floats:
    """Return the rotations that map a box onto itself; only the identity for other shapes.

    These are half turns about its axes, and quarter turns about the axes of square faces. Shape
    (n, 3, 3).
    """
    if object_class.shape is not Shape.BOX:
        return np.eye(3)[None]
    size = np.asarray(object_class.size)
    rotations = []
    for order in itertools.permutations(range(3)):
        for signs in itertools.product((1.0, -1.0), repeat=3):
            R = np.diag(signs)[list(order)]
            if np.linalg.det(R) > 0 and np.allclose(np.abs(R) @ size, size):
                rotations.append(R)
    return np.array(rotations)


def _rotation_error(object_class: ObjectClass, R_TA: Floats, R_TB: Floats) -> float:
    """Return the smallest angle between two orientations over the class's symmetries [rad]."""
    if object_class.shape is Shape.CYLINDER:
        sine = float(np.linalg.norm(np.cross(R_TA[:, 2], R_TB[:, 2])))
        return math.atan2(sine, abs(float(R_TA[:, 2] @ R_TB[:, 2])))
    traces = np.einsum("ij,nji->n", R_TA.T @ R_TB, symmetry_rotations(object_class))
    cosine = (float(traces.max()) - 1) / 2
    return math.acos(min(max(cosine, -1.0), 1.0))


def pose_error(object_class: ObjectClass, X_TO: Pose, X_TO_true: Pose) -> tuple[float, float]:
    """Return the errors of a pose's position [m] and orientation [rad].

    The orientation's error is the smallest one over the class's symmetries: half turns of a box
    about its axes, and any turn of a cylinder about its axis, also upside down. A mesh has none.

    Args:
        object_class: Class of the object.
        X_TO: The pose.
        X_TO_true: The true pose.
    """
    position_error = float(np.linalg.norm(X_TO.p - X_TO_true.p))
    return position_error, _rotation_error(object_class, X_TO.rotation, X_TO_true.rotation)
