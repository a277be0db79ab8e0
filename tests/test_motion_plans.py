"""Motions between any states of the cell: picks, places, moves and their sequences."""

import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from conftest import DEFAULT_CELL, cell_with, resting, rng, scene_of
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.trajectories import PiecewisePolynomial

from drake_clutter.cell.fixture import Fixture
from drake_clutter.cell.gripper import Grasp, Payload
from drake_clutter.cell.pose_spec import PoseSpec
from drake_clutter.cell.work_cell import load_cell
from drake_clutter.files import InputError
from drake_clutter.grammar import Orientation
from drake_clutter.planning.cubic_spline import CubicSpline
from drake_clutter.planning.motion_limits import CHECK_PERIOD, MotionLimits
from drake_clutter.planning.motion_plan import (
    DWELL_TIME,
    CellState,
    MotionPlan,
    Plan,
    PlanStep,
    concatenate_plans,
    plan_from_steps,
    stay_at,
)
from drake_clutter.planning.pick_place_plan import (
    PickPlacePlan,
    PlanningFailure,
    PlanningFailureReason,
)
from drake_clutter.planning.pick_place_planner import PickPlacePlanner
from drake_clutter.planning.planner_config import PlannerConfig
from drake_clutter.planning.transfer_planner import connect_trees, shorten_path
from drake_clutter.resources import resource_path
from drake_clutter.scenes.scene import Pose, SceneObject
from drake_clutter.simulation.scene_plant import rigid_transform
from drake_clutter.station.station_simulation import StationSimulation

BOX = resting("sugar_box", Orientation.UPRIGHT_0)
CAN = resting("tomato_soup_can", xy=(0.1, 0.0))
SCENE = scene_of(BOX, CAN)
PLACE = Pose((0.2, -0.2, BOX.X_TO.p[2] + 0.001), BOX.X_TO.quaternion)
PLANNER = PickPlacePlanner(DEFAULT_CELL, PlannerConfig(optimize=False))
HOME = tuple(DEFAULT_CELL.robot.home)
TOP = RigidTransform(RotationMatrix(np.diag([1.0, -1.0, -1.0])), [0.0, 0.0, 0.0])


def planned(found: Plan | PlanningFailure) -> MotionPlan:
    assert isinstance(found, MotionPlan), found
    return found


def failed(found: Plan | Grasp | PlanningFailure) -> PlanningFailure:
    assert isinstance(found, PlanningFailure)
    return found


def tool_pose(state: CellState, tool: str) -> RigidTransform:
    return RigidTransform(PLANNER.tools[tool].pose(np.array(state.q)))


@pytest.fixture(scope="module")
def pick() -> MotionPlan:
    return planned(PLANNER.plan_pick(PLANNER.home_state(SCENE.objects), BOX.name))


def test_a_sequence_is_carried_out(pick: MotionPlan) -> None:
    """A box is picked, moved, held, placed, and the arm moves to joints of one's own."""
    assert pick.end.held is not None
    assert [step.name for step in pick.steps] == ["approach", "grasp", "lift"]
    X_TG = tool_pose(pick.end, pick.end.held.tool)
    high = RigidTransform(X_TG.rotation(), X_TG.translation() + np.array([-0.1, 0.15, 0.1]))
    moved = planned(PLANNER.plan_move(pick.end, high))
    assert tool_pose(moved.end, pick.end.held.tool).IsNearlyEqualTo(high, 1e-6)
    (held_box,) = (o for o in moved.end.objects if o.name == BOX.name)
    lifted = PlannerConfig().lift_height + 0.1
    assert held_box.X_TO.p - BOX.X_TO.p == pytest.approx([-0.1, 0.15, lifted], abs=1e-6)
    hold = PLANNER.plan_hold(moved.end, 0.2)
    place = planned(PLANNER.plan_place(hold.end, PLACE))
    assert place.end.held is None
    aside = np.array(HOME) + np.array([0.3, 0.0, 0.0, 0.0, 0.0, 0.5])
    away = planned(PLANNER.plan_move(place.end, aside.tolist()))
    whole = concatenate_plans([pick, moved, hold, place, away])
    assert whole.duration == pytest.approx(
        sum(plan.duration for plan in (pick, moved, hold, place, away))
    )
    simulation = StationSimulation(DEFAULT_CELL, SCENE)
    result = simulation.execute(whole)
    assert not result.lost_object
    assert result.poses[BOX.name].p == pytest.approx(PLACE.p, abs=0.003)
    assert result.position_error < 0.003
    assert max(result.displacements.values()) < 0.001
    q = simulation.station.joint_positions(simulation.plant_context)
    assert q == pytest.approx(aside, abs=0.002)
    assert whole.end.q == pytest.approx(aside)


