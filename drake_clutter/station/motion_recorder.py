"""Recorder of the motions of a station: `ActionSamples` at any rate.

The plant is observed at its own time steps. A sample between two of them is interpolated: linearly,
and of rotations along the shorter arc. What has no values in between, such as the held object, is
that of the step before.
"""

import math
from collections.abc import Callable, Sequence, Set
from functools import partial
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydrake.systems.framework import Context, EventStatus
from scipy.spatial.transform import Rotation

from drake_clutter.planning.motion_plan import Plan
from drake_clutter.scenes.action_samples import (
    PHASES,
    POSE_COLUMNS,
    ActionSamples,
    ExecutedCommands,
)
from drake_clutter.scenes.scene import Scene
from drake_clutter.station.clutter_station import ClutterStation
from drake_clutter.station.gripper_actuator import GripperActuator
from drake_clutter.station.pick_place_executor import (
    EXECUTOR_UPDATE_PERIOD,
    ExecutorState,
    PickPlaceExecutor,
)

Floats = NDArray[np.float64]

DEFAULT_RATE = 125.0
"""Samples per second of recorded motions [Hz]: the rate of the controllers of UR arms before the
e-Series."""
_STEP_TOLERANCE = 1e-6
"""Largest difference of a time from a step of the plant, as a fraction of the step."""


class _Row(NamedTuple):
    """Observation of the plant at one of its steps.

    Attributes:
        step: Number of the step.
        positions: Positions of the plant.
        velocities: Velocities of the plant.
        torque: Torques of the actuators of the arm.
        command: Commanded positions, velocities and torques of the arm.
        gripper: Positions and velocities of the gripper.
        gripper_commanded: Commanded positions and velocities of the gripper.
        vacuum: Vacuum of the cups.
        X_TG: Matrix of the pose of the tool.
        states: Tool that is commanded, held object, phase, and both contacts.
    """

    step: int
    positions: Floats
    velocities: Floats
    torque: Floats
    command: Floats
    gripper: Floats
    gripper_commanded: Floats
    vacuum: Floats
    X_TG: Floats
    states: tuple[int, ...]


_NO_STATES = (-1, -1, -1, False, False)
"""`_Row.states` of which no sample takes any."""


