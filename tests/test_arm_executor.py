"""Simulated plans: placement errors, lost objects, guarded descents, and determinism."""

import itertools
import math
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from conftest import DEFAULT_CELL, ONE_CUP, cell_with, executed, resting, rng, scene_of
from pydrake.systems.analysis import Simulator

from drake_clutter.assets import build_assets
from drake_clutter.catalog import load_catalog
from drake_clutter.cell.work_cell import WorkCell
from drake_clutter.config import ClutterConfig
from drake_clutter.files import InputError
from drake_clutter.grammar import Orientation
from drake_clutter.perception.label_detector import LabelDetector
from drake_clutter.planning.collision_model import SignedDistance
from drake_clutter.planning.motion_plan import DWELL_TIME
from drake_clutter.planning.pick_place_plan import (
    PickPlacePlan,
    PlanningFailure,
    PlanningFailureReason,
    plan_to_dict,
)
from drake_clutter.planning.pick_place_planner import PickPlacePlanner
from drake_clutter.planning.planner_config import ANY_OVERLAP, PlannerConfig
from drake_clutter.reports.filmstrip import (
    render_filmstrip,
    rotation_to_base_side,
    select_key_frames,
)
from drake_clutter.reports.recording import motion_frames, write_recording
from drake_clutter.scenes.interfaces import Move, MoveResult, PickPlaceCommand
from drake_clutter.scenes.scene import Pose, Scene, SceneObject
from drake_clutter.station import station_simulation
from drake_clutter.station.arm_executor import ArmExecutor, evaluate_outcome
from drake_clutter.station.clutter_station import ClutterStation
from drake_clutter.station.command_schedule import build_command_schedule
from drake_clutter.station.grasp_constraint import WeldPair
from drake_clutter.station.messages import ExecutorStatus, PlannedMove
from drake_clutter.station.pick_place_executor import PickPlaceExecutor
from drake_clutter.station.station_simulation import PickPlaceResult, StationSimulation

SCENE = scene_of(
    resting("sugar_box", Orientation.UPRIGHT_0),
    resting("tomato_soup_can", xy=(0.08, 0.0)),
    resting("pudding_box", xy=(-0.15, 0.1)),
)
FIRST_TOOL = next(iter(DEFAULT_CELL.gripper.tools))
PLACE = Pose((0.2, -0.2, 0.0885), SCENE["sugar_box"].X_TO.quaternion)


def planned(scene: Scene = SCENE, pick: str = "sugar_box", X_TO: Pose = PLACE) -> PickPlacePlan:
    found = PickPlacePlanner(DEFAULT_CELL, PlannerConfig()).plan(scene.objects, pick, X_TO)
    assert isinstance(found, PickPlacePlan)
    return found


@pytest.fixture(scope="module")
def plan() -> PickPlacePlan:
    return planned()


def run(
    plan: PickPlacePlan, cell: WorkCell | None = None, weld: WeldPair | None = None
) -> PickPlaceResult:
    return StationSimulation(cell or DEFAULT_CELL, SCENE, weld=weld).execute(plan)


def test_an_object_is_placed_at_its_place_pose(plan: PickPlacePlan) -> None:
    result = run(plan)
    assert result.grasped
    assert math.isnan(result.drop_time)
    assert result.position_error < 0.003
    assert result.orientation_error < math.radians(1)
    assert result.poses["sugar_box"].translation[2] == pytest.approx(0.0875, abs=0.001), (
        "it stands on the tray"
    )
    assert result.slip < 0.001
    assert max(result.displacements.values()) < 0.001
    assert result.max_tracking_error < 0.02
    assert 0.1 < result.max_load_ratio < 1
    assert result.lowered_distance == 0.0, "without a guarded descent"


def test_a_weld_grasp_does_not_slip(plan: PickPlacePlan) -> None:
    result = run(plan, weld=WeldPair(plan.pick, plan.tool))
    assert result.grasped
    assert result.slip < 1e-9


