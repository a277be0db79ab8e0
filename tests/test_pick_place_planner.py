"""Pick-and-place plans are checked at independent samples, and failures have their reasons."""

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from conftest import CLASSES, DEFAULT_CELL, ONE_CUP, cell_with, random_scene, resting, rng

from drake_clutter.cell.work_cell import WorkCell
from drake_clutter.grammar import Orientation
from drake_clutter.planning.pick_place_plan import (
    PickPlacePlan,
    PlanningFailure,
    PlanningFailureReason,
)
from drake_clutter.planning.pick_place_planner import PickPlacePlanner
from drake_clutter.planning.planner_config import PlannerConfig
from drake_clutter.planning.tool_kinematics import ToolKinematics
from drake_clutter.scenes.geometry import objects_resting_on
from drake_clutter.scenes.interfaces import MovePart
from drake_clutter.scenes.scene import Pose, SceneObject
from drake_clutter.simulation.scene_plant import rigid_transform
from drake_clutter.validation import to_plain, validate

TRAY_SIDE, ALTITUDE = 0.70, 1.60
LYING = (math.sqrt(0.5), 0.0, math.sqrt(0.5), 0.0)


def planner(cell: WorkCell | None = None, config: PlannerConfig | None = None) -> PickPlacePlanner:
    return PickPlacePlanner(cell or DEFAULT_CELL, config or PlannerConfig())


def place_pose(o: SceneObject, x: float, y: float) -> Pose:
    """Return a place pose 1 mm above the tray."""
    return Pose((x, y, o.X_TO.translation[2] + 0.001), o.X_TO.quaternion)


PILE = [
    resting("sugar_box", Orientation.UPRIGHT_0),
    resting("tomato_soup_can", xy=(0.10, 0.0)),
    resting("cracker_box", Orientation.UPRIGHT_0, (-0.1, 0.15)),
    resting("gelatin_box", Orientation.UPRIGHT_0, (0.10, 0.0), 0.101),
]


@pytest.fixture(scope="module")
def plan() -> PickPlacePlan:
    found = planner().plan(PILE, "sugar_box", place_pose(PILE[0], 0.2, -0.2))
    assert isinstance(found, PickPlacePlan)
    return found


def test_segments_are_continuous_from_home_to_home(plan: PickPlacePlan) -> None:
    approach, carry, retreat = (phase.trajectory for phase in plan.segments)
    home = np.array(DEFAULT_CELL.robot.home)
    assert approach.value(0.0).ravel() == pytest.approx(home)
    assert carry.value(0.0).ravel() == pytest.approx(
        approach.value(approach.end_time()).ravel(), abs=1e-9
    )
    assert retreat.value(0.0).ravel() == pytest.approx(
        carry.value(carry.end_time()).ravel(), abs=1e-9
    )
    assert retreat.value(retreat.end_time()).ravel() == pytest.approx(home)
    for trajectory in (approach, carry, retreat):
        for time in (0.0, trajectory.end_time()):
            assert np.abs(trajectory.EvalDerivative(time, 1)).max() < 1e-3


def test_gripper_and_object_reach_their_target_poses(plan: PickPlacePlan) -> None:
    carry, tool = plan.segments[1].trajectory, ToolKinematics(DEFAULT_CELL, plan.tool)
    X_TG_pick, X_TG_place = (tool.pose(carry.value(t).ravel()) for t in (0.0, carry.end_time()))
    assert X_TG_pick[2, 3] == pytest.approx(0.175 + PlannerConfig().lip_gap, abs=1e-6), (
        "the top of the sugar box"
    )
    assert X_TG_pick[:3, 2] == pytest.approx([0.0, 0.0, -1.0], abs=1e-6)
    for X_TG, X_TO in ((X_TG_pick, plan.X_TO_pick), (X_TG_place, plan.X_TO_place)):
        expected = (rigid_transform(X_TO) @ plan.X_OG).GetAsMatrix4()
        assert pytest.approx(expected, abs=1e-6) == X_TG


