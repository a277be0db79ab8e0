"""Measure the planning and the simulation of pick-and-place moves.

    python benchmarks/pick_place.py moves --count 1000 --workers 2 --out moves.json
    python benchmarks/pick_place.py timing --count 20 --out timing.json
    python benchmarks/pick_place.py grasp-constraints --count 20 --out grasp_constraints.json

The moves are random legal moves in stable scenes of the random generator. An interrupted `moves`
is resumed by the same command; the other two, which measure times, start again.
"""

import itertools
import math
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from rich.console import Console

from benchmarks.measurement import Stopwatch
from drake_clutter.agents.generators import GenerationJob, SceneGenerator
from drake_clutter.cell.gripper import Payload
from drake_clutter.cell.work_cell import default_cell
from drake_clutter.config import ClutterConfig
from drake_clutter.files import write_json
from drake_clutter.perception.label_detector import LabelDetector
from drake_clutter.planning.cubic_spline import CubicSpline
from drake_clutter.planning.motion_limits import MotionLimits
from drake_clutter.planning.pick_place_plan import PickPlacePlan, PlanningFailure
from drake_clutter.planning.planner_config import PlannerConfig
from drake_clutter.planning.segment_check import MAX_REPORTED_DISTANCE
from drake_clutter.planning.time_parameterization import (
    bspline_path,
    parameterize_time_optimal,
    sample_path,
)
from drake_clutter.planning.trajectory_optimization import INFLUENCE_DISTANCE
from drake_clutter.records import partial_records
from drake_clutter.scenes.interfaces import Move, Observation, PickPlaceCommand
from drake_clutter.scenes.placement import resolve_placement
from drake_clutter.scenes.scene import Scene
from drake_clutter.seeding import item_rng
from drake_clutter.simulation.drake_judge import DrakeJudge
from drake_clutter.station.arm_executor import ArmExecutor, worst_instability
from drake_clutter.station.grasp_constraint import WeldPair
from drake_clutter.station.station_simulation import (
    PickPlaceResult,
    StationSimulation,
    simulate_plan,
)
from drake_clutter.statistics import wilson_interval
from drake_clutter.tasks.belief import legal_moves
from drake_clutter.validation import to_plain
from training.results_file import collect_records, provenance
from training.script import SeedOption, WorkersOption, progress, run_script

OutOption = Annotated[Path, typer.Option(metavar="FILE", help="Results file to write (JSON).")]

MOVES_PER_SCENE = 10
"""Number of moves that are tried in each scene."""
NODES = 25
"""Number of nodes of the scene graphs."""
MAX_POSITION_ERROR = 0.005
"""Largest error of the final position with which a move counts as carried out [m]."""
MAX_ORIENTATION_ERROR = math.radians(3)
"""Likewise of the final orientation [rad]."""
MAX_DISTURBANCE = 0.005
"""Likewise of the displacement of the other objects [m]."""
CARRIED_OUT = "carried out"
"""Result of a move that meets these three limits."""
CONFIG = ClutterConfig()
"""Configuration of the scenes and the work cell."""


@dataclass(frozen=True)
class Trial:
    """One move.

    Attributes:
        result: Why there is no plan, or how its execution ended.
        possible: Whether some grasp reaches both endpoints without collision.
        object_class: Class of the picked object.
        sure_planning: Planning time without trajectory optimization [s].
        planning: Planning time with trajectory optimization [s].
        sure_motion: Duration of the motion before trajectory optimization [s].
        motion: Duration of the motion [s].
        shortened: Names of the segments that trajectory optimization made shorter.
        wall: Wall-clock time of the simulation with its construction [s].
        place_error: Error of the final position [m].
        turn_error: Error of the final orientation [rad].
        disturbed: Largest displacement of another object [m].
        slip: Largest displacement of the object in the gripper [m].
        tracking: Largest tracking error of a joint [rad].
        clearance: Least distance between the plan and its surroundings [m].
        unstable_anyway: Whether a teleported move makes the scene unstable, too.
    """

    result: str
    possible: bool
    object_class: str
    sure_planning: float
    planning: float = math.nan
    sure_motion: float = math.nan
    motion: float = math.nan
    shortened: tuple[str, ...] = ()
    wall: float = math.nan
    place_error: float = math.nan
    turn_error: float = math.nan
    disturbed: float = math.nan
    slip: float = math.nan
    tracking: float = math.nan
    clearance: float = math.nan
    unstable_anyway: bool = False