def test_an_object_stays_held_between_two_plans(pick: MotionPlan) -> None:
    simulation = StationSimulation(DEFAULT_CELL, SCENE)
    first = simulation.execute(pick)
    assert simulation.gripper.status.held == BOX.name
    lift = PlannerConfig().lift_height
    assert first.poses[BOX.name].p == pytest.approx(BOX.X_TO.p + np.array([0, 0, lift]), abs=0.004)
    simulation.execute(PLANNER.plan_hold(pick.end, 0.3))
    assert simulation.gripper.status.held == BOX.name
    with pytest.raises(InputError, match=r"^plan: starts at joints .*; expected those of the arm"):
        simulation.execute(pick)


def test_a_plan_may_start_and_end_anywhere_with_a_grasp_of_ones_own() -> None:
    start = np.array(HOME) + np.array([0.5, 0, 0, 0, 0, 0])
    end = np.array(HOME) - np.array([0.4, 0, 0, 0, 0, 0.2])
    X_OG = rigid_transform(BOX.X_TO).inverse() @ RigidTransform(
        TOP.rotation(), [0.012, 0.0, BOX.top_height]
    )
    grasp = PLANNER.make_grasp(BOX, "large", X_OG)
    assert isinstance(grasp, Grasp)
    plan = PLANNER.plan(
        SCENE.objects, BOX.name, PLACE, grasp=grasp, start=start.tolist(), end=end.tolist()
    )
    assert isinstance(plan, PickPlacePlan)
    assert plan.segments[0].trajectory.value(0.0).ravel() == pytest.approx(start)
    retreat = plan.segments[2].trajectory
    assert retreat.value(retreat.end_time()).ravel() == pytest.approx(end)
    assert (plan.start.q, plan.end.q) == (tuple(start.tolist()), tuple(end.tolist()))
    lip_gap = RigidTransform([0.0, 0.0, -PlannerConfig().lip_gap])
    assert plan.X_OG.IsNearlyEqualTo(X_OG @ lip_gap, 1e-9)


def test_grasps_of_ones_own_have_to_hold() -> None:
    R, top = TOP.rotation(), BOX.top_height
    X_OT = rigid_transform(BOX.X_TO).inverse()
    beyond = failed(PLANNER.make_grasp(BOX, "large", X_OT @ RigidTransform(R, [0.035, 0, top])))
    assert beyond.reason is PlanningFailureReason.NO_SEAL
    high = failed(PLANNER.make_grasp(BOX, "large", X_OT @ RigidTransform(R, [0, 0, top + 0.02])))
    assert high.reason is PlanningFailureReason.NO_SEAL
    assert high.value == pytest.approx(0.02 + PlannerConfig().lip_gap)
    weak = failed(PLANNER.make_grasp(BOX, "small", X_OT @ RigidTransform(R, [0, 0, top])))
    assert weak.reason is PlanningFailureReason.GRASP_TOO_WEAK
    assert weak.value == -1.0, "it does not hold the box at rest"
    frail = PickPlacePlanner(cell_with("robot.payload=1"), PlannerConfig())
    heavy = failed(frail.make_grasp(BOX, "large", X_OT @ RigidTransform(R, [0, 0, top])))
    assert (heavy.reason, heavy.value) == (
        PlanningFailureReason.TOO_HEAVY,
        BOX.object_class.mass,
    )
    with pytest.raises(InputError, match=r"^tool: 'hook'; expected one of large, small$"):
        PLANNER.make_grasp(BOX, "hook", X_OT)


