"""Subproblems of trajectory optimization: their solutions are at the limits, and on the axes."""

import math
from dataclasses import replace

import numpy as np
import pytest
from conftest import DEFAULT_CELL
from numpy.typing import NDArray

from drake_clutter.cell.gripper import Payload
from drake_clutter.planning.motion_limits import LimitViolation, MotionLimits
from drake_clutter.planning.pick_place_planner import PickPlacePlanner
from drake_clutter.planning.planner_config import PlannerConfig
from drake_clutter.planning.spline_program import (
    DERIVATIVE_WEIGHTS,
    NUM_FIXED_CONTROL_POINTS,
    VALUE_WEIGHTS,
    LinearizedDistances,
    derivative_matrix,
)
from drake_clutter.planning.time_parameterization import (
    bspline_path,
    linear_joint_path,
    parameterize_time_optimal,
)
from drake_clutter.planning.trajectory_optimization import (
    TrajectoryOptimizationProblem,
    _fit_control_points,
    _solve_subproblem,
)

Floats = NDArray[np.float64]
PLANNER = PickPlacePlanner(DEFAULT_CELL, PlannerConfig())
TOOL = PLANNER.tools["large"]
HOME = np.array(DEFAULT_CELL.robot.home)


def problem_of(joint: int, angle: float) -> TrajectoryOptimizationProblem:
    """Return the problem of a motion of one joint from home, far from all obstacles."""
    path = linear_joint_path(HOME, HOME + angle * np.eye(6)[joint])
    initial = parameterize_time_optimal(bspline_path(path), MotionLimits(DEFAULT_CELL, Payload()))
    assert not isinstance(initial, LimitViolation)
    nothing = LinearizedDistances(np.zeros(0, np.int64), np.zeros((0, 6)), np.zeros(0))
    return TrajectoryOptimizationProblem(
        initial_trajectory=initial.to_trajectory(),
        robot=PLANNER.robot,
        departure_distances=(),
        arrival_distances=(),
        departure_directions=(-TOOL.axis(path[0]), -TOOL.axis(path[-1])),
        level_axis=None,
        max_tool_speed=math.inf,
        max_tool_acceleration=math.inf,
        nearby_distances=lambda q, s: nothing,
        column_distances=None,
        tool_jacobians=TOOL.jacobians,
        tool_rotations=lambda q: TOOL.pose(q)[:, :3, :3],
    )


def solve(problem: TrajectoryOptimizationProblem, duration: float) -> tuple[Floats, float]:
    """Return control points and duration after four subproblems from a duration [s]."""
    points = _fit_control_points(problem.initial_trajectory)
    for _ in range(4):
        solution = _solve_subproblem(problem, points, duration, 0.1)
        assert solution is not None
        points, duration = solution
    return points, duration


def test_the_shortest_motion_of_a_joint_is_at_its_speed_limit() -> None:
    """The limit is so low that the motion takes hardly longer than at that speed all the way."""
    problem = problem_of(0, 1.0)
    slow = replace(problem, robot=replace(problem.robot, velocity_limits=np.full(6, 0.2)))
    points, duration = solve(slow, 5.5)
    speeds = np.abs(derivative_matrix(1, 6) @ points.ravel()) / duration
    assert speeds.max() == pytest.approx(0.2, rel=2e-3)
    assert 1.0 / 0.2 < duration < 1.25 * 1.0 / 0.2


def test_the_shortest_motion_of_a_slow_tool_is_at_its_speed_limit() -> None:
    """The tool moves on a circle around the base, along whose tangents its speed is limited."""
    problem = replace(problem_of(0, 0.3), max_tool_speed=0.05)
    start = _fit_control_points(problem.initial_trajectory)
    q = VALUE_WEIGHTS @ start
    J = TOOL.jacobians(q)[:, 3:]
    tangents = J[:, :, 0] / np.linalg.norm(J[:, :, 0], axis=1)[:, None]
    duration = 1.05 * 0.3 * float(np.linalg.norm(J[0, :, 0])) / 0.05
    solution = _solve_subproblem(problem, start, duration, 0.1)
    assert solution is not None
    points, shortest = solution
    speeds = np.einsum("mi,mij,mj->m", tangents, J, DERIVATIVE_WEIGHTS @ points) / shortest
    assert speeds.max() == pytest.approx(0.05, rel=0.01)
    assert np.median(speeds) == pytest.approx(0.05, rel=0.01)


@pytest.mark.parametrize("at_start", [True, False])
def test_the_tool_leaves_along_its_axis(at_start: bool) -> None:
    distances = (0.005, 0.015, 0.02)
    problem = problem_of(0, 0.3)
    at_end = replace(problem, arrival_distances=distances)
    problem = replace(problem, departure_distances=distances) if at_start else at_end
    points, _ = solve(problem, 1.0)
    on_axis = points if at_start else points[::-1]
    X_TG = TOOL.pose(on_axis[: NUM_FIXED_CONTROL_POINTS + len(distances)])
    away = -X_TG[0, :3, 2]
    offsets = X_TG[NUM_FIXED_CONTROL_POINTS:, :3, 3] - X_TG[0, :3, 3]
    along = offsets @ away
    assert (along > np.array(distances) - 0.0005).all()
    sideways = np.linalg.norm(offsets - np.outer(along, away), axis=1)
    assert sideways == pytest.approx(0.0, abs=0.001)
