"""Check the limits of planned motions at 500 Hz, with Drake's dynamics, for all shipped robots.

    python benchmarks/motion_limits.py --count 1000 --seed 0 --out motion_limits.json

Objects of random scenes are moved to random poses on the support. Every move is planned without and
with trajectory optimization; each of these plans counts.
"""

import math
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from numpy.typing import NDArray
from pydrake.multibody.tree import JacobianWrtVariable, MultibodyForces
from scipy.interpolate import make_interp_spline

from drake_clutter.catalog import load_catalog
from drake_clutter.cell.gripper import Payload
from drake_clutter.cell.payload_limits import payload_wrench
from drake_clutter.cell.suction import SuctionGripper
from drake_clutter.cell.work_cell import WorkCell, load_cell
from drake_clutter.config import ClutterConfig
from drake_clutter.files import write_json
from drake_clutter.grammar import NodeBudget, SceneGrammar, uniform_choice
from drake_clutter.planning.arm_dynamics import dynamics_plant
from drake_clutter.planning.cubic_spline import CubicSpline
from drake_clutter.planning.motion_limits import MotionLimits
from drake_clutter.planning.pick_place_plan import (
    PickPlacePlan,
    PlanningFailure,
    PlanningFailureReason,
    TrajectorySegment,
)
from drake_clutter.planning.pick_place_planner import PickPlacePlanner
from drake_clutter.planning.planner_config import PlannerConfig
from drake_clutter.planning.time_parameterization import path_speed_problem
from drake_clutter.resources import resource_path
from drake_clutter.robots.robot_model import load_robot
from drake_clutter.scenes.layout import LayoutFailure, lay_out
from drake_clutter.scenes.scene import Pose, Scene, SceneObject
from drake_clutter.seeding import item_rng
from drake_clutter.validation import to_plain
from training.results_file import Row, collect_records, provenance
from training.script import SeedOption, WorkersOption, print_table, run_script

Floats = NDArray[np.float64]

ROBOTS = ("ur10", "ur3e", "ur5e", "ur10e", "ur16e", "iiwa14")
"""Robots of the shipped cells, which take turns."""
RATE = 500.0
"""Rate at which motions are sampled [Hz]."""
MAX_NODES = 15
"""Largest number of nodes of the scene graphs."""
MAX_EXCESS = 0.01
"""Largest fraction by which a limit may be exceeded."""
_NUM_PATH_POINTS = 200
"""Points of a motion through which its path is interpolated."""


@dataclass(frozen=True)
class PlanRecord:
    """What was measured of a plan.

    Attributes:
        ratios: Largest ratio to each limit, by name; see `limit_ratios`.
        duration: Duration [s].
        time_optimal_duration: Shortest duration along the paths without a limit of jerk [s].
        min_distance: Smallest distance to obstacles [m].
    """

    ratios: dict[str, float]
    duration: float
    time_optimal_duration: float
    min_distance: float


@dataclass(frozen=True)
class MoveRecord:
    """Record of a move.

    Attributes:
        robot: Robot of the cell.
        failed_moves: Number of random moves before it that could not be planned.
        infeasible: Limits that kept any of these from being planned.
        unoptimized: Plan without trajectory optimization.
        optimized: Plan with trajectory optimization; None if there is none.
    """

    robot: str
    failed_moves: int
    infeasible: tuple[str, ...]
    unoptimized: PlanRecord
    optimized: PlanRecord | None


def cell_of(robot: str) -> WorkCell:
    """Return the shipped cell of a robot."""
    return load_cell(resource_path(f"models/cells/{robot}_epick_tray.yaml"))


