"""Robot models: kinematics and limits of the shipped robots, and of a URDF."""

import re
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from conftest import rng
from numpy.typing import NDArray
from pydrake.math import RigidTransform
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import JacobianWrtVariable

from drake_clutter.cell.pose_spec import PoseSpec
from drake_clutter.cell.robot_spec import JointLimits, RobotSpec
from drake_clutter.cell.work_cell import load_cell
from drake_clutter.resources import resource_path
from drake_clutter.robots import ur_kinematics as kinematics
from drake_clutter.robots.numerical_ik import NumericalInverseKinematics
from drake_clutter.robots.robot_model import RobotModel, load_robot
from drake_clutter.robots.robot_plant import add_robot, allowed_collision_pairs

Floats = NDArray[np.float64]

CELLS = sorted(path.name.split("_")[0] for path in resource_path("models/cells").glob("*.yaml"))
URS = [name for name in CELLS if name.startswith("ur")]


def robot(name: str) -> RobotModel:
    return load_robot(load_cell(resource_path(f"models/cells/{name}_epick_tray.yaml")).robot)


def random_configurations(arm: RobotModel, count: int, seed: int = 0) -> Floats:
    """Return random configurations within the limits and [-pi, pi]."""
    lower, upper = np.clip(arm.position_limits, -np.pi, np.pi).T
    return rng(seed).uniform(lower, upper, (count, arm.num_joints))


@pytest.mark.parametrize("name", CELLS)
def test_poses_and_jacobians_agree_with_drake(name: str) -> None:
    arm, plant = robot(name), MultibodyPlant(0.0)
    instance = add_robot(plant, arm, visuals=False)
    plant.Finalize()
    context, world = plant.CreateDefaultContext(), plant.world_frame()
    flange = plant.GetFrameByName(arm.spec.tool_frame, instance)
    base = plant.GetFrameByName(arm.spec.base_link, instance)
    assert plant.num_actuated_dofs(instance) == arm.num_joints
    for q in random_configurations(arm, 100):
        plant.SetPositions(context, q)
        X_BF = plant.CalcRelativeTransform(context, base, flange).GetAsMatrix4()
        np.testing.assert_allclose(arm.forward_kinematics(q), X_BF, atol=1e-9)
        np.testing.assert_allclose(arm.chain.forward_kinematics(q), X_BF, atol=1e-9)
        along = context, JacobianWrtVariable.kV, flange, np.zeros(3), world, world
        J = plant.CalcJacobianSpatialVelocity(*along)
        R_BT = arm.X_TB.rotation().matrix().T
        np.testing.assert_allclose(arm.jacobian(q), np.kron(np.eye(2), R_BT) @ J, atol=1e-9)
        manipulability = np.sqrt(max(np.linalg.det(J @ J.T), 0.0))
        assert arm.manipulability(q) == pytest.approx(manipulability, abs=1e-9)


@pytest.mark.parametrize("name", URS)
def test_the_closed_form_finds_every_configuration(name: str) -> None:
    arm = robot(name)
    q = random_configurations(arm, 200, seed=1)
    X_BF = arm.forward_kinematics(q)
    found = arm.ik.solve(X_BF)
    assert found.shape == (200, arm.ik.num_solutions, 6)
    apart = np.abs((found - q[:, None] + np.pi) % (2 * np.pi) - np.pi).max(axis=-1)
    assert (np.nanmin(apart, axis=1) < 1e-6).all()
    reached = np.isfinite(found[..., 0])
    expected = np.broadcast_to(X_BF[:, None], (*reached.shape, 4, 4))[reached]
    np.testing.assert_allclose(arm.forward_kinematics(found[reached]), expected, atol=1e-9)


@pytest.mark.parametrize("name", CELLS)
def test_the_numerical_solver_reaches_nearly_all_poses(name: str) -> None:
    arm = robot(name)
    ik = NumericalInverseKinematics(arm.chain, arm.joint_range, arm.home)
    X_BF = arm.forward_kinematics(random_configurations(arm, 200, seed=2))
    found = ik.solve(X_BF)
    np.testing.assert_array_equal(found, ik.solve(X_BF))
    reached = np.isfinite(found[..., 0])
    assert reached.any(axis=1).mean() >= 0.99
    assert reached.sum(axis=1).mean() > 5
    expected = np.broadcast_to(X_BF[:, None], (*reached.shape, 4, 4))[reached]
    np.testing.assert_allclose(arm.chain.forward_kinematics(found[reached]), expected, atol=1e-9)
    lower, upper = arm.position_limits.T
    assert ((found[reached] >= lower) & (found[reached] <= upper)).all()
    far = np.eye(4)
    far[0, 3] = 5.0
    assert np.isnan(ik.solve(far)).all()
    assert ik.follow(far, arm.home) is None


