"""Station simulation: reset, steps, recordings and fixtures."""

import gc
import math
import weakref
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from conftest import DEFAULT_CELL, cell_with, resting, scene_of
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Context, EventStatus

from drake_clutter.cell.fixture import Fixture
from drake_clutter.cell.pose_spec import PoseSpec
from drake_clutter.cell.suction import SuctionGripper
from drake_clutter.cell.work_cell import WorkCell, load_cell
from drake_clutter.files import InputError
from drake_clutter.planning.collision_model import CollisionModel
from drake_clutter.planning.motion_plan import DWELL_TIME, Plan, concatenate_plans
from drake_clutter.planning.pick_place_plan import PickPlacePlan
from drake_clutter.planning.pick_place_planner import PickPlacePlanner
from drake_clutter.planning.planner_config import PlannerConfig
from drake_clutter.reports import recording
from drake_clutter.reports.recording import motion_frames
from drake_clutter.resources import resource_path
from drake_clutter.robots.robot_model import load_robot
from drake_clutter.scenes.action_samples import PHASES, ActionSamples
from drake_clutter.scenes.scene import Pose
from drake_clutter.simulation.scene_plant import pose_from_transform
from drake_clutter.station.clutter_station import ClutterStation
from drake_clutter.station.command_schedule import build_command_schedule
from drake_clutter.station.messages import PlannedMove
from drake_clutter.station.pick_place_executor import EXECUTOR_UPDATE_PERIOD
from drake_clutter.station.station_simulation import (
    STEP_PERIOD,
    TIME_STEP,
    StationSimulation,
    simulate_coarsely,
    simulate_plan,
)

SCENE = scene_of(resting("pudding_box"), resting("gelatin_box", xy=(0.15, 0.1)))
CELL = cell_with(
    "robot.base.x=-0.7",
    "robot.base.y=0.05",
    "robot.base.yaw=10",
    "gripper.extension=0.12",
    "cameras.overhead.pose.z=1.8",
)
"""Cell whose base, tool and camera have other poses than in the default cell."""


def planner_for(cell: WorkCell) -> PickPlacePlanner:
    return PickPlacePlanner(cell, PlannerConfig(optimize=False))


def planned(cell: WorkCell = CELL) -> PickPlacePlan:
    box = SCENE["pudding_box"].X_TO
    X_TO = Pose((0.0, -0.2, box.translation[2] + 0.001), box.quaternion)
    plan = planner_for(cell).plan(SCENE.objects, "pudding_box", X_TO)
    assert isinstance(plan, PickPlacePlan)
    return plan


def link_poses(simulation: StationSimulation) -> dict[str, Pose]:
    """Return X_TL of the arm's links by name, without the links of cups with moving bellows."""
    plant, context = simulation.station.plant, simulation.plant_context
    return {
        f"{plant.GetModelInstanceName(body.model_instance())}::{body.name()}": pose_from_transform(
            body.EvalPoseInWorld(context)
        )
        for body in simulation.station.arm.bodies
        if not body.name().endswith(("_slide", "_gimbal", "_cup"))
    }


def recorded(simulation: StationSimulation, plan: Plan) -> ActionSamples:
    """Return the samples of a plan."""
    samples = simulation.execute(plan).samples
    assert samples is not None
    return samples


class Watch:
    """Compares the samples of a recorder with the plant at the same times."""

    def __init__(self, simulation: StationSimulation, times: Sequence[float]) -> None:
        self.simulation = simulation
        self.times = [*times]
        self.q = list[np.ndarray]()
        self.links = list[dict[str, Pose]]()
        self.objects = list[dict[str, Pose]]()

    def __call__(self, root: Context) -> EventStatus:
        assert self.simulation.recorder is not None
        self.simulation.recorder.observe(root)
        if self.times and root.get_time() >= self.times[0] - 1e-9:
            assert root.get_time() == pytest.approx(self.times.pop(0), abs=1e-9)
            context = self.simulation.plant_context
            self.q.append(self.simulation.station.joint_positions(context))
            self.links.append(link_poses(self.simulation))
            self.objects.append(self.simulation.scene.poses)
        return EventStatus.DidNothing()


