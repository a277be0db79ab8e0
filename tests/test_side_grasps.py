"""Grasps on the sides of objects: sampled, loaded, planned out from below a board, simulated."""

import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from conftest import CLASSES, DEFAULT_CELL, cell_with, scene_of
from numpy.typing import NDArray

from benchmarks.motion_limits import limit_ratios
from drake_clutter.cell.gripper import Grasp
from drake_clutter.cell.work_cell import WorkCell
from drake_clutter.files import InputError
from drake_clutter.planning.pick_place_plan import (
    PickPlacePlan,
    PlanningFailure,
    PlanningFailureReason,
)
from drake_clutter.planning.pick_place_planner import PickPlacePlanner
from drake_clutter.planning.planner_config import PlannerConfig
from drake_clutter.planning.side_grasps import (
    CORNER_LENGTH,
    distance_from_below,
    side_normals,
)
from drake_clutter.scenes.scene import Pose, SceneObject
from drake_clutter.station.station_simulation import StationSimulation

Floats = NDArray[np.float64]

PLANNER = PickPlacePlanner(DEFAULT_CELL, PlannerConfig(optimize=False))
TURNED = (math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5))
HALF_HEIGHT = CLASSES["sugar_box"].size[2] / 2
BOX = SceneObject("sugar_box", CLASSES["sugar_box"], Pose((0.0, 0.25, HALF_HEIGHT), TURNED))
PLACE = Pose((0.1, -0.15, HALF_HEIGHT + 0.001), TURNED)
BOARD_FRONT = 0.18
"""y of the front edge of the board [m]."""


def shelf(headroom: float) -> WorkCell:
    """Return a cell with a board above the box, and a wall behind it.

    Args:
        headroom: Distance of the board from the top of the box [m].
    """
    height = 2 * HALF_HEIGHT + headroom
    boxes = {
        "table": ((0, 0, -0.031), (2.4, 2.4, 0.04)),
        "board": ((0, 0.28, height + 0.01), (0.3, 0.2, 0.02)),
        "back": ((0, 0.39, height / 2), (0.3, 0.02, height)),
    }
    fixtures = (
        f"{{name: {name}, pose: {{translation: {list(p)}}}, box: {list(size)}}}"
        for name, (p, size) in boxes.items()
    )
    return cell_with(f"fixtures=[{', '.join(fixtures)}]")


def grasps_of(o: SceneObject, normal: tuple[float, float, float]) -> tuple[Grasp, ...]:
    found = PLANNER.grasps(o, normal)
    assert not isinstance(found, PlanningFailure)
    return tuple(found)


def failed(found: object) -> PlanningFailure:
    assert isinstance(found, PlanningFailure)
    return found


def test_grasps_of_a_side_are_on_its_surface() -> None:
    """Each lip is on the face that is seen, with its axis along the normal."""
    for normal in ((0.0, -1.0, 0.0), (0.0, 5.0, 0.0)):
        for grasp in grasps_of(BOX, normal):
            outward = np.sign(normal)
            assert grasp.X_TG.rotation().matrix()[:, 2] == pytest.approx(-outward, abs=1e-9)
            from_center = grasp.X_TG.translation() - BOX.X_TO.p
            assert outward @ from_center == pytest.approx(BOX.object_class.size[0] / 2)
            assert (np.abs(from_center[[0, 2]]) < [0.0445 - 0.012, HALF_HEIGHT - 0.012]).all()
    # A leaning face of 60 degrees belongs to a side, one of 30 degrees to the top.
    for degrees, direction in ((60.0, (1.0, 0.0, 0.0)), (30.0, (0.0, 0.0, 1.0))):
        angle = math.radians(degrees)
        lean = (math.cos(angle / 2), 0.0, math.sin(angle / 2), 0.0)
        leaning = SceneObject("pudding_box", CLASSES["pudding_box"], Pose((0, 0, 0.2), lean))
        expected = np.array([math.sin(angle), 0.0, math.cos(angle)])
        axes = [g.X_TG.rotation().matrix()[:, 2] for g in grasps_of(leaning, direction)]
        assert any(np.allclose(axis, -expected, atol=1e-9) for axis in axes)
        assert all(axis[2] < 1e-9 for axis in axes), "no face that faces down"
    with pytest.raises(InputError, match=r"^normal: \[0.0, 0.0, 0.0\]; expected a direction"):
        PLANNER.grasps(BOX, (0.0, 0.0, 0.0))


