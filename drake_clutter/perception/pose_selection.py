"""Selection of the pose hypotheses that together explain a depth image best.

One object may yield several hypotheses, because its segment was split, or because a wrong class
fits a part of one of its faces. Such hypotheses explain pixels that a better hypothesis explains,
too, so hypotheses are selected greedily by the number of pixels that they alone explain.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drake_clutter.catalog import ObjectClass, Shape
from drake_clutter.cell.camera import Camera
from drake_clutter.cell.pinhole import pose_to_camera
from drake_clutter.compilation import njit
from drake_clutter.perception.mesh_pose_fit import render_mesh
from drake_clutter.perception.pose_score import (
    camera_position_in_object,
    cast_ray_row,
    image_bounds,
    ray_row,
)
from drake_clutter.scenes.scene import Pose

DEPTH_TOLERANCE = 0.008
"""Largest difference of measured and rendered depth at which a pixel is consistent [m]."""
MIN_UNCLAIMED_FRACTION = 0.5
"""Smallest fraction of a pose's consistent pixels that no selected pose explains."""
MAX_FREE_SPACE_FRACTION = 0.25
"""Largest fraction of free-space violations among a pose's conclusive pixels."""
MIN_UNCLAIMED_PIXELS = 25
"""Smallest number of a pose's consistent pixels that no selected pose explains."""
OBJECT_COST = 200
"""Number of pixels that one more object must explain to be worth selecting."""
# Result of the comparison of one pixel.
_INCONCLUSIVE = 0
_CONSISTENT = 1
_FREE_SPACE = 2


@dataclass(frozen=True)
class PoseEvidence:
    """Comparison of an object at a pose, rendered, with a measured depth image.

    All images are of the smallest window that contains the object's bounding box.

    Attributes:
        top: First row of the window.
        left: First column of the window.
        consistent: Whether the measured depth agrees with the pose. Shape (rows, columns).
        rendered_depth: Depth of the object [m]; 0 where it is not. Shape (rows, columns).
        num_free_space_violations: Number of pixels at which the camera sees through the object.
        num_unoccluded_pixels: Number of pixels that the object covers if nothing occludes it.
    """

    top: int
    left: int
    consistent: NDArray[np.bool_]
    rendered_depth: NDArray[np.float32]
    num_free_space_violations: int
    num_unoccluded_pixels: int

    @property
    def window(self) -> tuple[slice, slice]:
        """Rows and columns of the window in the image."""
        rows = slice(self.top, self.top + self.consistent.shape[0])
        columns = slice(self.left, self.left + self.consistent.shape[1])
        return rows, columns

    def mask(self, image_shape: tuple[int, ...]) -> NDArray[np.bool_]:
        """Return the consistent pixels as a mask of the whole image."""
        mask = np.zeros(image_shape, bool)
        mask[self.window] = self.consistent
        return mask


@njit(cache=True, error_model="numpy")
def _compare_with_depth(is_cylinder, half, R_TO, p_TO, depth, camera):  # type: ignore[no-untyped-def]
    """Compare an object at a pose with a depth image.

    Args:
        is_cylinder: Whether the object is a cylinder, not a box.
        half: Half sizes of the object [m]. Shape (3,).
        R_TO: Orientation. Shape (3, 3).
        p_TO: Position [m]. Shape (3,).
        depth: Measured depth [m]. Shape (H, W), float32.
        camera: The `Pinhole`.

    Returns:
        First row and first column of a window that contains the object; the result of each of its
        pixels, int8; the rendered depth of each of its pixels [m], float32; and the number of
        pixels that the object covers.
    """
    R, p = pose_to_camera(camera, R_TO, p_TO)
    top, bottom, left, right = image_bounds(half, R, p, depth.shape, camera)
    result = np.zeros((bottom - top, right - left), np.int8)
    rendered = np.zeros((bottom - top, right - left), np.float32)
    origin = camera_position_in_object(R, p)
    half_sizes = (half[0], half[1], half[2])
    num_covered = 0
    row = np.empty(right - left)
    for v in range(top, bottom):
        ray, step = ray_row(R, v, camera)
        cast_ray_row(is_cylinder, half_sizes, origin, ray, step, left - camera.u0, 1, row)
        for u in range(left, right):
            expected = row[u - left]
            if expected == np.inf:
                continue
            num_covered += 1
            rendered[v - top, u - left] = expected
            measured = depth[v, u]
            if not 0.05 < measured < 50.0:
                continue
            if measured > expected + DEPTH_TOLERANCE:
                result[v - top, u - left] = _FREE_SPACE
            elif measured > expected - DEPTH_TOLERANCE:
                result[v - top, u - left] = _CONSISTENT
    return top, left, result, rendered, num_covered


