"""The joint commands of a plan over time."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydrake.trajectories import PathParameterizedTrajectory, PiecewisePolynomial, Trajectory

from drake_clutter.cell.gripper import Payload
from drake_clutter.cell.work_cell import WorkCell
from drake_clutter.planning.pick_place_plan import PickPlacePlan
from drake_clutter.planning.time_parameterization import (
    dynamics_plant,
    inverse_dynamics,
    sample_motion,
)

Floats = NDArray[np.float64]

DWELL_TIME = 0.15
"""Time in which the vacuum builds up, and in which it is gone again [s]."""
SAMPLE_PERIOD = 0.01
"""Between samples of reference and feed-forward torque, interpolated linearly [s]."""


@dataclass(frozen=True)
class CommandSchedule:
    """A plan's commands over the time since it began.

    Attributes:
        command: Desired positions [rad] and velocities [rad/s], feed-forward torques [N m], of n
            joints. Shape (3 n,).
        suction_on_time: When the vacuum is switched on [s].
        descent_start_time: When the descent begins [s]; `suction_off_time` without a descent.
        suction_off_time: When the vacuum is switched off [s].
        end_time: When the arm is home again [s].
        stage_starts: Name and start [s] of each phase and dwell.
    """

    command: PiecewisePolynomial
    suction_on_time: float
    descent_start_time: float
    suction_off_time: float
    end_time: float
    stage_starts: tuple[tuple[str, float], ...]

    def stage_at(self, time: float) -> str:
        """Return what is done at a time [s]; `idle` afterwards."""
        if time >= self.end_time:
            return "idle"
        return [name for name, start in self.stage_starts if start <= time + 1e-9][-1]


def build_command_schedule(
    plan: PickPlacePlan, cell: WorkCell, contact_time: float = math.inf
) -> CommandSchedule:
    """Return a plan's phases one after the other, with dwells at the ends of the carry.

    Args:
        plan: What to carry out.
        cell: Where.
        contact_time: When the descent ends [s]; then the arm rises as far as it went down.
    """
    approach, carry, retreat = plan.segments
    parts, t_parts = list[Floats](), list[Floats]()
    starts, time = list[tuple[str, float]](), 0.0
    empty, loaded = Payload(), Payload(plan.mass, plan.p_GCm)
    put_down = list[tuple[str, Trajectory | None, Payload]]([("release", None, loaded)])
    if plan.guarded_descent is not None:
        down = _truncate(plan.guarded_descent, contact_time)
        descend, rise = ("descend", down, loaded), ("rise", _reverse(down), empty)
        put_down = [("steady", None, loaded), descend, *put_down, rise]
    for name, trajectory, payload in (
        ("approach", approach.trajectory, empty),
        ("grasp", None, empty),
        ("carry", carry.trajectory, loaded),
        *put_down,
        ("retreat", retreat.trajectory, empty),
    ):
        starts.append((name, time))
        duration = float(trajectory.end_time()) if trajectory else DWELL_TIME
        if trajectory:
            q, v, a = sample_motion(trajectory, max(2, round(duration / SAMPLE_PERIOD) + 1))
        else:
            num_joints = approach.trajectory.rows()
            q = np.repeat(parts[-1][-1:, :num_joints], 2, axis=0)
            v = a = np.zeros_like(q)
        t_parts.append(time + np.linspace(0.0, duration, len(q)))
        parts.append(
            np.column_stack([q, v, inverse_dynamics(dynamics_plant(cell, payload), q, v, a)])
        )
        time += duration
    at = dict(starts)
    # Neighbouring parts share a time: the later sample is left a moment later.
    t = np.concatenate(
        [part + (1e-6 * (k > 0)) * (part == part[0]) for k, part in enumerate(t_parts)]
    )
    command = PiecewisePolynomial.FirstOrderHold(t, np.vstack(parts).T)
    descent_start = at.get("descend", at["release"])
    return CommandSchedule(command, at["grasp"], descent_start, at["release"], time, tuple(starts))


def _truncate(trajectory: Trajectory, time: float) -> Trajectory:
    """Return the part up to a time [s]; it may end in motion."""
    end = min(time, trajectory.end_time())
    times = PiecewisePolynomial.FirstOrderHold([0.0, end], [[0.0, end]])
    return PathParameterizedTrajectory(trajectory, times)


def _reverse(trajectory: Trajectory) -> Trajectory:
    """Return the same way back."""
    end = trajectory.end_time()
    times = PiecewisePolynomial.FirstOrderHold([0.0, end], [[end, 0.0]])
    return PathParameterizedTrajectory(trajectory, times)
