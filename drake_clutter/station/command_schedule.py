"""Command schedule of a plan: joint commands and grasp times."""

import math
from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from pydrake.trajectories import PiecewisePolynomial

from drake_clutter.cell.work_cell import WorkCell
from drake_clutter.planning.arm_dynamics import arm_dynamics
from drake_clutter.planning.motion_plan import CellState, Plan, PlanStep, reverse
from drake_clutter.planning.pick_place_plan import PickPlacePlan
from drake_clutter.planning.time_parameterization import sample_motion

Floats = NDArray[np.float64]

JAW_MOVING_TIME = 0.12
"""Time in which jaws open or close [s]; less than `DWELL_TIME`."""
SAMPLE_PERIOD = 0.01
"""Sample period of the command, which is linearly interpolated [s]."""


@dataclass(frozen=True)
class CommandSchedule:
    """Commands of a plan over the time since its start.

    Attributes:
        command: Desired positions [rad], desired velocities [rad/s] and feed-forward torques [N m]
            of n joints. Shape (3 n,).
        steps: Steps of the plan.
        starts: Start time of each step [s].
        end_time: Time at which the last step ends [s].
        gripper_targets: Start time [s] and commanded positions [m] of each motion of the gripper's
            actuated joints, the initial positions first.
    """

    command: PiecewisePolynomial
    steps: tuple[PlanStep, ...]
    starts: tuple[float, ...]
    end_time: float
    gripper_targets: tuple[tuple[float, Floats], ...]

    def held_time(self, time: float) -> float:
        """Return when the gripper holds an object: at the end of the last grasp's dwell [s].

        During the dwell vacuum builds up, or jaws close.

        Args:
            time: Time since the start of the plan [s].

        Returns:
            The time [s]; infinite before the first grasp.
        """
        tools = ("", *(step.tool for step in self.steps))
        ends = (*self.starts[1:], self.end_time)
        grasp_ends = [
            end
            for start, end, before, tool in zip(
                self.starts, ends, tools[:-1], tools[1:], strict=True
            )
            if tool and not before and start <= time
        ]
        return grasp_ends[-1] if grasp_ends else math.inf

    @property
    def release_time(self) -> float:
        """Time at which an object is first released [s]; infinite if none is."""
        return self.start_of("release")

    def start_of(self, name: str) -> float:
        """Return the start time of the first step with a name [s]; infinite without one."""
        starts = zip(self.starts, self.steps, strict=True)
        return next((start for start, step in starts if step.name == name), math.inf)

    def knots(self) -> Floats:
        """Return the times between which all commands are linear [s]. Shape (k,)."""
        starts = [start for start, _ in self.gripper_targets[1:]] if self.num_actuated else []
        ramps = [time + end for time in starts for end in (0.0, JAW_MOVING_TIME)]
        inside = [time for time in ramps if 0 < time < self.end_time]
        return np.unique([*self.command.get_segment_times(), *inside])

    def commands_at(self, time: float) -> Floats:
        """Return the commands of the arm's and the gripper's joints at a time [s].

        Returns:
            Commands, see `ExecutedCommands`. Shape (3 n + m,).
        """
        time = min(time, self.end_time)
        return np.concatenate([self.command.value(time).ravel(), self.gripper_joints(time)])

    @property
    def num_actuated(self) -> int:
        """Number of actuated joints of the gripper, m."""
        return len(self.gripper_targets[0][1])

    def gripper_joints(self, time: float) -> Floats:
        """Return the commanded positions of the gripper's actuated joints at a time [s].

        They are 0, fully opened, at the start and at the end of a plan if no object is held there.

        Returns:
            Positions [m]. Shape (m,).
        """
        (_, positions), *targets = self.gripper_targets
        previous = positions
        for start, target in targets:
            share = min(max((time - start) / JAW_MOVING_TIME, 0.0), 1.0)
            positions = positions + share * (target - previous)
            previous = target
        return positions

    def tool_at(self, time: float) -> str:
        """Return the name of the tool that is commanded to hold at a time [s]; "" for none."""
        return self.steps[bisect_right(self.starts, time) - 1].tool

    def stage_at(self, time: float) -> str:
        """Return the name of the step at a time [s], see `PlanStep`; `idle` after the end."""
        if time >= self.end_time:
            return "idle"
        return self.steps[bisect_right(self.starts, time + 1e-9) - 1].name


