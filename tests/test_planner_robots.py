"""Plans of several robots are checked at independent samples."""

import math

import numpy as np
import pytest
from conftest import DEFAULT_CELL, cell_with, resting, rng

from drake_clutter.cell.fixture import Fixture
from drake_clutter.cell.gripper import Payload
from drake_clutter.cell.pose_spec import PoseSpec
from drake_clutter.cell.work_cell import WorkCell, load_cell
from drake_clutter.grammar import Orientation
from drake_clutter.planning.arm_dynamics import arm_dynamics
from drake_clutter.planning.pick_place_plan import (
    PickPlacePlan,
    PlanningFailure,
    PlanningFailureReason,
    TrajectorySegment,
)
from drake_clutter.planning.pick_place_planner import PickPlacePlanner
from drake_clutter.planning.planner_config import PlannerConfig
from drake_clutter.resources import resource_path
from drake_clutter.scenes.scene import Pose, SceneObject
from drake_clutter.simulation.scene_plant import rigid_transform

PILE = [
    resting("sugar_box", Orientation.UPRIGHT_0, (0.05, -0.05)),
    resting("tomato_soup_can", xy=(0.10, 0.10)),
    resting("cracker_box", Orientation.UPRIGHT_0, (-0.10, 0.12)),
]
MOVES = [
    ("sugar_box", 0.15, -0.15, 0.0),
    ("tomato_soup_can", -0.15, -0.12, 1.6),
    ("cracker_box", 0.0, -0.15, 0.8),
]
ROBOTS = ["iiwa14", "ur5e", "ur10e", "tilted ur10"]


def cell_of(name: str) -> WorkCell:
    if name == "tilted ur10":  # its joints keep no tool vertical by linear relations
        base = "robot.base.x=-0.7", "robot.base.z=0.4", "robot.base.pitch=10"
        return cell_with(*base, "robot.pedestal_side=0")
    return load_cell(resource_path(f"models/cells/{name}_epick_tray.yaml"))


def place_pose(o: SceneObject, x: float, y: float, yaw: float) -> Pose:
    """Return a place pose 1 mm above the tray, rotated about the vertical by yaw [rad]."""
    c, s = math.cos(yaw), math.sin(yaw)
    R = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]) @ o.X_TO.rotation
    return Pose.from_rotation(R, (x, y, o.X_TO.translation[2] + 0.001))


def samples(phase: TrajectorySegment, order: int = 0, rate: float = 100.0) -> np.ndarray:
    """Return samples of a segment at a rate [Hz]. Shape (m, n)."""
    times = np.linspace(0.0, phase.duration, math.ceil(rate * phase.duration) + 1)
    return np.asarray(phase.trajectory.MakeDerivative(order).vector_values(times).T)


def assert_limits(planner: PickPlacePlanner, plan: PickPlacePlan) -> None:
    robot, loaded = planner.robot, plan.payload
    lower, upper = robot.position_limits.T
    for phase in plan.segments:
        q, v, a, jerk = (samples(phase, order, 500.0) for order in range(4))
        assert q.shape[1] == robot.num_joints
        assert (q >= lower - 1e-9).all()
        assert (q <= upper + 1e-9).all()
        dynamics = arm_dynamics(planner.cell, loaded if phase.name == "carry" else Payload())
        assert np.abs(v / robot.velocity_limits).max() < 1.01
        assert np.abs(a / robot.acceleration_limits).max() < 1.01
        assert np.abs(jerk / robot.jerk_limits).max() < 1.01
        assert np.abs(dynamics.inverse_dynamics(q, v, a) / robot.torque_limits).max() < 1.01
        for at_rest in (v[[0, -1]], a[[0, -1]]):
            assert np.abs(at_rest).max() < 1e-8


def assert_collision_free(planner: PickPlacePlanner, plan: PickPlacePlan) -> None:
    scene = planner.collision_model(PILE)
    for phase in plan.segments:
        scene.set_object_poses(PILE)
        if phase.name == "carry":
            scene.attach_object(plan.pick, plan.tool, plan.X_OG)
        else:
            X_TO = plan.X_TO_pick if phase.name == "approach" else plan.X_TO_place
            scene.set_object_pose(plan.pick, X_TO)
        for q in samples(phase):
            for here in scene.distances_below(q, 0.0):
                touching = here.pair in ((f"{plan.tool}_cup", plan.pick), (plan.pick, "floor"))
                assert touching, f"{phase.name}: {here}"
                assert here.distance > -0.001


def assert_endpoints(planner: PickPlacePlanner, plan: PickPlacePlan) -> None:
    home = planner.robot.home
    approach, carry, retreat = (phase.trajectory for phase in plan.segments)
    assert approach.value(0.0).ravel() == pytest.approx(home)
    assert retreat.value(retreat.end_time()).ravel() == pytest.approx(home)
    for first, second in ((approach, carry), (carry, retreat)):
        assert first.value(first.end_time()) == pytest.approx(second.value(0.0), abs=1e-9)
    for time, X_TO in ((0.0, plan.X_TO_pick), (carry.end_time(), plan.X_TO_place)):
        expected = (rigid_transform(X_TO) @ plan.X_OG).GetAsMatrix4()
        X_TG = planner.tools[plan.tool].pose(carry.value(time).ravel())
        assert pytest.approx(expected, abs=1e-6) == X_TG


