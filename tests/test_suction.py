"""What a cup can hold: seals, loads and the limits of the pull, against numbers worked out by hand."""

import math

import numpy as np
import pytest
from conftest import CLASSES

from drake_clutter.catalogue import Rest, Shape, load_catalogue
from drake_clutter.cell.suction import GRAVITY, SuctionGripper, carried_load, greatest_acceleration, load_share, unevenness

CUP = SuctionGripper()


def on_top(height: float, x: float = 0.0, tilt: float = 0.0) -> np.ndarray:
    """X_OG of a cup that points down at a height, m, beside the axis by x, m, tilted about y, rad."""
    c, s = math.cos(tilt), math.sin(tilt)
    turn = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]]) @ np.diag([1.0, -1.0, -1.0])
    X = np.eye(4)
    X[:3, :3], X[:3, 3] = turn, (x, 0.0, height)
    return X


def test_a_flat_face_seals() -> None:
    box, can = CLASSES["cracker_box"], CLASSES["tomato_soup_can"]
    assert unevenness(box, on_top(0.115), CUP.cup_diameter) == pytest.approx(0.0, abs=1e-12)
    assert unevenness(can, on_top(0.0505, x=0.033 - 0.0130), CUP.cup_diameter) == pytest.approx(0.0, abs=1e-12)


def test_an_edge_does_not() -> None:
    """The rim of a can, and a face narrower than the cup."""
    assert unevenness(CLASSES["tomato_soup_can"], on_top(0.0505, x=0.025), CUP.cup_diameter) == math.inf
    narrow = np.eye(4)
    narrow[:3, :3] = np.array([[0.0, 1, 0], [0, 0, -1], [-1, 0, 0]]).T  # onto the side, which is 28 mm deep
    narrow[:3, 3] = (0.0, 0.0425, 0.0)
    assert unevenness(CLASSES["gelatin_box"], narrow, 0.030) == math.inf


def test_tilt_and_curvature_show_in_millimetres() -> None:
    """A plane tilted by a across a ring of diameter d: d * tan(a). A cylinder of radius r: r - sqrt(r^2 - (d / 2)^2)."""
    found = unevenness(CLASSES["cracker_box"], on_top(0.115, tilt=math.radians(5)), CUP.cup_diameter)
    assert found == pytest.approx(CUP.cup_diameter * math.tan(math.radians(5)), rel=1e-6)
    side = np.eye(4)
    side[:3, :3] = np.array([[0.0, 0, -1], [0, 1, 0], [1, 0, 0]])  # z along -x
    side[:3, 3] = (0.033, 0.0, 0.0)
    sagitta = 0.033 - math.sqrt(0.033**2 - 0.0125**2)
    assert unevenness(CLASSES["tomato_soup_can"], side, 0.025) == pytest.approx(sagitta, rel=0.1)  # of a prism of 32 sides


def test_the_cup_is_the_widest_that_seals_wherever_one_can() -> None:
    """On all faces of the boxes, and the tops of the cans, of all fourteen classes."""

    def seals(diameter: float) -> bool:
        for o in load_catalogue().object_set("pantry14"):
            for axis in range(3) if o.shape is Shape.BOX else [2] if o.only_rest is Rest.UPRIGHT else []:
                z = -np.eye(3)[axis]
                x = np.eye(3)[(axis + 1) % 3]
                X = np.eye(4)
                X[:3, :3], X[:3, 3] = np.column_stack([x, np.cross(z, x), z]), -z * o.size[axis] / 2
                if unevenness(o, X, diameter) > CUP.unevenness:
                    return False
        return True

    assert [d for d in (0.015, 0.020, 0.025, 0.030, 0.040, 0.055) if seals(d)] == [0.015, 0.020, CUP.cup_diameter]


def test_a_marker_cannot_be_held() -> None:
    side = np.eye(4)
    side[:3, :3] = np.array([[0.0, 0, -1], [0, 1, 0], [1, 0, 0]])
    side[:3, 3] = (0.009, 0.0, 0.0)
    for diameter in (0.010, 0.015, 0.025, 0.040):
        assert unevenness(CLASSES["large_marker"], side, diameter) > CUP.unevenness


def test_the_pull() -> None:
    assert CUP.pull == pytest.approx(0.8 * 101_325 * math.pi * 0.0125**2)


def test_shares_of_a_load_by_hand() -> None:
    zero = np.zeros(3)
    assert load_share(np.array([0.0, 0.0, CUP.pull]), zero, CUP) == pytest.approx(1.0)
    assert load_share(zero, np.array([0.0, CUP.pull * 0.0125 / 2, 0.0]), CUP) == pytest.approx(1.0)
    assert load_share(np.array([CUP.friction * CUP.pull, 0.0, 0.0]), zero, CUP) == pytest.approx(1.0)
    assert load_share(np.array([0.0, 0.0, -5.0]), zero, CUP) == 0.0, "pressed on"
    assert load_share(np.array([[0.0, 0, 10], [0, 0, 20]]), np.zeros((2, 3)), CUP) == pytest.approx(np.array([10, 20]) / CUP.pull)


def test_what_hangs_still_pulls_with_its_weight() -> None:
    force, moment = carried_load(0.5, np.array([0.02, 0.0, 0.1]), np.zeros(3))
    assert force == pytest.approx([0.0, 0.0, 0.5 * GRAVITY])
    assert moment == pytest.approx([0.0, -0.02 * 0.5 * GRAVITY, 0.0])


def test_accelerations_that_a_grasp_bears() -> None:
    """The higher the load's centre is from the cup, the sooner it tears off; too much is not held at all."""
    low = greatest_acceleration(0.4, np.array([0.0, 0.0, 0.0]), CUP)
    high = greatest_acceleration(0.4, np.array([0.0, 0.0, 0.15]), CUP)
    assert 0 < high < low
    share = load_share(*carried_load(0.4, np.array([0.0, 0.0, 0.15]), np.array([high, 0.0, 0.0])), CUP)
    assert 0.8 / CUP.safety < share <= 1.001 / CUP.safety
    assert greatest_acceleration(CUP.pull / GRAVITY, np.zeros(3), CUP) == -1.0
