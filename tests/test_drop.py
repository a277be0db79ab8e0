"""Random heaps: where objects start."""

import numpy as np
import pytest
from conftest import CLASSES, rng

from drake_clutter.cell.support import Support
from drake_clutter.simulation.drop import sample_drop_scene

NAMES = ["cracker_box", "large_marker", "tomato_soup_can", "sugar_box"] * 4
SUPPORT = Support(size=(0.8, 0.5))


@pytest.mark.parametrize("seed", range(3))
def test_objects_start_above_those_below_them(seed: int) -> None:
    """The gap to the highest object below, or to the floor, is 10 to 60 mm."""
    scene = sample_drop_scene([CLASSES[name] for name in NAMES], SUPPORT, rng(seed))
    assert [o.object_class.name for o in scene.objects] == NAMES
    for index, o in enumerate(scene.objects):
        lower, upper = o.bounds_T
        highest = 0.0
        for other in scene.objects[:index]:
            other_lower, other_upper = other.bounds_T
            if (upper > other_lower)[:2].all() and (lower < other_upper)[:2].all():
                highest = max(highest, other_upper[2])
        assert 0.010 <= lower[2] - highest <= 0.060


def test_objects_start_all_over_the_middle_of_the_support() -> None:
    """Within 0.3 of its size of the center, in x and in y, and in any orientation."""
    classes = [CLASSES["large_marker"]] * 60
    scene = sample_drop_scene(classes, SUPPORT, rng(0))
    xy = np.array([o.X_TO.p[:2] for o in scene.objects]) / SUPPORT.size
    assert (np.abs(xy) <= 0.3).all()
    assert (xy.min(axis=0) < -0.25).all()
    assert (xy.max(axis=0) > 0.25).all()
    assert abs(float((xy[:, 0] * xy[:, 1]).mean())) < 0.3 * 0.3**2 / 3, "x and y are independent"
    axes = np.array([o.X_TO.rotation[:, 2] for o in scene.objects])
    assert (np.ptp(axes, axis=0) > 1.7).all()


def test_only_objects_on_the_support_are_kept() -> None:
    for x, y, z, expected in (
        (0.399, 0.249, 0.001, True),
        (0.401, 0.0, 0.1, False),
        (0.0, -0.251, 0.1, False),
        (0.0, 0.0, -0.001, False),
    ):
        assert SUPPORT.carries((x, y, z)) == expected
