"""Which of many fitted poses are really there: those that together explain the image best.

A segment that fell apart gives several poses of one object, and a wrong class may fit a part of a face as well as the right one
fits all of it. Both explain what another pose explains better: poses are taken greedily, that with most pixels to itself first.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from drake_clutter.catalog import ObjectClass, Shape
from drake_clutter.cell.camera import Camera
from drake_clutter.cell.pinhole import pose_to_camera
from drake_clutter.perception.pose_score import (
    camera_position_in_object,
    cast_ray_row,
    image_bounds,
    ray_row,
)
from drake_clutter.scenes.scene import Pose

DEPTH_TOLERANCE = 0.008
"""m along the optical axis, within which a pose is said to be seen."""
_INCONCLUSIVE, _CONSISTENT, _FREE_SPACE = 0, 1, 2
MIN_UNCLAIMED_FRACTION = 0.5
"""Of the pixels of a pose that agree, the share that no better pose has claimed; with fewer it is no object."""
MAX_FREE_SPACE_FRACTION = 0.25
"""Of the pixels that speak for or against a pose, the share that the camera may see past it."""
MIN_UNCLAIMED_PIXELS = 25
"""Pixels of its own."""
OBJECT_COST = 200
"""Pixels that another object must explain for more objects to be the better explanation of an image."""


@dataclass(frozen=True)
class PoseEvidence:
    """What of the image a pose explains.

    Attributes:
        top, left: pixel where `consistent` begins.
        consistent: (rows, columns) bool, where the depth is as it should be.
        rendered_depth: (rows, columns) float32 m, where it is `consistent`, how far along the optical axis the pose says it is.
        free_space_violations: pixels where the camera sees past it.
        unoccluded_pixels: pixels that it would cover if nothing stood before it.
    """

    top: int
    left: int
    consistent: NDArray[np.bool_]
    rendered_depth: NDArray[np.float32]
    free_space_violations: int
    unoccluded_pixels: int

    @property
    def window(self) -> tuple[slice, slice]:
        """Rows and columns of the image that `seen` is of."""
        return slice(self.top, self.top + self.consistent.shape[0]), slice(
            self.left, self.left + self.consistent.shape[1]
        )

    def mask(self, image_shape: tuple[int, ...]) -> NDArray[np.bool_]:
        """Where in the whole image, of a shape, it is `seen`."""
        found = np.zeros(image_shape, bool)
        found[self.window] = self.consistent
        return found


@njit(cache=True, error_model="numpy")
def _compare_with_depth(cylinder, half, R, p, depth, camera):  # type: ignore[no-untyped-def]
    """What the pixels say of a pose.

    Returns:
        First row and column of a rectangle that holds it; (rows, columns) int8 what its pixels say,
        and float32 how far away the pose is there, m; how many pixels it covers.
    """
    R, p = pose_to_camera(camera, R, p)
    top, bottom, left, right = image_bounds(half, R, p, depth.shape, camera)
    said, far = (
        np.zeros((bottom - top, right - left), np.int8),
        np.zeros((bottom - top, right - left), np.float32),
    )
    e, h, alone = camera_position_in_object(R, p), (half[0], half[1], half[2]), 0
    distances = np.empty(right - left)
    for v in range(top, bottom):
        ray, step = ray_row(R, v, camera)
        cast_ray_row(cylinder, h, e, ray, step, left - camera.u0, 1, distances)
        for u in range(left, right):
            away = distances[u - left]
            if away == np.inf:
                continue
            alone += 1
            far[v - top, u - left] = away
            seen = depth[v, u]
            if not 0.05 < seen < 50.0:
                continue
            if seen > away + DEPTH_TOLERANCE:
                said[v - top, u - left] = _FREE_SPACE
            elif seen > away - DEPTH_TOLERANCE:
                said[v - top, u - left] = _CONSISTENT
    return top, left, said, far, alone


def evaluate_pose(
    object_class: ObjectClass, X_TO: Pose, depth: NDArray[np.float32], camera: Camera
) -> PoseEvidence:
    """What of a depth image (height, width) m, 0 or infinite where nothing is measured, a pose explains."""
    half, R, p = (
        np.asarray(object_class.size) / 2,
        np.ascontiguousarray(X_TO.rotation),
        np.asarray(X_TO.p, float),
    )
    depth, cylinder = np.ascontiguousarray(depth, np.float32), object_class.shape is Shape.CYLINDER
    top, left, said, away, alone = _compare_with_depth(cylinder, half, R, p, depth, camera.pinhole)
    return PoseEvidence(
        top, left, said == _CONSISTENT, away, int(np.count_nonzero(said == _FREE_SPACE)), int(alone)
    )


def select_consistent_poses(
    evidence: Sequence[PoseEvidence],
    scores: Sequence[float],
    image_shape: tuple[int, int],
    min_visible_fraction: float,
    conflict: Callable[[int, int], bool] = lambda a, b: False,
) -> list[int]:
    """The numbers of those that are taken for objects, the surest first.

    Greedily, and again with each of those that were left out as the first; of all these, what explains most with fewest.

    Args:
        evidence: of poses.
        scores: 0 to 1, how well each fits the segment that it was fitted to: a pixel of a pose that does counts for more.
        image_shape: of the image.
        min_visible_fraction: of the pixels that an object would cover alone, that must be seen.
        conflict: whether two, by their numbers, cannot both be there.
    """
    plausible = [k for k, e in enumerate(evidence) if _is_plausible(e, min_visible_fraction)]
    found, most = _select_greedily(evidence, scores, image_shape, plausible, conflict, None)
    for first in [k for k in plausible if k not in found]:
        other, explained = _select_greedily(
            evidence, scores, image_shape, plausible, conflict, first
        )
        if explained > most:
            found, most = other, explained
    return found


def _select_greedily(
    explanations: Sequence[PoseEvidence],
    scores: Sequence[float],
    shape: tuple[int, int],
    left: Sequence[int],
    clash: Callable[[int, int], bool],
    first: int | None,
) -> tuple[list[int], int]:
    """Of those that are left, one after the other; and what they explain: pixels, less those where the camera sees past them."""
    claimed = np.zeros(shape, bool)
    found, explained = list[int](), 0
    # What a pose has to itself only becomes less: the first whose number is still right is the best.
    own = dict.fromkeys(left, math.inf)
    while own:
        best = first if first in own else max(own, key=lambda k: (own[k], -k))
        e = explanations[best]
        mine = int(np.count_nonzero(e.consistent & ~claimed[e.window])) - e.free_space_violations
        if mine < max(
            MIN_UNCLAIMED_PIXELS, MIN_UNCLAIMED_FRACTION * np.count_nonzero(e.consistent)
        ):
            del own[best]
            continue
        if best != first and scores[best] * mine < own[best]:
            own[best] = scores[best] * mine
            continue
        del own[best]
        if any(clash(best, other) for other in found):
            continue
        claimed[e.window] |= e.consistent
        found.append(best)
        explained += mine - OBJECT_COST
    return found, explained


def _is_plausible(e: PoseEvidence, min_visible_fraction: float) -> bool:
    consistent = int(np.count_nonzero(e.consistent))
    violations = e.free_space_violations
    return consistent >= max(
        1.0, min_visible_fraction * e.unoccluded_pixels
    ) and violations <= MAX_FREE_SPACE_FRACTION * (consistent + violations)
