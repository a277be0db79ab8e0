"""Margins of a planned move: how far the arm stays from what it must not reach.

Frames: T is the support, B is the robot's base, F is its flange, G is the tool that holds the
object.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drake_clutter.cell.gripper import Payload
from drake_clutter.cell.work_cell import WorkCell
from drake_clutter.planning.cubic_spline import CubicSpline, MotionSamples
from drake_clutter.planning.motion_limits import LimitKind, MotionLimits, sample_spline
from drake_clutter.planning.pick_place_plan import PickPlacePlan
from drake_clutter.planning.tool_kinematics import ToolKinematics
from drake_clutter.robots.robot_model import RobotModel

Floats = NDArray[np.float64]

SAMPLE_PERIOD = 0.02
"""Period at which the margins of a trajectory are evaluated [s]."""


@dataclass(frozen=True)
class MoveMargins:
    """Margins of a planned move, the smallest along all of its trajectories.

    Attributes:
        joint_margin: Smallest distance of a joint from its limits [rad or m].
        singular_value: Smallest singular value of the Jacobian, with lengths in units of the arm's
            reach; 0 at a singularity.
        manipulability: Smallest manipulability (Yoshikawa 1985) of the same Jacobian.
        torque_share: Largest torque of a joint, as a fraction of its limit.
        load_share: Largest acceleration of the object, as a fraction of what the tool holds.
        num_ik_solutions: Number of inverse kinematics solutions of the grasp.
        num_connected: Number of these that continue to the place pose on the same branch.
    """

    joint_margin: float
    singular_value: float
    manipulability: float
    torque_share: float
    load_share: float
    num_ik_solutions: int
    num_connected: int


def arm_reach(robot: RobotModel) -> float:
    """Return the length of the stretched arm from its first joint to the flange [m]."""
    return float(np.linalg.norm(robot.chain.fixed[1:, :3, 3], axis=1).sum())


def scaled_jacobians(robot: RobotModel, q: Floats) -> Floats:
    """Return spatial Jacobians of F with lengths in units of the arm's reach. Shape (m, 6, n).

    Args:
        robot: Robot.
        q: Joint positions. Shape (m, n).
    """
    J = np.array([robot.jacobian(row) for row in q])
    J[:, 3:] /= arm_reach(robot)
    return J


def compute_margins(plan: PickPlacePlan, cell: WorkCell, tool: ToolKinematics) -> MoveMargins:
    """Return the margins of a plan.

    Args:
        plan: The plan.
        cell: Work cell.
        tool: Kinematics of the plan's tool.
    """
    robot = tool.robot
    joint_margin = math.inf
    torque_share = load_share = 0.0
    configurations = []
    for segment in plan.segments:
        limits = MotionLimits(cell, plan.payload if segment.name == "carry" else Payload())
        motion = sample_spline(CubicSpline.from_trajectory(segment.trajectory), SAMPLE_PERIOD)
        lower, upper = robot.position_limits.T
        joint_margin = min(
            joint_margin, float(np.minimum(motion.q - lower, upper - motion.q).min())
        )
        torque_share = max(torque_share, _torque_share(limits, motion))
        if segment.name == "carry":
            ratios = limits.ratios(motion)
            load_share = float(ratios.values[:, ratios.kinds == LimitKind.LOAD].max())
        configurations.append(motion.q)
    J = scaled_jacobians(robot, np.vstack(configurations))
    singular_values = np.linalg.svd(J, compute_uv=False)
    num_solutions, num_connected = _count_solutions(plan, tool)
    return MoveMargins(
        joint_margin=joint_margin,
        singular_value=float(singular_values[:, -1].min()),
        manipulability=float(singular_values.prod(axis=1).min()),
        torque_share=torque_share,
        load_share=load_share,
        num_ik_solutions=num_solutions,
        num_connected=num_connected,
    )


def _torque_share(limits: MotionLimits, motion: MotionSamples) -> float:
    moved = limits.dynamics.motion(motion.q, motion.v, motion.a, limits.p_FC)
    torques = moved.gravity_torques + moved.dynamic_torques
    return float((np.abs(torques) / limits.robot.torque_limits).max())


def _count_solutions(plan: PickPlacePlan, tool: ToolKinematics) -> tuple[int, int]:
    """Return the numbers of solutions of the grasp, and of those that reach the place pose."""
    carry = plan.segments[1].trajectory
    ends = np.array([carry.value(0.0).ravel(), carry.value(carry.end_time()).ravel()])
    X_TG = tool.pose(ends)
    q_pick = tool.solve_ik(X_TG[0])
    q_place = tool.robot.ik.match(q_pick, tool.solve_ik(X_TG[1]))
    is_solution = np.isfinite(q_pick[:, 0])
    return int(is_solution.sum()), int((is_solution & np.isfinite(q_place[:, 0])).sum())
