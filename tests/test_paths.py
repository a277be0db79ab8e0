"""Ways of the arm: whole turns, smooth corners, and trajectories within the limits, densely sampled."""

import math

import numpy as np
import pytest
from conftest import rng

from drake_clutter.arm.kinematics import forward_kinematics
from drake_clutter.arm.paths import (
    ACCELERATION_LIMIT,
    TORQUE_LIMIT,
    VELOCITY_LIMIT,
    Payload,
    dynamics_plant,
    nearest_turns,
    sampled,
    smooth,
    straight,
    timed,
    torques,
)
from drake_clutter.arm.station import ArmConfig

ARM = ArmConfig()
HOME = np.array(ARM.home)


def test_whole_turns() -> None:
    assert nearest_turns(np.array([3.0]), np.array([-3.0])) == pytest.approx([3.0 - 2 * math.pi])
    assert nearest_turns(np.array([3.0]), np.array([6.2])) == pytest.approx([3.0])
    assert nearest_turns(np.array([-3.0]), np.array([6.2])) == pytest.approx([2 * math.pi - 3.0])
    assert nearest_turns(np.array([1.0]), np.array([6.2])) == pytest.approx([1.0]), "a turn more is out of the joint's range"


def test_a_smooth_way_keeps_its_ends_and_cuts_corners() -> None:
    corner = HOME + np.array([0.5, 0.0, 0.0, 0.0, 0.0, 0.0])
    end = corner + np.array([0.0, 0.4, 0.0, 0.0, 0.0, 0.0])
    points = sampled(smooth(np.vstack([straight(HOME, corner), straight(corner, end)[1:]])))
    assert points[0] == pytest.approx(HOME)
    assert points[-1] == pytest.approx(end)
    aside = np.abs(points[:, 0] - corner[0]) + np.abs(points[:, 1] - corner[1])
    assert 0.005 < aside.min() < 0.08


@pytest.mark.parametrize("payload", [Payload(), Payload(0.5, (0.0, 0.0, 0.1), 1.5)])
def test_trajectories_keep_the_limits(payload: Payload) -> None:
    draw = rng(0)
    for _ in range(3):
        middle, end = (HOME + draw.uniform(-0.8, 0.8, 6) for _ in range(2))
        trajectory = timed(smooth(np.vstack([straight(HOME, middle), straight(middle, end)[1:]])), ARM, payload)
        assert trajectory is not None
        times = np.linspace(0.0, trajectory.end_time(), 1500)
        q = np.array([trajectory.value(t).ravel() for t in times])
        v, a = (np.array([trajectory.EvalDerivative(t, order).ravel() for t in times]) for order in (1, 2))
        assert np.abs(v / VELOCITY_LIMIT).max() < 1.01
        assert np.abs(a / ACCELERATION_LIMIT).max() < 1.10, "ours; imposed at 70 points"
        assert np.abs(torques(dynamics_plant(ARM, payload), q, v, a) / TORQUE_LIMIT).max() < 1.01
        assert np.abs(v[[0, -1]]).max() < 1e-3
        if math.isfinite(payload.acceleration):
            X_FL = np.eye(4)
            X_FL[:3, 3] = [0.0, 0.0, ARM.suction.length + payload.p_GCm[2]]
            p = (forward_kinematics(q) @ X_FL)[:, :3, 3]
            step = times[1] - times[0]
            of_load = np.diff(p, 2, axis=0) / step**2
            assert np.linalg.norm(of_load, axis=1).max() < 1.15 * payload.acceleration


def test_the_faster_joint_decides() -> None:
    """Over a long way the shoulder runs at its 120 deg/s: the way over the speed, and a little to start and stop."""
    way = straight(HOME, HOME + np.array([2.5, 0.0, 0.0, 0.0, 0.0, 0.0]))
    trajectory = timed(smooth(way), ARM, Payload())
    assert trajectory is not None
    cruise = 2.5 / (0.97 * VELOCITY_LIMIT[0])
    starts = VELOCITY_LIMIT[0] / ACCELERATION_LIMIT[0]
    assert cruise + 0.8 * starts < trajectory.end_time() < cruise + 1.3 * starts