def test_the_small_cup_moves_a_marker_between_others() -> None:
    """Markers lie 2 mm apart; the vacuum of the large cup stays off."""
    markers = [
        resting("large_marker", xy=(0.0, y), name=name)
        for name, y in (("left", 0.02), ("middle", 0.0), ("right", -0.02))
    ]
    place = markers[1].X_TO.translated((0.1, -0.2, 0.001))
    plan = PickPlacePlanner(DEFAULT_CELL, PlannerConfig()).plan(markers, "middle", place)
    assert isinstance(plan, PickPlacePlan)
    assert plan.tool == "small"
    simulation = StationSimulation(DEFAULT_CELL, scene_of(*markers), rate=40.0)
    result = simulation.execute(plan)
    assert result.grasped
    assert not result.lost_object
    assert result.position_error < 0.003
    assert max(result.displacements.values()) < 0.001
    assert result.samples is not None
    small = [*DEFAULT_CELL.gripper.tools].index("small")
    assert {*result.samples.tool_commanded.tolist()} == {-1, small}
    assert simulation.gripper.status.tool == "small"


def test_an_object_is_dropped_if_the_vacuum_is_too_weak(plan: PickPlacePlan) -> None:
    """The plan assumes a vacuum of 80 %; the simulation has 10 %, or 5 N for a weight of 5 N."""
    result = run(plan, cell_with("gripper.vacuum=0.1"))
    assert result.grasped
    on = build_command_schedule(plan, DEFAULT_CELL).start_of("grasp")
    assert on < result.drop_time < on + DWELL_TIME + 0.5, "as soon as it is lifted"
    assert result.position_error > 0.2


def test_an_uneventful_move_changes_nothing_but_the_picked_object(plan: PickPlacePlan) -> None:
    result = run(plan)
    assert result.is_uneventful
    assert replace(result, displacements={}).is_uneventful
    for change in (
        {"grasped": False},
        {"drop_time": 1.0},
        {"position_error": 0.1},
        {"orientation_error": 1.0},
        {"displacements": {"a": 0.0, "b": 0.1}},
    ):
        assert not replace(result, **change).is_uneventful


def test_an_object_is_not_lifted_without_a_seal(plan: PickPlacePlan) -> None:
    result = run(plan, cell_with("gripper.unevenness=0"))
    assert not result.grasped
    assert result.poses["sugar_box"].p == pytest.approx(SCENE["sugar_box"].X_TO.p, abs=0.001)


