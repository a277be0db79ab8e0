"""The arm: random legal moves in stable RG scenes, planned and carried out; its parts; and the two ways to hold an object.

python benchmarks/pick_place.py moves --count 1000 --workers 2 --out benchmarks/results/arm_moves.json
python benchmarks/pick_place.py parts --count 20 --out benchmarks/results/arm_parts.json
python benchmarks/pick_place.py holds --count 20 --out benchmarks/results/arm_holds.json
"""

import math
import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any, TypeVar

import numpy as np
import typer
from rich.console import Console
from rich.progress import track

from drake_clutter.agents.generators import GenerationJob, SceneGenerator
from drake_clutter.cell.gripper import Payload
from drake_clutter.cell.work_cell import default_cell
from drake_clutter.config import ClutterConfig
from drake_clutter.files import cli_error_handler, write_json
from drake_clutter.perception.label_detector import LabelDetector
from drake_clutter.planning.pick_place_plan import PickPlacePlan, PlanningFailure
from drake_clutter.planning.pick_place_search import INFLUENCE_DISTANCE, MAX_REPORTED_DISTANCE
from drake_clutter.planning.planner_config import PlannerConfig
from drake_clutter.planning.time_parameterization import (
    bspline_path,
    parameterize_time_optimal,
    sample_path,
)
from drake_clutter.resources import git_commit
from drake_clutter.scenes.placement import resolve_placement
from drake_clutter.scenes.scene import Scene
from drake_clutter.seeding import item_rng
from drake_clutter.simulation.drake_judge import DrakeJudge
from drake_clutter.station.arm_executor import ArmExecutor, worst_instability
from drake_clutter.station.station_simulation import PickPlaceResult, StationSimulation
from drake_clutter.statistics import wilson_interval
from drake_clutter.tasks.belief import legal_moves
from drake_clutter.validation import to_plain
from drake_clutter.workers.parallel_map import map_ordered

Result = TypeVar("Result")

MOVES_PER_SCENE = 10
PLACED_WITHIN, TURNED_WITHIN, UNDISTURBED = 0.005, math.radians(3), 0.005
"""m, rad, m: what counts as carried out."""
WORLD = ClutterConfig()
console = Console(stderr=True)