def evaluate_pose(
    object_class: ObjectClass, X_TO: Pose, depth: NDArray[np.float32], camera: Camera
) -> PoseEvidence:
    """Compare an object at a pose with a depth image.

    Args:
        object_class: Class of the object.
        X_TO: Pose of the object in the tray frame.
        depth: Measured depth [m]; 0 or infinite where there is no measurement. Shape (H, W).
        camera: Camera of the depth image.
    """
    if object_class.shape is Shape.MESH:
        return _evaluate_mesh_pose(object_class, X_TO, depth, camera)
    top, left, result, rendered, num_covered = _compare_with_depth(
        object_class.shape is Shape.CYLINDER,
        np.asarray(object_class.size) / 2,
        np.ascontiguousarray(X_TO.rotation),
        np.asarray(X_TO.p, float),
        np.ascontiguousarray(depth, np.float32),
        camera.pinhole,
    )
    num_violations = int(np.count_nonzero(result == _FREE_SPACE))
    return PoseEvidence(
        top, left, result == _CONSISTENT, rendered, num_violations, int(num_covered)
    )


def _evaluate_mesh_pose(
    object_class: ObjectClass, X_TO: Pose, depth: NDArray[np.float32], camera: Camera
) -> PoseEvidence:
    """Compare a mesh at a pose with a depth image, see `evaluate_pose`."""
    top, left, expected = render_mesh(object_class, X_TO.rotation, X_TO.p, camera)
    rows, columns = expected.shape
    measured = depth[top : top + rows, left : left + columns]
    is_covered = np.isfinite(expected)
    is_compared = is_covered & (measured > 0.05) & (measured < 50.0)
    difference = np.where(is_compared, measured - np.where(is_covered, expected, 0), -np.inf)
    return PoseEvidence(
        top,
        left,
        np.abs(difference) <= DEPTH_TOLERANCE,
        np.where(is_covered, expected, 0).astype(np.float32),
        int(np.count_nonzero(difference > DEPTH_TOLERANCE)),
        int(np.count_nonzero(is_covered)),
    )


def select_consistent_poses(
    evidence: Sequence[PoseEvidence],
    scores: Sequence[float],
    image_shape: tuple[int, int],
    min_visible_fraction: float,
    conflict: Callable[[int, int], bool] = lambda a, b: False,
) -> list[int]:
    """Select the poses that explain the most pixels with the fewest objects.

    The greedy selection is repeated with each unselected pose as its first one, and the best
    result counts.

    Args:
        evidence: Evidence for each pose.
        scores: How well each pose fits its own segment, from 0 to 1; the weight of its pixels.
        image_shape: Shape of the depth image.
        min_visible_fraction: Smallest fraction of an object's unoccluded pixels that must be
            consistent.
        conflict: Whether the poses of two indices exclude each other.

    Returns:
        Indices of the selected poses in the order of their selection.
    """
    plausible = [k for k, e in enumerate(evidence) if _is_plausible(e, min_visible_fraction)]
    selected, best_objective = _select_greedily(
        evidence, scores, image_shape, plausible, conflict, None
    )
    for first in [k for k in plausible if k not in selected]:
        alternative, objective = _select_greedily(
            evidence, scores, image_shape, plausible, conflict, first
        )
        if objective > best_objective:
            selected, best_objective = alternative, objective
    return selected


def _select_greedily(
    evidence: Sequence[PoseEvidence],
    scores: Sequence[float],
    image_shape: tuple[int, int],
    plausible: Sequence[int],
    conflict: Callable[[int, int], bool],
    first: int | None,
) -> tuple[list[int], int]:
    """Select poses one after the other.

    Args:
        evidence: See `select_consistent_poses`.
        scores: See `select_consistent_poses`.
        image_shape: See `select_consistent_poses`.
        plausible: Indices of the poses to select from.
        conflict: See `select_consistent_poses`.
        first: Index of the pose that is selected first, or None for the best one.

    Returns:
        Indices of the selected poses, and the objective: the number of pixels that they explain,
        minus free-space violations and the cost of each object.
    """
    claimed = np.zeros(image_shape, bool)
    selected = list[int]()
    objective = 0
    # Upper bound of the score that each pose can still add. The number of unclaimed pixels only
    # decreases, so a pose whose bound is exact and largest is the best one.
    bounds = dict.fromkeys(plausible, math.inf)
    while bounds:
        best = first if first in bounds else max(bounds, key=lambda k: (bounds[k], -k))
        e = evidence[best]
        num_unclaimed = int(np.count_nonzero(e.consistent & ~claimed[e.window]))
        gain = num_unclaimed - e.num_free_space_violations
        min_gain = MIN_UNCLAIMED_FRACTION * np.count_nonzero(e.consistent)
        if gain < max(MIN_UNCLAIMED_PIXELS, min_gain):
            del bounds[best]
            continue
        if best != first and scores[best] * gain < bounds[best]:
            bounds[best] = scores[best] * gain
            continue
        del bounds[best]
        if any(conflict(best, other) for other in selected):
            continue
        claimed[e.window] |= e.consistent
        selected.append(best)
        objective += gain - OBJECT_COST
    return selected, objective


def _is_plausible(e: PoseEvidence, min_visible_fraction: float) -> bool:
    num_consistent = int(np.count_nonzero(e.consistent))
    num_conclusive = num_consistent + e.num_free_space_violations
    min_consistent = max(1.0, min_visible_fraction * e.num_unoccluded_pixels)
    is_visible = num_consistent >= min_consistent
    return is_visible and e.num_free_space_violations <= MAX_FREE_SPACE_FRACTION * num_conclusive