@dataclass(frozen=True)
class RecordedSchedule(CommandSchedule):
    """Recorded commands, which the executor repeats without waiting or looking for contact.

    Attributes:
        gripper_command: Commanded positions of the gripper's m actuated joints [m]; None without
            any. Shape (m,).
        affected: Names of the objects that each step may disturb, see `affected_bodies`.
        wait_times: Times since the start at which the executor waited [s].
    """

    gripper_command: PiecewisePolynomial | None
    affected: tuple[frozenset[str], ...]
    wait_times: tuple[float, ...]

    def gripper_joints(self, time: float) -> Floats:
        """Return the commanded positions of the gripper's actuated joints at a time [s].

        Returns:
            Positions [m]. Shape (m,).
        """
        if self.gripper_command is None:
            return np.zeros(0)
        return np.asarray(self.gripper_command.value(time)).ravel()


def build_command_schedule(
    plan: Plan, cell: WorkCell, contact_time: float = math.inf
) -> CommandSchedule:
    """Return the command schedule of a plan.

    Args:
        plan: Plan to execute.
        cell: Work cell with robot and gripper.
        contact_time: Time since the start of the guarded descent at which it ends [s]. The arm then
            releases the object and rises by the same distance.
    """
    steps = plan.steps_until(contact_time) if isinstance(plan, PickPlacePlan) else plan.steps
    return _schedule_steps(steps, cell, plan.start, plan.end)


def build_withdrawal_schedule(
    schedule: CommandSchedule, plan: Plan, cell: WorkCell, time: float
) -> CommandSchedule:
    """Return the schedule of a plan that ends with a grasp without an object.

    The arm goes back on the way on which it came, which has room for it.

    Args:
        schedule: Schedule of the plan.
        plan: Plan that is executed.
        cell: Work cell with robot and gripper.
        time: Time during the grasp since the start of the plan [s].
    """
    grasp = bisect_right(schedule.starts, time) - 1
    steps = schedule.steps[: grasp + 1]
    steps += tuple(
        PlanStep("withdraw", reverse(step.trajectory), joints=step.joints)
        for step in steps[:-1][-1:]
    )
    return _schedule_steps(steps, cell, plan.start, replace(plan.start, held=None))


def _schedule_steps(
    steps: Sequence[PlanStep], cell: WorkCell, first: CellState, last: CellState
) -> CommandSchedule:
    """Return the command schedule of steps.

    Args:
        steps: Steps in order.
        cell: Work cell with robot and gripper.
        first: State at the start.
        last: State at the end.
    """
    time = 0.0
    times = list[Floats]()
    commands = list[Floats]()
    starts = list[float]()
    for step in steps:
        starts.append(time)
        count = max(2, round(step.duration / SAMPLE_PERIOD) + 1)
        q, v, a = sample_motion(step.trajectory, count)
        torques = arm_dynamics(cell, step.payload).inverse_dynamics(q, v, a)
        times.append(time + np.linspace(0.0, step.duration, len(q)))
        commands.append(np.column_stack([q, v, torques]))
        time += step.duration
    # Neighboring stages share a time, at which torques may jump: the later sample is delayed by
    # 1 us, because breaks must increase.
    breaks = np.concatenate(
        [stage + (1e-6 * (k > 0)) * (stage == stage[0]) for k, stage in enumerate(times)]
    )
    num_joints = cell.gripper.num_actuated_joints
    targets = [(0.0, _joints_at_rest(first, num_joints))]
    targets += [(start, np.array(step.joints)) for start, step in zip(starts, steps, strict=True)]
    targets.append((time - JAW_MOVING_TIME, _joints_at_rest(last, num_joints)))
    return CommandSchedule(
        command=PiecewisePolynomial.FirstOrderHold(breaks, np.vstack(commands).T),
        steps=tuple(steps),
        starts=tuple(starts),
        end_time=time,
        gripper_targets=tuple(targets) if num_joints else ((0.0, np.zeros(0)),),
    )


def _joints_at_rest(state: CellState, num_joints: int) -> Floats:
    """Return the positions of the gripper's actuated joints between two plans [m]. Shape (m,)."""
    return np.zeros(num_joints) if state.held is None else np.array(state.held.joints_closed)