def test_the_ur10_equals_its_closed_form_exactly() -> None:
    arm, parameters = robot("ur10"), kinematics.UR10_PARAMETERS
    assert arm.ur_fit is not None
    assert (arm.ur_fit.parameters, arm.ur_fit.X_B0, arm.ur_fit.X_6F) == (parameters, None, None)
    q = random_configurations(arm, 500, seed=3)
    X_BF = kinematics.forward_kinematics(q)
    np.testing.assert_array_equal(arm.forward_kinematics(q), X_BF)
    np.testing.assert_array_equal(arm.ik.solve(X_BF), kinematics.ik_branches(X_BF))
    np.testing.assert_array_equal(arm.manipulability(q), kinematics.manipulability(q))
    reference = rng(4).uniform(-6.2, 6.2, q.shape)
    turned = q + 2 * np.pi * np.round((reference - q) / (2 * np.pi))
    turned = np.where(np.abs(turned) > 2 * np.pi, turned - 2 * np.pi * np.sign(turned), turned)
    turned[:, 2] = q[:, 2]  # the elbow turns by no more than a full turn
    np.testing.assert_array_equal(arm.unwrap(q, reference), turned)
    assert arm.velocity_limits.tolist() == np.radians([120, 120, 180, 180, 180, 180]).tolist()
    assert arm.torque_limits.tolist() == [330, 330, 150, 56, 56, 56]


def poses_above(arm: RobotModel, q: Floats, heights: Floats) -> Floats:
    """Return flange poses vertically above that of q. Shape (m, 4, 4)."""
    X_BF = np.broadcast_to(arm.forward_kinematics(q), (len(heights), 4, 4)).copy()
    X_BF[:, 2, 3] += heights
    return X_BF


@pytest.mark.parametrize("name", CELLS)
def test_a_path_is_tracked_on_its_branch(name: str) -> None:
    arm = robot(name)
    start = arm.home + 0.1
    X_BF = poses_above(arm, start, np.linspace(0.0, 0.1, 6))
    path = arm.ik.track(X_BF, start)
    assert path is not None
    np.testing.assert_array_equal(path[0], start)
    np.testing.assert_allclose(arm.forward_kinematics(path), X_BF, atol=1e-9)
    assert np.abs(np.diff(path, axis=0)).max() < 0.3
    end = arm.ik.follow(X_BF[-1], path[-2])
    assert end is not None
    if arm.ur_fit is not None:
        np.testing.assert_array_equal(end, path[-1])
    assert arm.ik.track(poses_above(arm, start, np.linspace(0.0, 3.0, 100)), start) is None


def test_a_tracked_path_equals_one_branch_of_all_solutions() -> None:
    """The path equals one branch of all solutions exactly."""
    arm = robot("ur10")
    for q in random_configurations(arm, 50, seed=5):
        X_BF = poses_above(arm, q, np.linspace(0.0, 0.06, 4))
        solutions = arm.ik.solve(X_BF)
        apart = np.abs((solutions[0] - q + np.pi) % (2 * np.pi) - np.pi).max(axis=1)
        expected = solutions[:, np.nanargmin(apart)].copy()
        path = arm.ik.track(X_BF, q)
        expected[0] = q
        for k in range(1, len(expected)):
            expected[k] = arm.unwrap(expected[k], expected[k - 1])
        if path is None:
            assert not np.isfinite(expected).all() or np.abs(np.diff(expected, axis=0)).max() > 0.5
        else:
            np.testing.assert_array_equal(path, expected)


def test_solutions_of_two_poses_are_matched() -> None:
    for name in ("ur5e", "iiwa14"):
        arm = robot(name)
        X_BF = poses_above(arm, arm.home, np.array([0.0, 0.02]))
        q_from, q_to = arm.ik.solve(X_BF)
        matched = arm.ik.match(q_from, q_to)
        near = arm.unwrap(matched, q_from)
        reached = np.isfinite(q_from[:, 0]) & np.isfinite(near[:, 0])
        assert reached.any()
        assert np.median(np.abs(near - q_from)[reached].max(axis=1)) < 0.3


