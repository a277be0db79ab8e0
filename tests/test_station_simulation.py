"""Station simulation: reset, steps, recordings and fixtures."""

import gc
import math
import weakref
from functools import partial
from pathlib import Path

import h5py
import numpy as np
import pytest
from conftest import DEFAULT_CELL, cell_with, resting, scene_of
from pydrake.systems.analysis import Simulator

from drake_clutter.catalog import load_catalog
from drake_clutter.cell.fixture import Fixture
from drake_clutter.cell.pose_spec import PoseSpec
from drake_clutter.cell.work_cell import WorkCell, load_cell
from drake_clutter.files import InputError
from drake_clutter.planning.collision_model import CollisionModel
from drake_clutter.planning.pick_place_plan import PickPlacePlan
from drake_clutter.planning.pick_place_planner import PickPlacePlanner
from drake_clutter.planning.planner_config import PlannerConfig
from drake_clutter.reports import recording
from drake_clutter.resources import resource_path
from drake_clutter.scenes.interfaces import MotionSample, Move, MoveResult, Outcome
from drake_clutter.scenes.scene import Pose
from drake_clutter.simulation.scene_plant import pose_from_transform
from drake_clutter.station.clutter_station import ClutterStation
from drake_clutter.station.messages import PlannedMove
from drake_clutter.station.pick_place_executor import EXECUTOR_UPDATE_PERIOD
from drake_clutter.station.station_simulation import (
    STEP_PERIOD,
    TIME_STEP,
    StationSimulation,
    simulate_plan,
)
from drake_clutter.station.trajectory_file import read_trajectories, write_trajectories
from drake_clutter.validation import config_yaml

SCENE = scene_of(resting("pudding_box"), resting("gelatin_box", xy=(0.15, 0.1)))
CELL = cell_with(
    "robot.base.x=-0.7",
    "robot.base.y=0.05",
    "robot.base.yaw=10",
    "gripper.extension=0.12",
    "cameras.overhead.pose.z=1.8",
)
"""Cell whose base, tool and camera have other poses than in the default cell."""


def planned(cell: WorkCell = CELL) -> PickPlacePlan:
    box = SCENE["pudding_box"].X_TO
    X_TO = Pose((0.0, -0.2, box.translation[2] + 0.001), box.quaternion)
    planner = PickPlacePlanner(cell, PlannerConfig(optimize=False))
    plan = planner.plan(SCENE.objects, "pudding_box", X_TO)
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


def is_past(simulation: StationSimulation, time: float) -> bool:
    return bool(simulation.root.get_time() > time)


def test_recordings_show_the_arm_at_its_simulated_poses(tmp_path: Path) -> None:
    simulation, motion, simulated = StationSimulation(CELL, SCENE), list[MotionSample](), []
    context = simulation.executor.GetMyMutableContextFromRoot(simulation.root)
    simulation.executor.GetInputPort("plan").FixValue(context, PlannedMove(1, planned()))
    for end in (0.4, 0.8, 1.2):
        simulation.run_until(partial(is_past, simulation, end))
        motion.append(simulation.sample())
        simulated.append(link_poses(simulation))
    outcome = Outcome(MoveResult.PLACED, SCENE, motion=tuple(motion))
    path = tmp_path / "trajectory.h5"
    write_trajectories(path, SCENE, [(Move("pudding_box"), outcome)], CELL)
    scene, cell, ((_, frames),) = read_trajectories(path, load_catalog())
    assert cell == CELL
    _, _, drawn_at = recording._build_viewer(scene, cell, arm=True)
    for frame, poses in zip(frames, simulated, strict=True):
        assert frame.arm is not None
        drawn = drawn_at(frame.arm.q)
        for name, X_TL in poses.items():
            assert drawn[name].p == pytest.approx(X_TL.p, abs=1e-9)
            assert drawn[name].rotation == pytest.approx(X_TL.rotation, abs=1e-9)
    ends = [poses["epick::body"].p for poses in (simulated[0], simulated[-1])]
    assert np.linalg.norm(ends[1] - ends[0]) > 0.1, "it moved meanwhile"


def test_a_reset_simulation_repeats_itself() -> None:
    plan, simulation = planned(), StationSimulation(CELL, SCENE)
    first = simulation.execute(plan, record=True)
    simulation.reset(SCENE)
    assert simulation.root.get_time() == 0.0
    assert simulation.scene["pudding_box"].X_TO.p == pytest.approx(SCENE["pudding_box"].X_TO.p)
    again = simulation.execute(plan, record=True)
    assert again.poses == first.poses
    assert again.motion == first.motion


def test_plans_are_executed_one_after_the_other() -> None:
    simulation = StationSimulation(CELL, SCENE)
    first = simulation.execute(planned())
    assert (simulation.finished_plan, simulation.is_executing, first.lost_object) == (
        1,
        False,
        False,
    )
    place = Pose((0.0, 0.2, 0.0185), simulation.scene["pudding_box"].X_TO.quaternion)
    planner = PickPlacePlanner(CELL, PlannerConfig(optimize=False))
    plan = planner.plan(simulation.scene.objects, "pudding_box", place)
    assert isinstance(plan, PickPlacePlan)
    second = simulation.execute(plan, record=True)
    assert simulation.finished_plan == 2
    assert second.poses["pudding_box"].p[:2] == pytest.approx(place.p[:2], abs=0.003)
    assert 0 < second.motion[0].time <= 2 * STEP_PERIOD
    assert second.motion[-1].time == pytest.approx(
        second.simulated_time - simulation.executor_state.start_time
    )


def test_an_arm_with_seven_joints_executes_a_plan(tmp_path: Path) -> None:
    cell = load_cell(resource_path("models/cells/iiwa14_epick_tray.yaml"))
    result = StationSimulation(cell, SCENE).execute(planned(cell), record=True)
    assert result.poses["pudding_box"].p[:2] == pytest.approx([0.0, -0.2], abs=0.005)
    assert result.max_tracking_error < 0.02
    outcome, path = Outcome(MoveResult.PLACED, SCENE, motion=result.motion), tmp_path / "t.h5"
    write_trajectories(path, SCENE, [(Move("pudding_box"), outcome)], cell)
    _, read, ((_, frames),) = read_trajectories(path, load_catalog())
    assert read == cell.with_support(SCENE.support)
    assert frames[0].arm is not None
    assert frames[0].arm.q == pytest.approx(cell.robot.home, abs=0.01)
    with h5py.File(path, "a") as file:
        file.attrs["cell"] = config_yaml(CELL)
    with pytest.raises(InputError, match=r"move_0001\.q; expected a dataset of shape \('n', 6\)"):
        read_trajectories(path, load_catalog())


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
    result = simulate_plan(CELL, SCENE, plan, record=True)
    assert result.is_uneventful
    assert result.simulated_time == pytest.approx(exact.simulated_time, abs=1e-9)
    for name, X_TO in exact.poses.items():
        assert result.poses[name].p == pytest.approx(X_TO.p, abs=2e-4)
        assert result.motion[-1].poses[name] == result.poses[name]
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
    ("time_constant", "waited"), [(0.05, 0.0), (0.2, 0.2 * math.log(5) - 0.15), (5.0, 0.475)]
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
    assert (vacuum.Eval(station_context)[0] >= 0.8 * 0.8 * 101_325) == (time_constant < 5)