def test_samples_are_states_of_the_plant_at_their_times() -> None:
    times = (0.4, 0.8, 1.2)
    simulation = StationSimulation(CELL, SCENE, rate=40.0)
    watch = Watch(simulation, times)
    simulation.simulator.set_monitor(watch)
    samples = recorded(simulation, planned())
    indices = [round(40 * time) for time in times]
    assert samples.time[indices] == pytest.approx(times)
    assert samples.q[indices] == pytest.approx(np.array(watch.q), abs=1e-12)
    frames = motion_frames(samples, SCENE.names)
    _, _, drawn_at = recording._build_viewer(SCENE, CELL, arm=True)
    for index, links, objects in zip(indices, watch.links, watch.objects, strict=True):
        for name, X_TL in links.items():
            drawn = drawn_at(frames[index].q)[name]
            assert drawn.p == pytest.approx(X_TL.p, abs=1e-9)
            assert drawn.rotation == pytest.approx(X_TL.rotation, abs=1e-9)
        for name, X_TO in objects.items():
            assert frames[index].poses[name].p == pytest.approx(X_TO.p, abs=1e-12)
            assert frames[index].poses[name].rotation == pytest.approx(X_TO.rotation, abs=1e-9)
    ends = [poses["epick::body"].p for poses in (watch.links[0], watch.links[-1])]
    assert np.linalg.norm(ends[1] - ends[0]) > 0.1, "it moved meanwhile"


def test_samples_tell_what_happens() -> None:
    """Commands, phases, grasp and contacts of a move, at a rate that the time step divides not."""
    samples = recorded(StationSimulation(CELL, SCENE, rate=125.0), planned())
    assert samples.time == pytest.approx(np.arange(len(samples)) / 125)
    for end in (0, -1):
        assert np.abs(samples.v[end]).max() < 1e-4, "at rest at both ends"
        assert samples.q[end] == pytest.approx(CELL.robot.home, abs=1e-4)
    assert samples.torque[0] == pytest.approx(samples.torque_commanded[0])
    # The plant follows the command of the step before.
    delayed = [
        np.interp(samples.time - samples.time_step, samples.time, column)
        for column in samples.q_commanded.T
    ]
    assert np.abs(samples.q - np.column_stack(delayed)).max() < 1e-3
    slope = np.gradient(samples.q, samples.time, axis=0)[1:-1]
    assert np.abs(slope - samples.v[1:-1]).max() < 0.05
    assert np.abs(samples.v).max() > 0.5
    limits = load_robot(CELL.robot)
    assert (np.abs(samples.v) <= 1.01 * limits.velocity_limits).all()
    assert (np.abs(samples.torque) <= 1.01 * limits.torque_limits).all()
    order = [PHASES[k] for k in samples.phase[np.flatnonzero(np.diff(samples.phase, prepend=-9))]]
    assert order == ["approach", "grasp", "carry", "release", "retreat", "idle"]
    on, off = np.flatnonzero(np.diff(samples.tool_commanded))
    attached, released = np.flatnonzero(np.diff(samples.held_object))
    assert on < attached < off <= released
    assert samples.held_object[attached + 1] == SCENE.names.index("pudding_box")
    assert isinstance(CELL.gripper, SuctionGripper)
    full = CELL.gripper.full_vacuum
    assert samples.vacuum[on, 0] == 0
    assert samples.vacuum[off, 0] == pytest.approx(full, rel=0.05)
    carried = (attached + released) // 2
    held = samples.X_TO[carried, SCENE.names.index("pudding_box")]
    assert np.linalg.norm(held[4:] - samples.X_TG[carried, 4:]) < 0.03, "half its height"
    assert not samples.object_contact[carried]
    assert samples.object_contact[attached + 2], "it stands until it is lifted"
    assert not samples.tool_contact[[0, -1]].any()
    assert samples.gripper[carried, 0] > 1e-4, "the bellows carry it"


def test_a_reset_simulation_repeats_itself() -> None:
    plan, simulation = planned(), StationSimulation(CELL, SCENE, rate=40.0)
    first = simulation.execute(plan)
    simulation.reset(SCENE)
    assert simulation.root.get_time() == 0.0
    assert simulation.scene["pudding_box"].X_TO.p == pytest.approx(SCENE["pudding_box"].X_TO.p)
    again = simulation.execute(plan)
    assert again.poses == first.poses
    assert first.samples is not None
    assert again.samples is not None
    for name, values in again.samples.channels().items():
        np.testing.assert_array_equal(values, first.samples.channels()[name])


