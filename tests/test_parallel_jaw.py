"""Parallel jaws: grasps on two opposed faces, loads, and a simulated pick-and-place by friction."""

from collections.abc import Sequence

import numpy as np
import pytest
from conftest import CLASSES, resting, scene_of

from drake_clutter.cell.gripper import GraspFailure, GraspFailureReason, GraspSampling, Gripper
from drake_clutter.cell.parallel_jaw import JAWS, ParallelJawGripper
from drake_clutter.cell.work_cell import WorkCell, load_cell
from drake_clutter.grammar import Orientation
from drake_clutter.planning.motion_plan import HeldObject
from drake_clutter.planning.pick_place_plan import PickPlacePlan, PlanningFailure
from drake_clutter.planning.pick_place_planner import PickPlacePlanner
from drake_clutter.planning.planner_config import PlannerConfig
from drake_clutter.resources import resource_path
from drake_clutter.scenes.scene import SceneObject
from drake_clutter.simulation.scene_plant import rigid_transform
from drake_clutter.station.station_simulation import StationSimulation, execute_grips

GRIPPER = ParallelJawGripper(kind="parallel_jaw")
SAMPLING = GraspSampling(spacing=0.012, lip_gap=0.0005, max_grasps=9, min_payload_acceleration=0.3)


@pytest.fixture(scope="module")
def cell() -> WorkCell:
    return load_cell(resource_path("models/cells/ur10_2f85_tray.yaml"))


def planned(
    cell: WorkCell, objects: list[SceneObject], pick: str, config: PlannerConfig
) -> PickPlacePlan | PlanningFailure:
    o = next(o for o in objects if o.name == pick)
    return PickPlacePlanner(cell, config).plan(objects, pick, o.X_TO.translated((0.1, -0.2, 0.001)))


def test_jaws_close_on_two_opposed_faces() -> None:
    """The box is 38 mm by 89 mm, and 175 mm high: one pair of faces is within the stroke."""
    gripper: Gripper = GRIPPER
    box = resting("sugar_box", Orientation.UPRIGHT_0, (0.1, -0.2))
    grasps = gripper.sample_grasps(box.object_class, rigid_transform(box.X_TO), SAMPLING)
    assert not isinstance(grasps, GraspFailure)
    (grasp,) = grasps
    narrow_axis = box.X_TO.rotation[:, 0]
    assert abs(grasp.X_TG.rotation().matrix()[:, 1] @ narrow_axis) == pytest.approx(1.0)
    assert grasp.X_TG.rotation().matrix()[:, 2] == pytest.approx([0.0, 0.0, -1.0])
    assert GRIPPER.stroke - 2 * grasp.joints_held[0] == pytest.approx(0.038)
    assert GRIPPER.stroke - 2 * grasp.joints_open[0] == pytest.approx(0.038 + 2 * 0.007)
    assert grasp.X_TG.translation() == pytest.approx([0.1, -0.2, 0.175 - 0.0375 / 2])
    X_OG = rigid_transform(box.X_TO).InvertAndCompose(grasp.X_TG)
    assert gripper.can_attach(JAWS, box.object_class, X_OG)


def test_faces_beyond_the_stroke_are_refused() -> None:
    box = resting("cracker_box")
    found = GRIPPER.sample_grasps(box.object_class, rigid_transform(box.X_TO), SAMPLING)
    assert found == GraspFailure(GraspFailureReason.NO_OPPOSED_FACES, 0.160)
    weak = GRIPPER.model_copy(update={"force": 4.0})
    sugar = resting("sugar_box", Orientation.UPRIGHT_0)
    found = weak.sample_grasps(sugar.object_class, rigid_transform(sugar.X_TO), SAMPLING)
    assert found == GraspFailure(GraspFailureReason.TOO_HEAVY, CLASSES["sugar_box"].mass)


def test_two_pads_bear_twice_the_friction() -> None:
    zero = np.zeros(3)
    capacity = 2 * GRIPPER.friction * GRIPPER.force
    assert GRIPPER.load_ratio(JAWS, np.array([0.0, 0.0, capacity]), zero) == pytest.approx(1.0)
    assert GRIPPER.load_ratio(JAWS, np.array([0.6, 0.0, 0.8]) * capacity, zero) == pytest.approx(
        1.0
    )
    assert GRIPPER.load_ratio(JAWS, np.array([0.0, GRIPPER.force, 0.0]), zero) == pytest.approx(1.0)
    torsion = np.array([0.0, capacity * 2 / 3 * 0.011, 0.0])
    assert GRIPPER.load_ratio(JAWS, zero, torsion) == pytest.approx(1.0)


