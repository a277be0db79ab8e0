"""Limits of 30 plans of the shipped robots, at 500 Hz with Drake's dynamics."""

import math

import numpy as np
import pytest
from conftest import resting, rng

from benchmarks.motion_limits import ROBOTS, cell_of, limit_ratios
from drake_clutter.planning.pick_place_plan import PickPlacePlan, PlanningFailure
from drake_clutter.planning.pick_place_planner import PickPlacePlanner
from drake_clutter.planning.planner_config import PlannerConfig
from drake_clutter.scenes.scene import Pose

NUM_MOVES = 5
"""Moves of each robot."""


@pytest.mark.parametrize("robot", ROBOTS)
def test_no_limit_is_exceeded(robot: str) -> None:
    """One move of each robot is planned with optimization."""
    cell = cell_of(robot)
    can = resting("tomato_soup_can", xy=(0.1, -0.05))
    generator = rng(7)
    for number in range(NUM_MOVES):
        planner = PickPlacePlanner(cell, PlannerConfig(optimize=number == 0))
        angle = math.pi * number / NUM_MOVES
        x, y = 0.12 * math.cos(angle), 0.12 * math.sin(angle)
        z = can.X_TO.translation[2] + generator.uniform(0.0005, 0.005)
        plan = planner.plan([can], can.name, Pose((x, y, z), can.X_TO.quaternion))
        assert isinstance(plan, PickPlacePlan), plan
        for segment in plan.segments:
            ratios = limit_ratios(cell, plan, segment)
            assert ratios.pop("rest") < 1e-6
            assert max(ratios.values()) < 1.01, f"{segment.name}: {ratios}"
            assert max(ratios["velocity"], ratios["acceleration"], ratios["jerk"]) > 0.95


def test_a_torque_below_that_of_gravity_is_a_planning_failure() -> None:
    cell = cell_of("ur10")
    torques = (330.0, 40.0, 150.0, 56.0, 56.0, 56.0)
    limits = cell.robot.limits.model_copy(update={"torque": torques})
    weak = cell.model_copy(update={"robot": cell.robot.model_copy(update={"limits": limits})})
    box = resting("sugar_box", xy=(0.2, 0.1))
    failure = PickPlacePlanner(weak, PlannerConfig(optimize=False, max_attempts=10)).plan(
        [box], box.name, box.X_TO.translated(np.array([0.0, -0.2, 0.001]))
    )
    assert isinstance(failure, PlanningFailure)
    assert str(failure) == "trajectory infeasible: carry: torque of shoulder_lift_joint"
    assert failure.value == math.inf
