"""Plans as evenly sampled files for the controllers of real arms: CSV and URScript.

Source of the URScript commands: Universal Robots, "The URScript Programming Language", and the
article "ServoJ command": `servoj(q, a, v, t, lookahead_time, gain)` blocks for t, at least 0.002 s,
with a look-ahead time from 0.03 to 0.2 s and a gain from 100 to 2000; a and v are not used.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from drake_clutter.files import InputError, write_text
from drake_clutter.planning.motion_plan import Plan
from drake_clutter.robots.robot_model import RobotModel

Floats = NDArray[np.float64]

MIN_RATE = 10.0
"""Lowest rate of samples [Hz]."""
MAX_RATE = 1000.0
"""Highest rate of samples [Hz]."""
MAX_URSCRIPT_RATE = 500.0
"""Highest rate of the controller of UR arms [Hz]; 125 Hz before the e-Series."""
_NUM_TOOL_OUTPUTS = 2
"""Digital outputs at the flange of a UR arm. Further tools have the standard digital outputs."""
_SERVO_PARAMETERS = "0.1, 300"
"""Look-ahead time [s] and gain: the defaults of `servoj`."""


SUFFIXES = {"csv": ".csv", "urscript": ".script"}
"""File name suffix of each format."""


@dataclass(frozen=True)
class PlanSamples:
    """Samples of a plan at even times, with the dwells.

    Attributes:
        rate: Samples per second [Hz].
        phases: Name of the step at each sample, see `PlanStep`.
        tools: Name of the tool that is commanded to hold at each sample; "" for none.
        q: Joint positions [rad]. Shape (m, n).
        v: Joint velocities [rad/s]. Shape (m, n).
    """

    rate: float
    phases: tuple[str, ...]
    tools: tuple[str, ...]
    q: Floats
    v: Floats

    @property
    def times(self) -> Floats:
        """Times [s]. Shape (m,)."""
        return np.arange(len(self.q)) / self.rate


def sample_plan(plan: Plan, rate: float) -> PlanSamples:
    """Return samples of a plan; the last one is at its end, or less than a period later.

    Args:
        plan: The plan.
        rate: Samples per second [Hz].

    Raises:
        InputError: The rate is out of range.
    """
    if not MIN_RATE <= rate <= MAX_RATE:
        raise InputError(f"rate: {rate:g}; expected {MIN_RATE:g} to {MAX_RATE:g} Hz")
    ends = np.cumsum([step.duration for step in plan.steps])
    times = np.arange(math.ceil(float(ends[-1]) * rate - 1e-9) + 1) / rate
    indices = np.minimum(np.searchsorted(ends, times + 1e-9, side="right"), len(ends) - 1)
    parts_q, parts_v = list[Floats](), list[Floats]()
    for k, step in enumerate(plan.steps):
        local = times[indices == k] - (ends[k] - step.duration)
        if len(local):
            within = np.clip(local, 0.0, step.duration)
            parts_q.append(step.trajectory.vector_values(within).T)
            parts_v.append(step.trajectory.MakeDerivative(1).vector_values(within).T)
    return PlanSamples(
        rate,
        tuple(plan.steps[k].name for k in indices),
        tuple(plan.steps[k].tool for k in indices),
        np.vstack(parts_q),
        np.vstack(parts_v),
    )


def export_plan(
    plan: Plan,
    path: Path,
    export_format: str,
    rate: float,
    robot: RobotModel,
    tools: Sequence[str],
) -> None:
    """Write a plan as an evenly sampled file.

    Args:
        plan: The plan.
        path: File to write.
        export_format: Format of the file, a key of `SUFFIXES`.
        rate: Samples per second [Hz].
        robot: Robot of the plan.
        tools: Names of the tools of the gripper.

    Raises:
        InputError: The rate is out of range, or the robot does not understand the format.
    """
    check_export(export_format, rate, robot)
    samples = sample_plan(plan, rate)
    if export_format == "csv":
        write_text(path, to_csv(samples))
    else:
        write_text(path, to_urscript(samples, tools))


def check_export(export_format: str, rate: float, robot: RobotModel) -> None:
    """Check that a robot can run a plan in a format.

    Raises:
        InputError: The rate is out of range, or the robot does not understand the format.
    """
    highest = MAX_RATE if export_format == "csv" else MAX_URSCRIPT_RATE
    if not MIN_RATE <= rate <= highest:
        raise InputError(
            f"--rate {rate:g} with --export {export_format}; "
            f"expected {MIN_RATE:g} to {highest:g} Hz"
        )
    if export_format == "urscript" and robot.ur_fit is None:
        raise InputError(
            f"--export urscript: {robot.spec.model!r} with robot.ik {robot.spec.ik!r}; "
            "expected an arm of the UR family with robot.ik 'ur', or --export csv"
        )


def to_csv(samples: PlanSamples) -> str:
    """Return samples as CSV with the columns `time, phase, cup, q_1, ..., v_1, ...`.

    Times are in s, positions in rad, velocities in rad/s. The cup is the name of the tool that is
    commanded to hold an object, empty without one.
    """
    numbers = range(1, samples.q.shape[1] + 1)
    header = ["time", "phase", "cup", *(f"q_{k}" for k in numbers), *(f"v_{k}" for k in numbers)]
    rows = [
        f"{time:.6f},{phase},{tool}," + ",".join(f"{value:.9f}" for value in (*q, *v))
        for time, phase, tool, q, v in zip(
            samples.times, samples.phases, samples.tools, samples.q, samples.v, strict=True
        )
    ]
    return "\n".join([",".join(header), *rows, ""])


def to_urscript(samples: PlanSamples, tools: Sequence[str]) -> str:
    """Return samples as a URScript program of `servoj` commands.

    The program moves to the first sample with `movej`, and switches a digital output for each tool.

    Args:
        samples: Samples of a plan of an arm of the UR family.
        tools: Names of the tools of the gripper.
    """
    outputs = dict(zip(tools, _outputs(len(tools)), strict=True))
    lines = [
        "# Joint positions are streamed with servoj; every call blocks for one period of "
        f"{1 / samples.rate:g} s.",
        *(
            f"# {output.format('True')} switches tool {tool!r} on."
            for tool, output in outputs.items()
        ),
        "def drake_clutter_plan():",
        *(f"  {output.format('False')}" for output in outputs.values()),
        f"  movej({_to_list(samples.q[0])}, a=0.5, v=0.5)",
    ]
    current_phase = current_tool = ""
    for phase, tool, q in zip(samples.phases, samples.tools, samples.q, strict=True):
        if phase != current_phase:
            lines.append(f"  # {phase}")
        if tool != current_tool:
            lines += [f"  {outputs[current_tool].format('False')}"] if current_tool else []
            lines += [f"  {outputs[tool].format('True')}"] if tool else []
        current_phase, current_tool = phase, tool
        lines.append(f"  servoj({_to_list(q)}, 0, 0, {1 / samples.rate:g}, {_SERVO_PARAMETERS})")
    return "\n".join([*lines, "  stopj(1.0)", "end", ""])


def _outputs(count: int) -> list[str]:
    """Return the command of each output with a placeholder for its state."""
    at_flange = [f"set_tool_digital_out({k}, {{}})" for k in range(_NUM_TOOL_OUTPUTS)]
    standard = [f"set_standard_digital_out({k}, {{}})" for k in range(count)]
    return (at_flange + standard)[:count]


def _to_list(q: Floats) -> str:
    """Return joint positions as a list of URScript."""
    return f"[{', '.join(f'{value:.6f}' for value in q)}]"
