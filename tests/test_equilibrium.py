"""The equilibrium of stacked objects, against closed forms of the least residual.

A force f at a lever d balances the weight 1 of an object as well as possible if
(1 - f)^2 + (f d / a)^2 is least, where a = 5 cm. The residual is then q / sqrt(1 + q^2), q = d / a.
"""

from collections.abc import Sequence

import numpy as np
import pytest
from conftest import resting
from numpy.typing import ArrayLike, NDArray

from drake_clutter.scenes.scene import SceneObject
from drake_clutter.stability import equilibrium
from drake_clutter.stability.contacts import GROUND
from drake_clutter.stability.shape_table import ShapeTable

ARM = 0.05
BOX = resting("cracker_box", xy=(0.12, -0.07))  # 230 mm along x, 160 mm along y, 60 mm high
HALF = np.array([0.115, 0.080])
DIRECTIONS = [(1.0, 0.0), (-1.0, 0.0), (0.0, 1.0), (0.0, -1.0)]


def residuals(
    objects: Sequence[SceneObject] = (BOX,),
    pairs: Sequence[tuple[int, int]] = ((GROUND, 0),),
    offsets: ArrayLike = ((0.0, 0.0),),
    *,
    margin: float = 0.0,
    friction: float = 0.0,
    loads: NDArray[np.float64] = equilibrium.NO_LOADS,
    com: Sequence[float] | None = None,
) -> NDArray[np.float64]:
    """Return the residuals of objects with moved centers of mass; `com` replaces the first's."""
    shapes = ShapeTable()
    rows, p_T = shapes.rows_and_positions(objects)
    table = shapes.arrays.table.copy()
    if com is not None:
        table["com"][rows[0]] = com
    return np.asarray(
        equilibrium.equilibrium_residuals(
            table,
            rows,
            p_T,
            np.array(pairs, np.int64).reshape(-1, 2),
            np.full(len(objects), margin),
            np.asarray(offsets, float),
            friction,
            loads,
        )
    )


def least(lever: float) -> float:
    """Return the least residual of a force at a lever [m]."""
    return lever / ARM / float(np.hypot(1.0, lever / ARM))


def test_the_residual_of_a_floating_object_is_its_share_of_the_weight() -> None:
    can = resting("tomato_soup_can", xy=(0.3, 0.0))
    masses = np.array([o.object_class.mass for o in (BOX, can)])
    offsets = np.zeros((2, 2))
    assert residuals((BOX, can), (), offsets) == pytest.approx(masses / masses.sum())
    found = residuals((BOX, can), ((GROUND, 1),), offsets)
    assert found == pytest.approx([masses[0] / masses.sum(), 0.0])


@pytest.mark.parametrize("direction", DIRECTIONS)
def test_the_residual_of_an_overhang(direction: tuple[float, float]) -> None:
    """The center of mass is beyond the edge of the foot, by its offset or in the object itself."""
    direction_array = np.array(direction)
    foot = float(np.abs(direction_array) @ HALF)
    for lever in (-0.001, 0.02, 0.07):
        offset = (foot + lever) * direction_array
        expected = [least(max(lever, 0.0))]
        assert residuals(offsets=[offset]) == pytest.approx(expected, abs=1e-9)
        assert residuals(com=(*offset, 0.01)) == pytest.approx(expected, abs=1e-9)
        # Offset and center of mass add up.
        apart = [offset - 0.03 * direction_array]
        found = residuals(offsets=apart, com=(*(0.03 * direction_array), 0.01))
        assert found == pytest.approx(expected, abs=1e-9)
    assert residuals(offsets=[foot * direction_array], margin=0.01) == pytest.approx([least(0.01)])


def test_the_residual_beyond_a_corner() -> None:
    lever = np.array([0.03, 0.04])
    assert residuals(offsets=[HALF + lever]) == pytest.approx([least(0.05)])