@dataclass(frozen=True)
class SceneTrials:
    """Record of a scene.

    Attributes:
        trials: Its moves.
    """

    trials: tuple[Trial, ...]


def execution_result(result: PickPlaceResult) -> str:
    """Return how the execution of a plan ended."""
    if not result.grasped:
        return "not sealed"
    if not math.isnan(result.drop_time):
        return "dropped"
    if max(result.displacements.values(), default=0.0) > MAX_DISTURBANCE:
        return "disturbed others"
    is_position_right = result.position_error < MAX_POSITION_ERROR
    is_orientation_right = result.orientation_error < MAX_ORIENTATION_ERROR
    return CARRIED_OUT if is_position_right and is_orientation_right else "misplaced"


def is_unstable_when_teleported(scene: Scene, plan: PickPlacePlan) -> bool:
    """Return whether the scene is unstable, or the object moves, after a teleported move."""
    after = scene.with_poses({plan.pick: plan.X_TO_place})
    verdict = DrakeJudge(CONFIG).judge(after, np.random.default_rng(0))
    strict = replace(CONFIG.settle, max_displacement=MAX_DISTURBANCE, max_tilt_deg=3.0)
    settled = after.with_poses(verdict.settled)
    return not verdict.stable or worst_instability(after.objects, settled, strict) is not None


class StableScenes:
    """Stable scenes of the random generator, at rest."""

    def __init__(self, nodes: int, seed: int) -> None:
        """Create the generator and the judge.

        Args:
            nodes: Number of nodes of the scene graphs.
            seed: Seed of the scenes.
        """
        job = GenerationJob("random", "ycb7", None, nodes, seed, CONFIG)
        self._generator = SceneGenerator(job)
        self._judge = DrakeJudge(CONFIG)
        self._seed = seed

    def __call__(self, number: int) -> Scene:
        """Return the scene of a number."""
        rng = item_rng(self._seed, number)
        while True:
            scene, _ = self._generator.lay_out(rng)
            verdict = self._judge.judge(scene, rng)
            if verdict.stable:
                return scene.with_poses(verdict.settled)


@dataclass(frozen=True)
class SampledMove:
    """A random legal move.

    Attributes:
        scene: The scene.
        command: The move with its placement.
    """

    scene: Scene
    command: PickPlaceCommand

    @property
    def arguments(self) -> tuple[Any, ...]:
        """Arguments of the planner's methods."""
        return self.scene.objects, self.command.move.pick, self.command.X_TO_place


class MoveSampler:
    """Samples one legal move in each stable scene."""

    def __init__(self, nodes: int, seed: int) -> None:
        """Create the scenes and the detector.

        Args:
            nodes: Number of nodes of the scene graphs.
            seed: Seed of the scenes and moves.
        """
        self._scenes = StableScenes(nodes, seed)
        self._detector = LabelDetector(CONFIG.cell.camera)
        self._seed = seed

    def __call__(self, number: int) -> SampledMove | None:
        """Return the move in the scene of a number; None if it has no free placement."""
        scene, rng = self._scenes(number), item_rng(self._seed, number, 1)
        observation = self._detector.perceive(scene).observation
        moves = legal_moves(observation)
        move = moves[rng.integers(len(moves))]
        command = resolve_placement(move, observation, CONFIG.exploration, rng)
        return None if command is None else SampledMove(scene, command)


