"""Place poses that are impossible are refused with the number that decides."""

import math

import numpy as np
import pytest
from conftest import CLASSES, DEFAULT_CELL, cell_with, resting, scene_of

from drake_clutter.cell.work_cell import WorkCell, load_cell
from drake_clutter.files import InputError
from drake_clutter.grammar import Orientation
from drake_clutter.planning.pick_place_plan import (
    PickPlacePlan,
    PlanningFailure,
    PlanningFailureReason,
)
from drake_clutter.planning.pick_place_planner import PickPlacePlanner
from drake_clutter.planning.place_check import (
    _overhang,
    check_place,
    resting_tilt,
)
from drake_clutter.planning.planner_config import PlannerConfig
from drake_clutter.resources import resource_path
from drake_clutter.robots.robot_model import load_robot
from drake_clutter.scenes.scene import Pose, SceneObject
from drake_clutter.station.station_simulation import StationSimulation

BOX = resting("sugar_box", Orientation.UPRIGHT_0)
"""92 x 44 x 175 mm."""
CRACKERS = resting("cracker_box", Orientation.UPRIGHT_0, (-0.1, 0.15))
CAN = resting("tomato_soup_can", xy=(0.1, 0.0))
SCENE = [BOX, CAN, CRACKERS]
HEIGHT = BOX.X_TO.translation[2]


def tilted(o: SceneObject, degrees: float, xy: tuple[float, float]) -> Pose:
    """Return a pose tilted about x with the lowest point 1 mm above the tray."""
    angle = math.radians(degrees)
    c, s = math.cos(angle), math.sin(angle)
    X = Pose((0.0, 0.0, 0.0), (math.cos(angle / 2), math.sin(angle / 2), 0.0, 0.0))
    assert X.rotation[2, 1:] == pytest.approx([s, c])
    R_TO = X.rotation @ o.X_TO.rotation
    lowest = float((o.object_class.corners @ R_TO.T)[:, 2].min())
    return Pose.from_rotation(R_TO, (*xy, 0.001 - lowest))


def check(
    pick: str,
    X_TO: Pose,
    cell: WorkCell = DEFAULT_CELL,
    objects: list[SceneObject] = SCENE,
    max_drop: float = 0.0,
) -> PlanningFailure | None:
    model = PickPlacePlanner(cell, PlannerConfig()).collision_model(objects)
    (picked,) = (o for o in objects if o.name == pick)
    others = [o for o in objects if o is not picked]
    placed = SceneObject(pick, picked.object_class, X_TO)
    return check_place(placed, others, model, max_drop)


def plan(X_TO: Pose, pick: str = "sugar_box") -> PickPlacePlan | PlanningFailure:
    return PickPlacePlanner(DEFAULT_CELL, PlannerConfig(optimize=False)).plan(SCENE, pick, X_TO)


@pytest.mark.parametrize(
    ("X_TO", "reason", "detail", "value"),
    [
        (
            Pose((0.2, -0.2, HEIGHT - 0.037), BOX.X_TO.quaternion),
            PlanningFailureReason.PLACE_IN_COLLISION,
            "floor",
            0.037,
        ),
        (
            Pose((-0.1, 0.15 + 0.04, HEIGHT), BOX.X_TO.quaternion),
            PlanningFailureReason.PLACE_IN_COLLISION,
            "cracker_box",
            None,
        ),
        (
            tilted(BOX, 20.0, (0.2, -0.2)),
            PlanningFailureReason.PLACE_TILTED,
            "sugar_box",
            math.radians(20.0),
        ),
        (
            Pose((0.2, -0.2, HEIGHT + 0.03), BOX.X_TO.quaternion),
            PlanningFailureReason.PLACE_UNSUPPORTED,
            "sugar_box",
            0.03,
        ),
    ],
)
def test_impossible_places_are_not_planned(
    X_TO: Pose, reason: PlanningFailureReason, detail: str, value: float | None
) -> None:
    found = plan(X_TO)
    assert isinstance(found, PlanningFailure)
    assert (found.reason, found.detail) == (reason, detail)
    assert found.value == pytest.approx(value, abs=1e-6) if value else found.value > 0.001


def test_a_small_overlap_gap_and_tilt_are_allowed() -> None:
    for X_TO in (
        Pose((0.2, -0.2, HEIGHT - 0.0004), BOX.X_TO.quaternion),
        Pose((0.2, -0.2, HEIGHT + 0.0049), BOX.X_TO.quaternion),
        tilted(BOX, 4.9, (0.2, -0.2)),
    ):
        assert check("sugar_box", X_TO) is None
    for X_TO in (
        Pose((0.2, -0.2, HEIGHT - 0.0006), BOX.X_TO.quaternion),
        Pose((0.2, -0.2, HEIGHT + 0.0051), BOX.X_TO.quaternion),
        tilted(BOX, 5.1, (0.2, -0.2)),
    ):
        assert check("sugar_box", X_TO) is not None
    above = Pose((0.2, -0.2, HEIGHT + 0.03), BOX.X_TO.quaternion)
    assert check("sugar_box", above, max_drop=0.026) is None
    assert check("sugar_box", above, max_drop=0.024) is not None