@pytest.mark.parametrize("direction", DIRECTIONS)
def test_friction_reduces_the_moment_at_the_cost_of_a_force(
    direction: tuple[float, float],
) -> None:
    """A force h at the height z of the center of mass has the moment h z, but is not balanced.

    Of (1 - f)^2 + h^2 + (f d - h z)^2, the least over h is (1 - f)^2 + (f d)^2 / (1 + z^2).
    """
    height = 0.03 + 0.09
    offset = (np.abs(direction) @ HALF + 0.02) * np.array(direction)
    expected = least(0.02 / float(np.hypot(1.0, height / ARM)))
    assert residuals(com=(*offset, 0.09), friction=0.9) == pytest.approx([expected])
    # The least force is h = f d z / (1 + z^2): a smaller friction does not reach it.
    assert residuals(com=(*offset, 0.09), friction=0.05)[0] > 1.001 * expected


@pytest.mark.parametrize("direction", DIRECTIONS)
def test_a_load_on_the_other_side_is_a_counterweight(direction: tuple[float, float]) -> None:
    """On the same side a load is of no use."""
    foot = float(np.abs(direction) @ HALF)
    offset = [(foot + 0.02) * np.array(direction)]
    for friction in (0.0, 0.3):
        for side, expected in ((-0.5, 0.0), (1.5, residuals(offsets=offset, friction=friction)[0])):
            x, y = BOX.X_TO.p[:2] + side * foot * np.array(direction)
            load = np.array([[x, y, 0.06, 0.0]])
            found = residuals(offsets=offset, loads=load, friction=friction)
            assert found == pytest.approx([expected], abs=1e-6)


def test_a_contact_presses_the_lower_object_down() -> None:
    """Weights add up: a box on the overhanging end of another one tips it."""
    above = resting("gelatin_box", xy=(0.12, -0.07), floor=0.06, name="above")
    pairs = ((GROUND, 0), (0, 1))
    assert residuals((BOX, above), pairs, np.zeros((2, 2))) == pytest.approx([0.0, 0.0])
    ratio = above.object_class.mass / BOX.object_class.mass
    for lever, stands in ((0.9 * ratio * 0.115, True), (1.1 * ratio * 0.115, False)):
        # The center of mass of the lower box is beyond the edge by `lever`, and the upper one
        # presses at up to 115 mm on the other side of the edge.
        offsets = [(0.115 + lever, 0.0), (0.0, 0.0)]
        found = residuals((BOX, above), pairs, offsets)
        assert (found.max() == 0.0) == stands


# --- The least stable object ---


def least_stable(
    objects: Sequence[SceneObject],
    pairs: Sequence[tuple[int, int]],
    *,
    margin: float = 0.0,
    friction: float = 0.0,
    com: Sequence[float] | None = None,
) -> tuple[int, bool]:
    """Return the least stable object and whether it rolls; `com` replaces the first's."""
    shapes = ShapeTable()
    rows, p_T = shapes.rows_and_positions(objects)
    table = shapes.arrays.table.copy()
    if com is not None:
        table["com"][rows[0]] = com
    found, rolls = equilibrium.least_stable_object(
        table, rows, p_T, np.array(pairs, np.int64).reshape(-1, 2), margin, friction
    )
    return int(found), bool(rolls)


@pytest.mark.parametrize("direction", DIRECTIONS)
def test_an_object_stands_while_its_center_of_mass_is_above_its_foot(
    direction: tuple[float, float],
) -> None:
    foot = float(np.abs(direction) @ HALF)
    for margin in (0.0, 0.004):
        for lever, expected in ((-0.001, -1), (0.001, 0)):
            offset = (foot - margin + lever) * np.array(direction)
            found = least_stable((BOX,), ((GROUND, 0),), margin=margin, com=(*offset, 0.0))
            assert found == (expected, False)


