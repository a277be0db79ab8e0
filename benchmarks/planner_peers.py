"""Plan transfer motions with this package, OMPL and Drake, in the same collision model.

    python benchmarks/planner_peers.py problems.jsonl.gz --count 1000 --out planner_peers.json

Needs the package `ompl`. The problems are those of `planning_problems.py` that have a plan. A
transfer motion moves the held object between the configurations of that plan at which it has left
its neighbors, and keeps the tool vertical. All planners have start, goal, robot, limits and
collision model in common:

- `ours`, `ours, optimized`: `PickPlacePlanner.plan_move` without and with trajectory optimization.
  It also keeps the object at a distance for its sag, and clear of the space below its poses, which
  may hide something.
- `RRT-Connect`: of OMPL, in the four coordinates that keep the tool vertical, then its
  simplification of the path. Limits are imposed on the path as on ours.
- `BIT*`: likewise, with a fixed time for the optimization of the path length before.
- `KTO`: `KinematicTrajectoryOptimization` of Drake for minimum time with SNOPT, from the straight
  line in joint space; our distances and gradients are constraints at samples.

`vamp-planner` (0.6.4) is left out: it has no model of the UR10, and its sources fetch what they
need while they are built.

Every trajectory is checked for collisions as densely as ours, and for limits at 500 Hz. Times are
CPU times of the process; callbacks of the peers are Python. An interrupted run is resumed by the
same command.
"""

import math
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import partial
from itertools import pairwise
from typing import Annotated, Any

import numpy as np
import typer
from numpy.typing import NDArray
from pydrake.autodiffutils import ExtractGradient, ExtractValue, InitializeAutoDiff
from pydrake.planning import KinematicTrajectoryOptimization
from pydrake.solvers import SnoptSolver
from pydrake.trajectories import BsplineTrajectory

from benchmarks.pick_place import OutOption, fraction, quantiles, write_results
from benchmarks.planning_problems import ProblemsArgument, load_problems
from benchmarks.planning_worker import to_objects, to_pose
from drake_clutter.cell.work_cell import WorkCell, default_cell
from drake_clutter.planning.collision_model import CollisionModel
from drake_clutter.planning.cubic_spline import SPLINE_ORDER, CubicSpline, clamped_knots
from drake_clutter.planning.load_deflection import LoadDeflection
from drake_clutter.planning.motion_limits import LimitViolation, MotionLimits, scale_to_limits
from drake_clutter.planning.motion_plan import CellState, HeldObject
from drake_clutter.planning.pick_place_plan import PickPlacePlan, PlanningFailure
from drake_clutter.planning.pick_place_planner import PickPlacePlanner
from drake_clutter.planning.planner_config import PlannerConfig
from drake_clutter.planning.state_check import find_object
from drake_clutter.planning.time_parameterization import (
    MAX_JOINT_STEP,
    bspline_path,
    linear_joint_path,
    parameterize_time_optimal,
    sample_path,
)
from drake_clutter.planning.trajectory_optimization import INFLUENCE_DISTANCE
from drake_clutter.records import partial_records
from drake_clutter.robots.robot_model import RobotModel, load_robot
from drake_clutter.simulation.scene_plant import rigid_transform
from drake_clutter.validation import to_plain
from training.results_file import collect_records
from training.script import WorkersOption, run_script

Floats = NDArray[np.float64]

CELL: WorkCell = default_cell()
"""Work cell; its robot keeps the tool vertical on a linear subspace of the joints."""
VERTICAL_BASIS = np.array(
    [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, -1, -1, 0], [0, 0, 0, 0], [0, 0, 0, 1.0]]
)
"""Directions of the joints that keep the tool vertical. Shape (6, 4)."""
PEER_MARGIN = 0.003
"""Distance that the peers keep in addition to the required one [m]: distances are imposed at
samples, and corners of the paths are blended."""
START_MARGIN = 0.004
"""Distance to neighbors at the start and the goal of a transfer in addition to what ours requires
[m]."""
MIN_TRANSFER_SAMPLES = 20
"""Least length of a transfer, as samples that are about 0.01 rad apart."""
SAMPLED_RANGE = 2.0
"""Range of the joints that OMPL samples around start and goal [rad]."""
MAX_RRT_TIME = 10.0
"""Time after which RRT-Connect fails [s]."""
SIMPLIFICATION_TIME = 0.5
"""Largest time of the simplification of a path [s]."""
BIT_TIME = 2.0
"""Time of BIT* [s]."""
KTO_POINTS = 14
"""Control points of KTO."""
KTO_SAMPLES = 30
"""Samples of KTO at which distances are constraints."""
KTO_MAX_ITERATIONS = 200
"""Largest number of major iterations of SNOPT."""


