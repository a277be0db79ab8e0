"""Contacts between objects: polygons and distances of rectangles and lines in closed form."""

from collections.abc import Sequence

import numpy as np
import pytest
from conftest import resting
from numpy.typing import NDArray

from drake_clutter.grammar import Orientation
from drake_clutter.scenes.scene import SceneObject
from drake_clutter.stability import contacts, shape_table
from drake_clutter.stability.contacts import GROUND, MAX_MISS_DISTANCE
from drake_clutter.stability.shape_table import ShapeTable

# A cracker box is 230 mm long along x and 160 mm along y, a gelatin box 85 mm and 73 mm.
LOWER = resting("cracker_box", xy=(0.3, -0.2), name="lower")
GELATIN_BOX = np.array([0.085, 0.073])
Corners = set[tuple[float, float]]


def corners(polygon: NDArray[np.float64]) -> Corners:
    """Return distinct corners in whole micrometers, as [m]."""
    return {(round(float(x), 6), round(float(y), 6)) for x, y in polygon}


def rectangle(x0: float, x1: float, y0: float, y1: float) -> Corners:
    """Return the corners of a rectangle."""
    return {(round(x, 6), round(y, 6)) for x in (x0, x1) for y in (y0, y1)}


def polygon_of(
    lower: SceneObject | None, upper: SceneObject, margin: float = 0.0
) -> NDArray[np.float64]:
    """Return the contact polygon of two objects, or of one and the support."""
    shapes = ShapeTable()
    rows, p_T = shapes.rows_and_positions([upper, lower or upper])
    lower_row = rows[1] if lower else GROUND
    return np.asarray(
        contacts.contact_polygon(shapes.arrays.table, lower_row, rows[0], p_T[1], p_T[0], margin)
    )


@pytest.mark.parametrize("margin", [0.0, 0.002, -0.003])
def test_the_contact_with_the_support_is_the_bottom_shrunk_by_the_margin(margin: float) -> None:
    x, y = 0.115 - margin, 0.080 - margin
    assert corners(polygon_of(None, LOWER, margin)) == rectangle(
        0.3 - x, 0.3 + x, -0.2 - y, -0.2 + y
    )


@pytest.mark.parametrize("margin", [0.0, 0.002])
@pytest.mark.parametrize("x", [0.3 - 0.115, 0.3 + 0.115])
@pytest.mark.parametrize("y", [-0.2 - 0.080, -0.2 + 0.080])
def test_the_contact_of_two_boxes_is_the_intersection_shrunk_by_the_margin(
    x: float, y: float, margin: float
) -> None:
    """The upper box lies with its center above a corner of the lower one."""
    upper = resting("gelatin_box", xy=(x, y), floor=0.06)
    inward = np.sign([0.3 - x, -0.2 - y])
    near = np.array([x, y]) + inward * margin
    far = np.array([x, y]) + inward * (GELATIN_BOX / 2 - margin)
    expected = rectangle(near[0], far[0], near[1], far[1])
    assert corners(polygon_of(LOWER, upper, margin)) == expected


def test_boxes_that_do_not_overlap_have_no_contact() -> None:
    assert len(polygon_of(LOWER, resting("gelatin_box", xy=(0.5, -0.2), floor=0.06))) == 0


@pytest.mark.parametrize(
    ("orientation", "axis"), [(Orientation.FLAT_0, 0), (Orientation.FLAT_90, 1)]
)
def test_the_contact_with_a_lying_cylinder_is_a_segment(
    orientation: Orientation, axis: int
) -> None:
    """It is the part of the line below the box, without its margin at the ends."""
    marker = resting("large_marker", orientation, (0.3, -0.2))
    length = float(np.ptp(marker.corners_T[:, axis]))
    along = np.eye(2)[axis]
    xy = np.array([0.3, -0.2]) + 0.06 * along + 0.003 * along[::-1]
    upper = resting("gelatin_box", xy=xy.tolist(), floor=0.018)
    found = polygon_of(marker, upper, 0.002)
    half = GELATIN_BOX[axis] / 2
    start = 0.06 - half + 0.002
    end = length / 2 - 0.002
    assert start < end < 0.06 + half - 0.002
    relative = found - [0.3, -0.2]
    assert relative @ along[::-1] == pytest.approx(0.0, abs=1e-8)
    assert [(relative @ along).min(), (relative @ along).max()] == pytest.approx([start, end])