def test_a_motion_that_does_not_end_is_given_up(
    plan: PickPlacePlan, config: ClutterConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A motion that may be late by -0.2 s is given up before its end."""
    monkeypatch.setattr(station_simulation, "MAX_OVERTIME", -0.2)
    executor = ArmExecutor(config)
    monkeypatch.setattr(executor, "plan", lambda *_: plan)
    command = PickPlaceCommand(Move("sugar_box"), SCENE["sugar_box"].X_TO, PLACE)
    outcome = executor.execute(SCENE, command, rng())
    assert outcome.result is MoveResult.INCONCLUSIVE
    assert outcome.samples is None
    assert outcome.scene is SCENE
    found = re.fullmatch(r"the motion had not ended after (\S+) s", outcome.detail)
    assert found is not None
    duration = sum(step.duration for step in plan.steps)
    assert float(found[1]) == pytest.approx(duration - 0.2, abs=0.03)


def test_a_motion_of_hours_is_refused(plan: PickPlacePlan) -> None:
    schedule = replace(build_command_schedule(plan, DEFAULT_CELL), end_time=1e9)
    simulation = StationSimulation(DEFAULT_CELL, SCENE, movable=frozenset())
    with pytest.raises(InputError, match=r"plan: takes 1e\+09 s; expected at most 3600 s"):
        simulation.execute(plan, schedule)


@pytest.mark.parametrize(
    ("xy", "result"), [((0.2, -0.2), MoveResult.CAME_OFF), ((0.2, 0.0), MoveResult.DROPPED)]
)
def test_an_object_that_comes_off_at_its_place_pose_is_not_dropped(
    xy: tuple[float, float], result: MoveResult, config: ClutterConfig
) -> None:
    """The impact at touchdown may break the seal just before the vacuum is switched off."""
    after = SCENE.with_poses({"sugar_box": Pose((*xy, 0.0875), PLACE.quaternion)})
    outcome = evaluate_outcome(SCENE, after, "sugar_box", PLACE, True, config.settle)
    assert (outcome.result, outcome.instability) == (result, None)


def test_only_disturbed_objects_are_settled(config: ClutterConfig) -> None:
    """Every object is in the air: the picked one, one that the motion moved, and one it did not."""
    in_the_air = scene_of(
        *(replace(o, X_TO=o.X_TO.translated((0.0, 0.0, 0.001))) for o in SCENE.objects)
    )
    can, untouched = "tomato_soup_can", "pudding_box"
    X_TO_moved = in_the_air[can].X_TO.translated((0.0, 0.001, 0.0))
    after = in_the_air.with_poses({"sugar_box": PLACE, can: X_TO_moved})
    outcome = evaluate_outcome(in_the_air, after, "sugar_box", PLACE, False, config.settle)
    assert (outcome.result, outcome.instability) == (MoveResult.PLACED, None)
    for name in ("sugar_box", can):
        fall = after[name].X_TO.p - outcome.scene[name].X_TO.p
        assert fall == pytest.approx([0.0, 0.0, 0.001], abs=2e-4)
    assert outcome.scene[untouched].X_TO == after[untouched].X_TO


LOST = Pose((0.62, 0.05, 0.077), PLACE.quaternion)
"""On the table beside the tray."""


@pytest.mark.parametrize("lost", ["sugar_box", "pudding_box"])
def test_an_object_that_leaves_the_tray_is_blamed_on_that_move(
    lost: str, config: ClutterConfig
) -> None:
    """The gripper drops the picked object beside the tray, or throws another one off it."""
    after = SCENE.with_poses({"sugar_box": PLACE, lost: LOST})
    outcome = evaluate_outcome(SCENE, after, "sugar_box", PLACE, True, config.settle)
    assert outcome.result is MoveResult.LEFT_TRAY
    assert outcome.instability_text.startswith(f"{lost} left the tray")
    assert outcome.instability_text.endswith("and is at (0.620, 0.050, 0.077) m")


def test_later_moves_are_not_blamed_for_an_object_beside_the_tray(config: ClutterConfig) -> None:
    before = SCENE.with_poses({"pudding_box": LOST})
    after = before.with_poses({"sugar_box": PLACE, "pudding_box": LOST.translated((0.1, 0, 0))})
    outcome = evaluate_outcome(before, after, "sugar_box", PLACE, False, config.settle)
    assert (outcome.result, outcome.instability) == (MoveResult.PLACED, None)


def test_a_written_plan_has_the_smallest_distance_of_each_segment(plan: PickPlacePlan) -> None:
    near = SignedDistance(0.01, ("sugar_box", "floor"))
    alone = SignedDistance(math.inf, ("", ""))
    first, *others = plan.segments
    segments = (
        replace(first, min_distance=near),
        *(replace(o, min_distance=alone) for o in others),
    )
    written = plan_to_dict(replace(plan, segments=segments))["segments"]
    assert [(s["min_distance"], s["closest_pair"]) for s in written] == [
        (0.01, ["sugar_box", "floor"]),
        *[(None, [])] * len(others),
    ]


def test_stages_of_the_command_schedule(plan: PickPlacePlan) -> None:
    schedule = build_command_schedule(plan, DEFAULT_CELL)
    assert [step.name for step in schedule.steps] == [
        "approach",
        "grasp",
        "carry",
        "release",
        "retreat",
    ]
    assert schedule.end_time == pytest.approx(plan.duration + 2 * DWELL_TIME)
    assert schedule.stage_at(0.0) == "approach"
    assert schedule.stage_at(schedule.start_of("grasp")) == "grasp"
    assert schedule.stage_at(schedule.release_time + 0.01) == "release"
    assert schedule.stage_at(schedule.end_time) == "idle"
    home = np.concatenate([DEFAULT_CELL.robot.home, np.zeros(6)])
    assert schedule.command.value(0.0).ravel()[:12] == pytest.approx(home, abs=1e-3)
    assert schedule.command.value(schedule.end_time).ravel()[:12] == pytest.approx(home, abs=1e-3)


@pytest.mark.parametrize("too_tall", [0.065, 0.0])
def test_an_object_of_unknown_height_is_lowered_until_contact(
    too_tall: float,
) -> None:
    """A pudding box is mistaken for a sugar box; or it is known, and 3 mm too high."""
    stands = resting("pudding_box", Orientation.UPRIGHT_0)
    taken_for = (
        resting("sugar_box", Orientation.UPRIGHT_0, floor=-too_tall, name=stands.name)
        if too_tall
        else stands
    )
    X_TO = Pose(
        (0.2, -0.2, taken_for.X_TO.translation[2] + too_tall + 0.003), taken_for.X_TO.quaternion
    )
    config = PlannerConfig(max_guarded_descent=0.08, max_overlap=ANY_OVERLAP)
    guarded = PickPlacePlanner(DEFAULT_CELL, config)
    plan = guarded.plan([taken_for], taken_for.name, X_TO)
    assert isinstance(plan, PickPlacePlan)
    simulation = StationSimulation(DEFAULT_CELL, scene_of(stands))
    result = simulation.execute(plan)
    context = simulation.executor.GetMyContextFromRoot(simulation.root)
    status = simulation.executor.GetOutputPort("status").Eval(context)
    assert status.felt_mass == pytest.approx(stands.object_class.mass, abs=0.003)
    assert status.has_touched
    assert result.lowered_distance == pytest.approx(too_tall + 0.003, abs=0.002)
    assert result.poses[stands.name].p == pytest.approx([0.2, -0.2, 0.055], abs=0.003)


def test_a_guarded_descent_stops_at_an_unexpectedly_high_support() -> None:
    """The support is estimated 10.5 mm too low, which exceeds the stroke of the bellows."""
    box, support = SCENE["sugar_box"], resting("cracker_box", xy=(0.2, -0.2))
    top = support.top_height
    X_TO = Pose((0.2, -0.2, top - 0.0105 + 0.0875), box.X_TO.quaternion)
    slow = PlannerConfig(max_guarded_descent=0.08, optimize=False)
    plan = PickPlacePlanner(DEFAULT_CELL, slow).plan([box], box.name, X_TO)
    assert isinstance(plan, PickPlacePlan)
    result = StationSimulation(DEFAULT_CELL, scene_of(box, support)).execute(plan)
    assert result.lowered_distance < 0.002
    assert result.poses[box.name].p == pytest.approx([0.2, -0.2, top + 0.0875], abs=0.005)
    assert result.displacements[support.name] < 0.005


def test_a_guarded_descent_without_an_object_ends_at_once(plan: PickPlacePlan) -> None:
    guarded = PickPlacePlanner(DEFAULT_CELL, PlannerConfig(max_guarded_descent=0.08)).plan(
        SCENE.objects, "sugar_box", PLACE
    )
    assert isinstance(guarded, PickPlacePlan)
    assert guarded.max_descent == pytest.approx(0.08)
    result = StationSimulation(cell_with("gripper.unevenness=0"), SCENE).execute(guarded)
    assert result.lowered_distance < 0.002


@pytest.mark.parametrize("weld", [None, WeldPair("sugar_box", FIRST_TOOL)])
def test_visual_geometry_has_the_poses_of_the_bodies(weld: WeldPair | None) -> None:
    classes = [(o.name, o.object_class) for o in SCENE.objects]
    options: dict[str, Any] = {
        "time_step": 0.01,
        "weld": weld,
        "visuals": True,
    }
    station = ClutterStation(DEFAULT_CELL, classes, **options)
    root = station.CreateDefaultContext()
    station.set_state(root, np.array(DEFAULT_CELL.robot.home), SCENE.objects)
    query, poses = (station.GetOutputPort(name).Eval(root) for name in ("query", "body_poses"))
    inspector, compared = query.inspector(), 0
    for geometry in inspector.GetAllGeometryIds():
        name = inspector.GetName(inspector.GetFrameId(geometry))
        for model in (f"{o.name}::{o.object_class.name}" for o in SCENE.objects):
            if name.startswith(model):
                body = station.scene_plant.bodies[model.split("::")[0]]
                X_TB = query.GetPoseInWorld(inspector.GetFrameId(geometry))
                assert X_TB.IsNearlyEqualTo(poses[int(body.index())], 1e-9)
                compared += 1
    assert compared >= len(SCENE.objects)


def test_an_executor_without_a_plan_commands_the_home_configuration() -> None:
    executor = PickPlaceExecutor(cell=DEFAULT_CELL)
    context = executor.CreateDefaultContext()
    assert executor.GetOutputPort("command").Eval(context)[:6] == pytest.approx(
        DEFAULT_CELL.robot.home
    )
    assert executor.GetOutputPort("hold").Eval(context)[0] == 0
    assert executor.GetOutputPort("status").Eval(context) == ExecutorStatus()


def test_a_cloned_context_continues_identically(plan: PickPlacePlan) -> None:
    """All state of the executor is in its context."""
    executor = PickPlaceExecutor(cell=DEFAULT_CELL)
    context = executor.CreateDefaultContext()
    executor.GetInputPort("plan").FixValue(context, PlannedMove(1, plan))
    simulator = Simulator(executor, context)
    simulator.AdvanceTo(1.0)
    clone = Simulator(executor, simulator.get_context().Clone())
    simulator.AdvanceTo(2.0)
    clone.AdvanceTo(2.0)
    for port in ("command", "hold"):
        first, second = (
            executor.GetOutputPort(port).Eval(s.get_context()) for s in (simulator, clone)
        )
        assert (first == second).all()
    phase = build_command_schedule(plan, DEFAULT_CELL).stage_at(2.0)
    assert executor.GetOutputPort("status").Eval(clone.get_context()) == ExecutorStatus(1, phase)
    assert executor.GetOutputPort("command").Eval(clone.get_context())[:6] != pytest.approx(
        DEFAULT_CELL.robot.home
    )


def test_simulation_is_deterministic(plan: PickPlacePlan) -> None:
    first, second = run(plan), run(plan)
    assert first.poses == second.poses
    assert first.max_load_ratio == second.max_load_ratio


def test_moves_are_executed_or_refused_with_a_reason(
    detector: LabelDetector, config: ClutterConfig
) -> None:
    """A large cup places a box; it refuses a marker and a box that carries another one."""
    scene = scene_of(
        resting("pudding_box"),
        resting("gelatin_box", floor=0.035),
        resting("large_marker", xy=(0.2, 0.2)),
    )
    one_cup = replace(config, cell=cell_with(ONE_CUP))
    executor, observation = ArmExecutor(one_cup), detector.perceive(scene).observation
    placed = executed(executor, scene, observation, Move("gelatin_box"), rng())
    assert placed.result is MoveResult.PLACED
    assert placed.instability is None
    assert "mm" in placed.detail
    assert placed.scene["gelatin_box"].bounds_T[0][2] == pytest.approx(0.0, abs=0.001)
    assert placed.scene["pudding_box"].X_TO.p == pytest.approx(
        scene["pudding_box"].X_TO.p, abs=0.002
    )
    assert placed.samples is not None
    for name, why in (("large_marker", "no seal"), ("pudding_box", "carries others")):
        outcome = executed(executor, scene, observation, Move(name), rng())
        assert outcome.result is MoveResult.NOT_PLANNED
        assert outcome.detail.startswith(why)
        assert outcome.failure_reason == why
        assert outcome.scene == scene
        assert not outcome.result.was_executed


def test_images_and_recordings_show_the_arm(plan: PickPlacePlan, tmp_path: Path) -> None:
    samples = StationSimulation(DEFAULT_CELL, SCENE, rate=40.0).execute(plan).samples
    assert samples is not None
    motion = motion_frames(samples, SCENE.names)
    assert motion[0].q == pytest.approx(DEFAULT_CELL.robot.home, abs=1e-6)
    moments = select_key_frames(motion, "sugar_box")
    times = [frame.time for frame in moments]
    assert times == sorted(times)
    assert moments[0].poses["sugar_box"].p == pytest.approx(SCENE["sugar_box"].X_TO.p, abs=0.01)
    assert moments[1].poses["sugar_box"].p[2] > 0.1
    assert moments[2].poses["sugar_box"].p[:2] == pytest.approx(PLACE.p[:2], abs=0.005)
    picture = render_filmstrip(SCENE, moments, DEFAULT_CELL, 480)
    assert picture.shape == (480, 4 * 480, 3)
    quarters = np.split(picture.astype(int), 4, axis=1)
    assert all(np.abs(a - b).mean() > 1 for a, b in itertools.pairwise(quarters)), "the arm moves"
    write_recording(tmp_path / "with.html", SCENE, motion[::8], DEFAULT_CELL)
    write_recording(
        tmp_path / "without.html",
        SCENE,
        [replace(frame, q=()) for frame in motion[::8]],
        DEFAULT_CELL,
    )
    with_arm, without = ((tmp_path / f"{name}.html").stat().st_size for name in ("with", "without"))
    assert with_arm > without + 20_000, "its links, and their key frames"


def test_images_are_rendered_from_the_side_opposite_the_base() -> None:
    assert rotation_to_base_side(DEFAULT_CELL).tolist() == np.eye(3).tolist()
    other_side = rotation_to_base_side(cell_with("robot.base.x=0.65"))
    assert (other_side @ [-1.0, 0.0, 0.0]).tolist() == [1.0, 0.0, 0.0]
    side = rotation_to_base_side(cell_with("robot.base.x=0.1", "robot.base.y=-0.65"))
    assert (side @ [-1.0, 0.0, 0.0]).tolist() == [0.0, -1.0, 0.0]
    above = rotation_to_base_side(cell_with("robot.base.x=0.0", "robot.base.y=0.0"))
    assert above.tolist() == np.eye(3).tolist()


def test_an_object_placed_on_an_edge_falls() -> None:
    """A box that is released on the edge of a slim one falls.

    The planner refuses that, unless it takes the slim one for two.
    """
    scene = scene_of(
        resting("sugar_box", Orientation.UPRIGHT_0), resting("gelatin_box", xy=(0.15, 0.0))
    )
    X_TO_edge = Pose((0.0, 0.03, 0.175 + 0.014 + 0.001), scene["gelatin_box"].X_TO.quaternion)
    planner = PickPlacePlanner(DEFAULT_CELL, PlannerConfig())
    refused = planner.plan(scene.objects, "gelatin_box", X_TO_edge)
    assert isinstance(refused, PlanningFailure)
    assert refused.reason is PlanningFailureReason.PLACE_OFF_BALANCE
    assert refused.value == pytest.approx(0.03 - 0.038 / 2, abs=1e-6)
    imagined = resting("sugar_box", Orientation.UPRIGHT_0, (0.0, 0.05), name="imagined")
    plan = planned(scene_of(*scene.objects, imagined), "gelatin_box", X_TO_edge)
    result = StationSimulation(DEFAULT_CELL, scene).execute(plan)
    assert result.grasped
    assert result.poses["gelatin_box"].translation[2] < 0.1


def test_a_thin_sheet_is_lifted_from_the_tray_and_from_a_box(tmp_path: Path) -> None:
    """The floor is 4 mm below the lip, less than the distance kept from other bodies."""
    sheet_entry = "{shape: box, size_mm: [150, 200, 4], mass_g: 250}"
    (tmp_path / "catalog.yaml").write_text(f"classes:\n  sheet: {sheet_entry}\n")
    build_assets(tmp_path)
    sheet_class = load_catalog(tmp_path).classes["sheet"]
    box = resting("pudding_box", xy=(0.15, 0.0))
    planner = PickPlacePlanner(DEFAULT_CELL, PlannerConfig(optimize=False))
    on_tray = Pose((-0.1, 0.0, 0.002), (1.0, 0.0, 0.0, 0.0))
    on_box = Pose((0.15, 0.0, 0.037), (1.0, 0.0, 0.0, 0.0))
    from_tray, from_box = (
        (planner.plan([sheet, box], "sheet", X_TO_place.translated((0.0, 0.0, 0.001))), sheet)
        for sheet, X_TO_place in (
            (SceneObject("sheet", sheet_class, on_tray), on_box),
            (SceneObject("sheet", sheet_class, on_box), on_tray),
        )
    )
    assert isinstance(from_box[0], PickPlacePlan)
    plan, sheet = from_tray
    assert isinstance(plan, PickPlacePlan)
    result = StationSimulation(DEFAULT_CELL, scene_of(sheet, box)).execute(plan)
    assert not result.lost_object, str(result)
    assert result.position_error < 0.001
    assert result.poses["sheet"].p[2] == pytest.approx(0.037, abs=0.0003)


def test_an_open_crate_is_lifted_by_its_floor(tmp_path: Path) -> None:
    """The cup rises above the walls before it moves sideways."""
    crate = trimesh.util.concatenate(
        [
            trimesh.creation.box(bounds=np.array([lower, upper]) / 1000)
            for lower, upper in (
                ((-60, -60, 0), (60, 60, 5)),
                ((-60, -60, 5.1), (-56, 60, 80)),
                ((56, -60, 5.1), (60, 60, 80)),
                ((-55.9, -60, 5.1), (55.9, -56, 80)),
                ((-55.9, 56, 5.1), (55.9, 60, 80)),
            )
        ]
    )
    crate.export(tmp_path / "crate.stl")  # type: ignore[no-untyped-call]
    (tmp_path / "catalog.yaml").write_text(
        "classes:\n  crate: {shape: mesh, mesh: crate.stl, mass_g: 250}\n"
    )
    build_assets(tmp_path)
    crate_class = load_catalog(tmp_path).classes["crate"]
    scene_object = SceneObject("crate", crate_class, Pose((0.0, 0.0, 0.04), (1.0, 0.0, 0.0, 0.0)))
    planner = PickPlacePlanner(DEFAULT_CELL, PlannerConfig(optimize=False))
    X_TO_place = scene_object.X_TO.translated((0.2, 0.1, 0.001))
    plan = planner.plan([scene_object], "crate", X_TO_place)
    assert isinstance(plan, PickPlacePlan), plan
    assert plan.X_OG.translation()[2] == pytest.approx(-0.035 + PlannerConfig().lip_gap, abs=1e-4)
    result = StationSimulation(DEFAULT_CELL, scene_of(scene_object)).execute(plan)
    assert result.grasped, str(result)
    assert result.position_error < 0.001