@dataclass(frozen=True)
class TransferResult:
    """Result of a planner.

    Attributes:
        failure: Why there is no trajectory; empty if there is one.
        seconds: CPU time of planning [s].
        duration: Duration of the motion [s].
        clearance: Smallest distance of arm and object to obstacles [m]; at most that at which
            distances are reported.
    """

    failure: str
    seconds: float
    duration: float = math.nan
    clearance: float = math.nan


@dataclass(frozen=True)
class PeersRecord:
    """Record of a problem.

    Attributes:
        results: Results by the name of the planner; none if the problem has no transfer motion.
    """

    results: dict[str, TransferResult]


@dataclass(frozen=True)
class Transfer:
    """A transfer motion.

    Attributes:
        state: State at the start.
        q_start: Start. Shape (6,).
        q_goal: Goal. Shape (6,).
    """

    state: CellState
    q_start: Floats
    q_goal: Floats


def attach(model: CollisionModel, held: HeldObject) -> None:
    """Attach the held object in a collision model."""
    model.set_gripper_joints(held.joints_held)
    model.attach_object(held.name, held.tool, held.X_OG)


class Peers:
    """Plans the transfer motion of a problem with all planners; a worker for `map_ordered`."""

    def __init__(self) -> None:
        """Create the planners."""
        self._robot: RobotModel = load_robot(CELL.robot)
        self._config = PlannerConfig()
        self._planners = {
            name: PickPlacePlanner(CELL, PlannerConfig(optimize=optimize))
            for name, optimize in (("ours", False), ("ours, optimized", True))
        }

    def __call__(self, problem: dict[str, Any]) -> PeersRecord:
        """Return the results of a problem."""
        planner = self._planners["ours"]
        objects = to_objects(problem)
        plan = planner.plan(objects, problem["pick"], to_pose(problem["X_TO_place"]))
        if not isinstance(plan, PickPlacePlan):
            return PeersRecord({})
        model = planner.collision_model(objects)
        transfer = self._find_transfer(plan, CellState(tuple(self._robot.home), objects), model)
        if transfer is None:
            return PeersRecord({})
        results = {
            name: self._plan_ours(own, transfer, model) for name, own in self._planners.items()
        }
        limits = MotionLimits(CELL, plan.payload)
        peers: dict[str, Callable[[Transfer, CollisionModel, MotionLimits], CubicSpline | str]] = {
            "RRT-Connect": partial(self._plan_ompl, optimizes=False),
            "BIT*": partial(self._plan_ompl, optimizes=True),
            "KTO": self._plan_kto,
        }
        for name, peer in peers.items():
            held = transfer.state.held
            assert held is not None
            model.set_object_poses(transfer.state.objects)
            attach(model, held)
            start = time.process_time()
            trajectory = peer(transfer, model, limits)
            clearance = self._clearance(trajectory, model)
            seconds = time.process_time() - start
            if isinstance(trajectory, CubicSpline) and clearance < self._config.min_distance:
                trajectory = "in collision"
            results[name] = (
                TransferResult(trajectory, seconds)
                if isinstance(trajectory, str)
                else TransferResult("", seconds, trajectory.end_time, clearance)
            )
        return PeersRecord(results)

    def _find_transfer(
        self, plan: PickPlacePlan, home: CellState, model: CollisionModel
    ) -> Transfer | None:
        """Return the part of a carry without contacts; None if there is none."""
        held = HeldObject(
            plan.pick, plan.tool, plan.X_OG, plan.payload, 0.0, plan.joints_open, plan.joints_held
        )
        path = sample_path(CubicSpline.from_trajectory(plan.segments[1].trajectory), 0.01)
        attach(model, held)
        X_TG = rigid_transform(plan.X_TO_pick) @ plan.X_OG
        deflection = LoadDeflection.of(
            CELL.gripper,
            plan.tool,
            find_object(plan.start.objects, plan.pick).object_class,
            plan.X_OG.inverse(),
            X_TG.GetAsMatrix4(),
        )
        clearance = self._config.carry_clearance.of_load(deflection.displacement)
        distance = self._config.min_distance + clearance
        found = model.distances_along(path, distance + START_MARGIN)
        # The longest part that is clear of obstacles.
        near = np.array([-1, *np.unique(found.rows[~model.is_to_arm(found)]), len(path)])
        longest = int(np.diff(near).argmax())
        first, last = int(near[longest]) + 1, int(near[longest + 1]) - 1
        if last - first < MIN_TRANSFER_SAMPLES:
            return None
        tool = self._planners["ours"].tools[plan.tool]
        state = CellState(home.q, home.objects, held).moved(path[first], tool.pose(path[first]))
        return Transfer(state, path[first], path[last])

    def _plan_ours(
        self, planner: PickPlacePlanner, transfer: Transfer, model: CollisionModel
    ) -> TransferResult:
        planner.collision_model(transfer.state.objects)
        start = time.process_time()
        plan = planner.plan_move(transfer.state, transfer.q_goal.tolist())
        seconds = time.process_time() - start
        if isinstance(plan, PlanningFailure):
            return TransferResult(str(plan), seconds)
        trajectory = plan.steps[0].trajectory
        assert isinstance(trajectory, BsplineTrajectory)
        assert transfer.state.held is not None
        model.set_object_poses(transfer.state.objects)
        attach(model, transfer.state.held)
        clearance = self._clearance(CubicSpline.from_trajectory(trajectory), model)
        return TransferResult("", seconds, plan.duration, clearance)

    @staticmethod
    def _clearance(trajectory: CubicSpline | str, model: CollisionModel) -> float:
        """Return the smallest distance along a trajectory; NaN without one."""
        if isinstance(trajectory, str):
            return math.nan
        path = sample_path(trajectory, MAX_JOINT_STEP / 4)
        found = model.distances_along(path, INFLUENCE_DISTANCE)
        of_obstacles = found.distances[~model.is_to_arm(found)]
        return float(of_obstacles.min(initial=INFLUENCE_DISTANCE))

    def _plan_ompl(
        self, transfer: Transfer, model: CollisionModel, limits: MotionLimits, *, optimizes: bool
    ) -> CubicSpline | str:
        """Return a trajectory along a path of OMPL, or why there is none."""
        from ompl import base, geometric, util

        util.noOutputHandler()
        util.RNG.setSeed(1)
        origin = transfer.q_start
        goal_y = np.linalg.lstsq(VERTICAL_BASIS, transfer.q_goal - origin, rcond=None)[0]
        lower, upper = self._robot.position_limits.T
        space = base.RealVectorStateSpace(4)
        bounds = base.RealVectorBounds(4)
        for k in range(4):
            bounds.setLow(k, min(0.0, float(goal_y[k])) - SAMPLED_RANGE)
            bounds.setHigh(k, max(0.0, float(goal_y[k])) + SAMPLED_RANGE)
        space.setBounds(bounds)
        setup = geometric.SimpleSetup(space)

        def is_valid(state: Any) -> bool:
            q = origin + VERTICAL_BASIS @ [state[k] for k in range(4)]
            if (q < lower).any() or (q > upper).any():
                return False
            found = model.distances_along(q[None], self._config.min_distance + PEER_MARGIN)
            return not len(found.rows)

        setup.setStateValidityChecker(is_valid)
        space_information = setup.getSpaceInformation()
        resolution = MAX_JOINT_STEP / 4 / space.getMaximumExtent()
        space_information.setStateValidityCheckingResolution(resolution)
        start, goal = space.allocState(), space.allocState()
        for k in range(4):
            start[k], goal[k] = 0.0, float(goal_y[k])
        setup.setStartAndGoalStates(start, goal)
        planner = geometric.BITstar if optimizes else geometric.RRTConnect
        setup.setPlanner(planner(space_information))
        setup.solve(BIT_TIME if optimizes else MAX_RRT_TIME)
        if not setup.haveExactSolutionPath():
            return "no path"
        setup.simplifySolution(SIMPLIFICATION_TIME)
        y = np.array([[s[k] for k in range(4)] for s in setup.getSolutionPath().getStates()])
        vertices = origin + y @ VERTICAL_BASIS.T
        lines = [linear_joint_path(*ends) for ends in pairwise(vertices)]
        waypoints = np.vstack([lines[0], *(line[1:] for line in lines[1:])])
        trajectory = parameterize_time_optimal(bspline_path(waypoints), limits)
        return str(trajectory) if isinstance(trajectory, LimitViolation) else trajectory

    def _plan_kto(
        self, transfer: Transfer, model: CollisionModel, limits: MotionLimits
    ) -> CubicSpline | str:
        """Return a trajectory of Drake's trajectory optimization, or why there is none."""
        robot, n = self._robot, self._robot.num_joints
        q_start, q_goal = transfer.q_start, transfer.q_goal
        optimization = KinematicTrajectoryOptimization(n, KTO_POINTS, SPLINE_ORDER)
        program = optimization.get_mutable_prog()
        optimization.AddPositionBounds(*robot.position_limits.T)
        optimization.AddVelocityBounds(-robot.velocity_limits, robot.velocity_limits)
        optimization.AddAccelerationBounds(-robot.acceleration_limits, robot.acceleration_limits)
        optimization.AddJerkBounds(-robot.jerk_limits, robot.jerk_limits)
        optimization.AddDurationConstraint(0.1, 20.0)
        optimization.AddDurationCost(1.0)
        points = optimization.control_points()
        rows = robot.vertical_tool_rows
        assert rows is not None
        for k in range(KTO_POINTS):
            # Three equal control points at either end give zero velocity and acceleration.
            if k < SPLINE_ORDER - 1:
                program.AddBoundingBoxConstraint(q_start, q_start, points[:, k])
            elif k > KTO_POINTS - SPLINE_ORDER:
                program.AddBoundingBoxConstraint(q_goal, q_goal, points[:, k])
            else:
                program.AddLinearEqualityConstraint(rows, rows @ q_start, points[:, k])
        s = np.linspace(0.0, 1.0, KTO_SAMPLES + 2)[1:-1]
        weights = CubicSpline(clamped_knots(KTO_POINTS), np.eye(KTO_POINTS)).values(s)
        required = self._config.min_distance + PEER_MARGIN

        def distances(x: NDArray[Any]) -> NDArray[Any]:
            is_plain = x.dtype == float
            q = weights @ (x if is_plain else ExtractValue(x)).reshape(n, KTO_POINTS).T
            found = model.distances_along(q, INFLUENCE_DISTANCE, with_gradients=True)
            values = np.full(KTO_SAMPLES, INFLUENCE_DISTANCE)
            jacobian = np.zeros((KTO_SAMPLES, n, KTO_POINTS))
            for row, distance, gradient in zip(
                found.rows, found.distances, found.gradients, strict=True
            ):
                if distance < values[row] and np.abs(gradient).max() > 1e-6:
                    values[row] = distance
                    jacobian[row] = np.outer(gradient, weights[row])
            if is_plain:
                return values
            gradients = jacobian.reshape(KTO_SAMPLES, -1) @ ExtractGradient(x)
            return np.asarray(InitializeAutoDiff(values, gradients)).ravel()

        bound = np.full(KTO_SAMPLES, required)
        program.AddConstraint(distances, bound, np.full(KTO_SAMPLES, np.inf), points.ravel())
        line = np.linspace(q_start, q_goal, KTO_POINTS - 2 * (SPLINE_ORDER - 2))
        ends = SPLINE_ORDER - 2
        guess = np.vstack([[q_start] * ends, line, [q_goal] * ends])
        initial = CubicSpline(2.0 * clamped_knots(KTO_POINTS), guess).to_trajectory()
        optimization.SetInitialGuess(initial)
        solver = SnoptSolver()
        program.SetSolverOption(solver.id(), "Major iterations limit", KTO_MAX_ITERATIONS)
        result = solver.Solve(program)
        if not result.is_success():
            return "no solution"
        solution = CubicSpline.from_trajectory(optimization.ReconstructTrajectory(result))
        trajectory = scale_to_limits(solution, limits)
        return str(trajectory) if isinstance(trajectory, LimitViolation) else trajectory


