"""Command recorded free-space motions of the arm in MuJoCo, and compare the tool's positions.

    python benchmarks/mujoco_motion.py --count 50 --seed 61 --out mujoco_motion.json

Each motion leads from home over one random tool pose above the empty tray to another one. The
station carries it out and records it. Then the recorded commands control the exported cell in
MuJoCo, linearly interpolated:

    station         With the control law of the station: positions, velocities and torques.
    delayed         The same, one time step of the station later. The position control of Drake is
                    implicit: its joints follow the command by one time step.
    positions only  Positions without velocities and torques.

An interrupted run is resumed by the same command.
"""

import math
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum
from functools import partial
from pathlib import Path
from typing import Annotated

import mujoco
import numpy as np
import typer
from numpy.typing import NDArray
from pydrake.math import RigidTransform, RotationMatrix

from benchmarks.measurement import describe_machine
from benchmarks.pick_place import OutOption, fraction, write_results
from drake_clutter.cell.work_cell import WorkCell, default_cell
from drake_clutter.export import ExportFormat, export_scene
from drake_clutter.planning.motion_plan import MotionPlan, concatenate_plans
from drake_clutter.planning.pick_place_planner import PickPlacePlanner
from drake_clutter.planning.planner_config import PlannerConfig
from drake_clutter.records import partial_records
from drake_clutter.scenes.action_samples import ActionSamples
from drake_clutter.scenes.scene import Scene
from drake_clutter.seeding import item_rng
from drake_clutter.station.station_simulation import StationSimulation
from training.results_file import collect_records
from training.script import SeedOption, WorkersOption, run_script

Floats = NDArray[np.float64]

MAX_FINAL_DEVIATION = 0.005
"""Largest distance of the tools at the end of a motion that counts as the same [m]."""
RATE = 125.0
"""Samples of the recorded motion per second [Hz]."""
NUM_POSES = 2
"""Tool poses of a motion."""
HEIGHTS = (0.05, 0.40)
"""Range of the heights of the tool poses [m]."""
MAX_TILT_DEG = 30.0
"""Largest tilt of the tool [deg]."""


class Control(Enum):
    """How recorded commands control the arm in MuJoCo."""

    STATION = "station"
    DELAYED = "delayed"
    POSITIONS_ONLY = "positions only"


HEADER = {
    "max_final_deviation_mm": 1000 * MAX_FINAL_DEVIATION,
    "rate_hz": RATE,
    "poses": NUM_POSES,
    "heights_m": HEIGHTS,
    "max_tilt_deg": MAX_TILT_DEG,
}
"""What all motions have in common."""


def sample_tool_pose(cell: WorkCell, rng: np.random.Generator) -> RigidTransform:
    """Return a random pose of a tool above the tray, tilted from the vertical."""
    half = 0.8 * cell.support.half_size
    x, y = rng.uniform(-half, half)
    yaw, direction = rng.uniform(-math.pi, math.pi, 2)
    tilt = math.radians(rng.uniform(0.0, MAX_TILT_DEG))
    axis = np.array([math.cos(direction), math.sin(direction), 0.0])
    down = RotationMatrix.MakeXRotation(math.pi)
    R_TG = RotationMatrix.MakeZRotation(yaw) @ down
    if tilt > 0:
        x_axis = RotationMatrix.MakeFromOneVector(axis, 0)
        R_TG = x_axis @ RotationMatrix.MakeXRotation(tilt) @ x_axis.inverse() @ R_TG
    return RigidTransform(R_TG, [x, y, rng.uniform(*HEIGHTS)])


def plan_motion(planner: PickPlacePlanner, rng: np.random.Generator) -> MotionPlan:
    """Return a motion from home over random tool poses; poses without a plan are replaced."""
    plans = list[MotionPlan]()
    state = planner.home_state([])
    while len(plans) < NUM_POSES:
        plan = planner.plan_move(state, sample_tool_pose(planner.cell, rng))
        if isinstance(plan, MotionPlan):
            plans.append(plan)
            state = plan.end
    return concatenate_plans(plans)


def export_cell(cell: WorkCell) -> mujoco.MjModel:
    """Return the MuJoCo model of a cell without objects."""
    with tempfile.TemporaryDirectory() as folder:
        scene = Scene((), cell.support)
        path = export_scene(scene, ExportFormat.MJCF, Path(folder), cell=cell)
        return mujoco.MjModel.from_xml_path(str(path))


