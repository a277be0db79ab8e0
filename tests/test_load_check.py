"""Loads that known objects carry: expected values from manual sums of centers of mass."""

from dataclasses import replace

from conftest import resting

from drake_clutter.scenes.scene import SceneObject
from drake_clutter.stability.contacts import GROUND
from drake_clutter.stability.load_check import collect_stack, is_carried, known_contacts
from drake_clutter.stability.shape_table import ShapeTable

MARGIN = 0.005
HIDDEN_FRACTION = 0.1


def carries(below: list[SceneObject], carrier: int, x: float, y: float = 0.0) -> bool:
    """Return whether a cracker box is carried, its center at x, y, on one of some objects."""
    shapes = ShapeTable()
    placed = resting("cracker_box", floor=below[carrier].top_height, xy=(x, y))
    rows, p_T = shapes.rows_and_positions([*below, placed])
    table = shapes.arrays.table
    pairs = known_contacts(table, rows[:-1], p_T[:-1])
    stack = collect_stack(table, rows[:-1], p_T[:-1], pairs, carrier, MARGIN, HIDDEN_FRACTION)
    return bool(is_carried(table, stack, MARGIN, rows[-1], p_T[-1]))


def test_on_the_tray_half_of_the_contact_less_the_margin_carries() -> None:
    """The center of mass is within the lower box's top of 230 mm, less 5 mm."""
    box = resting("cracker_box")
    assert carries([box], 0, 0.109)
    assert not carries([box], 0, 0.111)


def test_a_hidden_support_carries_only_near_the_center_of_mass() -> None:
    """A tenth of the bottom of 230 mm x 160 mm is left: its sides move inwards by 72 mm.

    The common center of mass of two equal boxes is half as far off as that of the upper one.
    """
    box = resting("cracker_box", floor=0.2)
    limit = 2 * (0.115 - 0.9 * 0.080)
    assert carries([box], 0, limit - 0.001)
    assert not carries([box], 0, limit + 0.001)


def test_a_hidden_support_of_a_box_with_its_center_of_mass_off_the_middle() -> None:
    """The center of mass lies 20 mm to the side, 60 mm from the next one of the bottom.

    All sides move inwards by 54 mm, which leaves 26 mm on each side of the middle. The common
    center of mass is halfway between that of the box and that of its load.
    """
    box = resting("cracker_box", floor=0.2)
    off_middle = box.X_TO.rotation.T @ [0.0, 0.020, 0.0]
    stated = replace(box.object_class, stated_center_of_mass=tuple(off_middle.tolist()))
    below = [replace(box, object_class=stated)]
    assert carries(below, 0, 0.0, 2 * 0.026 - 0.020 - 0.001)
    assert not carries(below, 0, 0.0, 2 * 0.026 - 0.020 + 0.001)


def test_what_overhangs_carries_less_on_its_free_side() -> None:
    """A box overhangs an equal one by 40 mm; the contact is from 40 mm - 115 mm to 115 mm.

    The common center of mass of box and load, (40 mm + x) / 2, is at most 115 mm - 5 mm.
    The load must also be over its carrier, whose top ends at 155 mm.
    """
    below = [resting("cracker_box"), resting("cracker_box", floor=0.060, xy=(0.040, 0.0))]
    assert carries(below, 1, 0.149)
    assert not carries(below, 1, 0.151)
    below[1] = resting("cracker_box", floor=0.060, xy=(0.090, 0.0))
    assert carries(below, 1, 0.129)  # (90 + 129) / 2 = 109.5
    assert not carries(below, 1, 0.131)


def test_faces_at_nearly_equal_heights_are_in_contact() -> None:
    """A box 3 mm above another rests on it, as poses from images have it; at 5 mm it does not."""
    shapes = ShapeTable()
    for gap, expected in ((0.003, [[GROUND, 0], [0, 1]]), (0.005, [[GROUND, 0]])):
        objects = [resting("cracker_box"), resting("sugar_box", floor=0.060 + gap)]
        rows, p_T = shapes.rows_and_positions(objects)
        assert known_contacts(shapes.arrays.table, rows, p_T).tolist() == expected


def test_a_box_on_one_lying_marker_carries_nothing() -> None:
    """A marker carries on a line; on two of them, 60 mm apart, the box is carried between."""
    markers = [resting("large_marker", xy=(0.0, y), name=str(y)) for y in (-0.030, 0.030)]
    floor = markers[0].top_height
    on_one = resting("cracker_box", floor=floor, xy=(0.0, -0.030))
    assert not carries([markers[0], on_one], 1, 0.0, -0.030)
    between = resting("cracker_box", floor=floor)
    assert carries([*markers, between], 2, 0.0)