def test_unwrapping_keeps_to_the_limits_and_to_joints_that_can_turn() -> None:
    arm = robot("iiwa14")
    q, reference = random_configurations(arm, 20), random_configurations(arm, 20, seed=6)
    np.testing.assert_array_equal(arm.unwrap(q, reference), q)
    limits = ((-4.0, 4.0), *((-2.0 * np.pi, 2.0 * np.pi),) * 5)
    spec = robot("ur5e").spec
    given = spec.limits.model_copy(update={"position": limits})
    arm = load_robot(spec.model_copy(update={"limits": given}))
    found = arm.unwrap(np.full(6, -3.0), np.full(6, 3.2))
    assert found == pytest.approx(np.full(6, 2 * np.pi - 3.0))
    found = arm.unwrap(np.full(6, -1.0), np.full(6, 6.0))
    assert found[0] == pytest.approx(-1.0), "5.28 is outside of the first joint's limits"
    assert found[1:] == pytest.approx(np.full(5, 2 * np.pi - 1.0))


def test_solutions_outside_narrow_limits_are_left_out() -> None:
    spec = robot("ur5e").spec
    limits = ((-1.0, 4.5), *((-2.0, 2.0),) * 5)
    given = spec.limits.model_copy(update={"position": limits})
    arm = load_robot(spec.model_copy(update={"limits": given, "home": (0.0,) * 6}))
    q = np.array([4.0, -1.0, 1.2, -0.7, 1.1, 0.3])
    found = arm.ik.solve(arm.forward_kinematics(q))
    reached = found[np.isfinite(found[:, 0])]
    lower, upper = np.array(limits).T
    assert ((reached >= lower) & (reached <= upper)).all()
    assert np.abs(reached - q).max(axis=1).min() < 1e-6


def test_the_tool_stays_vertical_along_the_rows() -> None:
    arm = robot("ur10e")
    rows = arm.vertical_tool_rows
    assert rows is not None
    q = np.array([0.4, -1.3, 1.6, -0.3 - np.pi / 2, -np.pi / 2, 0.7])
    q[3] = -np.pi / 2 - q[1] - q[2]
    assert abs(arm.forward_kinematics(q)[2, 2]) == pytest.approx(1.0)
    _, _, basis = np.linalg.svd(rows)
    for step in basis[len(rows) :]:
        assert abs(arm.forward_kinematics(q + 0.3 * step)[2, 2]) == pytest.approx(1.0)
    for step in basis[: len(rows)]:
        assert abs(arm.forward_kinematics(q + 0.3 * step)[2, 2]) < 0.99
    tilted = arm.spec.model_copy(update={"base": PoseSpec(rpy_deg=(30.0, 0.0, 0.0))})
    assert load_robot(tilted).vertical_tool_rows is None
    assert robot("iiwa14").vertical_tool_rows is None


def test_link_depths_count_the_joints_from_the_base() -> None:
    expected = ["base", "shoulder", "upper_arm", "forearm", "wrist_1", "wrist_2", "wrist_3"]
    assert dict(robot("ur10").link_depths) == {name: k for k, name in enumerate(expected)}
    assert list(robot("iiwa14").link_depths.values()) == list(range(8))


def test_allowed_collision_pairs_of_the_ur10() -> None:
    pairs = set(allowed_collision_pairs(robot("ur10")))
    links = list(robot("ur10").link_depths)
    assert pairs - set(pairwise(links)) == {("base", "upper_arm"), ("wrist_1", "wrist_3")}


def bullet_iiwa() -> RobotSpec:
    data = pytest.importorskip("pybullet_data")
    return RobotSpec(
        model=str(Path(data.getDataPath()) / "kuka_iiwa" / "model.urdf"),
        base_link="lbr_iiwa_link_0",
        tool_frame="lbr_iiwa_link_7",
        base=PoseSpec(),
        home=(0.0, 0.5, 0.0, -1.2, 0.0, 1.2, 0.0),
        limits=JointLimits(acceleration=(5.0,) * 7),
        payload=14.0,
    )


def test_a_robot_is_loaded_from_a_urdf() -> None:
    """The iiwa of pybullet has its own limits, and the kinematics of the shipped model."""
    arm, own = load_robot(bullet_iiwa()), robot("iiwa14")
    assert arm.torque_limits.tolist() == [300.0] * 7
    assert arm.velocity_limits.tolist() == [10.0] * 7
    assert np.degrees(arm.position_limits[:, 1]) == pytest.approx([170, 120] * 3 + [175])
    assert np.isinf(arm.jerk_limits).all()
    q = random_configurations(arm, 20)
    X_LF = RigidTransform([0.0, 0.0, 0.045]).GetAsMatrix4()
    theirs = arm.forward_kinematics(q) @ X_LF
    np.testing.assert_allclose(theirs, own.forward_kinematics(q), atol=1e-9)
    neighbors = list(pairwise(arm.link_depths))
    assert set(neighbors) <= set(allowed_collision_pairs(arm)), (
        "its STL meshes are converted for Drake"
    )


