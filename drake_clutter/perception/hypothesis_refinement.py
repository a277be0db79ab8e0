"""Where to look again when a network's segments have been fitted: surfaces that no pose explains, and poses of a doubtful class.

A network draws objects of the same class that lie side by side together, tears long ones apart, and takes the end of one box for
that of another. Depth alone tells where a surface ends, so what it holds together is a better mask there.

All masks are of the network's answers, (h, w): every second pixel each way.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation, median_filter
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

Mask = NDArray[np.bool_]

MIN_SEGMENT_CELLS = 20
"""Answers that make a segment."""
MAX_SURFACE_STEP = 0.008
"""m; neighbours that differ more in height belong to different surfaces, and what is lower is the floor."""
EXPLAINED_FRACTION, EXPLAINED_FRACTION_BY_ONE_POSE = 0.95, 0.9
"""Share of a surface that poses together, or one of them, must explain for it to be left alone."""
MIN_UNEXPLAINED_CELLS = 50
"""Answers of a surface that no pose explains, fewer than which are left alone: with so little no object is believed."""
AMBIGUITY_THRESHOLD = 0.2
"""Mean chance of another class that makes a class doubtful."""
MIN_CLASS_PROBABILITY, MAX_CANDIDATE_CLASSES = 0.15, 3
"""Mean chance with which a class is tried on a mask, and how many are."""
DILATION_CELLS = 5
"""Answers by which the mask of a doubtful pose is widened: the right class may be larger."""


def label_surfaces(height: NDArray[np.float32]) -> NDArray[np.int64]:
    """(h, w) the number of the surface that hangs together there; -1 for the floor and what is not measured.

    Args:
        height: (h, w) m over the tray's floor, NaN where it is not measured.
    """
    z = median_filter(np.nan_to_num(height, nan=-1.0), 3)
    number = np.arange(z.size).reshape(z.shape)
    ends = list[NDArray[np.int64]]()
    for a, b in ((np.s_[:, :-1], np.s_[:, 1:]), (np.s_[:-1], np.s_[1:])):
        joined = np.abs(z[a] - z[b]) < MAX_SURFACE_STEP
        ends.append(np.stack([number[a][joined], number[b][joined]]))
    pairs = np.concatenate(ends, axis=1)
    graph = coo_array((np.ones(pairs.shape[1], bool), (pairs[0], pairs[1])), shape=(z.size, z.size))
    _, found = connected_components(graph, directed=False)
    return np.where(z > MAX_SURFACE_STEP, found.reshape(z.shape), -1)


def find_unexplained_surfaces(surface: NDArray[np.int64], explained: Sequence[Mask]) -> list[Mask]:
    """The surfaces that poses do not explain, given what each explains."""
    size = np.bincount(surface[surface >= 0], minlength=1)
    by_all = np.any([np.zeros(surface.shape, bool), *explained], axis=0)
    found = []
    for number in np.flatnonzero(size >= MIN_SEGMENT_CELLS):
        mine = surface == number
        by_one = max((each[mine].mean() for each in explained), default=0.0)
        left = np.count_nonzero(mine & ~by_all)
        if (
            left >= max(MIN_UNEXPLAINED_CELLS, (1 - EXPLAINED_FRACTION) * size[number])
            and by_one <= EXPLAINED_FRACTION_BY_ONE_POSE
        ):
            found.append(mine)
    return found


def find_ambiguous_regions(
    surface: NDArray[np.int64],
    explained: Sequence[Mask],
    classes: Sequence[int],
    class_probabilities: NDArray[np.float32],
) -> list[Mask]:
    """Of what each pose explains, where its class is doubtful, all of the surface about it that no other explains.

    Args:
        surface: see `surfaces`.
        explained: by each pose; classes: of each, numbers of `class_probabilities`.
        class_probabilities: (classes, h, w) of each class.
    """
    found = []
    for k, (mine, own) in enumerate(zip(explained, classes, strict=True)):
        if (
            mine.sum() < MIN_SEGMENT_CELLS
            or np.delete(class_probabilities[:, mine].mean(axis=1), own).max() < AMBIGUITY_THRESHOLD
        ):
            continue
        others = np.any([np.zeros_like(mine), *explained[:k], *explained[k + 1 :]], axis=0)
        about = binary_dilation(mine, iterations=DILATION_CELLS) & np.isin(
            surface, np.unique(surface[mine & (surface >= 0)])
        )
        found.append(mine | about & ~others)
    return found


def split_mask(mask: Mask, votes_T: NDArray[np.float32]) -> list[Mask]:
    """A mask cut in two in three ways: along and across it, and where the votes (h, w, 3) m for an object's middle part."""
    places, votes = np.argwhere(mask).astype(float), np.nan_to_num(votes_T[mask]).astype(float)
    places, votes = places - places.mean(axis=0), votes - votes.mean(axis=0)
    axes = np.linalg.eigh(places.T @ places)[1]
    along = [places @ axes[:, k] for k in range(2)]
    cuts = [(value, (value.min() + value.max()) / 2) for value in along]
    parted = votes @ np.linalg.eigh(votes.T @ votes)[1][:, -1]
    cuts.append((parted, float(np.median(parted))))
    found = []
    for value, middle in cuts:
        for side in (value < middle, value >= middle):
            half = np.zeros_like(mask)
            half[mask] = side
            if side.sum() >= MIN_SEGMENT_CELLS:
                found.append(half)
    return found


def candidate_classes(mask: Mask, class_probabilities: NDArray[np.float32]) -> list[int]:
    """The classes that may be in a mask, the likeliest first; see `doubtful`."""
    mean = class_probabilities[:, mask].mean(axis=1)
    return [
        int(k) for k in np.argsort(-mean)[:MAX_CANDIDATE_CLASSES] if mean[k] > MIN_CLASS_PROBABILITY
    ]
