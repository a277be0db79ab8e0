"""Pick objects that lean on others and put them down flat: planned and carried-out shares.

    python benchmarks/tilted_picks.py --count 300 --seed 51 --out tilted_picks.json

An object is laid against another one at a random tilt and settles. Scenes in which it comes to rest
tilted by 5 to 30 degrees count, if the other one stays in its place without it: a lying can may be
wedged by what leans on it. An interrupted run is resumed by the same command.
"""

import math
from collections import Counter
from dataclasses import asdict, dataclass
from functools import partial
from typing import Annotated, Any

import numpy as np
import typer
from scipy.spatial.transform import Rotation

from benchmarks.pick_place import (
    CARRIED_OUT,
    CONFIG,
    OutOption,
    execution_result,
    fraction,
    is_unstable_when_teleported,
    write_results,
)
from drake_clutter.catalog import ObjectClass, load_catalog
from drake_clutter.cell.work_cell import default_cell
from drake_clutter.perception.label_detector import LabelDetector
from drake_clutter.planning.pick_place_plan import PickPlacePlan
from drake_clutter.planning.place_check import resting_tilt
from drake_clutter.planning.planner_config import PlannerConfig
from drake_clutter.records import partial_records
from drake_clutter.scenes.interfaces import Move
from drake_clutter.scenes.placement import resolve_placement
from drake_clutter.scenes.scene import Pose, Scene, SceneObject
from drake_clutter.seeding import item_rng
from drake_clutter.simulation.drake_judge import DrakeJudge
from drake_clutter.station.arm_executor import ArmExecutor
from drake_clutter.station.station_simulation import StationSimulation
from drake_clutter.validation import to_plain
from training.results_file import collect_records
from training.script import SeedOption, WorkersOption, run_script

MIN_TILT_DEG = 5.0
"""Smallest tilt of the picked object [deg]."""
MAX_TILT_DEG = 30.0
"""Largest tilt of the picked object [deg]."""
MAX_SUPPORT_DISPLACEMENT = 0.0025
"""Largest displacement of the other object without the leaning one, with the judge's offset [m]."""
LEANING, SUPPORT = "leaning", "support"
"""Names of the picked object and of what it leans on."""


@dataclass(frozen=True)
class TiltedPick:
    """Record of a pick.

    Attributes:
        object_class: Class of the picked object.
        tilt_deg: Its tilt [deg].
        planned: Whether there is a plan.
        possible: Whether some grasp reaches both endpoints without collision.
        result: Why there is no plan, or how its execution ended.
        unstable_anyway: Whether a teleported move makes the scene unstable, too.
    """

    object_class: str
    tilt_deg: float
    planned: bool
    possible: bool
    result: str
    unstable_anyway: bool = False


def lower_onto(object_class: ObjectClass, R: np.ndarray[Any, Any], xy: Any, bottom: float) -> Pose:
    """Return the pose of an orientation at which the lowest point has a height.

    Args:
        object_class: Class of the object.
        R: Orientation. Shape (3, 3).
        xy: Horizontal position [m]. Shape (2,).
        bottom: Height of the lowest point [m].
    """
    z = bottom - float((object_class.corners @ R.T)[:, 2].min())
    return Pose.from_rotation(R, (*xy, z))


