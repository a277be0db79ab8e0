"""Samples of a motion of the arm: commands, measurements and object poses over time.

Frames: T is the support and the world W of every simulation, G is the tool that the action uses, O
is an object.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

PHASES = (
    *("idle", "approach", "grasp", "lift", "carry", "steady", "descend", "release", "rise"),
    *("retreat", "move", "hold", "withdraw"),
)
"""Names of the steps of a plan, see `PlanStep`, and `idle` without one."""
POSE_COLUMNS = ("qw", "qx", "qy", "qz", "x", "y", "z")
"""Columns of a pose: unit quaternion and position [m]."""


@dataclass(frozen=True)
class Channel:
    """A quantity of `ActionSamples`.

    Attributes:
        name: Field of `ActionSamples`.
        description: What it is.
        unit: Unit; "" for none.
        axes: Axes after the first one, which is the time: keys of `RecordedEpisode.axes`.
        frame: Frame in which it is expressed; "" for none.
        dtype: Type of its values.
    """

    name: str
    description: str
    unit: str
    axes: tuple[str, ...] = ()
    frame: str = ""
    dtype: str = "float64"


CHANNELS = (
    Channel("time", "time since the start of the action", "s"),
    Channel("q", "measured joint positions", "rad", ("joints",)),
    Channel("v", "measured joint velocities", "rad/s", ("joints",)),
    Channel("torque", "torques of the actuators of the joints", "N m", ("joints",)),
    Channel("q_commanded", "commanded joint positions", "rad", ("joints",)),
    Channel("v_commanded", "commanded joint velocities", "rad/s", ("joints",)),
    Channel("torque_commanded", "commanded feed-forward torques", "N m", ("joints",)),
    Channel("gripper", "measured positions of the gripper's joints", "m, rad", ("gripper_joints",)),
    Channel(
        "gripper_commanded",
        "commanded positions of the gripper's actuated joints",
        "m",
        ("gripper_actuators",),
    ),
    Channel("tool_commanded", "index of the tool that is to hold, -1 for none", "", dtype="int16"),
    Channel("vacuum", "pressure of each suction cup below the ambient one", "Pa", ("cups",)),
    Channel("X_TG", "pose of the tool that the action uses", "1, m", ("pose",), "T"),
    Channel("held_object", "index of the held object, -1 for none", "", dtype="int16"),
    Channel("phase", "index of the plan's step, -1 for one of another name", "", dtype="int16"),
    Channel("tool_contact", "whether the gripper touches or holds an object", "", dtype="bool"),
    Channel(
        "object_contact",
        "whether the held object touches anything but the gripper",
        "",
        dtype="bool",
    ),
    Channel("X_TO", "pose of each object", "1, m", ("objects", "pose"), "T"),
)
"""Quantities of `ActionSamples`, in the order of its fields."""


EXECUTED_COMMANDS = (
    Channel("time", "times without waiting, between which the commands are linear", "s"),
    Channel(
        "command",
        "positions, velocities and torques of the joints, then positions of the gripper's joints",
        "rad, rad/s, N m, m",
        ("commands",),
    ),
    Channel("wait_time", "times at which the executor waited for the vacuum", "s"),
    Channel("step_start", "start of each step of the plan, and the end of the last", "s"),
    Channel("step_phase", "index of each step's phase, -1 for another name", "", dtype="int16"),
    Channel("step_tool", "index of the tool that is to hold, -1 for none", "", dtype="int16"),
    Channel(
        "step_affected",
        "whether each object may be disturbed by the step",
        "",
        ("objects",),
        dtype="bool",
    ),
)
"""Quantities of `ExecutedCommands`, in the order of its fields."""


@dataclass(frozen=True, eq=False)
class ExecutedCommands:
    """Commands of an action exactly as they were executed; for replays.

    Samples lose what happens between them, such as the instant at which the vacuum is switched, and
    a pile that collapses amplifies the smallest difference.

    Attributes:
        time: Times since the start of the action, without the time of waiting, between which the
            commands are linear [s]. Shape (k,).
        command: Commanded positions [rad], velocities [rad/s] and feed-forward torques [N m] of n
            joints, then positions of a actuated joints of the gripper [m]. Shape (k, 3 n + a).
        wait_time: Times since the start at which the executor waited for a period. Shape (w,).
        step_start: Start of each of s steps, and the end of the last, without the time of waiting
            [s]. Shape (s + 1,).
        step_phase: Index of each step in `PHASES`; -1 for another name. Shape (s,).
        step_tool: Index of the tool that each step commands to hold; -1 for none. Shape (s,).
        step_affected: Whether each object may be disturbed by a step and must be able to move.
            Shape (s, o).
    """

    time: Floats
    command: Floats
    wait_time: Floats
    step_start: Floats
    step_phase: NDArray[np.int16]
    step_tool: NDArray[np.int16]
    step_affected: NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class ActionSamples:
    """Samples of one action at m times, of an arm with n joints and o objects.

    Quantities that a file of version 1 does not hold are NaN, -1 or False.

    Attributes:
        time: Time since the start of the action, from 0 [s]. Shape (m,).
        q: Joint positions [rad]. Shape (m, n).
        v: Joint velocities [rad/s]. Shape (m, n).
        torque: Torques of the actuators of the joints [N m]. Shape (m, n).
        q_commanded: Commanded joint positions [rad]. Shape (m, n).
        v_commanded: Commanded joint velocities [rad/s]. Shape (m, n).
        torque_commanded: Commanded feed-forward torques [N m]. Shape (m, n).
        gripper: Positions of the gripper's k joints [m, rad]. Shape (m, k).
        gripper_commanded: Commanded positions of its actuated joints [m]. Shape (m, a).
        tool_commanded: Index of the tool that is commanded to hold; -1 for none. Shape (m,).
        vacuum: Pressure of each suction cup below the ambient one [Pa]. Shape (m, cups).
        X_TG: Pose of the tool that the action uses, as `POSE_COLUMNS`. Shape (m, 7).
        held_object: Index of the object that is held; -1 for none. Shape (m,).
        phase: Index of the plan's step in `PHASES`; -1 for one of another name. Shape (m,).
        tool_contact: Whether the gripper touches or holds an object. Shape (m,).
        object_contact: Whether the held object touches anything but the gripper. Shape (m,).
        X_TO: Pose of each object, as `POSE_COLUMNS`. Shape (m, o, 7).
        time_step: Time step of the simulation [s]; NaN if unknown.
        movable: Names of the objects that could move in the simulation.
        executed: Commands between the samples, too; None if unknown.
    """

    time: Floats
    q: Floats
    v: Floats
    torque: Floats
    q_commanded: Floats
    v_commanded: Floats
    torque_commanded: Floats
    gripper: Floats
    gripper_commanded: Floats
    tool_commanded: NDArray[np.int16]
    vacuum: Floats
    X_TG: Floats
    held_object: NDArray[np.int16]
    phase: NDArray[np.int16]
    tool_contact: NDArray[np.bool_]
    object_contact: NDArray[np.bool_]
    X_TO: Floats
    time_step: float
    movable: tuple[str, ...] = field(repr=False)
    executed: ExecutedCommands | None = field(default=None, repr=False)

    def __len__(self) -> int:
        """Return the number of samples."""
        return len(self.time)

    def channels(self) -> Mapping[str, NDArray[Any]]:
        """Return the arrays by the names of `CHANNELS`."""
        return {channel.name: getattr(self, channel.name) for channel in CHANNELS}