def test_given_grasps_have_to_hold_the_object() -> None:
    found = PLANNER.grasps(BOX)
    assert not isinstance(found, PlanningFailure)
    high = replace(found[0], X_TG=found[0].X_TG @ RigidTransform([0.0, 0.0, -0.1]))
    move = SCENE.objects, BOX.name, PLACE
    failure = failed(PLANNER.plan(*move, grasp=high))
    assert failure.reason is PlanningFailureReason.NO_SEAL
    assert failure.value == pytest.approx(0.1 + PlannerConfig().lip_gap)
    plan = PLANNER.plan(*move, grasp=[high, found[0]])
    assert isinstance(plan, PickPlacePlan)
    assert plan.X_OG.translation()[2] < BOX.top_height
    behind = RigidTransform(RotationMatrix(), [0.0, 0.0, 1.0])
    reason = failed(PLANNER.make_grasp(BOX, "large", behind)).reason
    assert reason is PlanningFailureReason.NO_SEAL, "the cup points away from the box"
    for grasp, message in (([], "grasp: none"), (replace(high, tool="hook"), "tool: 'hook'")):
        with pytest.raises(InputError, match=message):
            PLANNER.plan(*move, grasp=grasp)
    with pytest.raises(InputError, match="normal: "):
        PLANNER.grasps(BOX, (0.0, 1.0))  # type: ignore[arg-type]


def test_objects_have_names_of_their_own() -> None:
    twins = [BOX, replace(BOX, X_TO=BOX.X_TO.translated((0.2, 0.0, 0.0)))]
    with pytest.raises(InputError, match=f"objects: '{BOX.name}' twice; expected names that"):
        PLANNER.plan(twins, BOX.name, PLACE)


def test_a_jaw_grasp_of_ones_own_has_to_fit() -> None:
    cell = load_cell(resource_path("models/cells/ur10_2f85_tray.yaml"))
    planner = PickPlacePlanner(cell, PlannerConfig(optimize=False))
    x, y, _ = BOX.bounds_T[1] - BOX.bounds_T[0]
    across = RotationMatrix.MakeZRotation(np.pi / 2) @ TOP.rotation() if x < y else TOP.rotation()
    X_OT = rigid_transform(BOX.X_TO).inverse()
    grasp = planner.make_grasp(BOX, "jaws", X_OT @ RigidTransform(across, [0.0, 0.0, 0.16]))
    assert isinstance(grasp, Grasp)
    stroke = 2 * grasp.joints_held[0]
    assert stroke == pytest.approx(0.085 - min(x, y))
    plan = planned(planner.plan_pick(planner.home_state([BOX]), BOX.name, grasp=grasp))
    assert plan.end.held is not None
    along = across @ RotationMatrix.MakeZRotation(np.pi / 2)
    wide = failed(planner.make_grasp(BOX, "jaws", X_OT @ RigidTransform(along, [0, 0, 0.16])))
    assert wide.reason is PlanningFailureReason.NO_OPPOSED_FACES
    assert wide.value == pytest.approx(max(x, y))


def test_configurations_beyond_the_limits_are_refused_with_the_excess() -> None:
    beyond = np.array(HOME)
    beyond[2] = 6.5
    state = PLANNER.home_state(SCENE.objects)
    outside = replace(state, q=tuple(beyond.tolist()))
    q = beyond.tolist()
    for name, found in (
        ("start", PLANNER.plan(SCENE.objects, BOX.name, PLACE, start=q)),
        ("end", PLANNER.plan(SCENE.objects, BOX.name, PLACE, end=q)),
        ("start", PLANNER.plan_pick(outside, BOX.name)),
        ("start", PLANNER.plan_move(outside, HOME)),
        ("goal", PLANNER.plan_move(state, q)),
    ):
        failure = failed(found)
        assert failure.reason is PlanningFailureReason.JOINT_LIMIT
        assert failure.detail == f"{name}: elbow_joint"
        assert failure.value == pytest.approx(6.5 - np.pi)
    low = np.array(HOME)
    low[1] = 0.4
    collides = failed(PLANNER.plan_move(state, low.tolist()))
    assert (collides.reason, collides.value < 0) == (PlanningFailureReason.IN_COLLISION, True)
    assert collides.detail.startswith("at the goal: ")
    far = RigidTransform(TOP.rotation(), [3.0, 0.0, 0.5])
    unreachable = failed(PLANNER.plan_move(state, far))
    assert (unreachable.reason, unreachable.detail) == (
        PlanningFailureReason.UNREACHABLE,
        "the goal",
    )


