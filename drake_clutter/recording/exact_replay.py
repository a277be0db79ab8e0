"""Exact replay: the recorded commands of an action through the simulated station.

with recorded_physics(episode) as scene:
    replayed = replay_action(scene, episode.cell, action.samples, episode.rate)
errors = compare_samples(action.samples, replayed)
"""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from pydrake.trajectories import PiecewisePolynomial

from drake_clutter.cell.work_cell import WorkCell
from drake_clutter.files import InputError
from drake_clutter.planning.motion_plan import CellState, MotionPlan, PlanStep, stay_at
from drake_clutter.recording.randomization import Variation, varied_physics
from drake_clutter.recording.recorded_episode import RecordedEpisode
from drake_clutter.robots.robot_model import load_robot
from drake_clutter.scenes.action_samples import PHASES, ActionSamples, ExecutedCommands
from drake_clutter.scenes.scene import Pose, Scene
from drake_clutter.station.command_schedule import RecordedSchedule
from drake_clutter.station.station_simulation import StationSimulation

Floats = NDArray[np.float64]

MAX_JOINT_ERROR = 5e-4
"""Largest difference of a joint of an exact replay [rad]."""
MAX_OBJECT_ERROR = 1e-3
"""Largest distance of an object's origin of an exact replay [m]."""


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


@contextmanager
def recorded_physics(episode: RecordedEpisode) -> Iterator[Scene]:
    """Yield the initial scene with the masses and friction of the recording.

    Its classes exist until the block ends, see `varied_physics`.

    Args:
        episode: Recorded episode.

    Raises:
        InputError: `RecordedEpisode.variation` has a value that is not allowed.
    """
    with varied_physics(episode.initial_scene, Variation.from_dict(episode.variation)) as scene:
        yield scene


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
    scene: Scene, cell: WorkCell, samples: ActionSamples, rate: float
) -> ActionSamples:
    """Return the samples of a replayed action, in a simulation as that of the recording.

    Args:
        scene: Scene of the episode, for names and classes; see `recorded_physics`.
        cell: Work cell.
        samples: Recorded samples.
        rate: Samples per second [Hz].

    Raises:
        InputError: The samples are without the commands between them, as those of version 1, or
            with so many waits that the arm does not move.
    """
    executed = samples.executed
    if executed is None:
        raise InputError("samples: have no executed commands; expected a recording of version 2")
    start = scene_at(scene, samples, 0)
    schedule = _recorded_schedule(cell, executed, scene.names)
    q = tuple(executed.command[0, : samples.q.shape[1]].tolist())
    end = CellState(q, scene_at(scene, samples, -1).objects)
    plan = MotionPlan(CellState(q, start.objects), end, schedule.steps)
    simulation = StationSimulation(
        cell, start, movable={*samples.movable}, time_step=samples.time_step, rate=rate
    )
    result = simulation.execute(plan, schedule)
    simulation.release()
    if not result.has_ended:
        raise InputError(f"samples: {result}; expected recorded commands that end")
    assert result.samples is not None
    return result.samples


def _recorded_schedule(
    cell: WorkCell, executed: ExecutedCommands, object_names: Sequence[str]
) -> RecordedSchedule:
    """Return recorded commands as a schedule of the executor."""
    tools = [*cell.gripper.tools, ""]
    names = [*PHASES, ""]
    num_joints = load_robot(cell.robot).num_joints
    starts = executed.step_start.tolist()
    q = executed.command[0, :num_joints]
    steps = tuple(
        PlanStep(names[phase], stay_at(q, end - start), tool=tools[tool])
        for phase, tool, (start, end) in zip(
            executed.step_phase.tolist(), executed.step_tool.tolist(), pairwise(starts), strict=True
        )
    )
    affected = tuple(
        frozenset(name for name, is_affected in zip(object_names, row, strict=True) if is_affected)
        for row in executed.step_affected.tolist()
    )
    command, gripper = np.split(executed.command.T, [3 * num_joints])
    hold = PiecewisePolynomial.FirstOrderHold
    return RecordedSchedule(
        command=hold(executed.time, command),
        steps=steps,
        starts=tuple(starts[:-1]),
        end_time=starts[-1],
        gripper_targets=((0.0, gripper[:, 0]),),
        gripper_command=hold(executed.time, gripper) if len(gripper) else None,
        affected=affected,
        wait_times=tuple(executed.wait_time.tolist()),
    )


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