def test_plans_are_executed_one_after_the_other() -> None:
    simulation = StationSimulation(CELL, SCENE, rate=40.0)
    first = simulation.execute(planned())
    assert (simulation.finished_plan, first.lost_object) == (1, False)
    place = Pose((0.0, 0.2, 0.0185), simulation.scene["pudding_box"].X_TO.quaternion)
    planner = PickPlacePlanner(CELL, PlannerConfig(optimize=False))
    plan = planner.plan(simulation.scene.objects, "pudding_box", place)
    assert isinstance(plan, PickPlacePlan)
    second = simulation.execute(plan)
    assert simulation.finished_plan == 2
    assert second.poses["pudding_box"].p[:2] == pytest.approx(place.p[:2], abs=0.003)
    assert second.samples is not None
    assert second.samples.time[0] == 0
    assert np.abs(second.samples.v[0]).max() < 1e-4
    executed = second.simulated_time - simulation.executor_state.start_time
    assert executed - STEP_PERIOD < second.samples.time[-1] <= executed


def test_an_arm_with_seven_joints_executes_a_plan(tmp_path: Path) -> None:
    cell = load_cell(resource_path("models/cells/iiwa14_epick_tray.yaml"))
    result = StationSimulation(cell, SCENE, rate=40.0).execute(planned(cell))
    assert result.poses["pudding_box"].p[:2] == pytest.approx([0.0, -0.2], abs=0.005)
    assert result.max_tracking_error < 0.02
    assert result.samples is not None
    assert result.samples.q.shape[1] == 7
    assert result.samples.q[0] == pytest.approx(cell.robot.home, abs=1e-6)


BOARD = """<robot name="board"><link name="top">
  <visual><geometry><box size="0.2 0.2 0.02"/></geometry></visual>
  <collision><geometry><box size="0.2 0.2 0.02"/></geometry></collision>
</link>{}</robot>"""
FLAP = """<link name="flap"/><joint name="hinge" type="{}"><parent link="top"/><child link="flap"/>
  <limit lower="-1" upper="1" effort="1" velocity="1"/></joint>"""


def with_board(path: Path, z: float) -> WorkCell:
    board = Fixture(name="shelf", model=str(path), pose=PoseSpec(translation=(0.0, 0.0, z)))
    return CELL.model_copy(update={"fixtures": (*CELL.fixtures, board)})


def test_a_fixture_with_a_model_is_an_obstacle(tmp_path: Path) -> None:
    """The fixture is an obstacle in simulation and in planning, and named in failures."""
    path, top = tmp_path / "board.urdf", 0.12
    path.write_text(BOARD.format(FLAP.format("fixed")))
    cell = with_board(path, top - 0.01)
    scene = scene_of(resting("gelatin_box", floor=top))
    simulation = StationSimulation(cell, scene)
    for _ in range(8):
        simulation.step()
    assert simulation.scene["gelatin_box"].X_TO.p == pytest.approx(scene["gelatin_box"].X_TO.p)
    around = CollisionModel(cell, [])
    near = around.distances_below(np.array(cell.robot.home), 1.0)
    assert any("shelf" in clearance.pair for clearance in near)


def test_objects_rest_on_a_fixture_with_a_model(tmp_path: Path) -> None:
    """The model has no hydroelastic properties, and its contact is solid all the same."""
    path, top = tmp_path / "board.urdf", 0.12
    path.write_text(BOARD.format(""))
    cell = with_board(path, top - 0.01)
    box = resting("cracker_box", floor=top + 0.001)
    station = ClutterStation(cell, [(box.name, box.object_class)], time_step=TIME_STEP)
    simulator = Simulator(station)
    root = simulator.get_mutable_context()
    home = np.array(cell.robot.home)
    station.set_state(root, home, [box])
    station.GetInputPort("command").FixValue(root, [*home, *np.zeros(2 * len(home))])
    station.GetInputPort("gripper_command").FixValue(root, np.zeros(0))
    simulator.AdvanceTo(0.4)
    (X_TO,) = station.scene_plant.poses(station.plant_context(root)).values()
    assert X_TO.p == pytest.approx(box.X_TO.p - [0.0, 0.0, 0.001], abs=0.0005)