def limit_ratios(
    cell: WorkCell, plan: PickPlacePlan, segment: TrajectorySegment
) -> dict[str, float]:
    """Return the largest ratios of a segment of a plan to its limits at `RATE`.

    Dynamics and kinematics are those of Drake.

    Args:
        cell: Work cell with robot and gripper.
        plan: The plan.
        segment: Segment of the plan.

    Returns:
        Ratios by the name of the limit. `rest` is the largest ratio of velocity or acceleration at
        the ends; `cup load` includes the safety factor.
    """
    robot = load_robot(cell.robot)
    payload = plan.payload if segment.name == "carry" else Payload()
    plant = dynamics_plant(cell, payload)
    times = np.linspace(0.0, segment.duration, math.ceil(RATE * segment.duration) + 1)
    trajectory = segment.trajectory
    q, v, a, jerk = (trajectory.MakeDerivative(k).vector_values(times).T for k in range(4))
    context = plant.CreateDefaultContext()
    forces = MultibodyForces(plant)
    flange = plant.GetFrameByName(cell.robot.tool_frame)
    world = plant.world_frame()
    X_FG = cell.gripper.tools[plan.tool].X_FG
    torques, accelerations = np.empty(q.shape), np.zeros((len(q), 3))
    down_G = np.zeros((len(q), 3))
    for k in range(len(q)):
        plant.SetPositions(context, q[k])
        plant.SetVelocities(context, v[k])
        plant.CalcForceElementsContribution(context, forces)
        torques[k] = plant.CalcInverseDynamics(context, a[k], forces)
        if payload.mass:
            frames = (context, JacobianWrtVariable.kV, flange, np.array(payload.p_FCm))
            bias = plant.CalcBiasTranslationalAcceleration(*frames, world, world).ravel()
            J = plant.CalcJacobianTranslationalVelocity(*frames, world, world)
            R_GW = (flange.CalcPoseInWorld(context).rotation() @ X_FG.rotation()).inverse()
            accelerations[k] = R_GW @ (J @ a[k] + bias)
            down_G[k] = R_GW @ np.array([0.0, 0.0, -1.0])
    lower, upper = robot.position_limits.T
    ratios = {
        "position": (2 * q - lower - upper) / (upper - lower),
        "velocity": v / robot.velocity_limits,
        "acceleration": a / robot.acceleration_limits,
        "jerk": jerk / robot.jerk_limits,
        "torque": torques / robot.torque_limits,
        "load acceleration": np.linalg.norm(accelerations, axis=1) / payload.max_acceleration,
        "rest": np.hstack([(v / robot.velocity_limits)[[0, -1]], a[[0, -1]]]),
    }
    gripper = cell.gripper
    if payload.mass and isinstance(gripper, SuctionGripper):
        p_GCm = X_FG.inverse() @ np.array(payload.p_FCm)
        wrench = payload_wrench(payload.mass, p_GCm, down_G, accelerations)
        ratios["cup load"] = gripper.safety * gripper.load_ratio(plan.tool, *wrench)
    return {name: float(np.abs(ratio).max()) for name, ratio in ratios.items()}


def time_optimal_duration(cell: WorkCell, plan: PickPlacePlan, segment: TrajectorySegment) -> float:
    """Return the shortest duration along the path of a segment without a limit of jerk [s].

    Args:
        cell: Work cell with robot and gripper.
        plan: The plan.
        segment: Segment of the plan.
    """
    limits_of_robot = cell.robot.limits.model_copy(update={"jerk": None})
    robot = cell.robot.model_copy(update={"limits": limits_of_robot})
    unlimited = cell.model_copy(update={"robot": robot})
    payload = plan.payload if segment.name == "carry" else Payload()
    q = segment.trajectory.vector_values(np.linspace(0.0, segment.duration, 2000)).T
    length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(q, axis=0), axis=1))])
    s = np.linspace(0.0, length[-1], _NUM_PATH_POINTS)
    points = np.column_stack([np.interp(s, length, joint) for joint in q.T])
    path = make_interp_spline(s / length[-1], points, k=3)
    problem = path_speed_problem(CubicSpline(path.t, path.c), MotionLimits(unlimited, payload))
    speeds = problem.time_optimal_speeds()
    return float((2 * np.diff(problem.grid) / (speeds[1:] + speeds[:-1])).sum())


def check_plan(cell: WorkCell, plan: PickPlacePlan) -> PlanRecord:
    """Return what was measured of a plan."""
    ratios = [limit_ratios(cell, plan, segment) for segment in plan.segments]
    names = {name for of_segment in ratios for name in of_segment}
    return PlanRecord(
        ratios={
            name: float(f"{max(part.get(name, 0.0) for part in ratios):.5g}")
            for name in sorted(names)
        },
        duration=round(plan.duration, 4),
        time_optimal_duration=round(
            sum(time_optimal_duration(cell, plan, segment) for segment in plan.segments), 4
        ),
        min_distance=round(min(s.min_distance.distance for s in plan.segments), 6),
    )


