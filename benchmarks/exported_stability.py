"""Measure whether exported stable scenes stay at rest in MuJoCo and PyBullet.

    python benchmarks/exported_stability.py --out exported_stability.json

Takes shipped stable scenes of every generator at their settled poses, exports them, and simulates
each in both simulators. A scene stays if no object is ever farther than `MAX_DISPLACEMENT` from
where it was. An interrupted run is resumed by the same command.
"""

import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import mujoco
import numpy as np
import pybullet
import typer
from numpy.typing import NDArray

from benchmarks.measurement import describe_machine
from benchmarks.pybullet_world import TIME_STEP, load_world
from drake_clutter.catalog import load_catalog
from drake_clutter.config import ClutterConfig
from drake_clutter.export import ExportFormat, export_scene
from drake_clutter.scenes.scene import Scene
from drake_clutter.scenes.scene_dataset import load_scene_dataset
from drake_clutter.statistics import wilson_interval
from training.results_file import ResultsFile, Row, provenance
from training.script import SCENES, print_table, progress, run_script

DATASETS = ("rg_25", "sg_star_25", "sg_14")
"""One dataset of each generator."""
MAX_DISPLACEMENT = 0.010
"""Largest displacement of an object that counts as at rest [m]."""
DURATION = 10.0
"""Simulated time [s]."""
SAMPLE_PERIOD = 0.1
"""Time between two measurements of the displacements [s]."""
SOLVER_ITERATIONS = 200
"""Iterations of PyBullet's solver in a step. Its default of 50 does not hold tall stacks."""


def simulate_mujoco(scene: Scene, duration: float) -> float:
    """Return the largest displacement of an object in MuJoCo [m]."""
    with tempfile.TemporaryDirectory() as folder:
        path = export_scene(scene, ExportFormat.MJCF, Path(folder))
        model = mujoco.MjModel.from_xml_path(str(path))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    bodies = [model.body(name).id for name in scene.names]
    return _max_displacement(
        lambda: mujoco.mj_step(model, data, round(SAMPLE_PERIOD / model.opt.timestep)),
        lambda: np.array(data.xpos[bodies]),
        duration,
    )


def simulate_pybullet(scene: Scene, duration: float) -> float:
    """Return the largest displacement of an object in PyBullet [m]."""
    with tempfile.TemporaryDirectory() as folder:
        load_world(export_scene(scene, ExportFormat.SDF, Path(folder)))
    pybullet.setPhysicsEngineParameter(numSolverIterations=SOLVER_ITERATIONS)

    def advance() -> None:
        for _ in range(round(SAMPLE_PERIOD / TIME_STEP)):
            pybullet.stepSimulation()

    def positions() -> NDArray[np.float64]:
        bodies = range(1, 1 + len(scene.objects))  # Body 0 is the tray.
        return np.array([pybullet.getBasePositionAndOrientation(body)[0] for body in bodies])

    try:
        return _max_displacement(advance, positions, duration)
    finally:
        pybullet.disconnect()


def _max_displacement(
    advance: Callable[[], None], positions: Callable[[], NDArray[np.float64]], duration: float
) -> float:
    """Return the largest displacement of an object during a simulation [m].

    Args:
        advance: Advances the simulation by `SAMPLE_PERIOD`.
        positions: Returns the positions of all objects [m]. Shape (n, 3).
        duration: Simulated time [s].
    """
    start = positions()
    largest = 0.0
    for _ in range(round(duration / SAMPLE_PERIOD)):
        advance()
        largest = max(largest, float(np.linalg.norm(positions() - start, axis=1).max()))
    return largest


SIMULATORS = {"mujoco": simulate_mujoco, "pybullet": simulate_pybullet}
"""Simulations by the name of the simulator's package."""


def measure(name: str, simulator: str, count: int) -> Row:
    """Return how many scenes of a dataset stay at rest in a simulator.

    Args:
        name: Name of the dataset.
        simulator: Key of `SIMULATORS`.
        count: Number of scenes, the first of the dataset.
    """
    dataset = load_scene_dataset(SCENES / f"{name}.json", load_catalog())
    grammar = dataset.grammar
    config = ClutterConfig()
    displacements = [
        SIMULATORS[simulator](dataset.settled_scene(index, grammar, config), DURATION)
        for index in progress(range(count), f"{name} in {simulator}")
    ]
    stays = [displacement <= MAX_DISPLACEMENT for displacement in displacements]
    return {
        "dataset": name,
        "sha256": dataset.sha256,
        "agent": dataset.metadata["agent"],
        "seed": dataset.metadata["seed"],
        "simulator": simulator,
        "scenes": count,
        "at_rest": sum(stays),
        "at_rest_share": sum(stays) / count,
        "at_rest_ci95": wilson_interval(sum(stays), count),
        "displacements_mm": [round(1000 * d, 3) for d in displacements],
        **describe_machine(simulator),
        **provenance(),
    }


def main(
    count: Annotated[int, typer.Option(min=1, max=100, help="Scenes of each dataset.")] = 100,
    out: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Results file to write (JSON).")
    ] = None,
) -> None:
    """Simulate the scenes of all datasets in both simulators."""
    header = {
        "max_displacement_mm": 1000 * MAX_DISPLACEMENT,
        "duration_s": DURATION,
        "pybullet_time_step_s": TIME_STEP,
        "pybullet_solver_iterations": SOLVER_ITERATIONS,
    }
    results = ResultsFile(out, header, ("dataset", "simulator", "scenes")) if out else None
    rows = []
    for name in DATASETS:
        for simulator in SIMULATORS:
            key = {"dataset": name, "simulator": simulator, "scenes": count}
            row = results.find(key) if results else None
            if row is None:
                row = measure(name, simulator, count)
                if results:
                    results.add(row)
            rows.append(row)
    print_table(
        [
            {
                "dataset": row["dataset"],
                "generator": row["agent"],
                "simulator": row["simulator"],
                "scenes": row["scenes"],
                "at rest": f"{row['at_rest_share']:.2f}",
            }
            for row in rows
        ]
    )


if __name__ == "__main__":
    run_script(main)