def overlap(i: SceneObject, j: SceneObject, measure_gap: bool = True) -> float:
    """Return the overlap of the footprints of two objects."""
    shapes = ShapeTable()
    rows, p_T = shapes.rows_and_positions([i, j])
    table = shapes.arrays.table
    return float(contacts._overlap(table, rows[0], rows[1], p_T[0], p_T[1], measure_gap))


@pytest.mark.parametrize("direction", [(1.0, 0.0), (-1.0, 0.0), (0.0, 1.0), (0.0, -1.0)])
def test_the_overlap_of_boxes_is_the_smallest_along_an_axis(direction: tuple[float, float]) -> None:
    touching = np.array([0.115, 0.080]) + GELATIN_BOX / 2
    for depth in (0.010, 0.001, -0.004, -0.030):
        xy = np.array([0.3, -0.2]) + (touching - depth) * direction
        other = resting("gelatin_box", xy=xy.tolist())
        for pair in ((LOWER, other), (other, LOWER)):
            assert overlap(*pair) == pytest.approx(depth)
            assert (overlap(*pair, measure_gap=False) > 0) == (depth > 0)


def test_the_gap_of_distant_objects_is_at_least_that_of_their_circles() -> None:
    other = resting("cracker_box", xy=(0.9, -0.2))
    radius = np.hypot(0.115, 0.080)
    assert overlap(LOWER, other) == pytest.approx(2 * radius - 0.6)
    assert overlap(LOWER, other) < -MAX_MISS_DISTANCE


def test_what_an_object_does_not_cover_of_the_top_below() -> None:
    """The box above covers the end of the lower one: three parts, of which two have no width."""
    upper = resting("sugar_box", xy=(0.3 + 0.115, -0.2), floor=0.06)
    shapes = ShapeTable()
    rows, p_T = shapes.rows_and_positions([LOWER, upper])
    table = shapes.arrays.table
    found = contacts.uncovered_top(table, rows[0], rows[1], p_T[0], p_T[1], 0.002)
    length, width = np.ptp(upper.corners_T[:, :2], axis=0)
    edge = 0.115 - length / 2 - 0.002
    side = width / 2 + 0.002
    assert side < 0.080
    expected = (
        rectangle(-0.115, edge, -0.080, 0.080)
        | rectangle(-0.115, 0.115, side, 0.080)
        | rectangle(-0.115, 0.115, -0.080, -side)
    )
    assert corners(found - [0.3, -0.2]) == expected


def test_objects_that_may_touch_directly_or_through_others() -> None:
    """Boxes in a row along each axis with gaps of 4 mm, and one that is 6 mm away."""
    size = np.ptp(LOWER.corners_T, axis=0)
    for axis in range(3):
        shapes = ShapeTable()
        places = [0.0, size[axis] + 0.004, 2 * size[axis] + 0.008, 3 * size[axis] + 0.014]
        row: Sequence[SceneObject] = [
            resting("cracker_box", xy=(0.0, 0.0), name=f"{k}") for k in range(4)
        ]
        rows, p_T = shapes.rows_and_positions(row)
        p_T[:, axis] += places
        for index, expected in ((0, [1, 1, 1, 0]), (2, [1, 1, 1, 0]), (3, [0, 0, 0, 1])):
            found = contacts.connected_objects(shapes.arrays.table, rows, p_T, index, 0.005)
            assert found.tolist() == [bool(value) for value in expected]