def assert_collision_free(plan: PickPlacePlan, objects: list[SceneObject], *supports: str) -> None:
    """Assert that a plan has no collisions, at samples three times as dense as the planner's.

    The picked object may touch the floor and what it is placed on.
    """
    scene = planner().collision_model(objects)
    for phase in plan.segments:
        scene.set_object_poses(objects)
        if phase.name == "carry":
            scene.attach_object(plan.pick, plan.tool, plan.X_OG)
        else:
            scene.set_object_pose(
                plan.pick, plan.X_TO_pick if phase.name == "approach" else plan.X_TO_place
            )
        least = own = math.inf
        for time in np.linspace(0.0, phase.duration, 300):
            for here in scene.distances_below(phase.trajectory.value(time).ravel(), 0.03):
                if here.pair[0] == plan.pick and here.pair[1] in ("floor", *supports):
                    assert here.distance > -0.001
                elif here.pair == (f"{plan.tool}_cup", plan.pick):
                    assert here.distance > -0.0005, (
                        "the lip, which is on a spring, hardly goes into the face"
                    )
                elif here.pair[1] in scene.arm_names:
                    own = min(own, here.distance)
                else:
                    least = min(least, here.distance)
        assert min(least, own) > PlannerConfig().min_distance - 0.001
        assert least > min(phase.min_distance.distance, 0.03) - 0.001


def test_a_plan_keeps_the_distance_and_names_the_smallest(plan: PickPlacePlan) -> None:
    """Pairs that may touch, such as the cup and the object, do not count."""
    for segment in plan.segments:
        assert PlannerConfig().min_distance <= segment.min_distance.distance < 0.05


def test_grasps_are_sampled_every_12_mm() -> None:
    """The top is larger than the grid of nine points around its center."""
    grasps = planner().grasps(resting("cracker_box"))
    assert not isinstance(grasps, PlanningFailure)
    points = np.array([grasp.X_TG.translation()[:2] for grasp in grasps if grasp.tool == "large"])
    distances = np.linalg.norm(points[:, None] - points, axis=2) + np.eye(len(points))
    assert distances.min(axis=1) == pytest.approx(0.012)


def test_a_plan_is_free_of_collisions(plan: PickPlacePlan) -> None:
    assert_collision_free(plan, PILE)


def test_planning_is_deterministic(plan: PickPlacePlan) -> None:
    again = planner().plan(PILE, "sugar_box", place_pose(PILE[0], 0.2, -0.2))
    assert isinstance(again, PickPlacePlan)
    for phase, other in zip(plan.segments, again.segments, strict=True):
        assert phase.duration == other.duration
        assert (phase.trajectory.value(0.3) == other.trajectory.value(0.3)).all()
    assert plan.num_attempts == again.num_attempts
    assert plan.X_OG.IsExactlyEqualTo(again.X_OG)


def reason(found: PickPlacePlan | PlanningFailure) -> PlanningFailureReason:
    assert isinstance(found, PlanningFailure)
    return found.reason


def failed_part(found: PickPlacePlan | PlanningFailure) -> MovePart | None:
    assert isinstance(found, PlanningFailure)
    return found.failed_part


def test_a_marker_does_not_seal_on_a_large_cup() -> None:
    marker = SceneObject("marker", CLASSES["large_marker"], Pose((0.0, 0.0, 0.009), LYING))
    found = planner(cell_with(ONE_CUP)).plan([marker], "marker", Pose((0.1, 0.1, 0.01), LYING))
    assert reason(found) is PlanningFailureReason.NO_SEAL
    assert isinstance(found, PlanningFailure)
    assert found.value > 0.001
    assert str(found) == "no seal: marker"
    assert found.failed_part is MovePart.PICK


def test_an_object_with_others_on_top_is_not_picked() -> None:
    found = planner().plan(PILE, "tomato_soup_can", place_pose(PILE[1], 0.2, -0.2))
    assert reason(found) is PlanningFailureReason.CARRIES_OTHERS
    assert isinstance(found, PlanningFailure)
    assert found.detail == "gelatin_box"
    assert found.failed_part is MovePart.PICK
    assert objects_resting_on(PILE[3], PILE) == ()


def test_an_object_may_be_too_heavy() -> None:
    """The vacuum is too weak for 0.5 kg, or the payload of the arm is exceeded."""
    weak = cell_with("gripper.vacuum=0.1")
    assert (
        reason(planner(weak).plan(PILE, "sugar_box", place_pose(PILE[0], 0.2, -0.2)))
        is PlanningFailureReason.TOO_HEAVY
    )
    frail = cell_with("robot.payload=1")
    assert (
        reason(planner(frail).plan(PILE, "sugar_box", place_pose(PILE[0], 0.2, -0.2)))
        is PlanningFailureReason.TOO_HEAVY
    )


