"""Segments of objects in the output of the segmentation network, by clusters of votes."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drake_clutter.compilation import njit
from drake_clutter.perception.segmentation import ImageWindow, upsample


@njit(cache=True)
def _densest_vote(votes, is_free, radius):  # type: ignore[no-untyped-def]
    """Return the index of the free vote with the most free votes around it.

    Of many free votes, only about 300 at regular intervals are considered.

    Args:
        votes: Votes [m]. Shape (n, 3).
        is_free: Whether each vote is not assigned yet. Shape (n,).
        radius: Radius of the neighborhood [m].

    Returns:
        The index; -1 if no vote is free.
    """
    free = np.flatnonzero(is_free)
    free = free[:: max(1, len(free) // 300)]
    most, densest = 0, -1
    for n in range(len(free)):
        i, count = free[n], 0
        for j in free:
            x = votes[i, 0] - votes[j, 0]
            y = votes[i, 1] - votes[j, 1]
            z = votes[i, 2] - votes[j, 2]
            count += x * x + y * y + z * z < radius * radius
        if count > most:
            most, densest = count, int(i)
    return densest


@njit(cache=True)
def cluster_votes(votes, radius, min_votes):  # type: ignore[no-untyped-def]
    """Assign votes to objects.

    The densest neighborhood becomes a cluster, which moves to the mean of its votes (mean shift)
    and takes all votes within the radius. This is repeated for the remaining votes.

    Args:
        votes: Votes for the center of an object [m]. Shape (n, 3).
        radius: Radius of a cluster [m].
        min_votes: Smallest number of votes of an object.

    Returns:
        Index of each vote's cluster; negative: none. Shape (n,).
    """
    labels = np.full(len(votes), -1)
    is_free = np.ones(len(votes), np.bool_)
    num_objects = 0
    while True:
        first = _densest_vote(votes, is_free, radius)
        if first < 0:
            return labels
        x, y, z = votes[first]
        for _ in range(3):
            total, sx, sy, sz = 0, 0.0, 0.0, 0.0
            for j in range(len(votes)):
                a, b, c = votes[j, 0] - x, votes[j, 1] - y, votes[j, 2] - z
                if is_free[j] and a * a + b * b + c * c < radius * radius:
                    total += 1
                    sx += votes[j, 0]
                    sy += votes[j, 1]
                    sz += votes[j, 2]
            if total > 0:
                x, y, z = sx / total, sy / total, sz / total
        total = 0
        for j in range(len(votes)):
            a, b, c = votes[j, 0] - x, votes[j, 1] - y, votes[j, 2] - z
            if is_free[j] and (j == first or a * a + b * b + c * c < radius * radius):
                is_free[j] = False
                labels[j] = num_objects
                total += 1
        if total < min_votes:
            labels[labels == num_objects] = -2  # These votes are not considered again.
        else:
            num_objects += 1


@dataclass(frozen=True)
class Segment:
    """Pixels of one object.

    Attributes:
        class_name: Name of the object's class.
        mask: Pixels of the object. Shape (H, W).
        p_TO: Estimated position of the object's center [m]. Shape (3,).
    """

    class_name: str
    mask: NDArray[np.bool_]
    p_TO: NDArray[np.float64]


def extract_segments(
    class_map: NDArray[np.int64],
    votes_T: NDArray[np.float32],
    radii: Sequence[float],
    class_names: Sequence[str],
    window: ImageWindow,
    image_shape: tuple[int, int],
    min_votes: int,
) -> list[Segment]:
    """Return the segments of objects in the network's output.

    Args:
        class_map: Class of each cell plus 1; 0: no object. Shape (h, w).
        votes_T: Predicted position of the object's center [m]; NaN where no depth was measured.
            Shape (h, w, 3).
        radii: Radius of each class's clusters of votes [m].
        class_names: Name of each class.
        window: Part of the image that the cells cover.
        image_shape: Height and width of the image.
        min_votes: Smallest number of votes of an object.
    """
    segments = []
    is_measured = np.isfinite(votes_T).all(axis=2)
    for k, (name, radius) in enumerate(zip(class_names, radii, strict=True), start=1):
        rows, columns = np.nonzero((class_map == k) & is_measured)
        if len(rows) < min_votes:
            continue
        votes = votes_T[rows, columns].astype(np.float64)
        labels = cluster_votes(votes, radius, min_votes)
        for cluster in range(labels.max() + 1):
            is_member = labels == cluster
            cells = np.zeros(class_map.shape, bool)
            cells[rows[is_member], columns[is_member]] = True
            p_TO = np.median(votes[is_member], axis=0)
            segments.append(Segment(name, upsample(cells, window, image_shape), p_TO))
    return segments