def test_misuse_is_one_line(pick: MotionPlan) -> None:
    state = PLANNER.home_state(SCENE.objects)
    with pytest.raises(InputError, match=r"^goal: \[0.0\]; expected 6 joint positions in rad$"):
        PLANNER.plan_move(state, [0.0])
    with pytest.raises(InputError, match=r"^pick: 'spoon' is not a known object"):
        PLANNER.plan_pick(state, "spoon")
    with pytest.raises(InputError, match=r"^state: no object is held"):
        PLANNER.plan_place(state, PLACE)
    with pytest.raises(InputError, match=r"^state: 'sugar_box' is held"):
        PLANNER.plan_pick(pick.end, CAN.name)
    with pytest.raises(InputError, match=r"^tool: 'hook'; expected one of large, small$"):
        PLANNER.plan_move(state, TOP, tool="hook")
    with pytest.raises(InputError, match=r"^plan 2: starts at joints \[.*; expected \["):
        concatenate_plans([pick, pick])
    with pytest.raises(InputError, match=r"^plan 2: starts with 'nothing' held; expected 'sugar"):
        concatenate_plans([pick, PLANNER.plan_hold(replace(pick.end, held=None), 0.1)])
    with pytest.raises(InputError, match=r"^place: \[nan, .*; expected a finite position"):
        PLANNER.plan(SCENE.objects, BOX.name, Pose((math.nan, 0.0, 0.1)))
    with pytest.raises(InputError, match=r"^place: .*; expected a finite position and a unit"):
        PLANNER.plan_place(pick.end, Pose((0.0, 0.0, 0.1), (0.0, 0.0, 0.0, 0.0)))
    with pytest.raises(InputError, match=r"^lift_height: -0\.1; expected a positive number$"):
        PLANNER.plan_pick(state, BOX.name, lift_height=-0.1)
    with pytest.raises(InputError, match=r"^duration: 0; expected a positive number$"):
        PLANNER.plan_hold(state, 0.0)
    with pytest.raises(InputError, match=r"^goal: .*; expected 6 joint positions in rad$"):
        PLANNER.plan_move(state, "home")
    with pytest.raises(InputError, match=r"^plans: none; expected at least one plan$"):
        concatenate_plans([])
    with pytest.raises(InputError, match=r"^steps: none; expected at least one step$"):
        plan_from_steps(state, [])
    hooked = plan_from_steps(state, [PlanStep("hook", stay_at(HOME), tool="hook")])
    with pytest.raises(InputError, match=r"^step 'hook': tool 'hook'; expected one of large, sm"):
        StationSimulation(DEFAULT_CELL, SCENE).execute(hooked)
    for start in (np.zeros(6), np.array([*HOME[:5], HOME[5] + 0.01])):
        with pytest.raises(InputError, match=r"^wait: starts at joints"):
            plan_from_steps(state, [PlanStep("wait", stay_at(start))])


def test_a_move_to_where_the_arm_is_stays_there() -> None:
    state = PLANNER.home_state(SCENE.objects)
    plan = planned(PLANNER.plan_move(state, HOME))
    assert plan.end == state
    assert plan.duration == pytest.approx(DWELL_TIME)


def test_a_move_leads_around_an_obstacle() -> None:
    """A wall stands between two poses, so that neither a straight line nor a retreat is free."""
    wall = Fixture(name="wall", pose=PoseSpec(translation=(-0.1, 0.0, 0.4)), box=(0.4, 0.03, 0.78))
    cell = DEFAULT_CELL.model_copy(update={"fixtures": (wall,)})
    planner = PickPlacePlanner(cell, PlannerConfig())
    can = replace(CAN, X_TO=CAN.X_TO.translated((0.0, 0.2, 0.0)))
    state = planner.home_state([can])
    left = RigidTransform(TOP.rotation(), [-0.1, 0.25, 0.2])
    right = RigidTransform(TOP.rotation(), [-0.1, -0.25, 0.2])
    # Where the arm would stop without the wall; with it, other branches are free of it.
    stop = planned(PLANNER.plan_move(state, left)).end
    first = planned(planner.plan_move(state, stop.q))
    second = planned(planner.plan_move(first.end, planned(PLANNER.plan_move(stop, right)).end.q))
    model = planner.collision_model([can])
    limits = MotionLimits(cell, Payload())
    for plan in (first, second):
        (step,) = plan.steps
        times = np.arange(0.0, step.duration, CHECK_PERIOD)
        q = step.trajectory.vector_values(times).T
        distances = model.distances_along(q, 0.05).distances
        assert distances.min(initial=1.0) > planner.config.min_distance - 0.001
        motion = CubicSpline.from_trajectory(step.trajectory).sample(times)
        assert limits.ratios(motion).values.max() < 1.01
        ends = q[[0, -1]]
        assert (q > ends.min(axis=0) - math.pi / 2 - 1e-6).all(), "samples lie near both ends"
        assert (q < ends.max(axis=0) + math.pi / 2 + 1e-6).all()
    tool = planner.tools["large"]
    q_left, q_right = np.array(first.end.q), np.array(second.end.q)
    for path in (*tool.paths_between(q_left, q_right), *tool.paths_between(q_right, q_left)):
        assert len(model.distances_along(path, 0.0).distances), "the wall is in the way"
    assert RigidTransform(tool.pose(q_right)).IsNearlyEqualTo(right, 1e-6)
    behind = SceneObject("box", BOX.object_class, Pose((-0.1, -0.2, BOX.X_TO.p[2])))
    pick = planned(planner.plan_pick(replace(first.end, objects=(behind,)), "box"))
    assert pick.start.q == first.end.q


