"""Command schedule of a plan: joint commands and grasp times."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydrake.trajectories import PathParameterizedTrajectory, PiecewisePolynomial, Trajectory

from drake_clutter.cell.gripper import Payload
from drake_clutter.cell.work_cell import WorkCell
from drake_clutter.planning.arm_dynamics import arm_dynamics
from drake_clutter.planning.pick_place_plan import PickPlacePlan
from drake_clutter.planning.time_parameterization import sample_motion

Floats = NDArray[np.float64]

DWELL_TIME = 0.15
"""Time at rest in which the gripper grasps or releases the object [s]."""
JAW_MOVING_TIME = 0.12
"""Time in which jaws open or close [s]; less than `DWELL_TIME`."""
JAW_SQUEEZE = 0.003
"""Distance by which jaws are commanded to close beyond the surface of the object [m], which takes
them to their largest force."""
SAMPLE_PERIOD = 0.01
"""Sample period of the command, which is linearly interpolated [s]."""


@dataclass(frozen=True)
class CommandSchedule:
    """Commands of a plan over the time since its start.

    Attributes:
        command: Desired positions [rad], desired velocities [rad/s] and feed-forward torques [N m]
            of n joints. Shape (3 n,).
        grasp_time: Time at which the gripper grasps the object [s].
        descent_start_time: Time at which the guarded descent starts [s]; `release_time` without
            guarded descent.
        release_time: Time at which the gripper releases the object [s].
        end_time: Time at which the arm is home again [s].
        stage_starts: Name and start time [s] of each stage.
        joints_open: Positions of the gripper's actuated joints without the object [m]. Shape (m,).
        joints_closed: Commanded positions while the object is held [m]. Shape (m,).
    """

    command: PiecewisePolynomial
    grasp_time: float
    descent_start_time: float
    release_time: float
    end_time: float
    stage_starts: tuple[tuple[str, float], ...]
    joints_open: Floats
    joints_closed: Floats

    def gripper_joints(self, time: float) -> Floats:
        """Return the commanded positions of the gripper's actuated joints at a time [s].

        They are 0, fully opened, at the start and at the end of the plan.

        Returns:
            Positions [m]. Shape (m,).
        """

        def ramp(start: float) -> float:
            return min(max((time - start) / JAW_MOVING_TIME, 0.0), 1.0)

        opened = ramp(0.0) - ramp(self.end_time - JAW_MOVING_TIME)
        closed = ramp(self.grasp_time) - ramp(self.release_time)
        return opened * self.joints_open + closed * (self.joints_closed - self.joints_open)

    def stage_at(self, time: float) -> str:
        """Return the name of the stage at a time [s].

        Returns:
            `approach`, `grasp`, `carry`, `release`, `retreat`, with a guarded descent also
            `steady`, `descend` and `rise`; `idle` after the end.
        """
        if time >= self.end_time:
            return "idle"
        return [name for name, start in self.stage_starts if start <= time + 1e-9][-1]


def build_command_schedule(
    plan: PickPlacePlan, cell: WorkCell, contact_time: float = math.inf
) -> CommandSchedule:
    """Return the command schedule of a plan, with dwells at grasp and release.

    Args:
        plan: Plan to execute.
        cell: Work cell with robot and gripper.
        contact_time: Time since the start of the guarded descent at which it ends [s]. The arm then
            releases the object and rises by the same distance.
    """
    approach, carry, retreat = plan.segments
    empty = Payload()
    loaded = plan.payload
    placement = list[tuple[str, Trajectory | None, Payload]]([("release", None, loaded)])
    if plan.guarded_descent is not None:
        descent = _truncate(plan.guarded_descent.trajectory, contact_time)
        placement = [
            ("steady", None, loaded),
            ("descend", descent, loaded),
            *placement,
            ("rise", _reverse(descent), empty),
        ]
    time = 0.0
    times = list[Floats]()
    commands = list[Floats]()
    stage_starts = list[tuple[str, float]]()
    for name, trajectory, payload in (
        ("approach", approach.trajectory, empty),
        ("grasp", None, empty),
        ("carry", carry.trajectory, loaded),
        *placement,
        ("retreat", retreat.trajectory, empty),
    ):
        stage_starts.append((name, time))
        duration = float(trajectory.end_time()) if trajectory else DWELL_TIME
        if trajectory:
            q, v, a = sample_motion(trajectory, max(2, round(duration / SAMPLE_PERIOD) + 1))
        else:
            num_joints = approach.trajectory.rows()
            q = np.repeat(commands[-1][-1:, :num_joints], 2, axis=0)
            v = a = np.zeros_like(q)
        torques = arm_dynamics(cell, payload).inverse_dynamics(q, v, a)
        times.append(time + np.linspace(0.0, duration, len(q)))
        commands.append(np.column_stack([q, v, torques]))
        time += duration
    start_of = dict(stage_starts)
    # Neighboring stages share a time, at which torques may jump: the later sample is delayed by
    # 1 us, because breaks must increase.
    breaks = np.concatenate(
        [stage + (1e-6 * (k > 0)) * (stage == stage[0]) for k, stage in enumerate(times)]
    )
    return CommandSchedule(
        command=PiecewisePolynomial.FirstOrderHold(breaks, np.vstack(commands).T),
        grasp_time=start_of["grasp"],
        descent_start_time=start_of.get("descend", start_of["release"]),
        release_time=start_of["release"],
        end_time=time,
        stage_starts=tuple(stage_starts),
        joints_open=np.array(plan.joints_open),
        joints_closed=np.array(plan.joints_held) + JAW_SQUEEZE,
    )


def _truncate(trajectory: Trajectory, time: float) -> Trajectory:
    """Return a trajectory up to a time [s]."""
    end = min(time, trajectory.end_time())
    scaling = PiecewisePolynomial.FirstOrderHold([0.0, end], [[0.0, end]])
    return PathParameterizedTrajectory(trajectory, scaling)


def _reverse(trajectory: Trajectory) -> Trajectory:
    """Return a trajectory traversed backwards."""
    end = trajectory.end_time()
    scaling = PiecewisePolynomial.FirstOrderHold([0.0, end], [[end, 0.0]])
    return PathParameterizedTrajectory(trajectory, scaling)