def play_in_mujoco(
    model: mujoco.MjModel, samples: ActionSamples, tool: str, control: Control
) -> Floats:
    """Return the positions of a tool at the times of recorded samples [m]. Shape (m, 3).

    Args:
        model: Exported cell.
        samples: Recorded motion of an arm that starts at rest at home.
        tool: Name of the tool.
        control: How the recorded commands control the arm.
    """
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, model.key("home").id)
    num_joints = samples.q.shape[1]
    stiffness = model.actuator_gainprm[:num_joints, 0]
    damping = -model.actuator_biasprm[:num_joints, 2]
    commands = samples.q_commanded
    if control is not Control.POSITIONS_ONLY:
        feed_forward = damping * samples.v_commanded + samples.torque_commanded
        commands = commands + feed_forward / stiffness
    delay = samples.time_step if control is Control.DELAYED else 0.0
    positions = []
    for time in samples.time:
        while data.time < time - model.opt.timestep / 2:
            data.ctrl[:num_joints] = [
                np.interp(data.time - delay, samples.time, column) for column in commands.T
            ]
            mujoco.mj_step(model, data)
        # After a step, the poses of sites are still those of its start.
        mujoco.mj_kinematics(model, data)
        positions.append(data.site(f"gripper/{tool}").xpos.copy())
    return np.array(positions)


@dataclass(frozen=True)
class Deviation:
    """Distance of the tools in Drake and in MuJoCo.

    Attributes:
        final_mm: At the end [mm].
        max_mm: Largest on the way [mm].
        mean_mm: Mean on the way [mm].
    """

    final_mm: float
    max_mm: float
    mean_mm: float


@dataclass(frozen=True)
class MotionComparison:
    """Record of a motion.

    Attributes:
        duration: Duration [s].
        path_length: Length of the path of the tool [m].
        max_speed: Largest speed of the tool [m/s].
        deviations: Deviation by `Control`.
    """

    duration: float
    path_length: float
    max_speed: float
    deviations: dict[str, Deviation]


class MotionComparer:
    """Plans, simulates and compares motions; a worker for `map_ordered`."""

    def __init__(self, seed: int) -> None:
        """Create planner, simulation and model.

        Args:
            seed: Seed of the motions.
        """
        self._seed = seed
        self._cell = default_cell()
        self._planner = PickPlacePlanner(self._cell, PlannerConfig())
        self._tool = next(iter(self._cell.gripper.tools))
        self._scene = Scene((), self._cell.support)
        self._simulation = StationSimulation(self._cell, self._scene, rate=RATE)
        self._model = export_cell(self._cell)

    def record(self, number: int) -> ActionSamples:
        """Return the recorded motion of a number."""
        plan = plan_motion(self._planner, item_rng(self._seed, number))
        self._simulation.reset(self._scene)
        samples = self._simulation.execute(plan).samples
        assert samples is not None
        return samples

    def __call__(self, number: int) -> MotionComparison:
        """Return the record of a number."""
        samples = self.record(number)
        p_TG = samples.X_TG[:, 4:]
        steps = np.linalg.norm(np.diff(p_TG, axis=0), axis=1)
        return MotionComparison(
            duration=float(samples.time[-1]),
            path_length=round(float(steps.sum()), 4),
            max_speed=round(float((steps / np.diff(samples.time)).max()), 4),
            deviations={
                control.value: deviation(
                    p_TG - play_in_mujoco(self._model, samples, self._tool, control)
                )
                for control in Control
            },
        )


def deviation(offsets: Floats) -> Deviation:
    """Return the deviation of offsets of the tools [m], shape (m, 3)."""
    distances = 1000 * np.linalg.norm(offsets, axis=1)
    values = distances[-1], distances.max(), distances.mean()
    return Deviation(*(round(float(value), 6) for value in values))


def spread(values: Sequence[float] | Floats) -> dict[str, float]:
    """Return median and maximum."""
    return {"median": round(float(np.median(values)), 4), "max": float(np.max(values))}


def main(
    out: OutOption,
    count: Annotated[int, typer.Option(min=1, help="Number of motions.")] = 50,
    seed: SeedOption = 61,
    workers: WorkersOption = 1,
) -> None:
    """Command recorded motions in MuJoCo, and compare the tool's positions."""
    header = {"seed": seed, **HEADER}
    with partial_records(out) as path:
        records = collect_records(
            path,
            header,
            partial(MotionComparer, seed),
            range(count),
            schema=MotionComparison,
            workers=workers,
        )
    rows = []
    for control in Control:
        deviations = [record["deviations"][control.value] for record in records]
        final, largest = (
            np.array([entry[name] for entry in deviations]) for name in ("final_mm", "max_mm")
        )
        rows.append(
            {
                "control": control.value,
                "same_end": fraction(
                    int((final <= 1000 * MAX_FINAL_DEVIATION).sum()), len(deviations)
                ),
                "final_mm": spread(final),
                "max_mm": spread(largest),
            }
        )
    command = f"benchmarks/mujoco_motion.py --count {count} --seed {seed} --workers {workers}"
    fields = {
        "command": command,
        "count": count,
        **header,
        "rows": rows,
        "duration_s": spread([record["duration"] for record in records]),
        "path_length_m": spread([record["path_length"] for record in records]),
        "max_speed_m_s": spread([record["max_speed"] for record in records]),
        "motions": records,
        **describe_machine("mujoco"),
    }
    write_results(out, fields)


if __name__ == "__main__":
    run_script(main)