class MoveTester:
    """Tests random legal moves in a scene; a worker for `map_ordered`."""

    def __init__(self, nodes: int, seed: int) -> None:
        """Create the scenes, the detector and the executors.

        Args:
            nodes: Number of nodes of the scene graphs.
            seed: Seed of the scenes and moves.
        """
        self._scenes = StableScenes(nodes, seed)
        self._seed = seed
        self._detector = LabelDetector(CONFIG.cell.camera)
        self._executor = ArmExecutor(CONFIG)
        self._unoptimized = ArmExecutor(CONFIG, planner_config=PlannerConfig(optimize=False))

    def __call__(self, number: int) -> SceneTrials:
        """Return the trials in the scene of a number."""
        scene, rng = self._scenes(number), item_rng(self._seed, number, 1)
        observation = self._detector.perceive(scene).observation
        moves = legal_moves(observation)
        for executor in (self._executor, self._unoptimized):
            # The model is cached, as in an episode: it does not count as planning time.
            executor.planner_for(scene.support).collision_model(scene.objects)
        order = rng.permutation(len(moves))[:MOVES_PER_SCENE]
        return SceneTrials(tuple(self._test(scene, moves[k], rng, observation) for k in order))

    def _test(
        self, scene: Scene, move: Move, rng: np.random.Generator, observation: Observation
    ) -> Trial:
        name = scene[move.pick].object_class.name
        command = resolve_placement(move, observation, CONFIG.exploration, rng)
        if command is None:
            return Trial("no free spot", False, name, 0.0)
        planner = self._executor.planner_for(scene.support)
        unoptimized_planner = self._unoptimized.planner_for(scene.support)
        arguments = (scene.objects, move.pick, command.X_TO_place)
        unoptimized = unoptimized_planner.plan(*arguments)
        plan = planner.plan(*arguments)
        if isinstance(plan, PlanningFailure):
            is_possible = planner.are_endpoints_reachable(*arguments)
            return Trial(str(plan.reason.value), is_possible, name, unoptimized.planning_time)
        start = time.perf_counter()
        execution = simulate_plan(default_cell(), scene, plan)
        wall = time.perf_counter() - start
        result = execution_result(execution)
        return Trial(
            result=result,
            possible=True,
            object_class=name,
            sure_planning=unoptimized.planning_time,
            planning=plan.planning_time,
            sure_motion=plan.unoptimized_duration,
            motion=plan.duration,
            shortened=tuple(
                segment.name
                for segment in plan.segments
                if segment.duration < segment.unoptimized_duration
            ),
            wall=wall,
            place_error=execution.position_error,
            turn_error=execution.orientation_error,
            disturbed=max(execution.displacements.values(), default=0.0),
            slip=execution.slip,
            tracking=execution.max_tracking_error,
            clearance=min(segment.min_distance.distance for segment in plan.segments),
            unstable_anyway=result != CARRIED_OUT and is_unstable_when_teleported(scene, plan),
        )


def quantiles(values: Sequence[float]) -> dict[str, float]:
    """Return the median, 95th and 99th percentile."""
    percentiles = np.quantile(values, [0.5, 0.95, 0.99]) if len(values) else [math.nan] * 3
    return dict(zip(("p50", "p95", "p99"), map(float, percentiles), strict=True))


def fraction(successes: int, count: int) -> dict[str, Any]:
    """Return a fraction with its 95 % interval."""
    return {
        "of": count,
        "fraction": successes / count if count else None,
        "interval": wilson_interval(successes, count),
    }


def write_results(out: Path, fields: dict[str, Any]) -> None:
    """Write and print results."""
    results = fields | provenance()
    write_json(out, results)
    Console(stderr=True).print_json(data=results)


