"""Process that plans pick-and-place problems with the `drake_clutter` of one checkout.

    python benchmarks/planning_worker.py

Each line of the standard input is a problem of `planning_problems.py`; each line of the output is
its result. The process imports nothing else of this folder, so that `planning_speed.py` can run it
with the package of another checkout.
"""

import json
import math
import sys
import time
from typing import Any

from drake_clutter.catalog import load_catalog
from drake_clutter.cell.work_cell import default_cell
from drake_clutter.planning.pick_place_plan import PickPlacePlan
from drake_clutter.planning.pick_place_planner import PickPlacePlanner
from drake_clutter.planning.planner_config import PlannerConfig
from drake_clutter.scenes.scene import Pose, SceneObject


def to_pose(document: dict[str, Any]) -> Pose:
    """Return a pose of a problem."""
    x, y, z = document["translation"]
    qw, qx, qy, qz = document["quaternion"]
    return Pose((x, y, z), (qw, qx, qy, qz))


def to_objects(document: dict[str, Any]) -> tuple[SceneObject, ...]:
    """Return the objects of a problem."""
    classes = load_catalog().classes
    return tuple(
        SceneObject(o["name"], classes[o["object_class"]], to_pose(o["X_TO"]))
        for o in document["objects"]
    )


class Worker:
    """Plans problems without and with trajectory optimization."""

    def __init__(self) -> None:
        """Create the planners."""
        self._planners = {
            name: PickPlacePlanner(default_cell(), PlannerConfig(optimize=optimize))
            for name, optimize in (("unoptimized", False), ("optimized", True))
        }

    def __call__(self, problem: dict[str, Any]) -> dict[str, dict[str, Any]]:
        """Return the results of a problem.

        Returns:
            Reason of the failure or an empty string, CPU time [s], and of a plan its duration [s]
            and smallest distance [m], by the name of the planner.
        """
        objects, X_TO_place = to_objects(problem), to_pose(problem["X_TO_place"])
        results = {}
        for name, planner in self._planners.items():
            planner.collision_model(objects)
            start = time.process_time()
            plan = planner.plan(objects, problem["pick"], X_TO_place)
            seconds = time.process_time() - start
            planned = plan if isinstance(plan, PickPlacePlan) else None
            distances = [s.min_distance.distance for s in planned.segments] if planned else []
            results[name] = {
                "failure": "" if planned else str(plan),
                "seconds": seconds,
                "duration": planned.duration if planned else math.nan,
                "min_distance": min(distances, default=math.nan),
            }
        return results


if __name__ == "__main__":
    worker = Worker()
    for line in sys.stdin:
        sys.stdout.write(json.dumps(worker(json.loads(line))) + "\n")
        sys.stdout.flush()