class MotionRecorder:
    """Records the motion of a station from the start of a plan; a monitor of its simulator.

    Attributes:
        start_time: Time at which the plan started [s]; None before. It is a multiple of the time
            step.
    """

    def __init__(
        self,
        station: ClutterStation,
        executor: PickPlaceExecutor,
        gripper: GripperActuator,
        root: Context,
        scene: Scene,
        rate: float,
    ) -> None:
        """Create a recorder.

        Args:
            station: The station.
            executor: Its executor.
            gripper: Actuator of its gripper.
            root: Context of the root diagram, that of the simulator.
            scene: Objects, and the poses of the fixed ones.
            rate: Samples per second [Hz].
        """
        self._station = station
        self._executor = executor
        self._gripper = gripper
        self._scene = scene
        self._rate = rate
        self._tool_names = tuple(station.cell.gripper.tools)
        self._tool_indices = {name: k for k, name in enumerate(self._tool_names)} | {"": -1}
        self._object_indices = {name: k for k, name in enumerate(scene.names)} | {"": -1}
        # They are looked up once: the recorder is called at every step of the plant.
        self._plant_context = station.plant_context(root)
        self._executor_context = executor.GetMyContextFromRoot(root)
        self._command = executor.GetOutputPort("command")
        self._gripper_command: Callable[[], Floats] = lambda: np.zeros(0)
        if station.cell.gripper.num_actuated_joints:
            port = executor.GetOutputPort("gripper_command")
            self._gripper_command = partial(port.Eval, self._executor_context)
        self._torque = station.plant.get_net_actuation_output_port(station.arm.robot)
        self._gripper_state = station.plant.get_state_output_port(station.arm.gripper)
        self._vacuum: Callable[[], Floats] = lambda: np.zeros(0)
        if station.vacuum_system is not None:
            port = station.vacuum_system.GetOutputPort("vacuum")
            self._vacuum = partial(port.Eval, station.vacuum_system.GetMyContextFromRoot(root))
        self._number = 0
        self.clear()

    def clear(self) -> None:
        """Forget what was recorded; the next plan that starts is recorded."""
        self.start_time: float | None = None
        self._previous_number = self._number
        self._tool = self._tool_names[0]
        self._last_step = -1
        self._rows = list[_Row]()
        self._states = list[tuple[float, ExecutorState]]()

    def skip(self, number: int) -> None:
        """Forget what was recorded, and do not record the plan of a number."""
        self._number = number
        self.clear()

    def observe(self, root: Context) -> EventStatus:
        """Record the plant if its state is that of the current time and a sample needs it.

        Args:
            root: Context of the root diagram.
        """
        time = root.get_time()
        steps = time / self._station.time_step
        step = round(steps)
        # Rounding may separate simultaneous updates: the state is that of this time at the first.
        if step != self._last_step and abs(steps - step) < _STEP_TOLERANCE:
            self._last_step = step
            state = self._executor.state(self._executor_context)
            if self.start_time is None:
                self._detect_start(state)
            if self.start_time is not None and state is not self._states[-1][1]:
                self._states.append((_update_before(time) - self.start_time, state))
            since_sample, until_sample = self._distance_to_samples(step)
            has_states = until_sample < 1 - _STEP_TOLERANCE
            if has_states or since_sample < 1 - _STEP_TOLERANCE:
                self._rows.append(self._row(state, time, step, has_states=has_states))
        return EventStatus.DidNothing()

    def _detect_start(self, state: ExecutorState) -> None:
        """Forget what is earlier than the start of a plan, if one has started."""
        self._number = state.number
        if state.number != self._previous_number and state.plan is not None:
            self.start_time = state.start_time
            first = round(state.start_time / self._station.time_step)
            self._rows = [row for row in self._rows if row.step >= first]
            self._tool = plan_tool(state.plan) or self._tool_names[0]
            self._states = [(0.0, state)]

    def _distance_to_samples(self, step: int) -> tuple[float, float]:
        """Return the distances of a step from the sample before and that at or after it [steps]."""
        if self.start_time is None:
            return 0.0, 0.0
        elapsed = step - self.start_time / self._station.time_step
        samples = elapsed / self._steps_per_sample
        after = math.ceil(samples - _STEP_TOLERANCE)
        return (
            (samples - (after - 1)) * self._steps_per_sample,
            (after - samples) * self._steps_per_sample,
        )

    @property
    def _steps_per_sample(self) -> float:
        return 1 / (self._rate * self._station.time_step)

    def _row(self, state: ExecutorState, time: float, step: int, *, has_states: bool) -> _Row:
        """Return an observation; `has_states` tells whether a sample takes `_Row.states` of it."""
        station, context = self._station, self._plant_context
        command = self._command.Eval(self._executor_context)
        # Before the first step nothing was actuated; at rest, the torque is the commanded one.
        torque = self._torque.Eval(context) if step else command[2 * len(command) // 3 :]
        return _Row(
            step,
            station.plant.GetPositions(context),
            station.plant.GetVelocities(context),
            torque,
            command,
            self._gripper_state.Eval(context),
            self._gripper_command(),
            self._vacuum(),
            station.arm.tools[self._tool].CalcPoseInWorld(context).GetAsMatrix4(),
            self._discrete_states(state, time) if has_states else _NO_STATES,
        )

    def _discrete_states(self, state: ExecutorState, time: float) -> tuple[int, ...]:
        """Return `_Row.states`."""
        held = self._gripper.status.held
        tool, name = "", "idle"
        if state.schedule is not None:
            elapsed = state.elapsed(time)
            tool, name = state.schedule.tool_at(elapsed), state.schedule.stage_at(elapsed)
        return (
            self._tool_indices[tool],
            self._object_indices[held],
            phase_index(name),
            *self._station.contact_flags(self._plant_context, held),
        )

    def samples(self, affected: Sequence[Set[str]]) -> ActionSamples:
        """Return what was recorded since the start of the plan.

        Args:
            affected: Names of the objects affected by each step of the plan, see
                `affected_bodies`.
        """
        assert self.start_time is not None
        station = self._station
        rows = self._rows
        columns = _Row(*(np.array(column) for column in zip(*rows, strict=True)))  # type: ignore[arg-type]
        steps = np.asarray(columns.step) - self.start_time / station.time_step
        count = math.floor(steps[-1] / self._steps_per_sample + _STEP_TOLERANCE) + 1
        times = np.arange(count) * self._steps_per_sample
        before = np.searchsorted(steps, times + _STEP_TOLERANCE, side="right") - 1
        after = np.minimum(before + 1, len(steps) - 1)
        weight = np.clip(times - steps[before], 0.0, 1.0)
        weight[weight < _STEP_TOLERANCE] = 0.0

        def at_times(values: Any) -> Floats:
            share = weight.reshape(-1, *[1] * (values.ndim - 1))
            return np.asarray(values[before] + share * (values[after] - values[before]))

        q_indices, v_indices = station.joint_indices
        num_joints = len(q_indices)
        command = at_times(columns.command)
        tool_commanded, held, phase, tool_contact, object_contact = np.asarray(columns.states)[
            before
        ].T
        num_gripper, num_actuated = (
            station.cell.gripper.num_joints,
            station.cell.gripper.num_actuated_joints,
        )
        X_TO = np.empty((len(rows), len(self._scene.objects), len(POSE_COLUMNS)))
        for k, o in enumerate(self._scene.objects):
            X_TO[:, k] = self._object_poses(o.name, np.asarray(columns.positions))
        X_TO_samples = _interpolate_poses(X_TO, before, after, weight)
        if steps[0] == 0 and self.start_time == 0:
            X_TO_samples[0] = self._initial_poses(X_TO_samples[0])
        return ActionSamples(
            time=np.arange(count) / self._rate,
            q=at_times(columns.positions)[:, q_indices],
            v=at_times(columns.velocities)[:, v_indices],
            torque=at_times(columns.torque),
            q_commanded=command[:, :num_joints],
            v_commanded=command[:, num_joints : 2 * num_joints],
            torque_commanded=command[:, 2 * num_joints :],
            gripper=at_times(columns.gripper)[:, :num_gripper],
            gripper_commanded=at_times(columns.gripper_commanded)[:, :num_actuated],
            tool_commanded=tool_commanded.astype(np.int16),
            vacuum=at_times(columns.vacuum),
            X_TG=_interpolate_poses(_pose_rows(np.asarray(columns.X_TG)), before, after, weight),
            held_object=held.astype(np.int16),
            phase=phase.astype(np.int16),
            tool_contact=tool_contact.astype(bool),
            object_contact=object_contact.astype(bool),
            X_TO=X_TO_samples,
            time_step=station.time_step,
            movable=tuple(station.scene_plant.bodies),
            executed=self._executed_commands(affected),
        )

    def _executed_commands(self, affected: Sequence[Set[str]]) -> ExecutedCommands:
        """Return the commands, from all states that the executor had."""
        _, initial = self._states[0]
        assert initial.schedule is not None
        parts = [(0.0, initial.schedule)]
        waits = list[float]()
        for (_, earlier), (update, later) in pairwise(self._states):
            assert later.schedule is not None
            if later.waited > earlier.waited:
                waits.append(update)
            if later.schedule is not earlier.schedule:
                parts.append((update - later.waited, later.schedule))
        times = list[float]()
        commands = list[Floats]()
        ends = [*(start for start, _ in parts[1:]), math.inf]
        for (start, schedule), end in zip(parts, ends, strict=True):
            # Commands may jump between two schedules: the later one begins 1 us later, because
            # times must increase.
            first = start + 1e-6 if times else 0.0
            inside = [t for t in schedule.knots().tolist() if first + 1e-9 < t < end - 1e-9]
            knots = [first, *inside, *([end] if math.isfinite(end) else [])]
            times += knots
            commands += [schedule.commands_at(time) for time in knots]
        _, schedule = parts[-1]
        steps = schedule.steps
        return ExecutedCommands(
            time=np.array(times),
            command=np.array(commands),
            wait_time=np.array(waits),
            step_start=np.array([*schedule.starts, schedule.end_time]),
            step_phase=np.array([phase_index(step.name) for step in steps], np.int16),
            step_tool=np.array([self._tool_indices[step.tool] for step in steps], np.int16),
            step_affected=np.array(
                [[name in bodies for name in self._scene.names] for bodies in affected]
            ),
        )

    def _initial_poses(self, X_TO: Floats) -> Floats:
        """Return the poses with which the simulation began, exactly as they were given.

        A pile amplifies rounding errors: replays start from the same numbers.

        Args:
            X_TO: Poses of the plant, whose signs of quaternions are kept. Shape (o, 7).
        """
        poses = np.array([[*o.X_TO.quaternion, *o.X_TO.translation] for o in self._scene.objects])
        poses = poses.reshape(X_TO.shape)  # also without objects
        dot = (poses[:, :4] * X_TO[:, :4]).sum(axis=1, keepdims=True)
        poses[:, :4] *= np.where(dot < 0, -1.0, 1.0)
        return poses

    def _object_poses(self, name: str, positions: Floats) -> Floats:
        """Return X_TO of an object in rows of positions of the plant. Shape (rows, 7)."""
        joint = self._station.free_joints.get(name)
        if joint is None:
            pose = self._scene[name].X_TO
            return np.array([*pose.quaternion, *pose.translation])
        start = joint.position_start()
        return positions[:, start : start + len(POSE_COLUMNS)]


def phase_index(name: str) -> int:
    """Return the index of a step's name in `PHASES`; -1 for another name."""
    return PHASES.index(name) if name in PHASES else -1


def _update_before(time: float) -> float:
    """Return the time of the executor's last update before a time [s]."""
    return EXECUTOR_UPDATE_PERIOD * math.floor(time / EXECUTOR_UPDATE_PERIOD - 1e-6)


def plan_tool(plan: Plan) -> str:
    """Return the name of the first tool that a plan uses; "" if it uses none."""
    return next((step.tool for step in plan.steps if step.tool), "")


def _pose_rows(matrices: Floats) -> Floats:
    """Return poses as `POSE_COLUMNS`. Shape (m, 7).

    Args:
        matrices: Homogeneous matrices. Shape (m, 4, 4).
    """
    quaternions = Rotation.from_matrix(matrices[:, :3, :3]).as_quat(scalar_first=True)
    return np.hstack([quaternions, matrices[:, :3, 3]])


def _interpolate_poses(
    poses: Floats, before: NDArray[np.int64], after: NDArray[np.int64], weight: Floats
) -> Floats:
    """Return poses between those of two rows each, with unit quaternions.

    Args:
        poses: Poses as `POSE_COLUMNS`. Shape (m, ..., 7).
        before: Row before each sample. Shape (k,).
        after: Row after each sample. Shape (k,).
        weight: Share of the row after. Shape (k,).
    """
    first, second = poses[before], poses[after]
    share = weight.reshape(-1, *[1] * (poses.ndim - 1))
    dot = (first[..., :4] * second[..., :4]).sum(axis=-1, keepdims=True)
    second = np.concatenate([np.sign(dot) * second[..., :4], second[..., 4:]], axis=-1)
    mixed = first + share * (second - first)
    mixed[..., :4] /= np.linalg.norm(mixed[..., :4], axis=-1, keepdims=True)
    return np.asarray(mixed)
