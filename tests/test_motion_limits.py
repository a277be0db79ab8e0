"""Limits of 30 plans of the shipped robots, at 500 Hz with Drake's dynamics."""

import math

import numpy as np
import pytest
from conftest import DEFAULT_CELL, cell_with, resting, rng
from numpy.typing import NDArray
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.tree import MultibodyForces

from benchmarks.motion_limits import ROBOTS, cell_of, limit_ratios
from drake_clutter.cell.gripper import Payload
from drake_clutter.planning.arm_dynamics import dynamics_plant
from drake_clutter.planning.cubic_spline import MotionSamples
from drake_clutter.planning.motion_limits import LimitKind, MotionLimits, TiltedLoad
from drake_clutter.planning.pick_place_plan import PickPlacePlan, PlanningFailure
from drake_clutter.planning.pick_place_planner import PickPlacePlanner
from drake_clutter.planning.planner_config import PlannerConfig
from drake_clutter.robots.robot_model import load_robot
from drake_clutter.scenes.scene import Pose

Floats = NDArray[np.float64]

NUM_MOVES = 5
"""Moves of each robot."""


@pytest.mark.parametrize("robot", ROBOTS)
def test_no_limit_is_exceeded(robot: str) -> None:
    """One move of each robot is planned with optimization."""
    cell = cell_of(robot)
    can = resting("tomato_soup_can", xy=(0.1, -0.05))
    generator = rng(7)
    for number in range(NUM_MOVES):
        planner = PickPlacePlanner(cell, PlannerConfig(optimize=number == 0))
        angle = math.pi * number / NUM_MOVES
        x, y = 0.12 * math.cos(angle), 0.12 * math.sin(angle)
        z = can.X_TO.translation[2] + generator.uniform(0.0005, 0.005)
        plan = planner.plan([can], can.name, Pose((x, y, z), can.X_TO.quaternion))
        assert isinstance(plan, PickPlacePlan), plan
        for segment in plan.segments:
            ratios = limit_ratios(cell, plan, segment)
            assert ratios.pop("rest") < 1e-6
            assert max(ratios.values()) < 1.01, f"{segment.name}: {ratios}"
            assert max(ratios["velocity"], ratios["acceleration"], ratios["jerk"]) > 0.95


def test_a_torque_below_that_of_gravity_is_a_planning_failure() -> None:
    cell = cell_of("ur10")
    torques = (330.0, 40.0, 150.0, 56.0, 56.0, 56.0)
    limits = cell.robot.limits.model_copy(update={"torque": torques})
    weak = cell.model_copy(update={"robot": cell.robot.model_copy(update={"limits": limits})})
    box = resting("sugar_box", xy=(0.2, 0.1))
    failure = PickPlacePlanner(weak, PlannerConfig(optimize=False, max_attempts=10)).plan(
        [box], box.name, box.X_TO.translated(np.array([0.0, -0.2, 0.001]))
    )
    assert isinstance(failure, PlanningFailure)
    assert str(failure) == "trajectory infeasible: carry: torque of shoulder_lift_joint"
    assert failure.value == math.inf


