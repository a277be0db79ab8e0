"""Segments that are tried after the network's own ones."""

import numpy as np

from drake_clutter.perception.hypothesis_refinement import (
    MIN_SEGMENT_CELLS,
    candidate_classes,
    find_ambiguous_regions,
    find_unexplained_surfaces,
    label_surfaces,
    split_mask,
)

SHAPE = (30, 40)
LEFT, RIGHT = np.zeros(SHAPE, bool), np.zeros(SHAPE, bool)
LEFT[5:15, 4:14] = RIGHT[5:15, 14:24] = True


def heights(left: float, right: float) -> np.ndarray:
    height = np.zeros(SHAPE, np.float32)
    height[LEFT], height[RIGHT] = left, right
    return height


def test_surfaces_end_at_steps_and_at_the_floor() -> None:
    surface = label_surfaces(heights(0.05, 0.10))
    assert surface[0, 0] == -1
    left, right = surface[10, 8], surface[10, 20]
    assert left != right
    for mask, number in ((LEFT, left), (RIGHT, right)):
        assert (surface[mask] == number).mean() > 0.95, "the median filter rounds corners"
        assert (surface[~mask] == number).sum() <= 4
    level = label_surfaces(heights(0.10, 0.10))
    assert level[10, 8] == level[10, 20] >= 0
    hole = heights(0.10, 0.10)
    hole[8:11, 6:9] = np.nan
    assert label_surfaces(hole)[9, 7] == -1, "cells without measurement have no surface"


def test_surfaces_that_a_pose_explains_are_not_tried_again() -> None:
    surface = label_surfaces(heights(0.05, 0.10))
    (left,) = find_unexplained_surfaces(surface, [RIGHT])
    assert np.array_equal(left, surface == surface[10, 8])
    assert find_unexplained_surfaces(surface, [LEFT, RIGHT]) == []
    assert len(find_unexplained_surfaces(surface, [])) == 2
    small = np.zeros(SHAPE, np.float32)
    small[3:6, 3:6] = 0.1
    assert small.astype(bool).sum() < MIN_SEGMENT_CELLS
    assert find_unexplained_surfaces(label_surfaces(small), []) == []


def test_the_mask_of_an_ambiguous_detection_grows_over_its_surface() -> None:
    surface = label_surfaces(heights(0.10, 0.10))
    part = LEFT.copy()
    part[:, 12:] = False
    probabilities = np.zeros((2, *SHAPE), np.float32)
    probabilities[0], probabilities[1] = 0.7, 0.3
    (wider,) = find_ambiguous_regions(surface, [part], [0], probabilities)
    assert wider[part].all()
    assert wider[10, 12]
    assert wider[10, 15]
    assert not wider[0, 0]
    regions = find_ambiguous_regions(surface, [part, RIGHT], [0, 0], probabilities)
    assert not (regions[0] & RIGHT).any(), "cells of another pose are left out"
    probabilities[1] = 0.1
    assert find_ambiguous_regions(surface, [part], [0], probabilities) == []


def test_halves_include_two_objects_side_by_side() -> None:
    both = LEFT | RIGHT
    votes = np.zeros((*SHAPE, 3), np.float32)
    votes[RIGHT, 0] = 0.05
    halves = split_mask(both, votes)
    assert len(halves) == 6
    for one in (LEFT, RIGHT):
        assert max((one & half).sum() / (one | half).sum() for half in halves) > 0.9


def test_candidate_classes_are_sorted_by_probability() -> None:
    probabilities = np.zeros((4, *SHAPE), np.float32)
    probabilities[:, LEFT] = np.array([0.2, 0.1, 0.5, 0.16])[:, None]
    assert candidate_classes(LEFT, probabilities) == [2, 0, 3]