def test_jaws_keep_clear_of_neighbors(cell: WorkCell) -> None:
    """A neighbor 10 mm beside each narrow face leaves no room for a jaw of 12 mm."""
    box = resting("sugar_box", Orientation.UPRIGHT_0)
    axis = box.X_TO.rotation[:2, 0] * (0.038 + 0.010)
    walls = [
        resting("sugar_box", Orientation.UPRIGHT_0, (sign * axis[0], sign * axis[1]), name=name)
        for sign, name in ((1, "left"), (-1, "right"))
    ]
    config = PlannerConfig(optimize=False)
    assert isinstance(planned(cell, [box], "sugar_box", config), PickPlacePlan)
    found = planned(cell, [box, *walls], "sugar_box", config)
    assert isinstance(found, PlanningFailure)
    assert "jaw" in found.detail


def test_friction_holds_a_box_from_pick_to_place(cell: WorkCell) -> None:
    scene = scene_of(
        resting("sugar_box", Orientation.UPRIGHT_0), resting("gelatin_box", xy=(-0.2, 0))
    )
    config = PlannerConfig(optimize=False, max_guarded_descent=0.02)
    plan = planned(cell, [*scene.objects], "sugar_box", config)
    assert isinstance(plan, PickPlacePlan)
    assert plan.guarded_descent is None, "no bellows tell the contact"
    simulation = StationSimulation(cell, scene)
    result = simulation.execute(plan)
    assert simulation.gripper.status.last_held == "sugar_box"
    assert not result.lost_object
    assert 0.1 < result.max_load_ratio < 1, "the tangential force is within friction"
    assert result.slip < 0.003
    assert result.position_error < 0.003
    assert result.poses["sugar_box"].p[2] == pytest.approx(0.0875, abs=0.001)


def test_jaws_without_an_object_are_open(cell: WorkCell) -> None:
    """The joints of the jaws are 0 where they are fully open."""
    planner = PickPlacePlanner(cell, PlannerConfig(optimize=False))
    q = np.array(cell.robot.home) + 0.2 * np.eye(6)[0]
    plan = planner.plan_move(planner.home_state([]), q.tolist())
    assert not isinstance(plan, PlanningFailure)
    assert {step.joints for step in plan.steps} == {(0.0, 0.0)}


def test_jaws_that_close_on_nothing_go_back_and_try_another_grasp(cell: WorkCell) -> None:
    """The can is 0.15 m beside its believed pose; each of two grasps closes beyond its surface."""
    believed, true = (resting("tomato_soup_can", xy=(x, 0.0)) for x in (0.1, -0.05))
    planner = PickPlacePlanner(cell, PlannerConfig(optimize=False))

    def plan(exclude: Sequence[HeldObject] = ()) -> PickPlacePlan | PlanningFailure:
        X_TO_place = believed.X_TO.translated((0.0, -0.2, 0.001))
        return planner.plan([believed], believed.name, X_TO_place, exclude=exclude)

    first = plan()
    assert isinstance(first, PickPlacePlan)
    simulation = StationSimulation(cell, scene_of(true))
    result = execute_grips(simulation, first, plan, max_grips=2)
    assert (result.grasped, result.missed_grasp, result.num_grips) == (False, True, 2)
    assert isinstance(result.plan, PickPlacePlan)
    turn = first.X_OG.rotation().InvertAndCompose(result.plan.X_OG.rotation())
    assert turn.ToAngleAxis().angle() > 0.1, "in another direction"
    assert result.poses[true.name].p == pytest.approx(true.X_TO.p, abs=0.0005)
    q = simulation.station.joint_positions(simulation.plant_context)
    assert q == pytest.approx(np.array(cell.robot.home), abs=0.001)
    jaws = simulation.station.GetOutputPort("gripper_state").Eval(
        simulation.station.GetMyContextFromRoot(simulation.root)
    )
    assert jaws[:2] == pytest.approx([0.0, 0.0], abs=0.001), "opened"
