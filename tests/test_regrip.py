"""Grasps without a seal: the arm goes back, and another grasp is tried."""

from collections.abc import Sequence

import numpy as np
import pytest
from conftest import DEFAULT_CELL, resting, scene_of

from drake_clutter.cell.gripper import Payload
from drake_clutter.planning.motion_plan import HeldObject
from drake_clutter.planning.pick_place_plan import (
    PickPlacePlan,
    PlanningFailure,
    PlanningFailureReason,
)
from drake_clutter.planning.pick_place_planner import PickPlacePlanner
from drake_clutter.planning.planner_config import PlannerConfig
from drake_clutter.scenes.scene import Scene
from drake_clutter.simulation.scene_plant import rigid_transform
from drake_clutter.station.station_simulation import StationSimulation, execute_grips

BOX = resting("pudding_box")
PLANNER = PickPlacePlanner(DEFAULT_CELL, PlannerConfig(optimize=False))


def planned(
    exclude: Sequence[HeldObject] = (), planner: PickPlacePlanner = PLANNER
) -> PickPlacePlan | PlanningFailure:
    """Plan for the box where it is believed to be."""
    X_TO_place = BOX.X_TO.translated((0.0, -0.2, 0.001))
    return planner.plan([BOX], BOX.name, X_TO_place, exclude=exclude)


def first_plan() -> PickPlacePlan:
    plan = planned()
    assert isinstance(plan, PickPlacePlan)
    return plan


def displaced(overlap: float) -> Scene:
    """Return the true scene: the box is beside its believed pose, in the direction of -x.

    Args:
        overlap: Distance by which the middle of its believed top lies inside its edge [m].
    """
    lower, upper = BOX.bounds_T
    distance = (upper - lower)[0] / 2 - overlap
    return scene_of(resting(BOX.name)).with_poses(
        {BOX.name: BOX.X_TO.translated((-distance, 0.0, 0.0))}
    )


def test_excluded_grasps_are_left_out_until_none_is_left() -> None:
    found = PLANNER.grasps(BOX)
    assert not isinstance(found, PlanningFailure)
    grasps = found[:3]
    tried = list[HeldObject]()
    while True:
        X_TO_place = BOX.X_TO.translated((0.0, -0.2, 0.001))
        plan = PLANNER.plan([BOX], BOX.name, X_TO_place, grasp=grasps, exclude=tried)
        if isinstance(plan, PlanningFailure):
            break
        tried.append(plan.held)
    X_OT = rigid_transform(BOX.X_TO).inverse()
    for grasp, held in zip(grasps, tried, strict=True):
        p_OG = (X_OT @ grasp.X_TG).translation()
        assert held.X_OG.translation() == pytest.approx(p_OG, abs=0.001)
    assert plan.reason is PlanningFailureReason.NO_GRASP_LEFT
    assert (plan.detail, plan.value, plan.quantity) == (BOX.name, 3.0, "3 excluded")


def test_a_grasp_at_another_angle_about_the_axis_of_a_cup_is_the_same() -> None:
    (grasp,) = list(PLANNER.grasps(BOX))[:1]  # type: ignore[arg-type]
    X_OG = rigid_transform(BOX.X_TO).InvertAndCompose(grasp.X_TG)
    held = HeldObject(BOX.name, grasp.tool, X_OG, Payload())
    plan = planned([held])
    assert isinstance(plan, PickPlacePlan)
    offset = plan.X_OG.translation() - X_OG.translation()
    assert float(np.linalg.norm(offset)) == pytest.approx(0.012, abs=0.001)


def test_the_second_grasp_holds_a_box_that_is_beside_its_believed_pose() -> None:
    """The lip of the first one projects over the edge; the second one is 12 mm beside it."""
    scene = displaced(0.008)
    simulation = StationSimulation(DEFAULT_CELL, scene)
    requests = list[int]()

    def regrip(tried: Sequence[HeldObject]) -> PickPlacePlan | PlanningFailure:
        requests.append(len(tried))
        return planned(tried)

    result = execute_grips(simulation, first_plan(), regrip, max_grips=3)
    assert requests == [1]
    assert (result.grasped, result.missed_grasp, result.num_grips) == (True, False, 2)
    assert isinstance(result.plan, PickPlacePlan)
    moved = result.poses[BOX.name].p - scene[BOX.name].X_TO.p
    assert moved == pytest.approx([0.0, -0.2, 0.0], abs=0.003)


@pytest.mark.parametrize(("max_grips", "num_grips"), [(1, 1), (2, 2)])
def test_without_a_seal_the_arm_goes_back_and_the_scene_stays(
    max_grips: int, num_grips: int
) -> None:
    scene = displaced(-0.02)
    simulation = StationSimulation(DEFAULT_CELL, scene)
    plan = first_plan()
    result = execute_grips(simulation, plan, planned, max_grips)
    assert (result.grasped, result.missed_grasp, result.num_grips) == (False, True, num_grips)
    assert result.poses[BOX.name].p == pytest.approx(scene[BOX.name].X_TO.p, abs=0.0005)
    q = simulation.station.joint_positions(simulation.plant_context)
    assert q == pytest.approx(np.array(plan.start.q), abs=0.001)
    assert "did not grasp" in str(result)
    schedule = simulation.executor_state.schedule
    assert schedule is not None
    assert [step.name for step in schedule.steps] == ["approach", "grasp", "withdraw"]
    approach, _, withdrawal = schedule.steps
    assert withdrawal.duration == pytest.approx(approach.duration)
