"""Exact replay: the recorded commands of an action through the simulated station.

replayed = replay_action(scene, episode.cell, action, episode.rate)
errors = compare_samples(action.samples, replayed)
"""

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from pydrake.trajectories import PiecewisePolynomial

from drake_clutter.cell.work_cell import WorkCell
from drake_clutter.planning.motion_plan import CellState, MotionPlan, PlanStep
from drake_clutter.recording.recorded_episode import RecordedAction
from drake_clutter.scenes.action_samples import PHASES, ActionSamples
from drake_clutter.scenes.scene import Pose, Scene
from drake_clutter.station.command_schedule import RecordedSchedule
from drake_clutter.station.station_simulation import StationSimulation

Floats = NDArray[np.float64]

MAX_JOINT_ERROR = 5e-4
"""Largest difference of a joint of an exact replay [rad]."""
MAX_OBJECT_ERROR = 1e-3
"""Largest distance of an object's origin of an exact replay [m]."""
_DWELLS = ("grasp", "steady", "descend", "release", "rise")
"""Phases in which the object touches others, which must be able to move."""


@dataclass(frozen=True)
class ReplayErrors:
    """Largest differences between a recording and its replay.

    Attributes:
        joint: Difference of a joint at any sample [rad].
        object: Distance between the origins of an object at any sample [m].
        object_index: Index of that object.
        time: Time at which an object is first farther apart than `MAX_OBJECT_ERROR` [s]; NaN if
            none is.
    """

    joint: float
    object: float
    object_index: int
    time: float

    @property
    def is_exact(self) -> bool:
        """Whether both are within their limits."""
        return self.joint <= MAX_JOINT_ERROR and self.object <= MAX_OBJECT_ERROR


def scene_at(scene: Scene, samples: ActionSamples, index: int) -> Scene:
    """Return a scene with the object poses of a sample.

    Args:
        scene: Scene of the episode.
        samples: Samples.
        index: Number of the sample; -1 for the last.
    """
    rows = samples.X_TO[index].tolist()
    poses = {
        name: Pose(tuple(row[4:]), tuple(row[:4]))
        for name, row in zip(scene.names, rows, strict=True)
    }
    return scene.with_poses(poses)


def replay_action(
    scene: Scene, cell: WorkCell, action: RecordedAction, rate: float
) -> ActionSamples:
    """Return the samples of a replayed action, in a simulation as that of the recording.

    Args:
        scene: Scene of the episode, for names and classes.
        cell: Work cell.
        action: Action with samples of version 2.
        rate: Samples per second [Hz].
    """
    samples = action.samples
    assert samples is not None
    start = scene_at(scene, samples, 0)
    steps, starts = _recorded_steps(cell, action, samples, start)
    state = CellState(tuple(samples.q_commanded[0].tolist()), start.objects)
    plan = MotionPlan(state, replace(state, objects=scene_at(scene, samples, -1).objects), steps)
    commands = np.hstack([samples.q_commanded, samples.v_commanded, samples.torque_commanded])
    schedule = RecordedSchedule(
        command=PiecewisePolynomial.FirstOrderHold(samples.time, commands.T),
        steps=steps,
        starts=starts[:-1],
        end_time=starts[-1],
        gripper_targets=(),
        gripper_commands=samples.gripper_commanded,
        gripper_times=samples.time,
    )
    simulation = StationSimulation(
        cell, start, movable={*samples.movable}, time_step=samples.time_step, rate=rate
    )
    replayed = simulation.execute(plan, schedule).samples
    simulation.release()
    assert replayed is not None
    return replayed


def _recorded_steps(
    cell: WorkCell, action: RecordedAction, samples: ActionSamples, start: Scene
) -> tuple[tuple[PlanStep, ...], tuple[float, ...]]:
    """Return the steps of a recording, and their start times with the end of the last [s]."""
    tools = tuple(cell.gripper.tools)
    states = np.column_stack([samples.phase, samples.tool_commanded])
    (changes,) = np.nonzero((np.diff(states, axis=0) != 0).any(axis=1))
    first = [0, *(changes + 1).tolist()]
    (idle,) = np.nonzero(samples.phase == PHASES.index("idle"))
    end = int(idle[0]) if len(idle) else len(samples) - 1
    bounds = [*(k for k in first if k < end), end]
    picked = start.names.index(action.move.pick)
    steps = list[PlanStep]()
    for k, following in pairwise(bounds):
        name = PHASES[samples.phase[k]] if samples.phase[k] >= 0 else ""
        tool = tools[samples.tool_commanded[k]] if samples.tool_commanded[k] >= 0 else ""
        times = samples.time[[k, following]]
        commands = samples.q_commanded[[k, following]]
        trajectory = PiecewisePolynomial.FirstOrderHold(times - times[0], commands.T)
        touched = tuple(
            Pose(tuple(row[4:]), tuple(row[:4]))
            for row in samples.X_TO[[k, following], picked].tolist()
        )
        is_dwell = name in _DWELLS
        steps.append(
            PlanStep(
                name,
                trajectory,
                tool=tool,
                object_name=action.move.pick if is_dwell else "",
                touched=touched if is_dwell else (),
            )
        )
    return tuple(steps), tuple(samples.time[bounds].tolist())


def compare_samples(recorded: ActionSamples, replayed: ActionSamples) -> ReplayErrors:
    """Return the largest differences between a recording and its replay.

    Args:
        recorded: Samples of the recording.
        replayed: Samples of the replay, at the same rate.
    """
    count = min(len(recorded), len(replayed))
    joint = np.abs(recorded.q[:count] - replayed.q[:count]).max()
    p_error = recorded.X_TO[:count, :, 4:] - replayed.X_TO[:count, :, 4:]
    distances = np.linalg.norm(p_error, axis=-1)
    (apart,) = np.nonzero((distances > MAX_OBJECT_ERROR).any(axis=1))
    return ReplayErrors(
        float(joint),
        float(distances.max()),
        int(distances.max(axis=0).argmax()),
        float(recorded.time[apart[0]]) if len(apart) else float("nan"),
    )