def found_contacts(
    objects: Sequence[SceneObject],
) -> tuple[int, int, list[list[int]], list[int]]:
    """Return fault, faulty object, contacts and stack numbers on a tray of 0.9 m by 0.7 m."""
    shapes = ShapeTable()
    rows, p_T = shapes.rows_and_positions(objects)
    is_apart = np.zeros((len(rows), len(rows)), np.bool_)
    fault, faulty, _, pairs, stack = contacts.find_contacts(
        shapes.arrays.table, rows, p_T, np.array([0.45, 0.35]), is_apart
    )
    return int(fault), int(faulty), pairs.tolist(), stack.tolist()


def test_contacts_join_objects_into_stacks() -> None:
    """A box bridges two others, which two more objects stand beside."""
    bridge = resting("cracker_box", xy=(0.0, 0.0), floor=0.038, name="bridge")
    feet = [resting("sugar_box", xy=(0.0, y), name=f"{y}") for y in (-0.06, 0.06)]
    alone = resting("tomato_soup_can", Orientation.UPRIGHT_0, xy=(0.3, 0.3))
    fault, _, pairs, stack = found_contacts([feet[0], alone, bridge, feet[1]])
    assert fault == contacts.NO_FAULT
    assert sorted(pairs) == [[GROUND, 0], [GROUND, 1], [GROUND, 3], [0, 2], [3, 2]]
    assert stack[0] == stack[2] == stack[3] != stack[1]


@pytest.mark.parametrize(
    ("other", "fault"),
    [
        (resting("cracker_box", xy=(0.3367, 0.0)), contacts.OUTSIDE),
        (resting("cracker_box", xy=(0.0, -0.2717)), contacts.OUTSIDE),
        (resting("cracker_box", xy=(-0.334, 0.269)), contacts.NO_FAULT),
        (resting("cracker_box", xy=(0.0, 0.2), floor=-0.002), contacts.OVERLAPPING),
        (resting("cracker_box", xy=(0.0, 0.158)), contacts.OVERLAPPING),
        (resting("cracker_box", xy=(0.0, 0.162)), contacts.NO_FAULT),
        (resting("cracker_box", xy=(0.0, 0.2), floor=0.1), contacts.FLOATING),
        (resting("cracker_box", xy=(0.0, 0.219), floor=0.06), contacts.UNSUPPORTED),
        (resting("cracker_box", xy=(0.0, 0.221), floor=0.06), contacts.FLOATING),
    ],
)
def test_faults_beside_a_box(other: SceneObject, fault: int) -> None:
    found = found_contacts([resting("cracker_box", name="first"), other])
    assert found[0] == fault
    if fault in (contacts.OUTSIDE, contacts.FLOATING, contacts.UNSUPPORTED):
        assert found[1] == 1


def test_objects_that_are_known_to_be_apart_do_not_overlap() -> None:
    """Two boxes overlap by 2 mm seen from above; the fault names both."""
    objects = [resting("cracker_box", name="first"), resting("cracker_box", xy=(0.0, 0.158))]
    shapes = ShapeTable()
    rows, p_T = shapes.rows_and_positions(objects)
    is_apart = np.zeros((2, 2), np.bool_)
    arguments = (shapes.arrays.table, rows, p_T, np.array([0.45, 0.35]), is_apart)
    fault, *pair, _, _ = contacts.find_contacts(*arguments)
    assert fault == contacts.OVERLAPPING
    assert sorted(pair) == [0, 1]
    is_apart[:] = True
    assert contacts.find_contacts(*arguments)[0] == contacts.NO_FAULT


def test_shapes_keep_their_rows_until_the_table_is_full(monkeypatch: pytest.MonkeyPatch) -> None:
    shapes = ShapeTable()
    box, can = resting("cracker_box"), resting("tomato_soup_can")
    first, second = shapes.find_rows([box, can]).tolist()
    assert shapes.find_rows([can, box, can]).tolist() == [second, first, second]
    assert shapes.generation == 0
    monkeypatch.setattr(shape_table, "_MAX_ROWS", 1)
    assert shapes.find_rows([can]).tolist() == [0]
    assert shapes.generation == 1
