"""Candidates of a move, their loads, and the distances that are allowed at its endpoints."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from conftest import DEFAULT_CELL, ONE_CUP, cell_with, resting
from numpy.typing import NDArray
from pydrake.math import RigidTransform, RollPitchYaw

from drake_clutter.cell.gripper import Payload
from drake_clutter.cell.support_sdf import FLOOR
from drake_clutter.cell.work_cell import WorkCell
from drake_clutter.grammar import Orientation
from drake_clutter.planning.pick_place_plan import PlanningFailure, PlanningFailureReason
from drake_clutter.planning.pick_place_planner import PickPlacePlanner
from drake_clutter.planning.pick_place_search import MoveGoal, PickPlaceSearch
from drake_clutter.planning.planner_config import PlannerConfig
from drake_clutter.planning.tool_kinematics import _MAX_POSE_STEP, WayOut, raise_pose
from drake_clutter.scenes.interfaces import MovePart
from drake_clutter.scenes.scene import SceneObject
from drake_clutter.simulation.scene_plant import rigid_transform

LOWER = resting("cracker_box", name="lower")
UPPER = resting("sugar_box", floor=LOWER.top_height, name="upper")
"""A box on another box."""
BESIDE = resting(
    "gelatin_box",
    floor=LOWER.top_height,
    xy=(UPPER.bounds_T[1][0] + 0.003 + 0.0445, 0.0),
    name="beside",
)


def search_of(
    objects: Sequence[SceneObject], pick: str, cell: WorkCell = DEFAULT_CELL
) -> tuple[PickPlacePlanner, PickPlaceSearch]:
    """Return the search for a move by 0.1 m along x, 0.2 m along -y and to the floor."""
    planner = PickPlacePlanner(cell, PlannerConfig(optimize=False))
    (picked,) = (o for o in objects if o.name == pick)
    place = picked.X_TO.translated((0.1, -0.2, 0.001 - picked.bounds_T[0][2]))
    goal = MoveGoal(picked, place, planner.config.lift_height, True, planner.robot.home)
    model = planner.collision_model(objects)
    return planner, planner._finder.search(model, planner.home_state(objects), goal)


def test_what_is_allowed_at_the_pick_pose_of_a_stacked_box() -> None:
    """The box touches the one below it, and stands 3 mm beside another one."""
    gap = BESIDE.bounds_T[0][0] - UPPER.bounds_T[1][0]
    planner, search = search_of([LOWER, UPPER, BESIDE], "upper")
    assert search._bodies_below(UPPER) == {FLOOR, "lower"}
    grasps = planner.grasps(UPPER)
    assert not isinstance(grasps, PlanningFailure)
    candidate = next(search.ik_candidates(grasps[0]))
    endpoint = search._pick_endpoint(candidate)
    assert endpoint is not None
    allowed = {pair: d for pair, d in endpoint.allowed_distances.items() if pair[0] == "upper"}
    assert allowed["upper", "lower"] == pytest.approx(-0.0005, abs=1e-6)
    assert allowed["upper", "beside"] == pytest.approx(gap - 0.0005, abs=1e-6)


def tool_pose(down: Sequence[float]) -> NDArray[np.float64]:
    """Return X_TG of a tool whose z axis, in the y-z plane, points along `down`."""
    roll = float(np.arctan2(down[1], -down[2]))
    X_TG = RigidTransform(RollPitchYaw(np.pi + roll, 0.0, 0.0), [0.0, 0.0, 0.3])
    return np.asarray(X_TG.GetAsMatrix4())


def test_the_load_of_a_tilted_grasp_is_that_at_its_worst_tilt() -> None:
    """The center of mass lies 30 mm below the lip, so that a tilted cup holds less."""
    planner, search = search_of([UPPER], "upper")
    grasps = planner.grasps(UPPER)
    assert not isinstance(grasps, PlanningFailure)
    grasp = grasps[0]
    X_OG = rigid_transform(UPPER.X_TO).inverse() @ grasp.X_TG
    p_GCm = X_OG.inverse() @ UPPER.object_class.center_of_mass
    upright, tilted = (tool_pose((0.0, np.sin(a), -np.cos(a))) for a in (0.0, np.radians(30)))

    def held(angle: float) -> float:
        down_G = np.array([0.0, np.sin(angle), np.cos(angle)])
        mass = UPPER.object_class.mass
        return DEFAULT_CELL.gripper.max_acceleration(grasp.tool, mass, p_GCm, down_G)

    worst = min(held(np.radians(30)), held(np.radians(-30)))
    assert worst < held(0.0) - 0.1
    for ends in ((tilted, upright), (upright, tilted)):
        payload = search._payload(grasp, X_OG.inverse(), *ends)
        assert payload.max_acceleration == pytest.approx(worst, abs=1e-6)
    assert search._payload(grasp, X_OG.inverse(), upright, upright) == grasp.payload


def test_the_furthest_failure_is_named() -> None:
    """High walls block each grasp at the place; one wall blocks some grasps at the pick."""
    low = resting("gelatin_box", Orientation.UPRIGHT_0, (-0.1, 0.1), name="low")
    wall = resting("cracker_box", Orientation.UPRIGHT_0, name="wall")
    apart = (np.ptp(low.bounds_T, axis=0)[0] + np.ptp(wall.bounds_T, axis=0)[0]) / 2 + 0.003
    spots = {"pick": (-0.1 + apart, 0.1), "east": (0.1 + apart, -0.2), "west": (0.1 - apart, -0.2)}
    walls = [
        resting("cracker_box", Orientation.UPRIGHT_0, xy, z, f"{name}_{z}")
        for name, xy in spots.items()
        for z in ((0.0,) if name == "pick" else (0.0, wall.top_height))
    ]
    planner = PickPlacePlanner(cell_with(ONE_CUP), PlannerConfig(optimize=False))
    found = planner.plan([low, *walls], "low", low.X_TO.translated((0.2, -0.3, 0.001)))
    assert isinstance(found, PlanningFailure)
    assert found.reason is PlanningFailureReason.IN_COLLISION
    assert found.detail.startswith("at the place: ")
    assert found.failed_part is MovePart.PLACE


def test_a_vertical_line_has_no_more_poses_than_its_steps_need() -> None:
    """All steps but the last two, which round the corner, are of the largest size but one."""
    planner, _ = search_of([UPPER], "upper")
    tool = planner.tools["large"]
    q = np.array(DEFAULT_CELL.robot.home)
    path = tool.extend_upwards(q[None], 0.1)
    assert path is not None
    heights = tool.pose(path)[:, 2, 3] - tool.pose(q)[2, 3]
    steps = np.diff(heights)
    assert heights[-1] == pytest.approx(0.1)
    num_long = len(steps) - 2
    assert steps[:num_long].max() <= _MAX_POSE_STEP + 1e-9
    assert (num_long - 1) * _MAX_POSE_STEP < heights[num_long]


def test_a_vertical_carry_is_straight_in_joint_space_where_the_tool_stays_vertical() -> None:
    planner, search = search_of([UPPER], "upper")
    grasps = planner.grasps(UPPER)
    assert not isinstance(grasps, PlanningFailure)
    candidate = next(search.ik_candidates(grasps[0]))
    tool = planner.tools[candidate.tool]
    ends = candidate.X_TG_pick, candidate.X_TG_place
    ways_out = WayOut(), WayOut()
    path = tool.carry_path(*ends, 0.4, candidate.q_pick, candidate.q_place, ways_out)
    assert not isinstance(path, str)
    bends = np.diff(path.transfer, n=2, axis=0)
    assert np.abs(bends).max() < 1e-9
    axes = tool.axis(path.transfer)
    assert axes == pytest.approx(np.tile([0.0, 0.0, -1.0], (len(axes), 1)), abs=1e-6)
    assert search.plan_candidate(candidate) is not None
    assert search.num_attempts == 2, "one for the candidate, and one for the first height"


def test_optimization_keeps_2_mm_more_from_columns_than_required() -> None:
    """The box is carried high above the column below its pick pose, far from its axis."""
    planner, search = search_of([UPPER], "upper")
    grasps = planner.grasps(UPPER)
    assert not isinstance(grasps, PlanningFailure)
    candidate = next(search.ik_candidates(grasps[0]))
    columns = search._checker.carry_columns(candidate)
    tool = planner.tools[candidate.tool]
    X_TG = raise_pose(candidate.X_TG_pick, columns.clearance + 0.01)
    X_TG[0, 3] += 0.01
    path = tool.track(np.array([candidate.X_TG_pick, X_TG]), candidate.q_pick)
    assert path is not None
    distances = columns.distances(path[-1:])
    assert distances.slack.min() == pytest.approx(0.01 - 0.002, abs=1e-5)
    assert columns.slack(path[-1:]) == pytest.approx(0.01, abs=2e-4)


def test_a_segment_that_cannot_be_made_faster_is_kept() -> None:
    planner, search = search_of([UPPER], "upper")
    grasps = planner.grasps(UPPER)
    assert not isinstance(grasps, PlanningFailure)
    candidate = next(search.ik_candidates(grasps[0]))
    pick = search._pick_endpoint(candidate)
    place = search._place_endpoint(candidate, candidate.q_place)
    assert pick is not None
    assert place is not None
    endpoints = pick, place
    found = search.plan_candidate(candidate)
    assert found is not None
    segment = found.segments["retreat"]
    faster = search._segments._optimize_segment(segment, Payload(), candidate, endpoints)
    assert faster.duration < segment.duration
    shortest = replace(segment, unoptimized_duration=0.9 * faster.duration)
    kept = search._segments._optimize_segment(shortest, Payload(), candidate, endpoints)
    assert kept is shortest