def test_the_load_of_a_side_grasp_has_shear_and_a_moment() -> None:
    """The box bears its weight with a lever of half its depth; a deeper one is too heavy."""
    gripper, mass = DEFAULT_CELL.gripper, BOX.object_class.mass
    weight = mass * 9.81
    down = np.array([1.0, 0.0, 0.0])
    radius, force = 0.0125, 0.8 * 101325.0 * math.pi * 0.0125**2
    for lever in (0.019, 0.0445):
        p_GCm = np.array([0.0, 0.0, lever])
        opening = 2 * weight * lever / radius / force
        sliding = weight / (0.5 * force)
        ratio = gripper.load_ratio("large", weight * down, np.cross(p_GCm, weight * down))
        assert float(ratio) == pytest.approx(max(opening, sliding), rel=1e-6)
        holds = gripper.max_acceleration("large", mass, p_GCm, down) > 0
        assert holds is (max(opening, sliding) < 1 / gripper.safety)
    narrow = failed(PLANNER.grasps(BOX, (1.0, 0.0, 0.0)))
    assert narrow.reason is PlanningFailureReason.TOO_HEAVY
    assert narrow.value == mass


def test_the_side_that_faces_the_robot_comes_first() -> None:
    normals = side_normals(BOX, np.array([0.0, -1.0, 0.3]))
    assert normals[0] == pytest.approx((0.0, -1.0, 0.0))
    assert normals[-1] == pytest.approx((0.0, 1.0, 0.0))
    assert np.abs(np.array(normals) @ normals[0]) == pytest.approx([1, 0, 0, 1], abs=1e-9)


def test_the_way_out_ends_where_nothing_is_above() -> None:
    corners = np.array(BOX.corners_T)
    high = BOX.bounds_T[1]

    def above(y: tuple[float, float], z: float, x: tuple[float, float] = (-1.0, 1.0)) -> Floats:
        grid = np.meshgrid(x, y, (z, z + 0.02), indexing="ij")
        return np.stack(grid, axis=-1).reshape(-1, 3)

    board = above((BOARD_FRONT, 0.4), high[2] + 0.05)
    outwards = np.array([0.0, -1.0])
    needed = float(high[1]) - BOARD_FRONT + 0.01 + CORNER_LENGTH
    assert distance_from_below(corners, outwards, [board], 0.01) == pytest.approx(needed)
    front = above((BOARD_FRONT - 0.1, BOARD_FRONT - 0.005), high[2] + 0.1)
    assert distance_from_below(corners, outwards, [board, front], 0.01) == pytest.approx(
        needed + 0.1
    )
    beside = above((0.0, 0.4), high[2] + 0.05, (float(high[0]) + 0.02, 1.0))
    below = above((0.0, 0.4), -0.02)
    behind = above((float(high[1]) + 0.011, 0.6), high[2])
    free = [beside, below, behind]
    assert distance_from_below(corners, outwards, free, 0.01) == 0.0
    far = above((BOARD_FRONT - 1.0, BOARD_FRONT - 0.9), high[2])
    assert distance_from_below(corners, outwards, [far, board], 0.01) == pytest.approx(needed)