def summarize(results: list[dict[str, Any]]) -> dict[str, Any]:
    """Return the results of one planner."""
    planned = [result for result in results if not result["failure"]]
    return {
        "planned": fraction(len(planned), len(results)),
        "failures": Counter(r["failure"].partition(":")[0] for r in results if r["failure"]),
        "seconds": quantiles([result["seconds"] for result in results]),
        "duration_s": quantiles([result["duration"] for result in planned]) if planned else None,
        "clearance_m": quantiles([r["clearance"] for r in planned]) if planned else None,
        "least_clearance_m": min((r["clearance"] for r in planned), default=None),
    }


def main(
    problems: ProblemsArgument,
    out: OutOption,
    count: Annotated[int, typer.Option(min=1, help="Number of problems.")] = 1000,
    workers: WorkersOption = 1,
) -> None:
    """Plan transfer motions with several planners."""
    found = load_problems(problems)[:count]
    with partial_records(out) as path:
        header = {"cell": to_plain(CELL), "planner": asdict(PlannerConfig())}
        records = collect_records(path, header, Peers, found, schema=PeersRecord, workers=workers)
    solved = [record["results"] for record in records if record["results"]]
    by_all = [part for part in solved if not any(r["failure"] for r in part.values())]
    rows = [
        {
            "planner": name,
            **summarize([part[name] for part in solved]),
            "duration_if_all_plan_s": quantiles([part[name]["duration"] for part in by_all])
            if by_all
            else None,
        }
        for name in (solved[0] if solved else ())
    ]
    command = f"benchmarks/planner_peers.py {problems.name} --count {count} --workers {workers}"
    fields = {"command": command, "count": len(solved), "planned_by_all": len(by_all)}
    write_results(out, fields | {"rows": rows})


if __name__ == "__main__":
    run_script(main)