@pytest.mark.parametrize("optimize", [False, True])
@pytest.mark.parametrize("name", ROBOTS)
def test_plans_of_other_robots_are_feasible(name: str, optimize: bool) -> None:
    planner = PickPlacePlanner(cell_of(name), PlannerConfig(optimize=optimize))
    by_name = {o.name: o for o in PILE}
    for pick, x, y, yaw in MOVES:
        place = place_pose(by_name[pick], x, y, yaw)
        plan = planner.plan(PILE, pick, place)
        assert isinstance(plan, PickPlacePlan), f"{pick}: {plan}"
        assert rigid_transform(plan.X_TO_place).IsNearlyEqualTo(rigid_transform(place), 1e-12)
        assert_limits(planner, plan)
        assert_collision_free(planner, plan)
        assert_endpoints(planner, plan)
        axis = planner.tools[plan.tool].axis(samples(plan.segments[1]))
        tilt = np.arctan2(np.hypot(axis[:, 0], axis[:, 1]), -axis[:, 2])
        assert np.degrees(tilt).max() < 1.0
        assert plan.duration < (0.95 if optimize else 1.01) * plan.unoptimized_duration


@pytest.mark.parametrize("name", ["iiwa14", "ur5e"])
def test_other_robots_plan_guarded_descents(name: str) -> None:
    config = PlannerConfig(optimize=False, max_guarded_descent=0.04, descent_start_offset=0.02)
    planner = PickPlacePlanner(cell_of(name), config)
    box = PILE[0]
    plan = planner.plan(PILE, box.name, place_pose(box, 0.15, -0.15, 0.3))
    assert isinstance(plan, PickPlacePlan)
    assert plan.guarded_descent is not None
    assert plan.max_descent >= 0.02
    q = plan.guarded_descent.trajectory.vector_values(
        np.linspace(0.0, plan.guarded_descent.duration, 20)
    ).T
    carry = plan.segments[1].trajectory
    assert q[0] == pytest.approx(carry.value(carry.end_time()).ravel(), abs=1e-9)
    p_TG = planner.tools[plan.tool].pose(q)[:, :3, 3]
    assert np.abs(p_TG[:, :2] - p_TG[0, :2]).max() < 1e-4
    assert p_TG[0, 2] - p_TG[-1, 2] == pytest.approx(plan.max_descent, abs=1e-4)


def test_distance_gradients_of_seven_joints() -> None:
    planner = PickPlacePlanner(cell_of("iiwa14"), PlannerConfig())
    generator = rng(0)
    step = 1e-5
    scene, checked = planner.collision_model(PILE[:2]), 0
    for _ in range(20):
        q = planner.robot.home + generator.normal(0.0, 0.2, 7)
        for here, gradient in scene.distances_and_gradients(q, 0.3):
            sides = []
            for joint in range(7):
                moved = [
                    scene.distances_below(q + sign * step * np.eye(7)[joint], 0.31)
                    for sign in (1, -1)
                ]
                ahead, behind = (
                    [c.distance for c in found if c.pair == here.pair] for found in moved
                )
                if len(ahead) == len(behind) == 1:
                    sides.append(abs(gradient[joint] - (ahead[0] - behind[0]) / (2 * step)))
            if len(sides) == 7:
                checked += 1
                assert np.median(sides) < 1e-3
    assert checked > 20


def with_wall(translation: tuple[float, float, float], box: tuple[float, float, float]) -> WorkCell:
    wall = Fixture(name="wall", pose=PoseSpec(translation=translation), box=box)
    return DEFAULT_CELL.model_copy(update={"fixtures": (*DEFAULT_CELL.fixtures, wall)})


def test_jacobians_of_the_tool_are_derivatives_of_its_pose() -> None:
    for cell in (DEFAULT_CELL, load_cell(resource_path("models/cells/iiwa14_epick_tray.yaml"))):
        for tool in PickPlacePlanner(cell, PlannerConfig()).tools.values():
            q = rng(2).uniform(-1.0, 1.0, (3, tool.robot.num_joints))
            jacobians = tool.jacobians(q)
            R = tool.pose(q)[:, :3, :3]
            for joint, dq in enumerate(1e-6 * np.eye(tool.robot.num_joints)):
                dX = (tool.pose(q + dq) - tool.pose(q - dq)) / 2e-6
                spin = dX[:, :3, :3] @ R.swapaxes(1, 2)
                angular = np.array([spin[:, 2, 1], spin[:, 0, 2], spin[:, 1, 0]]).T
                expected = np.hstack([angular, dX[:, :3, 3]])
                assert jacobians[:, :, joint] == pytest.approx(expected, abs=1e-7)


def test_fixtures_of_the_cell_are_avoided() -> None:
    box, X_TO = PILE[0], place_pose(PILE[0], 0.20, -0.25, 0.0)
    between = PickPlacePlanner(with_wall((0.12, -0.15, 0.13), (0.05, 0.05, 0.26)), PlannerConfig())
    free = PickPlacePlanner(DEFAULT_CELL, PlannerConfig()).plan([box], box.name, X_TO)
    passed = between.plan([box], box.name, X_TO)

    def nearest(plan: PickPlacePlan | PlanningFailure) -> float:
        assert isinstance(plan, PickPlacePlan)
        scene = between.collision_model([box])
        scene.attach_object(box.name, plan.tool, plan.X_OG)
        found = [here for q in samples(plan.segments[1]) for here in scene.distances_below(q, 0.3)]
        return min(here.distance for here in found if here.pair[1] == "wall")

    assert nearest(free) < 0, "the wall is in the way"
    assert nearest(passed) > PlannerConfig().min_distance - 0.001
    there = PickPlacePlanner(with_wall((0.20, -0.25, 0.3), (0.1, 0.1, 0.6)), PlannerConfig())
    found = there.plan([box], box.name, X_TO)
    assert isinstance(found, PlanningFailure)
    assert found.reason is PlanningFailureReason.PLACE_IN_COLLISION
    assert "wall" in found.detail
