"""Time parameterization: unwrapping, blended corners, and limits at dense samples."""

import math

import numpy as np
import pytest
from conftest import DEFAULT_CELL, rng
from pydrake.multibody.optimization import Toppra
from pydrake.trajectories import PathParameterizedTrajectory, PiecewisePolynomial, Trajectory

from drake_clutter.cell.gripper import Payload
from drake_clutter.planning.time_parameterization import (
    LIMIT_FRACTION,
    bspline_path,
    dynamics_plant,
    inverse_dynamics,
    linear_joint_path,
    parameterize_time_optimal,
    sample_path,
    scale_to_limits,
)
from drake_clutter.robots.robot_model import load_robot

ARM = DEFAULT_CELL
ROBOT = load_robot(ARM.robot)
HOME = ROBOT.home


def unwrapped(q: float, reference: float) -> float:
    found = ROBOT.unwrap(np.full(6, q), np.full(6, reference))
    assert (found == found[0]).all()
    return float(found[0])


def test_positions_are_unwrapped_to_the_nearest_equivalent() -> None:
    assert unwrapped(3.0, -3.0) == pytest.approx(3.0 - 2 * math.pi)
    assert unwrapped(3.0, 6.2) == pytest.approx(3.0)
    assert unwrapped(-3.0, 6.2) == pytest.approx(2 * math.pi - 3.0)
    assert unwrapped(1.0, 6.2) == pytest.approx(1.0), (
        "an equivalent outside of the joint's range is not taken"
    )


def test_a_bspline_path_keeps_its_ends_and_blends_corners() -> None:
    corner = HOME + np.array([0.5, 0.0, 0.0, 0.0, 0.0, 0.0])
    end = corner + np.array([0.0, 0.4, 0.0, 0.0, 0.0, 0.0])
    points = sample_path(
        bspline_path(
            np.vstack([linear_joint_path(HOME, corner), linear_joint_path(corner, end)[1:]])
        )
    )
    assert points[0] == pytest.approx(HOME)
    assert points[-1] == pytest.approx(end)
    aside = np.abs(points[:, 0] - corner[0]) + np.abs(points[:, 1] - corner[1])
    assert 0.005 < aside.min() < 0.08


def limit_ratios(trajectory: Trajectory, payload: Payload) -> dict[str, float]:
    """Return the largest ratio to each limit at 1,500 samples of a trajectory."""
    times = np.linspace(0.0, trajectory.end_time(), 1500)
    q = np.array([trajectory.value(t).ravel() for t in times])
    v, a = (
        np.array([trajectory.EvalDerivative(t, order).ravel() for t in times]) for order in (1, 2)
    )
    torque = inverse_dynamics(dynamics_plant(ARM, payload), q, v, a)
    pairs = {
        "speed": v / ROBOT.velocity_limits,
        "acceleration": a / ROBOT.acceleration_limits,
        "torque": torque / ROBOT.torque_limits,
    }
    X_FL = np.eye(4)
    X_FL[:3, 3] = payload.p_FCm
    of_load = (
        np.diff((ROBOT.forward_kinematics(q) @ X_FL)[:, :3, 3], 2, axis=0)
        / (times[1] - times[0]) ** 2
    )
    pairs["hold"] = np.linalg.norm(of_load, axis=1) / payload.max_acceleration
    return {name: float(np.abs(share).max()) for name, share in pairs.items()}


@pytest.mark.parametrize("payload", [Payload(), Payload(0.5, (0.0, 0.0, 0.3223), 1.5)])
def test_trajectories_satisfy_the_limits(payload: Payload) -> None:
    generator = rng(0)
    for _ in range(3):
        via, end = (HOME + generator.uniform(-0.8, 0.8, 6) for _ in range(2))
        trajectory = parameterize_time_optimal(
            bspline_path(
                np.vstack([linear_joint_path(HOME, via), linear_joint_path(via, end)[1:]])
            ),
            ARM,
            payload,
        )
        assert trajectory is not None
        ratios = limit_ratios(trajectory, payload)
        assert max(ratios.values()) < 1.01, ratios
        assert np.abs(trajectory.EvalDerivative(0.0, 1)).max() < 1e-3


@pytest.mark.parametrize("payload", [Payload(), Payload(0.5, (0.0, 0.0, 0.3223), 1.5)])
def test_a_trajectory_is_scaled_until_one_limit_is_active(payload: Payload) -> None:
    path = bspline_path(linear_joint_path(HOME, HOME + np.array([0.8, -0.4, 0.5, 0.3, 0.0, 0.2])))
    too_fast = PathParameterizedTrajectory(
        path, PiecewisePolynomial.CubicHermite([0.0, 0.3], [[0.0, 1.0]], [[0.0, 0.0]])
    )
    found = scale_to_limits(too_fast, ARM, payload)
    assert found is not None
    assert 0.95 < max(limit_ratios(found, payload).values()) < 1.01
    assert found.value(found.end_time()) == pytest.approx(too_fast.value(0.3))
    again = scale_to_limits(found, ARM, payload)
    assert again is not None
    assert again.end_time() == pytest.approx(found.end_time(), rel=0.01), (
        "as it is, if the limits hold"
    )


def test_durations_equal_those_of_drakes_toppra() -> None:
    generator = rng(1)
    for _ in range(3):
        via, end = (HOME + generator.uniform(-0.8, 0.8, 6) for _ in range(2))
        path = bspline_path(
            np.vstack([linear_joint_path(HOME, via), linear_joint_path(via, end)[1:]])
        )
        toppra = Toppra(path, dynamics_plant(ARM, Payload()), np.linspace(0.0, 1.0, 300))
        toppra.AddJointVelocityLimit(
            -LIMIT_FRACTION * ROBOT.velocity_limits, LIMIT_FRACTION * ROBOT.velocity_limits
        )
        toppra.AddJointAccelerationLimit(
            -LIMIT_FRACTION * ROBOT.acceleration_limits, LIMIT_FRACTION * ROBOT.acceleration_limits
        )
        found = parameterize_time_optimal(path, ARM, Payload())
        assert found is not None
        assert found.end_time() == pytest.approx(
            toppra.SolvePathParameterization().end_time(), rel=0.01
        )


def test_the_duration_of_a_long_path_follows_from_the_velocity_limit() -> None:
    """On a long path the shoulder moves at its velocity limit, 120 deg/s, most of the time."""
    waypoints = linear_joint_path(HOME, HOME + np.array([2.5, 0.0, 0.0, 0.0, 0.0, 0.0]))
    trajectory = parameterize_time_optimal(bspline_path(waypoints), ARM, Payload())
    assert trajectory is not None
    cruise = 2.5 / (0.97 * ROBOT.velocity_limits[0])
    starts = ROBOT.velocity_limits[0] / ROBOT.acceleration_limits[0]
    assert cruise + 0.8 * starts < trajectory.end_time() < cruise + 1.3 * starts
