"""Body sleeping: which objects may move, and when."""

import math
from dataclasses import replace

import pytest
from conftest import DEFAULT_CELL, resting, scene_of
from pydrake.math import RotationMatrix
from test_clutter_station import HOME, TOOL, station_at_home

from drake_clutter.grammar import Orientation
from drake_clutter.planning.motion_plan import DWELL_TIME
from drake_clutter.planning.pick_place_plan import PickPlacePlan
from drake_clutter.planning.pick_place_planner import PickPlacePlanner
from drake_clutter.planning.planner_config import PlannerConfig
from drake_clutter.scenes.geometry import penetration_depth
from drake_clutter.scenes.scene import Pose
from drake_clutter.station.body_sleep import BodySleepManager, affected_bodies, bodies_to_wake
from drake_clutter.station.command_schedule import build_command_schedule
from drake_clutter.station.gripper_actuator import GraspStatus
from drake_clutter.station.station_simulation import STEP_PERIOD

PICKED = resting("sugar_box", Orientation.UPRIGHT_0)
BESIDE = resting("tomato_soup_can", xy=(-0.2, -0.2))
SUPPORT = resting("cracker_box", xy=(0.2, -0.2))
SCENE = scene_of(PICKED, BESIDE, SUPPORT)
LOST = GraspStatus(TOOL, last_held=PICKED.name, release_time=1.0)


@pytest.fixture(scope="module")
def plan() -> PickPlacePlan:
    """Return a plan that lowers an object from 50 mm above the top of another one.

    The planner takes the other one for higher.
    """
    planner = PickPlacePlanner(
        DEFAULT_CELL, PlannerConfig(optimize=False, max_guarded_descent=0.08)
    )
    higher = replace(SUPPORT, X_TO=SUPPORT.X_TO.translated((0.0, 0.0, 0.05)))
    X_TO = Pose((0.2, -0.2, higher.top_height + PICKED.X_TO.p[2] + 0.001), PICKED.X_TO.quaternion)
    plan = planner.plan([PICKED, higher], PICKED.name, X_TO)
    assert isinstance(plan, PickPlacePlan)
    return plan


def test_an_object_that_is_reached_late_in_a_descent_is_affected(plan: PickPlacePlan) -> None:
    affected = affected_bodies(SCENE.objects, plan)
    by_step = {step.name: names for step, names in zip(plan.steps, affected, strict=True) if names}
    at_place = {PICKED.name, SUPPORT.name}
    assert by_step == {"grasp": {PICKED.name}, "descend": at_place, "release": at_place}


@pytest.mark.parametrize(("gap", "is_affected"), [(0.005, False), (0.002, True)])
def test_piles_are_affected_if_they_are_near_not_if_their_bounding_boxes_meet(
    gap: float, is_affected: bool, plan: PickPlacePlan
) -> None:
    """A box turned by 45 deg stands beside the picked one, along the diagonal, under another."""
    beside = resting("gelatin_box")
    turned = RotationMatrix.MakeZRotation(math.pi / 4).matrix() @ beside.X_TO.rotation
    distance = sum(PICKED.bounds_T[1][:2]) / math.sqrt(2) + beside.bounds_T[1][0] + gap
    xy = distance / math.sqrt(2)
    beside = replace(beside, X_TO=Pose.from_rotation(turned, (xy, xy, beside.X_TO.p[2])))
    upper = resting("tomato_soup_can", xy=(xy, xy), floor=beside.top_height, name="upper")
    assert penetration_depth(beside, PICKED) == pytest.approx(-gap, abs=1e-6)
    assert (beside.bounds_T[0][:2] < PICKED.bounds_T[1][:2]).all(), "their bounding boxes overlap"
    affected = affected_bodies([*SCENE.objects, beside, upper], plan)
    grasp = next(k for k, step in enumerate(plan.steps) if step.name == "grasp")
    near = {beside.name, upper.name} if is_affected else set()
    assert affected[grasp] == {PICKED.name} | near


def test_objects_are_woken_around_pick_and_place(plan: PickPlacePlan) -> None:
    schedule = build_command_schedule(plan, DEFAULT_CELL)
    descent_start = schedule.start_of("descend")
    carried = (schedule.start_of("grasp") + DWELL_TIME + descent_start) / 2
    at_place = {"descend": {"place"}, "release": {"place"}}
    affected = [({"grasp": {"pick"}} | at_place).get(step.name, set()) for step in plan.steps]
    for time, expected in (
        (0.0, set()),
        (schedule.start_of("grasp"), {"pick"}),
        (schedule.start_of("grasp") + DWELL_TIME, {"pick"}),
        (carried, set()),
        (descent_start, {"place"}),
        (schedule.release_time, {"place"}),
        (schedule.end_time, set()),
    ):
        assert bodies_to_wake(schedule, affected, time) == expected, time


@pytest.mark.parametrize(
    ("status", "expects_grasp", "awake"),
    [
        (GraspStatus(), False, set()),
        (GraspStatus(), True, set(SCENE.names)),
        (GraspStatus(TOOL, held=PICKED.name, last_held=PICKED.name), True, {PICKED.name}),
        (LOST, False, set(SCENE.names)),
        (LOST, True, set(SCENE.names)),
    ],
)
def test_all_objects_are_awake_if_the_gripper_does_not_hold_what_it_should(
    status: GraspStatus, expects_grasp: bool, awake: set[str]
) -> None:
    station, root = station_at_home(SCENE)
    manager = BodySleepManager(station)
    manager.reset(root)
    manager.update(root, set(), status, expects_grasp=expects_grasp)
    assert manager.awake == awake
    context = station.plant_context(root)
    for name, joint in station.free_joints.items():
        assert joint.is_locked(context) == (name not in awake)


@pytest.mark.parametrize(("drift", "stays_awake"), [(0.0, False), (0.0001, True)])
def test_an_object_sleeps_once_its_mean_speed_is_low(drift: float, stays_awake: bool) -> None:
    """Contacts chatter at 10 mm/s; 0.1 mm in 25 ms is a mean speed of 4 mm/s."""
    station, root = station_at_home(SCENE)
    manager = BodySleepManager(station)
    manager.reset(root)
    context = station.plant_context(root)
    joint = station.free_joints[BESIDE.name]
    awake = list[bool]()
    for k in range(manager.WINDOW + 2):
        root.SetTime(k * STEP_PERIOD)
        moved = SCENE.with_poses({BESIDE.name: BESIDE.X_TO.translated((k * drift, 0.0, 0.0))})
        station.set_state(root, HOME, moved.objects)
        if not joint.is_locked(context):
            velocities = station.plant.GetVelocities(context)
            velocities[joint.velocity_start() + 3] = 0.01
            station.plant.SetVelocities(context, velocities)
        required = {BESIDE.name} if k == 0 else set()
        manager.update(root, required, GraspStatus(), expects_grasp=False)
        awake.append(BESIDE.name in manager.awake)
    assert awake[: manager.WINDOW] == [True] * manager.WINDOW
    assert awake[-1] == stays_awake
