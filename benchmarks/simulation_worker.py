"""Process of `simulation_speed.py` that simulates moves with the package of a checkout.

Reads a line per move from standard input, the scene and the fields of a plan, and writes a line of
JSON with the result to standard output.
"""

import base64
import json
import pickle
import sys
import time
from dataclasses import fields
from typing import Any

from drake_clutter.cell.work_cell import default_cell
from drake_clutter.planning.pick_place_plan import PickPlacePlan
from drake_clutter.station import station_simulation


def simulate(move: dict[str, str]) -> dict[str, Any]:
    """Simulate a move, as `ArmExecutor` does in this checkout.

    Args:
        move: Pickled scene and pickled fields of the plan by name, in base 64. A checkout reads the
            fields that its plans have.
    """
    names = [field.name for field in fields(PickPlacePlan)]
    values = {name: pickle.loads(base64.b64decode(move[name])) for name in ["scene", *names]}
    scene = values.pop("scene")
    plan = PickPlacePlan(**values)
    wall, cpu = time.perf_counter(), time.process_time()
    if hasattr(station_simulation, "simulate_plan"):
        result = station_simulation.simulate_plan(default_cell(), scene, plan)
    else:
        result = station_simulation.StationSimulation(default_cell(), scene).execute(plan)
    return {
        "wall": time.perf_counter() - wall,
        "cpu": time.process_time() - cpu,
        "positions": {name: list(X_TO.translation) for name, X_TO in result.poses.items()},
        "tracking": result.max_tracking_error,
        "uneventful": not result.lost_object
        and result.position_error < 0.005
        and max(result.displacements.values(), default=0.0) < 0.005,
    }


if __name__ == "__main__":
    for line in sys.stdin:
        print(json.dumps(simulate(json.loads(line))), flush=True)
