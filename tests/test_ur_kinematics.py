"""Closed-form UR10 kinematics: published poses, branches, unreachable poses, derivatives."""

import numpy as np
import pytest
from conftest import rng
from numpy.typing import NDArray

from drake_clutter.robots.ur_kinematics import (
    forward_kinematics,
    inverse_kinematics,
    jacobian,
    link_poses,
    manipulability,
)


def angle_differences(q: NDArray[np.float64], other: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return differences of angles in [-pi, pi] [rad]."""
    return np.asarray((q - other + np.pi) % (2 * np.pi) - np.pi)


def test_at_zero_the_arm_lies_along_minus_x() -> None:
    """Coordinates are sums of the published lengths."""
    X_B6 = forward_kinematics(np.zeros(6))
    assert X_B6[:3, 3] == pytest.approx([-0.612 - 0.5723, -0.163941 - 0.0922, 0.1273 - 0.1157])
    assert X_B6[:3, 2] == pytest.approx([0.0, -1.0, 0.0])


def test_the_wrist_of_a_vertical_arm_is_at_its_greatest_height() -> None:
    X = link_poses(np.array([0.0, -np.pi / 2, 0.0, 0.0, 0.0, 0.0]))
    assert X[2, :3, 3] == pytest.approx([0.0, 0.0, 0.1273 + 0.612 + 0.5723])


def test_all_branches_reach_the_pose() -> None:
    generator = rng(0)
    counts = []
    for _ in range(300):
        q = generator.uniform(-np.pi, np.pi, 6)
        X_B6 = forward_kinematics(q)
        found = inverse_kinematics(X_B6)
        counts.append(len(found))
        np.testing.assert_allclose(
            forward_kinematics(found), np.broadcast_to(X_B6, (len(found), 4, 4)), atol=1e-9
        )
        assert (np.abs(found) <= np.pi).all()
        assert np.abs(angle_differences(found, q)).max(axis=1).min() < 1e-6, (
            "the initial configuration is among them"
        )
    assert max(counts) == 8
    assert set(counts) <= {2, 4, 6, 8}


def test_the_branches_differ() -> None:
    found = inverse_kinematics(forward_kinematics(np.array([0.3, -1.2, 1.4, -1.1, -1.4, 0.6])))
    assert len(found) == 8
    for k, q in enumerate(found):
        assert (np.abs(angle_differences(np.delete(found, k, axis=0), q)).max(axis=1) > 0.1).all()


@pytest.mark.parametrize("p_B6", [[1.5, 0.0, 0.3], [0.0, 0.0, 2.0], [0.05, 0.0, 0.3]])
def test_poses_may_be_out_of_reach(p_B6: list[float]) -> None:
    """Poses of a downward tool that are too far, too high, and too close to the base."""
    X_B6 = np.diag([1.0, -1.0, -1.0, 1.0])
    X_B6[:3, 3] = p_B6
    assert inverse_kinematics(X_B6).shape == (0, 6)


def test_the_last_joint_is_given_at_a_wrist_singularity() -> None:
    q = np.array([0.4, -1.0, 1.2, -0.7, 0.0, 0.9])
    found = inverse_kinematics(forward_kinematics(q), singular_wrist_3=0.25)
    straight = found[np.abs(found[:, 4]) < 1e-6]
    assert len(straight) > 0
    assert straight[:, 5] == pytest.approx(0.25)
    assert manipulability(q) == pytest.approx(0.0, abs=1e-12)


def test_the_jacobian_is_the_derivative() -> None:
    generator = rng(1)
    step = 1e-6
    for _ in range(20):
        q = generator.uniform(-np.pi, np.pi, 6)
        found = jacobian(q)
        for joint in range(6):
            ahead, behind = (
                forward_kinematics(q + sign * step * np.eye(6)[joint]) for sign in (1, -1)
            )
            v = (ahead[:3, 3] - behind[:3, 3]) / (2 * step)
            W = (ahead[:3, :3] - behind[:3, :3]) / (2 * step) @ forward_kinematics(q)[:3, :3].T
            w = np.array([W[2, 1], W[0, 2], W[1, 0]])
            assert found[:, joint] == pytest.approx(np.concatenate([w, v]), abs=1e-8)


def test_manipulability_is_proportional_to_the_sine_of_the_elbow() -> None:
    """A stretched arm is singular."""
    bent, half = (
        manipulability(np.array([0.1, -1.0, q3, -0.5, -1.5, 0.0])) for q3 in (np.pi / 2, np.pi / 6)
    )
    stretched = manipulability(np.array([0.1, -1.0, 0.0, -0.5, -1.5, 0.0]))
    assert bent > half > stretched == pytest.approx(0.0, abs=1e-12)