def test_ratios_of_a_motion_to_its_limits() -> None:
    """Compare with the dynamics of Drake, and with numerical derivatives of the poses of the tool.

    The speed of the tool is limited by the smaller one of two limits.
    """
    cell = cell_with("robot.tool_speed=0.5")
    robot, payload = load_robot(cell.robot), Payload(2.0, (0.02, 0.01, 0.2), 7.0)
    limits = MotionLimits(cell, payload, max_tool_speed=0.8)
    generator = rng(3)
    home = np.array(cell.robot.home)
    q, v, a, jerk = (
        home + generator.uniform(-0.5, 0.5, (4, 6)),
        *(scale * generator.normal(size=(4, 6)) for scale in (0.1, 0.2, 5.0)),
    )
    ratios = limits.ratios(MotionSamples(q, v, a, jerk))
    plant = dynamics_plant(cell, payload)
    context = plant.CreateDefaultContext()
    gravity, torque = np.empty((2, 4, 6))
    for k in range(4):
        plant.SetPositions(context, q[k])
        gravity[k] = -plant.CalcGravityGeneralizedForces(context)
        plant.SetVelocities(context, v[k])
        torque[k] = plant.CalcInverseDynamics(context, a[k], MultibodyForces(plant))
        torque[k] += gravity[k]
    dynamic = torque - gravity
    lower, upper = robot.position_limits.T
    positions = np.abs((q - (lower + upper) / 2) / ((upper - lower) / 2))
    reserve = np.where(dynamic > 0, robot.torque_limits - gravity, robot.torque_limits + gravity)

    def points(time: float, tool: str | None) -> NDArray[np.float64]:
        """Return the positions of a tool, or of the load's center of mass."""
        p_FC = payload.p_FCm if tool is None else cell.gripper.tools[tool].X_FG.translation()
        at = q + time * v + time**2 / 2 * a
        return np.array([RigidTransform(robot.forward_kinematics(x)) @ p_FC for x in at])

    step = 1e-3
    load = np.array([points(time, None) for time in (-step, 0.0, step)])
    load_acceleration = (load[0] - 2 * load[1] + load[2]) / step**2
    speeds = [
        np.linalg.norm(points(step, tool) - points(-step, tool), axis=1) / (2 * step)
        for tool in cell.gripper.tools
    ]
    expected = {
        LimitKind.POSITION: positions,
        LimitKind.VELOCITY: np.abs(v) / robot.velocity_limits,
        LimitKind.ACCELERATION: np.abs(a) / robot.acceleration_limits,
        LimitKind.JERK: np.abs(jerk) / robot.jerk_limits,
        LimitKind.TORQUE: np.abs(dynamic) / reserve,
        LimitKind.LOAD: np.linalg.norm(load_acceleration, axis=1)[:, None] / 7.0,
        LimitKind.TOOL_SPEED: np.transpose(speeds) / 0.5,
    }
    for kind, values in expected.items():
        assert ratios.values[:, ratios.kinds == kind] == pytest.approx(values, rel=2e-4), kind
    slowed = {
        1: (LimitKind.VELOCITY, LimitKind.TOOL_SPEED),
        2: (LimitKind.ACCELERATION, LimitKind.TORQUE, LimitKind.LOAD),
        3: (LimitKind.JERK,),
    }
    scales = np.max(
        [
            np.hstack([expected[kind] for kind in kinds]).max(axis=1) ** (1 / order)
            for order, kinds in slowed.items()
        ],
        axis=0,
    )
    assert ratios.time_scales() == pytest.approx(scales, rel=2e-4)
    assert scales.max() < 1.0, "the motion may be faster"


def test_a_load_in_a_tilted_tool_is_checked_at_its_tilt() -> None:
    """A wrist that turns a load to the side leaves the cup less for its acceleration."""
    gripper, mass, lever, acceleration = DEFAULT_CELL.gripper, 0.5, 0.03, 2.0
    X_FG = gripper.tools["large"].X_FG
    x, y, z = (X_FG @ np.array([0.0, 0.0, lever])).tolist()
    load = TiltedLoad(DEFAULT_CELL, Payload(mass, (x, y, z)), "large")
    radius, force, friction = 0.0125, 0.8 * 101325.0 * math.pi * 0.0125**2, 0.5
    weight, push = mass * 9.81, mass * acceleration

    def turned(degrees: float) -> Floats:
        """Return R_BF of a tool that is turned from pointing down."""
        angle = math.radians(degrees)
        return np.array([RotationMatrix.MakeYRotation(math.pi - angle).matrix()])

    (ratio,) = load.ratios(turned(0.0), np.array([[0.0, 0.0, acceleration]]))
    at_rest = gripper.safety * weight / force
    assert ratio == pytest.approx(gripper.safety * push / force / (1 - at_rest))
    (ratio,) = load.ratios(turned(90.0), np.array([[0.0, 0.0, acceleration]]))
    opening = 2 * lever / radius / force
    at_rest = gripper.safety * weight * max(opening, 1 / (friction * force))
    assert at_rest < 1
    assert ratio == pytest.approx(gripper.safety * push * opening / (1 - at_rest))
    heavy = TiltedLoad(DEFAULT_CELL, Payload(1.0, (x, y, z)), "large")
    assert np.isfinite(heavy.ratios(turned(0.0), np.zeros((1, 3)))).all()
    assert np.isinf(heavy.ratios(turned(90.0), np.zeros((1, 3)))).all()