@dataclass(frozen=True)
class Trial:
    """One move.

    Attributes:
        result: the reason why there is no plan, or what became of the plan.
        possible: whether some grasp reaches both ends without collision.
        object_class: of the picked object.
        sure_planning, planning: s, to plan the sure way, and with trajectory optimisation.
        sure_motion, motion: s, of both motions. shortened: names of the phases of which the optimised way is kept.
        wall: s, to build and simulate it.
        place_error: m. turn_error: rad. disturbed: m, of the object that was moved furthest. slip: m.
        tracking: rad.
        clearance: m, the least of the plan.
        unstable_anyway: whether what is left, or what it was put on, falls without an arm too.
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


def judged(carried: PickPlaceResult) -> str:
    """What became of a plan."""
    if not carried.grasped:
        return "not sealed"
    if not math.isnan(carried.drop_time):
        return "dropped"
    if max(carried.displacements.values(), default=0.0) > UNDISTURBED:
        return "disturbed others"
    return (
        "carried out"
        if carried.position_error < PLACED_WITHIN and carried.orientation_error < TURNED_WITHIN
        else "misplaced"
    )


def teleported_falls(scene: Scene, plan: PickPlacePlan) -> bool:
    """Whether the pile falls, or the object does not stay, when it is moved by teleport."""
    after = scene.with_poses({plan.pick: plan.X_TO_place})
    verdict = DrakeJudge(WORLD).judge(after, np.random.default_rng(0))
    strict = replace(WORLD.settle, max_displacement=UNDISTURBED, max_tilt_deg=3.0)
    return (
        not verdict.stable
        or worst_instability(after.objects, after.with_poses(verdict.settled), strict) is not None
    )


class Scenes:
    """Stable RG scenes, as they settle; the same for the same seed and number."""

    def __init__(self, nodes: int, seed: int) -> None:
        self._make = SceneGenerator(GenerationJob("random", "ycb7", None, nodes, seed, WORLD))
        self._judge, self._seed = DrakeJudge(WORLD), seed

    def __call__(self, number: int) -> Scene:
        """The one of a number."""
        rng = item_rng(self._seed, number)
        while True:
            scene, _ = self._make.lay_out(rng)
            verdict = self._judge.judge(scene, rng)
            if verdict.stable:
                return scene.with_poses(verdict.settled)


class Mover:
    """Tries random legal moves in a scene; a worker for the runner."""

    def __init__(self, nodes: int, seed: int) -> None:
        self._scenes, self._seed = Scenes(nodes, seed), seed
        self._detector, self._executor = LabelDetector(WORLD.cell.camera), ArmExecutor(WORLD)
        self._sure = ArmExecutor(WORLD, planner_config=PlannerConfig(optimize=False))

    def __call__(self, number: int) -> list[Trial]:
        """Moves in the scene of a number."""
        scene, rng = self._scenes(number), item_rng(self._seed, number, 1)
        observation = self._detector.perceive(scene).observation
        moves = legal_moves(observation)
        for executor in (self._executor, self._sure):
            executor.planner_for(scene.support).collision_model(
                scene.objects
            )  # as when moves follow each other
        return [
            self._tried(scene, moves[k], rng, observation)
            for k in rng.permutation(len(moves))[:MOVES_PER_SCENE]
        ]

    def _tried(self, scene: Scene, move: Any, rng: np.random.Generator, observation: Any) -> Trial:
        name = scene[move.pick].object_class.name
        command = resolve_placement(move, observation, WORLD.exploration, rng)
        if command is None:
            return Trial("no free spot", False, name, 0.0)
        planner, X_TO = self._executor.planner_for(scene.support), command.X_TO_place
        sure = self._sure.planner_for(scene.support).plan(scene.objects, move.pick, X_TO)
        plan = planner.plan(scene.objects, move.pick, X_TO)
        if isinstance(plan, PlanningFailure):
            return Trial(
                str(plan.reason.value),
                planner.are_endpoints_reachable(scene.objects, move.pick, X_TO),
                name,
                sure.planning_time,
            )
        begun = time.perf_counter()
        carried = StationSimulation(default_cell(), scene).execute(plan)
        wall, result = time.perf_counter() - begun, judged(carried)
        return Trial(
            result=result,
            possible=True,
            object_class=name,
            sure_planning=sure.planning_time,
            planning=plan.planning_time,
            sure_motion=plan.unoptimized_duration,
            motion=plan.duration,
            shortened=tuple(
                phase.name for phase in plan.segments if phase.duration < phase.unoptimized_duration
            ),
            wall=wall,
            place_error=carried.position_error,
            turn_error=carried.orientation_error,
            disturbed=max(carried.displacements.values(), default=0.0),
            slip=carried.slip,
            tracking=carried.max_tracking_error,
            clearance=min(phase.min_distance.distance for phase in plan.segments),
            unstable_anyway=result != "carried out" and teleported_falls(scene, plan),
        )


def quantiles(values: Sequence[float]) -> dict[str, float]:
    """Median, 95th and 99th percentile."""
    found = np.quantile(values, [0.5, 0.95, 0.99]) if len(values) else [math.nan] * 3
    return dict(zip(("p50", "p95", "p99"), map(float, found), strict=True))


def share(successes: int, count: int) -> dict[str, Any]:
    """With its 95 % interval."""
    return {
        "of": count,
        "share": successes / count if count else None,
        "interval": wilson_interval(successes, count),
    }


def moves(
    out: Annotated[Path, typer.Option(help="Results, JSON.")],
    count: Annotated[int, typer.Option(help="Moves.")] = 1000,
    nodes: Annotated[int, typer.Option(help="Size of the scenes' graphs.")] = 25,
    seed: Annotated[int, typer.Option(help="Same seed, same moves.")] = 0,
    workers: Annotated[int, typer.Option(help="Processes.")] = 1,
) -> None:
    """Plans and carries out random legal moves."""
    scenes = range(math.ceil(count / MOVES_PER_SCENE))
    done = map_ordered(partial(Mover, nodes, seed), scenes, workers=workers)
    trials = [
        trial for found in track(done, "scenes", len(scenes), console=console) for trial in found
    ][:count]
    planned = [t for t in trials if not math.isnan(t.motion)]
    fair = [t for t in planned if not t.unstable_anyway]
    good = sum(t.result == "carried out" for t in fair)
    fields = {
        "command": f"benchmarks/pick_place.py moves --count {count} --nodes {nodes} --seed {seed} --workers {workers}",
        "commit": git_commit(),
        "cell": to_plain(default_cell()),
        "planner": asdict(PlannerConfig()),
        "results": Counter(t.result for t in trials),
        "not_planned_by_class": Counter(
            f"{t.object_class}: {t.result}" for t in trials if math.isnan(t.motion)
        ),
        "planned_of_possible": share(len(planned), sum(t.possible for t in trials)),
        "carried_out_of_planned": share(
            sum(t.result == "carried out" for t in planned), len(planned)
        ),
        "carried_out_unless_unstable_anyway": share(good, len(fair)),
        "sure_planning_s": quantiles([t.sure_planning for t in planned]),
        "planning_s": quantiles([t.planning for t in planned]),
        "sure_motion_s": quantiles([t.sure_motion for t in planned]),
        "motion_s": quantiles([t.motion for t in planned]),
        "motion_of_sure": quantiles([t.motion / t.sure_motion for t in planned]),
        "optimised_carry_kept": share(sum("carry" in t.shortened for t in planned), len(planned)),
        "optimised_phases_kept": share(sum(len(t.shortened) for t in planned), 3 * len(planned)),
        "optimised_nothing_kept": share(sum(not t.shortened for t in planned), len(planned)),
        "simulation_wall_s": quantiles([t.wall for t in planned]),
        "place_error_m": quantiles([t.place_error for t in planned if t.result == "carried out"]),
        "slip_m": quantiles([t.slip for t in planned if not math.isnan(t.slip)]),
        "tracking_rad": quantiles([t.tracking for t in planned]),
        "least_clearance_m": min((t.clearance for t in planned), default=math.nan),
    }
    write_json(out, fields)
    console.print_json(data=fields)


def parts(
    out: Annotated[Path, typer.Option(help="Results, JSON.")],
    count: Annotated[int, typer.Option(help="Planned moves.")] = 20,
    seed: Annotated[int, typer.Option(help="Same seed, same moves.")] = 0,
) -> None:
    """Times the parts of planning and simulating a move, one by one, on one core."""
    detector, spent = LabelDetector(WORLD.cell.camera), dict[str, list[float]]()
    sure, executor, scenes = (
        ArmExecutor(WORLD, planner_config=PlannerConfig(optimize=False)),
        ArmExecutor(WORLD),
        Scenes(25, seed),
    )

    def timed_as(name: str, call: Callable[[], Result], of: int = 1) -> Result:
        begun = time.perf_counter()
        found = call()
        spent.setdefault(name, []).append((time.perf_counter() - begun) / of)
        return found

    def move_timed(number: int) -> bool:
        scene, rng = scenes(number), item_rng(seed, number, 1)
        observation = detector.perceive(scene).observation
        choices = legal_moves(observation)
        move = choices[rng.integers(len(choices))]
        command = resolve_placement(move, observation, WORLD.exploration, rng)
        if command is None:
            return False
        X_TO = command.X_TO_place
        planner, quick = executor.planner_for(scene.support), sure.planner_for(scene.support)
        timed_as("scene of distances", lambda: planner.collision_model(scene.objects))
        quick.collision_model(scene.objects)
        timed_as("sure plan", lambda: quick.plan(scene.objects, move.pick, X_TO))
        plan = timed_as("optimised plan", lambda: planner.plan(scene.objects, move.pick, X_TO))
        if not isinstance(plan, PickPlacePlan):
            spent["sure plan"].pop(), spent["optimised plan"].pop()
            return False
        around = planner.collision_model(scene.objects)
        q = sample_path(plan.segments[1].trajectory)
        poses = planner.tool.pose(q)
        timed_as(
            "forward kinematics of a pose", lambda: planner.tool.robot.forward_kinematics(q), len(q)
        )
        timed_as(
            "inverse kinematics of a pose, eight branches",
            lambda: planner.tool.solve_ik(poses),
            len(q),
        )
        timed_as(
            "distances at joint angles",
            lambda: [around.distances_below(at, MAX_REPORTED_DISTANCE) for at in q],
            len(q),
        )
        timed_as(
            "distances with gradients",
            lambda: [around.distances_and_gradients(at, INFLUENCE_DISTANCE) for at in q],
            len(q),
        )
        timed_as(
            "timing of a path without load",
            lambda: parameterize_time_optimal(bspline_path(q), default_cell(), Payload()),
        )
        simulation = timed_as("simulation, built", lambda: StationSimulation(default_cell(), scene))
        timed_as("simulation, run", lambda: simulation.execute(plan))
        return True

    number = done = 0
    while done < count:
        done += move_timed(number)
        number += 1
    fields = {
        "command": f"benchmarks/pick_place.py parts --count {count} --seed {seed}",
        "commit": git_commit(),
        "seconds": {name: quantiles(values) for name, values in spent.items()},
    }
    write_json(out, fields)
    console.print_json(data=fields)


def holds(
    out: Annotated[Path, typer.Option(help="Results, JSON.")],
    count: Annotated[int, typer.Option(help="Moves of each kind.")] = 20,
    seed: Annotated[int, typer.Option(help="Same seed, same moves.")] = 0,
) -> None:
    """Carries the same moves out with both ways to hold, of an object alone and in scenes of 25 nodes."""
    detector, executor, rows = (
        LabelDetector(WORLD.cell.camera),
        ArmExecutor(WORLD),
        list[dict[str, Any]](),
    )
    for kind, nodes in (("one object", 4), ("25 nodes", 25)):
        scenes, plans, number = Scenes(nodes, seed), list[tuple[Scene, PickPlacePlan]](), 0
        while len(plans) < count:
            scene, rng = scenes(number), item_rng(seed, number, 1)
            number += 1
            observation = detector.perceive(scene).observation
            choices = legal_moves(observation)
            move = choices[rng.integers(len(choices))]
            command = resolve_placement(move, observation, WORLD.exploration, rng)
            found = executor.plan(scene, command) if command else None
            if isinstance(found, PickPlacePlan):
                plans.append((scene, found))
        for hold, jointed in (("WeldGrasp", True), ("CompliantGrasp", False)):
            results, walls = list[PickPlaceResult](), list[float]()
            for scene, plan in track(plans, f"{kind}, {hold}", console=console):
                begun = time.perf_counter()
                name = plan.pick if jointed else ""
                simulation = StationSimulation(default_cell(), scene, weldable_object=name)
                results.append(simulation.execute(plan))
                walls.append(time.perf_counter() - begun)
            rows.append(
                {
                    "scenes": kind,
                    "hold": hold,
                    "moves": count,
                    "results": Counter(judged(c) for c in results),
                    "slip_m": quantiles([c.slip for c in results if not math.isnan(c.slip)]),
                    "place_error_m": quantiles([c.position_error for c in results]),
                    "wall_s": quantiles(walls),
                }
            )
    fields = {
        "command": f"benchmarks/pick_place.py holds --count {count} --seed {seed}",
        "commit": git_commit(),
        "rows": rows,
    }
    write_json(out, fields)
    console.print_json(data=fields)


if __name__ == "__main__":
    app = typer.Typer(add_completion=False)
    app.command()(moves)
    app.command()(parts)
    app.command()(holds)
    with cli_error_handler():
        app()