STATIC = """<sdf version="1.9"><model name="post"><static>true</static><link name="post">
  <collision name="post"><geometry><box><size>0.1 0.1 0.5</size></box></geometry></collision>
</link></model></sdf>"""


def test_fixtures_of_one_file_and_of_any_name(tmp_path: Path) -> None:
    """Models of furniture are often static; the fixture's pose is used all the same."""
    path = tmp_path / "post.sdf"
    path.write_text(STATIC)
    names = ("post", "other", "ur10", "epick")
    posts = tuple(
        Fixture(name=name, model=str(path), pose=PoseSpec(translation=(0.6, 0.3 * k, 0.25)))
        for k, name in enumerate(names)
    )
    around = CollisionModel(CELL.model_copy(update={"fixtures": posts}), [])
    near = around.distances_below(np.array(CELL.robot.home), 3.0)
    assert all(any(name in clearance.pair for clearance in near) for name in names)
    assert around.fixture_tops == pytest.approx([0.5] * 4)
    welded = tmp_path / "welded.urdf"
    parent = '<parent link="world"/><child link="top"/>'
    joint = f'<link name="world"/><joint name="weld" type="fixed">{parent}</joint>'
    welded.write_text(BOARD.format(joint))
    with pytest.raises(
        InputError, match=r"fixtures\.shelf\.model: .* is fixed to the world; expected"
    ):
        CollisionModel(with_board(welded, 0.3), [])


def test_a_fixture_that_moves_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "door.urdf"
    path.write_text(BOARD.format(FLAP.format("revolute")))
    with pytest.raises(
        InputError, match=r"fixtures\.shelf\.model: .* has movable joints; expected"
    ):
        StationSimulation(with_board(path, 0.3), SCENE)
    with pytest.raises(InputError, match=r"fixtures\.shelf\.model: .*expected an SDF or URDF"):
        StationSimulation(with_board(tmp_path / "none.urdf", 0.3), SCENE)


def test_a_move_simulated_with_few_movable_objects_ends_at_the_same_poses() -> None:
    """The coarse simulation stands for an uneventful move."""
    plan, full = planned(), StationSimulation(CELL, SCENE)
    exact = full.execute(plan)
    result = simulate_plan(CELL, SCENE, plan, rate=40.0)
    assert result.is_uneventful
    assert result.simulated_time == pytest.approx(exact.simulated_time, abs=1e-9)
    for name, X_TO in exact.poses.items():
        assert result.poses[name].p == pytest.approx(X_TO.p, abs=2e-4)
        assert result.samples is not None
        last = result.samples.X_TO[-1, SCENE.names.index(name)]
        assert last[4:] == pytest.approx(result.poses[name].p, abs=1e-6)
    assert result.max_load_ratio == pytest.approx(exact.max_load_ratio, abs=0.2)


def test_a_move_that_hits_another_object_is_simulated_with_all_objects_movable() -> None:
    """The plan does not know of the box at the place, which cannot move at first."""
    scene = scene_of(SCENE["pudding_box"], resting("cracker_box", xy=(0.0, -0.2)))
    few = StationSimulation(CELL, scene, movable={"pudding_box"})
    assert few.execute(planned()).displacements["cracker_box"] == 0.0
    assert few.woken_fixed_objects == {"cracker_box"}
    result = simulate_plan(CELL, scene, planned())
    assert result.displacements["cracker_box"] > 0.001


def test_a_lost_object_is_simulated_with_all_objects_movable() -> None:
    cell = cell_with("gripper.vacuum=0.02")
    plan = planned(DEFAULT_CELL)
    result = simulate_plan(cell, SCENE, plan)
    assert result.lost_object
    assert result.poses == StationSimulation(cell, SCENE).execute(plan).poses