@pytest.mark.parametrize(("reach", "expected"), [(0.004, (-1, False)), (0.002, (2, True))])
def test_the_center_of_mass_moves_of_one_object_on_cylinders_at_a_time(
    reach: float, expected: tuple[int, bool]
) -> None:
    """Two levels of a box on two markers, of which the lower ones are 2 s apart.

    With the margin e, the center of mass of the whole moves by 0.48 e with one of the boxes and by
    0.96 e with both. It stands within s.
    """
    objects = list[SceneObject]()
    for level, half_distance in enumerate((reach, 0.05)):
        floor = 0.078 * level
        for y in (-half_distance, half_distance):
            objects.append(resting("large_marker", xy=(0.0, y), floor=floor))
        objects.append(resting("cracker_box", floor=floor + 0.018))
    pairs = [(GROUND, 0), (GROUND, 1), (0, 2), (1, 2), (2, 3), (2, 4), (3, 5), (4, 5)]
    assert least_stable(objects, pairs, margin=0.005) == expected


@pytest.mark.parametrize("axis", [0, 1])
def test_an_object_balances_while_its_center_of_mass_is_above_the_contact(axis: int) -> None:
    """The center of mass is 30 mm off the center, the upper edge of the lower box at 115 or 80 mm.

    Two boxes of one size touch from the edge of the upper one to that of the lower one.
    """
    lower, upper = BOX, resting("cracker_box", name="upper")
    shapes = ShapeTable()
    rows, _ = shapes.rows_and_positions([lower, upper])
    table = np.concatenate([shapes.arrays.table, shapes.arrays.table[rows[1:]]]).view(np.recarray)
    lone = len(table) - 1
    table["first_part"][lone], table["last_part"][lone] = lone, lone + 1
    table["com"][lone, axis] = 0.03
    offsets = HALF[axis] + np.array([-0.031, -0.029])
    positions = np.zeros((4, 3))
    positions[:, axis] = [*offsets, *(-offsets)]
    positions[:, 2] = 0.06
    found = equilibrium.balanced_positions(table, rows[0], lone, positions, 0.0)
    assert found.tolist() == [True, False, True, True]


def test_the_description_of_stacks() -> None:
    """Stacks are described alike wherever they are; objects of stack -1 are left out."""
    shapes = np.array([7, 3, 3, 5, 7, 3])
    p_T = np.array(
        [
            [0.10, 0.20, 0.03],
            [0.11, 0.18, 0.09],
            [0.50, 0.50, 0.02],
            [0.09, 0.21, 0.03],
            [-0.20, 0.00, 0.03],
            [-0.19, -0.02, 0.09],
        ]
    )
    stack = np.array([4, 4, -1, 4, 1, 1])
    order, first, description = equilibrium.canonical_order(shapes, p_T, stack, 0.001)
    assert order.tolist() == [4, 5, 3, 0, 1]
    assert first.tolist() == [0, 2, 5]
    assert description.tolist() == [
        [7, 0, 0, 30],
        [3, 10, -20, 90],
        [5, 0, 0, 30],
        [7, 10, -10, 30],
        [3, 20, -30, 90],
    ]


def test_a_point_is_inside_a_polygon_at_least_a_margin_from_its_sides() -> None:
    corners = np.array([[0.0, 0.0], [0.3, 0.0], [0.3, 0.1], [0.0, 0.1], [9.0, 9.0]])
    p = np.array([1.0, 2.0, 5.0])
    for x, y, margin, expected in (
        (1.15, 2.05, 0.0, True),
        (1.29, 2.09, 0.009, True),
        (1.29, 2.09, 0.011, False),
        (1.01, 2.01, 0.009, True),
        (1.01, 2.01, 0.011, False),
        (1.31, 2.05, 0.0, False),
        (1.15, 1.99, 0.0, False),
        (0.99, 2.05, 0.0, False),
        (1.15, 2.11, 0.0, False),
    ):
        assert equilibrium._contains(corners, 4, p, x, y, margin) == expected
    assert not equilibrium._contains(corners, 2, p, 1.15, 2.0, 0.0), "a segment"