def test_a_box_below_a_board_is_picked_from_its_side() -> None:
    cell = shelf(0.06)
    planner = PickPlacePlanner(cell, PlannerConfig())
    from_above = planner.grasps(BOX)
    assert not isinstance(from_above, PlanningFailure)
    failure = failed(planner.plan([BOX], BOX.name, PLACE, grasp=from_above))
    assert failure.reason is PlanningFailureReason.IN_COLLISION
    plan = planner.plan([BOX], BOX.name, PLACE)
    assert isinstance(plan, PickPlacePlan)
    assert plan.segments[1].duration < 0.9 * plan.segments[1].unoptimized_duration
    ratios = limit_ratios(cell, plan, plan.segments[1])
    assert max(ratios.values()) < 1.01
    assert ratios["cup load"] > 0.5, "the weight alone"
    tool = planner.tools[plan.tool]
    approach, carry, _ = (segment.trajectory for segment in plan.segments)
    X_TG = tool.pose(carry.vector_values(np.linspace(0.0, carry.end_time(), 1000)).T)
    assert X_TG[0, :3, 2] == pytest.approx([0.0, 1.0, 0.0], abs=1e-3)
    p_TO = (X_TG @ plan.X_OG.inverse().GetAsMatrix4())[:, :3, 3]
    moved = p_TO - BOX.X_TO.p
    aside = np.linalg.norm(moved[:, :2], axis=1)
    clearance = planner.config.min_distance + 0.0025
    assert (moved[aside > 0.001, 2][:100] > clearance).all(), "it rises before it moves sideways"
    back_edge = p_TO[:, 1] + BOX.object_class.size[0] / 2
    is_below_board = back_edge > BOARD_FRONT
    assert moved[is_below_board, 2].max() < 0.06 - clearance
    q = approach.vector_values(np.linspace(0.0, approach.end_time(), 2000)).T
    before = tool.pose(q)[:, :3, 3] - X_TG[0, :3, 3]
    along, aside = -before[:, 1], np.linalg.norm(before[:, [0, 2]], axis=1)
    last = (along > 1e-4) & (np.linalg.norm(before, axis=1) < 0.0015)
    assert last.sum() > 10
    assert (aside[last] < 0.2 * along[last]).all(), "along the normal last"
    result = StationSimulation(cell, scene_of(BOX)).execute(plan)
    assert not result.lost_object
    assert result.position_error < 0.005
    assert result.orientation_error < math.radians(1)


def test_a_side_grasp_that_finds_no_way_out_names_the_board() -> None:
    """Between box and board there is less room than the load may swing."""
    planner = PickPlacePlanner(shelf(0.02), PlannerConfig(optimize=False))
    side = planner.grasps(BOX, (0.0, -1.0, 0.0))
    assert not isinstance(side, PlanningFailure)
    failure = failed(planner.plan([BOX], BOX.name, PLACE, grasp=side[:1]))
    assert failure.reason is PlanningFailureReason.IN_COLLISION
    assert failure.detail == "carry: sugar_box and board"
    assert 0.0 < failure.value < 0.02
    assert failure.quantity.endswith(" mm")


def test_a_grasp_on_a_side_that_is_asked_for_is_kept_level() -> None:
    """Without a board the box is lifted straight up; gravity keeps its direction in the tool."""
    plan = PLANNER.plan([BOX], BOX.name, PLACE, grasp=grasps_of(BOX, (0.0, -1.0, 0.0)))
    assert isinstance(plan, PickPlacePlan)
    carry = plan.segments[1].trajectory
    q = carry.vector_values(np.linspace(0.0, carry.end_time(), 300)).T
    X_TG = PLANNER.tools[plan.tool].pose(q)
    assert np.abs(X_TG[:, 2, :3] - X_TG[0, 2, :3]).max() < 1e-3
    rising = X_TG[:, 2, 3] < X_TG[0, 2, 3] + 0.01
    first = next(k for k, (a, b) in enumerate(pairwise(rising)) if a and not b)
    assert np.abs(X_TG[:first, :2, 3] - X_TG[0, :2, 3]).max() < 1e-3


def test_an_object_that_only_a_side_holds_can_be_picked() -> None:
    """No cup seals on the narrow top of a standing plate."""
    plate = replace(CLASSES["pudding_box"], name="plate", size=(0.004, 0.05, 0.12), mass=0.1)
    standing = SceneObject("plate", plate, Pose((0.0, 0.0, 0.06)))
    assert failed(PLANNER.grasps(standing)).reason is PlanningFailureReason.NO_SEAL
    assert PLANNER.can_grasp(standing)
    heavy = replace(standing, object_class=replace(plate, mass=4.0))
    assert not PLANNER.can_grasp(heavy)
    failure = failed(PLANNER.plan([heavy], "plate", Pose((0.1, 0.0, 0.06))))
    assert (failure.reason, failure.value) == (PlanningFailureReason.TOO_HEAVY, 4.0)
