"""Occlusion volumes below and behind known objects, and over unidentified points."""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from conftest import DEFAULT_CELL, resting, scene_of

from drake_clutter.grammar import Orientation
from drake_clutter.perception.label_detector import LabelDetector
from drake_clutter.planning.pick_place_plan import (
    PickPlacePlan,
    PlanningFailure,
    PlanningFailureReason,
)
from drake_clutter.planning.pick_place_planner import PickPlacePlanner
from drake_clutter.planning.planner_config import PlannerConfig
from drake_clutter.planning.tool_kinematics import ToolKinematics
from drake_clutter.scenes.interfaces import Observation
from drake_clutter.scenes.occlusion import (
    OccludedBox,
    objects_below_unidentified_points,
    occluded_boxes,
)
from drake_clutter.scenes.scene import Pose, SceneObject

CAMERA = DEFAULT_CELL.camera
EMPTY = LabelDetector(CAMERA).perceive(scene_of()).observation.depth
LOWER = resting("sugar_box", Orientation.FLAT_0)
UPPER = resting("cracker_box", Orientation.FLAT_0, floor=LOWER.top_height)


def seen(objects: Sequence[SceneObject]) -> Observation:
    return LabelDetector(CAMERA).perceive(scene_of(*objects)).observation


def test_a_block_is_the_least_upright_one() -> None:
    turn = 0.3
    R = np.array([[math.cos(turn), -math.sin(turn)], [math.sin(turn), math.cos(turn)]])
    corners = np.array([[0.1, 0.02], [-0.1, 0.02], [-0.1, -0.02], [0.1, -0.02]]) @ R.T + [0.2, -0.1]
    block = OccludedBox.below_points(corners, 0.06)
    assert block.center == pytest.approx((0.2, -0.1, 0.03))
    assert sorted(block.size[:2]) == pytest.approx([0.04, 0.2])
    assert (block.size[2], block.top_height) == (0.06, 0.06)
    long_axis = block.yaw if block.size[0] > block.size[1] else block.yaw + math.pi / 2
    assert math.sin(long_axis - turn) == pytest.approx(0.0, abs=1e-6)


def test_no_boxes_where_all_objects_are_known() -> None:
    assert occluded_boxes([], seen([]), EMPTY) == (), "the rim belongs to the empty cell"
    assert occluded_boxes([LOWER], seen([LOWER]), EMPTY) == ()


def test_what_is_known_has_a_shadow_down_to_the_floor() -> None:
    (shadow,) = occluded_boxes([UPPER], seen([LOWER, UPPER]), EMPTY)
    assert LOWER.top_height - 0.005 < shadow.top_height < LOWER.top_height
    assert sorted(shadow.size[:2]) == pytest.approx(
        sorted(np.ptp(UPPER.corners_T, axis=0)[:2]), abs=1e-6
    )


def test_what_is_seen_but_not_known_is_taken_for_full() -> None:
    stranger = replace(resting("tomato_soup_can", xy=(0.2, 0.1)), name="stranger")
    (block,) = occluded_boxes([LOWER], seen([LOWER, stranger]), EMPTY)
    assert block.top_height == pytest.approx(stranger.top_height, abs=2e-3)
    assert block.center[:2] == pytest.approx((0.2, 0.1), abs=5e-3)


def test_noise_is_nothing() -> None:
    observation = seen([LOWER])
    noisy = observation.depth + np.random.default_rng(0).normal(0, 0.0025, EMPTY.shape).astype(
        np.float32
    )
    noisy[100, 100] = 1.0  # a single wrong pixel
    noisy[200:210, 150:160] = 0.0  # not measured
    assert occluded_boxes([LOWER], replace(observation, depth=noisy), EMPTY) == ()


def test_what_something_unknown_may_lie_on() -> None:
    beside = resting("sugar_box", Orientation.FLAT_0, xy=(0.2, 0.2))
    assert objects_below_unidentified_points(
        [LOWER, beside], seen([LOWER, beside, UPPER]), EMPTY
    ) == {LOWER.name}
    assert not objects_below_unidentified_points([LOWER, UPPER], seen([LOWER, UPPER]), EMPTY)


def highest(plan: PickPlacePlan) -> float:
    """Return the greatest height of the cup during the transport [m]."""
    carry = plan.segments[1]
    q = carry.trajectory.vector_values(np.linspace(0, carry.duration, 40)).T
    return float(ToolKinematics(DEFAULT_CELL, plan.tool).pose(q)[:, 2, 3].max())


def test_plans_avoid_occluded_boxes() -> None:
    planner = PickPlacePlanner(DEFAULT_CELL, PlannerConfig(optimize=False))
    place = Pose((0.2, -0.2, LOWER.X_TO.translation[2] + 0.001), LOWER.X_TO.quaternion)
    between = OccludedBox((0.1, -0.1, 0.08), (0.05, 0.05, 0.16), 0.0)
    low, high = (planner.plan([LOWER], LOWER.name, place, unseen) for unseen in ((), (between,)))
    assert isinstance(low, PickPlacePlan)
    assert isinstance(high, PickPlacePlan)
    assert highest(high) > highest(low) + 0.05, "it is carried over the block"
    there = OccludedBox((0.2, -0.2, 0.1), (0.2, 0.2, 0.2), 0.0)
    blocked = planner.plan([LOWER], LOWER.name, place, (there,))
    assert isinstance(blocked, PlanningFailure)
    assert blocked.reason is PlanningFailureReason.IN_COLLISION


def test_points_on_a_line_are_no_object() -> None:
    """A row of pixels spans no area; eight rows do."""
    for width, count in ((1, 0), (8, 1)):
        depth = EMPTY.copy()
        depth[200 : 200 + width, 260:340] -= 0.05
        assert len(occluded_boxes([], replace(seen([]), depth=depth), EMPTY)) == count
