"""Further segments to try after the network's own segments have been fitted.

The network merges neighboring objects of the same class, splits long ones, and confuses the end of
one box with that of another. Depth discontinuities show where a surface ends, so a connected
surface is a better mask in such cases.

All masks are (h, w) images of the network's output cells, one for every second pixel in both
directions.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation, median_filter
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

Mask = NDArray[np.bool_]

MIN_SEGMENT_CELLS = 20
"""Smallest number of cells of a segment."""
MAX_SURFACE_STEP = 0.008
"""Largest height difference of neighboring cells of one surface, and of the floor from 0 [m]."""
EXPLAINED_FRACTION = 0.95
"""Fraction of a surface that all poses together must explain for it not to be tried again."""
EXPLAINED_FRACTION_BY_ONE_POSE = 0.9
"""Fraction of a surface that a single pose must explain for it not to be tried again."""
MIN_UNEXPLAINED_CELLS = 50
"""Surfaces with fewer unexplained cells are not tried again: a fit to so few is not trusted."""
AMBIGUITY_THRESHOLD = 0.2
"""Mean probability of another class at which a detection's class is ambiguous."""
MIN_CLASS_PROBABILITY = 0.15
"""Smallest mean probability of a class that is tried for a mask."""
MAX_CANDIDATE_CLASSES = 3
"""Largest number of classes that are tried for a mask."""
DILATION_CELLS = 5
"""Number of cells by which the mask of an ambiguous detection grows: its class may be larger."""


def label_surfaces(height: NDArray[np.float32]) -> NDArray[np.int64]:
    """Label the connected surfaces of a height image.

    Args:
        height: Height above the tray's floor [m]; NaN where there is no measurement. Shape (h, w).

    Returns:
        Number of each cell's surface; -1 for the floor and where there is no measurement. Shape
        (h, w).
    """
    z = median_filter(np.nan_to_num(height, nan=-1.0), 3)
    cell_index = np.arange(z.size).reshape(z.shape)
    edges = list[NDArray[np.int64]]()
    for a, b in ((np.s_[:, :-1], np.s_[:, 1:]), (np.s_[:-1], np.s_[1:])):
        connected = np.abs(z[a] - z[b]) < MAX_SURFACE_STEP
        edges.append(np.stack([cell_index[a][connected], cell_index[b][connected]]))
    pairs = np.concatenate(edges, axis=1)
    graph = coo_array((np.ones(pairs.shape[1], bool), (pairs[0], pairs[1])), shape=(z.size, z.size))
    _, component = connected_components(graph, directed=False)
    return np.where(z > MAX_SURFACE_STEP, component.reshape(z.shape), -1)


def find_unexplained_surfaces(surface: NDArray[np.int64], explained: Sequence[Mask]) -> list[Mask]:
    """Return the masks of surfaces that the poses found so far do not explain.

    Args:
        surface: Surface number of each cell, see `label_surfaces`. Shape (h, w).
        explained: Cells that each pose explains.
    """
    size = np.bincount(surface[surface >= 0], minlength=1)
    explained_by_any = np.any([np.zeros(surface.shape, bool), *explained], axis=0)
    unexplained = []
    for number in np.flatnonzero(size >= MIN_SEGMENT_CELLS):
        mask = surface == number
        best_fraction = max((cells[mask].mean() for cells in explained), default=0.0)
        num_unexplained = np.count_nonzero(mask & ~explained_by_any)
        min_unexplained = max(MIN_UNEXPLAINED_CELLS, (1 - EXPLAINED_FRACTION) * size[number])
        if num_unexplained >= min_unexplained and best_fraction <= EXPLAINED_FRACTION_BY_ONE_POSE:
            unexplained.append(mask)
    return unexplained


def find_ambiguous_regions(
    surface: NDArray[np.int64],
    explained: Sequence[Mask],
    classes: Sequence[int],
    class_probabilities: NDArray[np.float32],
) -> list[Mask]:
    """Return wider masks of the detections whose class is ambiguous.

    A mask grows over the rest of its surface, except where another pose explains it.

    Args:
        surface: Surface number of each cell, see `label_surfaces`. Shape (h, w).
        explained: Cells that each pose explains.
        classes: Class of each pose, an index of `class_probabilities`.
        class_probabilities: Probability of each class. Shape (classes, h, w).
    """
    regions = []
    for k, (mask, own_class) in enumerate(zip(explained, classes, strict=True)):
        if mask.sum() < MIN_SEGMENT_CELLS:
            continue
        mean_probabilities = class_probabilities[:, mask].mean(axis=1)
        if np.delete(mean_probabilities, own_class).max() < AMBIGUITY_THRESHOLD:
            continue
        others = np.any([np.zeros_like(mask), *explained[:k], *explained[k + 1 :]], axis=0)
        same_surface = np.isin(surface, np.unique(surface[mask & (surface >= 0)]))
        neighborhood = binary_dilation(mask, iterations=DILATION_CELLS) & same_surface
        regions.append(mask | neighborhood & ~others)
    return regions


def split_mask(mask: Mask, votes_T: NDArray[np.float32]) -> list[Mask]:
    """Split a mask into halves in three ways.

    It is split across its two principal axes, and along the principal direction of its votes.

    Args:
        mask: Cells to split. Shape (h, w).
        votes_T: Position of the object's center that each cell votes for [m]. Shape (h, w, 3).

    Returns:
        Up to six masks; those with too few cells are left out.
    """
    cells = np.argwhere(mask).astype(float)
    votes = np.nan_to_num(votes_T[mask]).astype(float)
    cells = cells - cells.mean(axis=0)
    votes = votes - votes.mean(axis=0)
    axes = np.linalg.eigh(cells.T @ cells)[1]
    along_axes = [cells @ axes[:, k] for k in range(2)]
    cuts = [(value, (value.min() + value.max()) / 2) for value in along_axes]
    along_votes = votes @ np.linalg.eigh(votes.T @ votes)[1][:, -1]
    cuts.append((along_votes, float(np.median(along_votes))))
    halves = []
    for value, threshold in cuts:
        for side in (value < threshold, value >= threshold):
            half = np.zeros_like(mask)
            half[mask] = side
            if side.sum() >= MIN_SEGMENT_CELLS:
                halves.append(half)
    return halves


def candidate_classes(mask: Mask, class_probabilities: NDArray[np.float32]) -> list[int]:
    """Return the classes to try for a mask, most probable first.

    Args:
        mask: Cells of the segment. Shape (h, w).
        class_probabilities: Probability of each class. Shape (classes, h, w).
    """
    mean = class_probabilities[:, mask].mean(axis=1)
    most_probable = np.argsort(-mean)[:MAX_CANDIDATE_CLASSES]
    return [int(k) for k in most_probable if mean[k] > MIN_CLASS_PROBABILITY]