def moves(
    out: OutOption,
    count: Annotated[int, typer.Option(min=1, help="Number of moves.")] = 1000,
    nodes: Annotated[int, typer.Option(min=3, help="Number of nodes of the scene graphs.")] = NODES,
    seed: SeedOption = 0,
    workers: WorkersOption = 1,
) -> None:
    """Plan and simulate random legal moves."""
    numbers = range(math.ceil(count / MOVES_PER_SCENE))
    setting = {"cell": to_plain(default_cell()), "planner": asdict(PlannerConfig())}
    with partial_records(out) as path:
        header = {"nodes": nodes, "seed": seed, "config": to_plain(CONFIG), **setting}
        make_worker = partial(MoveTester, nodes, seed)
        records = collect_records(
            path, header, make_worker, numbers, schema=SceneTrials, workers=workers
        )
        trials = [Trial(**trial) for record in records for trial in record["trials"]]
        command = f"moves --count {count} --nodes {nodes} --seed {seed} --workers {workers}"
        fields = {"command": f"benchmarks/pick_place.py {command}", "seed": seed, "count": count}
        write_results(out, fields | setting | summarize_trials(trials[:count]))


def summarize_trials(trials: Sequence[Trial]) -> dict[str, Any]:
    """Return the results of moves."""
    planned = [t for t in trials if not math.isnan(t.motion)]
    carried_out = [t for t in planned if t.result == CARRIED_OUT]
    fair = [t for t in planned if not t.unstable_anyway]
    num_shorter_segments = sum(len(t.shortened) for t in planned)
    return {
        "results": Counter(t.result for t in trials),
        "not_planned_by_class": Counter(
            f"{t.object_class}: {t.result}" for t in trials if math.isnan(t.motion)
        ),
        "planned_of_possible": fraction(len(planned), sum(t.possible for t in trials)),
        "carried_out_of_planned": fraction(len(carried_out), len(planned)),
        "carried_out_unless_unstable_anyway": fraction(len(carried_out), len(fair)),
        "sure_planning_s": quantiles([t.sure_planning for t in planned]),
        "planning_s": quantiles([t.planning for t in planned]),
        "sure_motion_s": quantiles([t.sure_motion for t in planned]),
        "motion_s": quantiles([t.motion for t in planned]),
        "motion_of_sure": quantiles([t.motion / t.sure_motion for t in planned]),
        "optimised_carry_kept": fraction(
            sum("carry" in t.shortened for t in planned), len(planned)
        ),
        "optimised_phases_kept": fraction(num_shorter_segments, 3 * len(planned)),
        "optimised_nothing_kept": fraction(sum(not t.shortened for t in planned), len(planned)),
        "simulation_wall_s": quantiles([t.wall for t in planned]),
        "place_error_m": quantiles([t.place_error for t in carried_out]),
        "slip_m": quantiles([t.slip for t in planned if not math.isnan(t.slip)]),
        "tracking_rad": quantiles([t.tracking for t in planned]),
        "least_clearance_m": min((t.clearance for t in planned), default=math.nan),
    }