@pytest.mark.parametrize("yaw", [0.0, 0.5])
def test_the_center_of_mass_has_to_be_over_the_support(yaw: float) -> None:
    """A can on a box, beyond the middle of the shorter edge by a distance along its normal."""
    R = Pose((0.0, 0.0, 0.0), (math.cos(yaw / 2), 0.0, 0.0, math.sin(yaw / 2))).rotation
    box = SceneObject(
        "box",
        CRACKERS.object_class,
        Pose.from_rotation(R @ CRACKERS.X_TO.rotation, CRACKERS.X_TO.p),
    )
    extent = abs(CRACKERS.bounds_T[1] - CRACKERS.bounds_T[0]) / 2
    for beyond, overhang in ((-0.002, None), (0.004, 0.004)):
        x, y = (R @ [extent[0] + beyond, 0.0, 0.0])[:2] + CRACKERS.X_TO.p[:2]
        X_TO = Pose((x, y, CRACKERS.top_height + CAN.X_TO.translation[2] + 0.001))
        found = check("tomato_soup_can", X_TO, objects=[CAN, box])
        if overhang is None:
            assert found is None
        else:
            assert found is not None
            assert found.reason is PlanningFailureReason.PLACE_OFF_BALANCE
            assert found.value == pytest.approx(overhang, abs=5e-4)


def test_a_box_may_bridge_two_others() -> None:
    """Its center of mass is between the supports, over neither of them."""
    pillars = [
        resting("sugar_box", Orientation.UPRIGHT_0, (x, 0.0), 0.0, f"pillar_{x}")
        for x in (-0.07, 0.07)
    ]
    beam = resting("cracker_box", Orientation.FLAT_0, (0.0, 0.25))
    sizes = sorted((beam.bounds_T[1] - beam.bounds_T[0])[:2])
    assert sizes[1] > 0.2
    quarter = Pose((0.0, 0.0, 0.0), (math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5))).rotation
    along_x = (beam.bounds_T[1] - beam.bounds_T[0])[0] > 0.2
    R = beam.X_TO.rotation if along_x else quarter @ beam.X_TO.rotation
    z = pillars[0].top_height + beam.X_TO.translation[2] + 0.001
    bridge = Pose.from_rotation(R, (0.0, 0.0, z))
    assert check("cracker_box", bridge, objects=[beam, *pillars]) is None
    alone = check("cracker_box", bridge, objects=[beam, pillars[0]])
    assert alone is not None
    assert alone.reason is PlanningFailureReason.PLACE_OFF_BALANCE


@pytest.mark.parametrize(
    ("pick", "X_TO"),
    [
        ("sugar_box", tilted(BOX, 4.9, (0.2, -0.2))),
        ("sugar_box", Pose((0.2, -0.2, HEIGHT - 0.0004), BOX.X_TO.quaternion)),
        (
            "tomato_soup_can",
            Pose((-0.1, 0.176, CRACKERS.top_height + CAN.X_TO.p[2] + 0.0049)),
        ),
    ],
)
def test_odd_places_that_pass_are_carried_out(pick: str, X_TO: Pose) -> None:
    """Tilted, 0.4 mm inside the floor, dropped by 5 mm at an edge: nothing is thrown."""
    found = plan(X_TO, pick)
    assert isinstance(found, PickPlacePlan)
    result = StationSimulation(DEFAULT_CELL, scene_of(*SCENE)).execute(found)
    assert result.grasped
    assert np.linalg.norm(result.poses[pick].p - X_TO.p) < 0.015
    assert max(result.displacements.values()) < 0.001


def test_a_descent_that_does_not_reach_what_is_below_is_refused() -> None:
    """Jaws have no guarded descent: they do not yield at contact."""
    cell = load_cell(resource_path("models/cells/ur10_2f85_tray.yaml"))
    config = PlannerConfig(optimize=False, max_guarded_descent=0.08)
    above = Pose((0.2, -0.2, HEIGHT + 0.03), BOX.X_TO.quaternion)
    found = PickPlacePlanner(cell, config).plan([BOX], BOX.name, above)
    assert isinstance(found, PlanningFailure)
    assert found.reason is PlanningFailureReason.PLACE_UNSUPPORTED
    lowered = PickPlacePlanner(DEFAULT_CELL, config).plan([BOX], BOX.name, above)
    assert isinstance(lowered, PickPlacePlan)
    assert lowered.max_descent > 0.03