def test_a_simulation_continues_at_the_end_of_a_motion_of_another_one() -> None:
    plan, simulation = planned(), StationSimulation(CELL, SCENE, rate=40.0)
    context = simulation.executor.GetMyMutableContextFromRoot(simulation.root)
    port = simulation.executor.GetInputPort("plan")
    simulation.step()
    assert not simulation.has_just_started
    port.FixValue(context, PlannedMove(7, plan))
    simulation.step()
    assert simulation.has_just_started
    motion = simulate_coarsely(CELL, SCENE, plan)
    motion.execute(plan)
    simulation.take_over(motion)
    duration = build_command_schedule(plan, CELL).end_time
    start = 2 * STEP_PERIOD
    assert simulation.executor_state.start_time == pytest.approx(start)
    assert 0 <= start + duration - simulation.root.get_time() < STEP_PERIOD
    simulation.step()
    assert simulation.finished_plan == 7
    joints = motion.station.joint_positions(motion.plant_context)
    for _ in range(2):  # also after a step
        context = simulation.plant_context
        assert simulation.station.joint_positions(context) == pytest.approx(joints, abs=1e-5)
        for name, X_TO in motion.scene.poses.items():
            assert simulation.scene.poses[name].p == pytest.approx(X_TO.p, abs=1e-9)
        simulation.step()
    simulation.run_until(lambda: simulation.is_at_rest)
    assert simulation.recorded_samples() is None
    back = planner_for(CELL).plan(
        simulation.scene.objects, "pudding_box", SCENE["pudding_box"].X_TO
    )
    assert isinstance(back, PickPlacePlan)
    returned = simulation.execute(back)
    assert returned.poses["pudding_box"].p == pytest.approx(SCENE["pudding_box"].X_TO.p, abs=1e-3)
    assert returned.samples is not None
    assert returned.samples.time[-1] < build_command_schedule(back, CELL).end_time + 0.2


def test_a_released_simulation_leaves_no_memory_behind() -> None:
    simulation = StationSimulation(CELL, SCENE)
    simulation.step()
    station = weakref.ref(simulation.station)
    assert station() is not None
    simulation.release()
    del simulation
    for _ in range(3):  # what a generation holds is found one after the other
        gc.collect()
    assert station() is None


@pytest.mark.parametrize(
    ("time_constant", "waited"), [(0.05, 0.0), (0.2, 0.2 * math.log(5) - 0.15), (2.0, 0.475)]
)
def test_the_arm_waits_for_the_vacuum_before_it_lifts(time_constant: float, waited: float) -> None:
    """80 % of the vacuum are reached after ln 5 time constants; the dwell is 0.15 s.

    The vacuum is checked every 25 ms.
    """
    cell = cell_with(f"gripper.pump_time_constant={time_constant}")
    simulation = StationSimulation(cell, SCENE, movable={"pudding_box"})
    plan = planned(DEFAULT_CELL)
    context = simulation.executor.GetMyMutableContextFromRoot(simulation.root)
    simulation.executor.GetInputPort("plan").FixValue(context, PlannedMove(1, plan))
    status = simulation.executor.GetOutputPort("status")
    simulation.run_until(lambda: status.Eval(context).stage == "carry")
    assert 0 <= simulation.executor_state.waited - waited <= 2 * EXECUTOR_UPDATE_PERIOD
    vacuum = simulation.station.GetOutputPort("vacuum")
    station_context = simulation.station.GetMyContextFromRoot(simulation.root)
    assert (vacuum.Eval(station_context)[0] >= 0.8 * 0.8 * 101_325) == (time_constant < 2)


def test_each_grasp_of_a_motion_waits_for_its_vacuum() -> None:
    """In 0.625 s a pump of 0.4 s reaches 79 % of the vacuum, so that both waits end by timeout."""
    cell = cell_with("gripper.pump_time_constant=0.4")
    first = planned(DEFAULT_CELL)
    place = Pose((0.0, 0.2, 0.0185), SCENE["pudding_box"].X_TO.quaternion)
    planner = PickPlacePlanner(DEFAULT_CELL, PlannerConfig(optimize=False))
    second = planner.plan(first.end.objects, "pudding_box", place)
    assert isinstance(second, PickPlacePlan)
    motion = concatenate_plans([first, second])
    schedule = build_command_schedule(motion, cell)
    grasps = [
        t for t, step in zip(schedule.starts, motion.steps, strict=True) if step.name == "grasp"
    ]
    held = [schedule.held_time(time) for time in (0.0, *grasps)]
    assert held == pytest.approx([math.inf, *(time + DWELL_TIME for time in grasps)])
    simulation = StationSimulation(cell, SCENE, movable={"pudding_box"})
    result = simulation.execute(motion)
    assert not result.lost_object
    waited = simulation.executor_state.waited
    assert waited == pytest.approx(2 * 0.475, abs=2 * EXECUTOR_UPDATE_PERIOD)