class TiltedPicker:
    """Samples a leaning object, plans and simulates its pick; a worker for `map_ordered`."""

    def __init__(self, seed: int) -> None:
        """Create judge, detector and executor.

        Args:
            seed: Seed of the scenes.
        """
        self._seed = seed
        self._judge = DrakeJudge(CONFIG)
        self._detector = LabelDetector(CONFIG.cell.camera)
        self._executor = ArmExecutor(CONFIG)
        self._classes = load_catalog().object_set("ycb7")

    def sample_scene(self, rng: np.random.Generator) -> tuple[Scene, float]:
        """Return a scene at rest and the tilt of its leaning object [rad]."""
        while True:
            leaning, support = (self._classes[k] for k in rng.integers(len(self._classes), size=2))
            rests = [Rotation.from_euler("x", 90, degrees=True), Rotation.identity()]
            rests.append(Rotation.from_euler("y", 90, degrees=True))
            turn = Rotation.from_euler("z", rng.uniform(-math.pi, math.pi))
            R_support = (turn * rests[rng.integers(3)]).as_matrix()
            below = lower_onto(support, R_support, (0.0, 0.0), 0.001)
            angle = rng.uniform(-math.pi, math.pi)
            tilt = math.radians(rng.uniform(MIN_TILT_DEG, MAX_TILT_DEG))
            # It slopes away from the support, on whose edge its raised end comes down.
            axis = np.array([-math.sin(angle), math.cos(angle), 0.0])
            lean = Rotation.from_rotvec(tilt * axis)
            R = (lean * Rotation.from_euler("z", angle) * rests[rng.integers(3)]).as_matrix()
            offset = rng.uniform(0.4, 1.0) * (max(leaning.size) + min(support.size)) / 2
            xy = offset * np.array([math.cos(angle), math.sin(angle)])
            objects = (
                SceneObject(SUPPORT, support, below),
                SceneObject(LEANING, leaning, lower_onto(leaning, R, xy, 0.002)),
            )
            highest = SceneObject(SUPPORT, support, below).top_height
            scene = Scene(objects, CONFIG.cell.support)
            lowest = objects[1].bounds_T[0][2]
            if objects[1].top_height < highest + lowest:
                continue
            settled = scene.with_poses(self._judge.judge(scene, rng).settled)
            verdict = self._judge.judge(settled, rng)
            at_rest = settled.with_poses(verdict.settled)
            found = resting_tilt(leaning, at_rest[LEANING].X_TO.rotation)
            if not verdict.stable or not MIN_TILT_DEG <= math.degrees(found) <= MAX_TILT_DEG:
                continue
            alone = self._judge.judge(Scene((at_rest[SUPPORT],), scene.support), rng)
            moved = alone.settled[SUPPORT].p - at_rest[SUPPORT].X_TO.p
            if alone.stable and float(np.linalg.norm(moved)) < MAX_SUPPORT_DISPLACEMENT:
                return at_rest, found

    def __call__(self, number: int) -> TiltedPick:
        """Return the record of a number."""
        rng = item_rng(self._seed, number)
        scene, tilt = self.sample_scene(rng)
        name = scene[LEANING].object_class.name
        degrees = round(math.degrees(tilt), 2)
        observation = self._detector.perceive(scene).observation
        command = resolve_placement(Move(LEANING), observation, CONFIG.exploration, rng)
        if command is None:
            return TiltedPick(name, degrees, False, False, "no free spot")
        planner = self._executor.planner_for(scene.support)
        arguments = (scene.objects, LEANING, command.X_TO_place)
        plan = planner.plan(*arguments)
        if not isinstance(plan, PickPlacePlan):
            is_possible = planner.are_endpoints_reachable(*arguments)
            return TiltedPick(name, degrees, False, is_possible, plan.reason.value)
        result = execution_result(StationSimulation(default_cell(), scene).execute(plan))
        unstable = result != CARRIED_OUT and is_unstable_when_teleported(scene, plan)
        return TiltedPick(name, degrees, True, True, result, unstable)


def main(
    out: OutOption,
    count: Annotated[int, typer.Option(min=1, help="Number of picks.")] = 300,
    seed: SeedOption = 51,
    workers: WorkersOption = 1,
) -> None:
    """Pick objects that lean on others."""
    header = {"seed": seed, "config": to_plain(CONFIG), "planner": asdict(PlannerConfig())}
    with partial_records(out) as path:
        records = collect_records(
            path,
            header,
            partial(TiltedPicker, seed),
            range(count),
            schema=TiltedPick,
            workers=workers,
        )
        planned = [record for record in records if record["planned"]]
        carried_out = [record for record in planned if record["result"] == CARRIED_OUT]
        command = f"benchmarks/tilted_picks.py --count {count} --seed {seed} --workers {workers}"
        fields = {
            "command": command,
            "count": count,
            **header,
            "planned_of_possible": fraction(
                len(planned), sum(record["possible"] for record in records)
            ),
            "carried_out_of_planned": fraction(len(carried_out), len(planned)),
            "carried_out_unless_unstable_anyway": fraction(
                len(carried_out), sum(not record["unstable_anyway"] for record in planned)
            ),
            "results": Counter(record["result"] for record in records),
            "by_class": Counter(f"{r['object_class']}: {r['result']}" for r in records),
        }
        write_results(out, fields)


if __name__ == "__main__":
    run_script(main)