def test_fixtures_are_solids_and_supports() -> None:
    cell = cell_with(
        'fixtures=[{"name": "step", "box": [0.2, 0.2, 0.1], "pose": {"translation": '
        "[0.2, -0.2, 0.05]}}]"
    )
    on_top = Pose((0.2, -0.2, HEIGHT + 0.101), BOX.X_TO.quaternion)
    assert check("sugar_box", on_top, cell) is None
    inside = check("sugar_box", on_top.translated((0.0, 0.0, -0.02)), cell)
    assert inside is not None
    assert (inside.reason, inside.detail) == (PlanningFailureReason.PLACE_IN_COLLISION, "step")
    assert inside.value == pytest.approx(0.019, abs=1e-6)


def test_the_table_carries_an_object_beyond_the_tray() -> None:
    on_table = Pose((0.45, 0.0, HEIGHT + DEFAULT_CELL.table_height + 0.001), BOX.X_TO.quaternion)
    assert check("sugar_box", on_table) is None
    inside = check("sugar_box", on_table.translated((0.0, 0.0, -0.012)))
    assert inside is not None
    assert (inside.reason, inside.detail) == (PlanningFailureReason.PLACE_IN_COLLISION, "table")
    assert inside.value == pytest.approx(0.011, abs=1.1e-3)
    beyond = check("sugar_box", on_table.translated((5.0, 0.0, 0.0)))
    assert beyond is not None
    assert (beyond.reason, beyond.value) == (PlanningFailureReason.PLACE_UNSUPPORTED, math.inf)


def test_the_tilt_is_that_against_the_closest_resting_orientation() -> None:
    marker = CLASSES["large_marker"]
    for object_class in (BOX.object_class, CAN.object_class, marker):
        for degrees, expected in ((0.0, 0.0), (30.0, 30.0), (70.0, 20.0), (90.0, 0.0)):
            half = math.radians(degrees) / 2
            R = Pose((0.0, 0.0, 0.0), (math.cos(half), math.sin(half), 0.0, 0.0)).rotation
            assert math.degrees(resting_tilt(object_class, R)) == pytest.approx(expected, abs=1e-5)


def test_an_unknown_object_and_a_home_beyond_the_limits_are_one_line() -> None:
    with pytest.raises(InputError, match=r"^pick: 'spoon' is not a known object; expected sugar"):
        plan(BOX.X_TO, "spoon")
    cell = cell_with("robot.home=[7, -1.5, 1, -1.5, -1.5, 0]")
    with pytest.raises(InputError, match=r"robot.home: 7 for joint .*; expected from -6.28"):
        load_robot(cell.robot)


def test_the_overhang_beyond_a_line_and_beyond_a_polygon() -> None:
    """The line leads from (0.1, 0) to (0.1, 0.4)."""
    line = np.array([[0.1, 0.0], [0.1, 0.1], [0.1, 0.4]])
    for x, y, expected in (
        (0.1, 0.2, 0.0),
        (0.13, 0.2, 0.03),
        (0.06, 0.35, 0.04),
        (0.13, 0.44, 0.05),
        (0.1, -0.02, 0.02),
    ):
        for points in (line, line[[0, 2]]):
            assert _overhang(points, np.array([x, y])) == pytest.approx(expected, abs=1e-9)
    square = np.array([[0.0, 0.0], [0.2, 0.0], [0.2, 0.2], [0.0, 0.2]])
    assert _overhang(square, np.array([0.1, 0.15])) == 0.0
    assert _overhang(square, np.array([0.1, 0.25])) == pytest.approx(0.05)


@pytest.mark.parametrize(("overlap", "expected"), [(0.0003, None), (0.0007, 0.0007)])
def test_a_neighbor_on_the_same_floor_is_touched_but_carries_nothing(
    overlap: float, expected: float | None
) -> None:
    """The bottoms of the two boxes are level, so that neither is below the other."""
    other = resting("sugar_box", Orientation.UPRIGHT_0, name="other")
    width = float(np.ptp(BOX.bounds_T, axis=0)[1])
    beside = BOX.X_TO.translated((0.0, width - overlap, 0.0))
    found = check("sugar_box", beside, objects=[BOX, other])
    if expected is None:
        assert found is None
    else:
        assert found is not None
        assert (found.reason, found.detail) == (PlanningFailureReason.PLACE_IN_COLLISION, "other")
        assert found.value == pytest.approx(expected, abs=1e-5)


def test_the_overhang_beyond_a_triangle() -> None:
    """The long side leads from (0.3, 0) to (0, 0.4), 0.24 m from the corner at the origin."""
    triangle = np.array([[0.0, 0.0], [0.3, 0.0], [0.0, 0.4]])
    assert _overhang(triangle, np.array([0.1, 0.1])) == 0.0
    assert _overhang(triangle, np.array([0.8, 0.6]) * 0.27) == pytest.approx(0.03)