class MovePlanner:
    """Plans a random move of a number and checks its limits; a worker for `map_ordered`."""

    def __init__(self, seed: int) -> None:
        """Load the catalog.

        Args:
            seed: Seed of the moves.
        """
        self._seed = seed
        self._grammar = SceneGrammar(load_catalog().object_set("ycb7"))
        self._planners = dict[tuple[str, bool], PickPlacePlanner]()

    def planner(self, robot: str, optimize: bool) -> PickPlacePlanner:
        """Return the planner of a shipped cell."""
        key = robot, optimize
        if key not in self._planners:
            config = PlannerConfig(optimize=optimize)
            self._planners[key] = PickPlacePlanner(cell_of(robot), config)
        return self._planners[key]

    def sample_move(
        self, cell: WorkCell, rng: np.random.Generator
    ) -> tuple[Scene, SceneObject, Pose]:
        """Return a random scene, one of its objects, and a random pose for it on the support."""
        while True:
            nodes = int(rng.integers(4, MAX_NODES + 1))
            derivation = self._grammar.derive(NodeBudget(nodes), uniform_choice(rng))
            scene = lay_out(derivation, self._grammar.classes, ClutterConfig(cell=cell), rng)
            if not isinstance(scene, LayoutFailure):
                break
        picked = scene.objects[rng.integers(len(scene.objects))]
        x, y = (rng.uniform(-0.4, 0.4) * side for side in cell.support.size)
        angle = rng.uniform(-math.pi, math.pi)
        c, s = math.cos(angle), math.sin(angle)
        R = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]) @ picked.X_TO.rotation
        height = picked.X_TO.translation[2] - picked.bounds_T[0][2] + 0.001
        return scene, picked, Pose.from_rotation(R, (x, y, height))

    def __call__(self, number: int) -> MoveRecord:
        """Return the record of a number: the first of its random moves that can be planned."""
        robot = ROBOTS[number % len(ROBOTS)]
        cell = cell_of(robot)
        rng = item_rng(self._seed, number)
        failures = list[PlanningFailure]()
        while True:
            scene, picked, X_TO_place = self.sample_move(cell, rng)
            arguments = (scene.objects, picked.name, X_TO_place)
            unoptimized = self.planner(robot, False).plan(*arguments)
            if isinstance(unoptimized, PickPlacePlan):
                break
            failures.append(unoptimized)
        optimized = self.planner(robot, True).plan(*arguments)
        return MoveRecord(
            robot=robot,
            failed_moves=len(failures),
            infeasible=tuple(
                failure.detail
                for failure in failures
                if failure.reason is PlanningFailureReason.TRAJECTORY_INFEASIBLE
            ),
            unoptimized=check_plan(cell, unoptimized),
            optimized=(
                check_plan(cell, optimized) if isinstance(optimized, PickPlacePlan) else None
            ),
        )


def summarize(records: list[Row]) -> list[Row]:
    """Return the largest ratios and the durations of unoptimized and of optimized plans."""
    rows = []
    for kind in ("unoptimized", "optimized"):
        plans = [record[kind] for record in records if record[kind] is not None]
        factors = [plan["duration"] / plan["time_optimal_duration"] for plan in plans]
        rows.append(
            {
                "plans": kind,
                "count": len(plans),
                "exceeded": sum(
                    max(ratio for name, ratio in plan["ratios"].items() if name != "rest")
                    > 1 + MAX_EXCESS
                    for plan in plans
                ),
                "largest": {
                    name: max(plan["ratios"][name] for plan in plans) for name in plans[0]["ratios"]
                },
                "duration_s": float(np.median([plan["duration"] for plan in plans])),
                "of_time_optimal": float(np.median(factors)),
                "min_distance_m": min(plan["min_distance"] for plan in plans),
            }
        )
    return rows


def main(
    out: Annotated[Path, typer.Option(metavar="FILE", help="Results file to write (JSON).")],
    count: Annotated[int, typer.Option(min=2, help="Number of plans, two of each move.")] = 1000,
    seed: SeedOption = 0,
    workers: WorkersOption = 1,
) -> None:
    """Check the limits of random plans; the exit code is 1 if one is exceeded.

    The records of all moves are in a file beside the results, from which a run is resumed.
    """
    header = {
        "seed": seed,
        "planner": asdict(PlannerConfig()),
        "cells": {robot: to_plain(cell_of(robot)) for robot in ROBOTS},
    }
    records = collect_records(
        out.with_suffix(".jsonl.gz"),
        header,
        partial(MovePlanner, seed),
        range(math.ceil(count / 2)),
        schema=MoveRecord,
        workers=workers,
    )
    rows = summarize(records)
    command = f"benchmarks/motion_limits.py --count {count} --seed {seed}"
    results = {"command": command, "count": count, **header, "rows": rows, **provenance()}
    write_json(out, results)
    print_table(
        [
            {
                "plans": row["plans"],
                "count": str(row["count"]),
                "exceeded": str(row["exceeded"]),
                "largest ratio": f"{max(v for k, v in row['largest'].items() if k != 'rest'):.4f}",
                "duration [s]": f"{row['duration_s']:.2f}",
                "of time-optimal": f"{row['of_time_optimal']:.3f}",
            }
            for row in rows
        ]
    )
    if any(row["exceeded"] for row in rows):
        raise typer.Exit(1)


if __name__ == "__main__":
    run_script(main)