def test_poses_may_be_out_of_reach() -> None:
    far = cell_with("robot.base.x=-2.5")
    found = planner(far).plan(PILE, "sugar_box", place_pose(PILE[0], 0.2, -0.2))
    assert (reason(found), str(found)) == (
        PlanningFailureReason.UNREACHABLE,
        "unreachable: the grasp",
    )
    assert failed_part(found) is MovePart.PICK
    nearer = cell_with("robot.base.x=-1.15")
    found = planner(nearer).plan(PILE, "cracker_box", place_pose(PILE[2], 0.26, -0.3))
    assert (reason(found), str(found)) == (
        PlanningFailureReason.UNREACHABLE,
        "unreachable: the place",
    )
    assert failed_part(found) is MovePart.PLACE


def test_neighbors_may_block_every_grasp() -> None:
    """The body of the gripper does not fit between two high boxes."""
    low = resting("gelatin_box", Orientation.UPRIGHT_0, name="low")
    places = [(y, z) for y in (0.048, -0.048) for z in (0.0, 0.23)]
    walls = [
        resting("cracker_box", Orientation.UPRIGHT_0, (0.0, y), z, f"wall_{k}")
        for k, (y, z) in enumerate(places)
    ]
    found = planner().plan([low, *walls], "low", place_pose(low, 0.2, -0.2))
    assert reason(found) is PlanningFailureReason.IN_COLLISION
    assert isinstance(found, PlanningFailure)
    assert "at the grasp" in found.detail
    assert found.failed_part is MovePart.PICK
    assert found.value < PlannerConfig().min_distance
    assert not planner().are_endpoints_reachable([low, *walls], "low", place_pose(low, 0.2, -0.2))


def test_planning_may_time_out() -> None:
    found = planner(config=PlannerConfig(time_limit=0.0)).plan(
        PILE, "sugar_box", place_pose(PILE[0], 0.2, -0.2)
    )
    assert reason(found) is PlanningFailureReason.TIME_OUT
    assert failed_part(found) is MovePart.CARRY


def test_moves_with_reachable_endpoints_are_planned() -> None:
    """Objects of random scenes are placed at random on the tray and on a high box."""
    num_planned = 0
    generator = rng(0)
    here = planner(config=PlannerConfig(optimize=False))
    for seed in range(3):
        scene = random_scene(seed, 12, 12)
        tower = resting("cracker_box", Orientation.UPRIGHT_90, (-0.315, 0.0), name="tower")
        objects = [*scene.objects, tower]
        for k, o in enumerate(scene.objects):
            x, y = generator.uniform(-0.25, 0.25, 2)
            x, y, floor = (-0.315, 0.0, tower.top_height) if k % 4 == 0 else (x, y, 0.0)
            height = float(o.X_TO.p[2] - o.bounds_T[0][2])
            place = Pose((x, y, floor + height + 0.001), o.X_TO.quaternion)
            if here.are_endpoints_reachable(objects, o.name, place):
                num_planned += 1
                assert isinstance(here.plan(objects, o.name, place), PickPlacePlan), o.name
    assert num_planned >= 5


def test_a_place_pose_may_be_rotated_by_90_degrees() -> None:
    quarter = (math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5))
    place = replace(place_pose(PILE[0], 0.2, -0.2), quaternion=quarter)
    assert isinstance(planner().plan(PILE, "sugar_box", place), PickPlacePlan)


def test_distance_gradients_equal_finite_differences(plan: PickPlacePlan) -> None:
    """Configurations are perturbed: closest points between parallel faces are not unique."""
    model = planner().collision_model(PILE)
    step = 1e-4
    generator = rng(0)
    model.attach_object(plan.pick, plan.tool, plan.X_OG)
    errors: dict[bool, list[float]] = {True: [], False: []}  # of pairs with a cylinder, and without
    for time in np.linspace(0.0, plan.segments[1].duration, 15):
        q = plan.segments[1].trajectory.value(time).ravel() + generator.normal(0, 0.1, 6)
        gradients = model.distances_and_gradients(q, 0.2)
        assert [clearance for clearance, _ in gradients] == model.distances_below(q, 0.2)
        pairs = [clearance.pair for clearance, _ in gradients]
        once = {pair for pair in pairs if pairs.count(pair) == 1}  # some parts have several shapes
        found = {c.pair: (c.distance, gradient) for c, gradient in gradients if c.pair in once}
        for joint in range(6):
            ahead = {
                c.pair: c.distance for c in model.distances_below(q + step * np.eye(6)[joint], 0.21)
            }
            behind = {
                c.pair: c.distance for c in model.distances_below(q - step * np.eye(6)[joint], 0.21)
            }
            for pair, (_, gradient) in found.items():
                sides = (
                    (ahead[pair] - found[pair][0]) / step,
                    (found[pair][0] - behind[pair]) / step,
                )
                if abs(sides[0] - sides[1]) < 1e-2:  # not where the nearest corner changes
                    errors["tomato_soup_can" in pair].append(
                        abs(float(gradient[joint] - sum(sides) / 2))
                    )
    assert min(len(of_some) for of_some in errors.values()) > 50
    assert np.quantile(errors[True] + errors[False], 0.9) < 5e-4
    assert max(errors[False]) < 5e-3
    assert max(errors[True]) < 1e-2, "Drake finds the nearest points of curved faces by iteration"