def test_trees_connect_around_a_wall_and_shortcuts_remove_detours() -> None:
    """In the plane, a wall with a gap at the top separates start and goal."""

    def is_free(q: np.ndarray, q_end: np.ndarray) -> bool:
        points = np.linspace(q, q_end, 50)
        return not bool(((np.abs(points[:, 0]) < 0.2) & (points[:, 1] < 1.5)).any())

    generator = rng(3)
    start, goal = np.array([-1.0, 0.0]), np.array([1.0, 0.0])
    path = connect_trees(start, goal, is_free, lambda: generator.uniform(-2, 2, 2), 500)
    assert path is not None
    assert (path[0] == start).all()
    assert (path[-1] == goal).all()
    assert all(is_free(*ends) for ends in pairwise(path))

    def length(points: list[np.ndarray]) -> float:
        return float(np.linalg.norm(np.diff(points, axis=0), axis=1).sum())

    shorter = shorten_path(path, is_free, generator)
    assert all(is_free(*ends) for ends in pairwise(shorter))
    assert 2 * np.hypot(0.8, 1.5) + 0.4 <= length(shorter) <= length(path)
    closed = connect_trees(start, goal, lambda q, q_end: False, lambda: start, 50)
    assert closed is None


def test_a_trajectory_of_ones_own_grasps_an_object() -> None:
    """Steps of one's own switch the vacuum of a cup."""
    box = resting("gelatin_box")
    top = box.top_height + PlannerConfig().lip_gap
    state = PLANNER.home_state([box])
    over = planned(PLANNER.plan_move(state, RigidTransform(TOP.rotation(), [0.0, 0.0, 0.15])))
    heights = np.linspace(0.15, top, 8)
    poses = [RigidTransform(TOP.rotation(), [0.0, 0.0, z]).GetAsMatrix4() for z in heights]
    q = PLANNER.tools["large"].track(np.array(poses), np.array(over.end.q))
    assert q is not None
    times = np.linspace(0.0, 1.5, len(q))
    lowering = PiecewisePolynomial.CubicShapePreserving(times, q.T, True)
    raising = PiecewisePolynomial.CubicShapePreserving(times, q[::-1].T, True)
    own = plan_from_steps(
        over.end,
        [
            PlanStep("lower", lowering),
            PlanStep("grasp", stay_at(q[-1]), tool="large"),
            PlanStep("raise", raising, tool="large"),
        ],
    )
    assert own.end.q == pytest.approx(q[0])
    simulation = StationSimulation(DEFAULT_CELL, scene_of(box))
    result = simulation.execute(concatenate_plans([over, own]))
    assert simulation.gripper.status.held == box.name
    raised = result.poses[box.name].p[2] - box.X_TO.p[2]
    assert raised == pytest.approx(0.15 - top, abs=0.004)


def test_trees_grow_in_steps_up_to_a_number_of_attempts() -> None:
    """Neighbors are at most 0.4 rad apart, and each attempt checks one line."""
    start, goal = np.array([-1.0, 0.0]), np.array([1.0, 0.5])
    path = connect_trees(start, goal, lambda q, q_end: True, lambda: goal, 50)
    assert path is not None
    steps = np.abs(np.diff(path, axis=0)).max(axis=1)
    assert steps.max() == pytest.approx(0.4)
    assert len(steps) == 5
    checked = list[float]()

    def is_free(q: np.ndarray, q_end: np.ndarray) -> bool:
        checked.append(0.0)
        return False

    assert connect_trees(start, goal, is_free, lambda: np.array([0.0, 3.0]), 20) is None
    assert len(checked) == 20