def ros_urdf(offset: float = 0.0) -> str:
    """Return a UR5e as in ROS: base_link is rotated, and the tool frame has another x axis."""
    pi = "3.141592653589793"
    joints = [
        ("shoulder_pan_joint", "0 0 0.1625", f"0 0 {pi}"),
        ("shoulder_lift_joint", "0 0 0", "1.5707963267948966 0 0"),
        ("elbow_joint", "-0.425 0 0", f"{offset} 0 0"),
        ("wrist_1_joint", "-0.3922 0 0.1333", "0 0 0"),
        ("wrist_2_joint", "0 -0.0997 0", "1.5707963267948966 0 0"),
        ("wrist_3_joint", "0 0.0996 0", f"1.5707963267948966 {pi} {pi}"),
    ]
    names = ["base_link", *(f"link_{k}" for k in range(6))]
    inertia = '<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/>'
    body = f'<inertial><mass value="1"/>{inertia}</inertial>'
    text = "".join(f'<link name="{name}">{body}</link>' for name in [*names, "tool0"])
    for k, (joint, xyz, rpy) in enumerate(joints):
        limit = '<limit lower="-6.2" upper="6.2" velocity="3" effort="150" drake:acceleration="2"/>'
        text += f"""<joint name="{joint}" type="revolute"><parent link="{names[k]}"/>
            <child link="{names[k + 1]}"/><origin xyz="{xyz}" rpy="{rpy}"/><axis xyz="0 0 1"/>
            {limit}</joint>"""
    text += """<joint name="tool" type="fixed"><parent link="link_5"/><child link="tool0"/>
        <origin xyz="0 0 0" rpy="0 0 0.5"/></joint>"""
    return f'<robot name="ur5e">{text}</robot>'


def ros_spec(folder: Path, text: str) -> RobotSpec:
    path = folder / "ur5e.urdf"
    path.write_text(text)
    return RobotSpec(
        model=str(path),
        base_link="base_link",
        tool_frame="tool0",
        base=PoseSpec(),
        home=(0.0,) * 6,
        limits=JointLimits(acceleration=(5.0,) * 6),
        ik="ur",
        payload=5.0,
    )


def test_the_closed_form_adapts_to_other_base_and_tool_frames(tmp_path: Path) -> None:
    arm = load_robot(ros_spec(tmp_path, ros_urdf()))
    assert arm.ur_fit is not None
    own = robot("ur5e").ur_fit
    assert own is not None
    assert arm.ur_fit.parameters.a == pytest.approx(own.parameters.a)
    assert arm.ur_fit.parameters.d == pytest.approx(own.parameters.d)
    q = random_configurations(arm, 100)
    X_BF = arm.forward_kinematics(q)
    np.testing.assert_allclose(X_BF, arm.chain.forward_kinematics(q), atol=1e-9)
    found = arm.ik.solve(X_BF)
    apart = np.abs((found - q[:, None] + np.pi) % (2 * np.pi) - np.pi).max(axis=-1)
    assert (np.nanmin(apart, axis=1) < 1e-6).all()


def test_actuators_are_in_the_order_of_the_joints(tmp_path: Path) -> None:
    own = robot("iiwa14").spec
    text = resource_path("models/robots/iiwa14.sdf").read_text()
    joints = re.findall(r"    <joint .*?</joint>\n", text, re.DOTALL)
    for joint in joints:
        text = text.replace(joint, "")
    path = tmp_path / "backwards.sdf"
    path.write_text(text.replace("  </model>", "".join(joints[::-1]) + "  </model>"))
    torque = own.limits.model_copy(update={"torque": tuple(float(k) for k in range(100, 107))})
    for limits in (own.limits, torque):
        arm = load_robot(own.model_copy(update={"model": str(path), "limits": limits}))
        plant = MultibodyPlant(0.001)
        instance = add_robot(plant, arm, visuals=False)
        plant.Finalize()
        motors = [
            plant.get_joint_actuator(index) for index in plant.GetJointActuatorIndices(instance)
        ]
        assert (
            tuple(motor.joint().name() for motor in motors)
            == arm.joint_names
            == robot("iiwa14").joint_names
        )
        assert [motor.effort_limit() for motor in motors] == arm.torque_limits.tolist()