def test_optimized_trajectories_are_faster(plan: PickPlacePlan) -> None:
    unoptimized = planner(config=PlannerConfig(optimize=False)).plan(
        PILE, "sugar_box", place_pose(PILE[0], 0.2, -0.2)
    )
    assert isinstance(unoptimized, PickPlacePlan)
    assert unoptimized.duration == unoptimized.unoptimized_duration == plan.unoptimized_duration
    assert plan.duration < 0.9 * plan.unoptimized_duration
    assert all(phase.duration <= phase.unoptimized_duration for phase in plan.segments)


def test_the_arm_retracts_from_a_high_place_pose_before_moving_home() -> None:
    """A straight joint-space path home would pass through the placed box."""
    box = resting("pudding_box", Orientation.FLAT_0, (-0.15, 0.0))
    tower = [
        resting("sugar_box", Orientation.UPRIGHT_0, (0.1, 0.0), 0.0, "lower"),
        resting("sugar_box", Orientation.UPRIGHT_0, (0.1, 0.0), 0.175, "middle"),
        resting("sugar_box", Orientation.UPRIGHT_0, (0.1, 0.0), 0.350, "upper"),
    ]
    for levels in (1, 2, 3):
        objects = [box, *tower[:levels]]
        high = box.X_TO.translated((0.25, 0.0, 0.175 * levels + 0.001))
        for optimize in (False, True):
            found = planner(config=PlannerConfig(optimize=optimize)).plan(objects, box.name, high)
            assert isinstance(found, PickPlacePlan)
            assert_collision_free(found, objects, objects[-1].name)


def test_results_files_with_earlier_names_load() -> None:
    """A results file of version 0.1 has earlier names of the planner's parameters."""
    path = Path(__file__).parents[1] / "benchmarks" / "results" / "arm_moves.json"
    earlier = json.loads(path.read_text())["planner"]
    assert "optimise" in earlier
    assert validate(PlannerConfig, earlier, str(path)) == PlannerConfig()
    written = to_plain(PlannerConfig(optimize=False))
    assert not {"clearance", "rise", "above", "optimise"} & written.keys()
    assert validate(PlannerConfig, written, "") == PlannerConfig(optimize=False)


@pytest.mark.parametrize(
    ("xy", "floor", "pair", "depth"),
    [
        ((0.075, 0.0), 0.0, "pudding_box and can", 0.013),
        ((0.2, 0.2), -0.037, "can and floor", 0.037),
        ((0.0865, 0.0), 0.0, "", 0.0),
    ],
    ids=["in a box", "in the floor", "as objects that lean"],
)
def test_objects_that_overlap_at_the_start_are_refused(
    xy: tuple[float, float], floor: float, pair: str, depth: float
) -> None:
    """The can has a radius of 33 mm, the box extends 55 mm along x from its center."""
    box = resting("pudding_box")
    bystander = resting("gelatin_box", xy=(-0.2, -0.2))
    can = resting("tomato_soup_can", Orientation.UPRIGHT_0, xy, floor, "can")
    objects = [box, can, bystander]
    here = planner()
    found = here.plan(objects, bystander.name, place_pose(bystander, -0.2, 0.2))
    moved = here.plan_move(here.home_state(objects), here.robot.home)
    is_reachable = here.are_endpoints_reachable(
        objects, bystander.name, place_pose(bystander, -0.2, 0.2)
    )
    if not pair:
        assert isinstance(found, PickPlacePlan)
        assert is_reachable
        return
    for failure in (found, moved):
        assert isinstance(failure, PlanningFailure)
        assert failure.reason is PlanningFailureReason.OBJECTS_OVERLAP
        assert failure.detail == pair
        assert failure.value == pytest.approx(depth, abs=1e-4)
    assert not is_reachable
    estimated = planner(config=PlannerConfig(max_overlap=depth + 0.001, optimize=False))
    found = estimated.plan(objects, bystander.name, place_pose(bystander, -0.2, 0.2))
    assert isinstance(found, PickPlacePlan)