def timing(
    out: OutOption,
    count: Annotated[int, typer.Option(min=1, help="Number of planned moves.")] = 20,
    seed: SeedOption = 0,
) -> None:
    """Time the parts of planning and simulating a move, on one core."""
    sample_move = MoveSampler(NODES, seed)
    executor = ArmExecutor(CONFIG)
    unoptimized = ArmExecutor(CONFIG, planner_config=PlannerConfig(optimize=False))
    stopwatch = Stopwatch()
    unloaded = MotionLimits(default_cell(), Payload())

    def measure_move(number: int) -> bool:
        """Measure the move of a number; return whether there is a plan."""
        move = sample_move(number)
        if move is None:
            return False
        scene = move.scene
        planner = executor.planner_for(scene.support)
        unoptimized_planner = unoptimized.planner_for(scene.support)
        unoptimized_planner.collision_model(scene.objects)
        model = stopwatch.measure(
            "scene of distances", lambda: planner.collision_model(scene.objects)
        )
        stopwatch.measure("sure plan", lambda: unoptimized_planner.plan(*move.arguments))
        plan = stopwatch.measure("optimised plan", lambda: planner.plan(*move.arguments))
        if not isinstance(plan, PickPlacePlan):
            stopwatch.seconds["sure plan"].pop()
            stopwatch.seconds["optimised plan"].pop()
            return False
        q = sample_path(CubicSpline.from_trajectory(plan.segments[1].trajectory))
        tool = planner.tools[plan.tool]
        poses = tool.pose(q)
        stopwatch.measure(
            "forward kinematics of a pose", lambda: planner.robot.forward_kinematics(q), len(q)
        )
        stopwatch.measure(
            "inverse kinematics of a pose, eight branches",
            lambda: tool.solve_ik(poses),
            len(q),
        )
        stopwatch.measure(
            "distances at joint angles",
            lambda: [model.distances_below(at, MAX_REPORTED_DISTANCE) for at in q],
            len(q),
        )
        stopwatch.measure(
            "distances with gradients",
            lambda: [model.distances_and_gradients(at, INFLUENCE_DISTANCE) for at in q],
            len(q),
        )
        stopwatch.measure(
            "timing of a path without load",
            lambda: parameterize_time_optimal(bspline_path(q), unloaded),
        )
        stopwatch.measure(
            "simulation, built", lambda: StationSimulation(default_cell(), scene).release()
        )
        stopwatch.measure("simulation, run", lambda: simulate_plan(default_cell(), scene, plan))
        return True

    measured = filter(measure_move, itertools.count())
    for _ in progress(itertools.islice(measured, count), "moves", count):
        pass
    seconds = {name: quantiles(values) for name, values in stopwatch.seconds.items()}
    command = f"benchmarks/pick_place.py timing --count {count} --seed {seed}"
    write_results(out, {"command": command, "seed": seed, "count": count, "seconds": seconds})


def grasp_constraints(
    out: OutOption,
    count: Annotated[int, typer.Option(min=1, help="Number of moves of each kind.")] = 20,
    seed: SeedOption = 0,
) -> None:
    """Simulate moves with both grasp constraints, in scenes of one object and of 25 nodes."""
    executor = ArmExecutor(CONFIG)
    rows = list[dict[str, Any]]()
    for kind, nodes in (("one object", 4), ("25 nodes", NODES)):
        sample_move = MoveSampler(nodes, seed)
        moves = filter(None, map(sample_move, itertools.count()))
        planned = ((move.scene, executor.plan(move.scene, move.command)) for move in moves)
        found = ((scene, plan) for scene, plan in planned if isinstance(plan, PickPlacePlan))
        plans = list(progress(itertools.islice(found, count), f"{kind}, plans", count))
        for constraint in ("WeldGrasp", "CompliantGrasp"):
            results = list[PickPlaceResult]()
            walls = list[float]()
            for scene, plan in progress(plans, f"{kind}, {constraint}"):
                start = time.perf_counter()
                weld = WeldPair(plan.pick, plan.tool) if constraint == "WeldGrasp" else None
                simulation = StationSimulation(default_cell(), scene, weld=weld)
                results.append(simulation.execute(plan))
                walls.append(time.perf_counter() - start)
            rows.append(
                {
                    "scenes": kind,
                    "hold": constraint,
                    "moves": count,
                    "results": Counter(execution_result(result) for result in results),
                    "slip_m": quantiles([r.slip for r in results if not math.isnan(r.slip)]),
                    "place_error_m": quantiles([r.position_error for r in results]),
                    "wall_s": quantiles(walls),
                }
            )
    command = f"benchmarks/pick_place.py grasp-constraints --count {count} --seed {seed}"
    write_results(out, {"command": command, "seed": seed, "count": count, "rows": rows})


if __name__ == "__main__":
    run_script(moves, timing, grasp_constraints)
