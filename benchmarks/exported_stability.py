"""Measure whether exported stable scenes stay at rest in MuJoCo and PyBullet.

    python benchmarks/exported_stability.py FOLDER --workers 2 --out exported_stability.json

Takes shipped stable scenes of every generator at their settled poses, exports them, and simulates
each in both simulators. A scene stays if no object is ever farther than `MAX_DISPLACEMENT` from
where it was. FOLDER keeps the displacements; an interrupted run is resumed by the same command.
The exit code is 1 if less than `MIN_SHARE_AT_REST` of the scenes of a dataset stay.
"""

import tempfile
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Annotated

import mujoco
import numpy as np
import pybullet
import typer
from numpy.typing import NDArray
from pydantic import BaseModel

from benchmarks.measurement import describe_machine
from drake_clutter.catalog import load_catalog
from drake_clutter.config import ClutterConfig
from drake_clutter.export import ExportFormat, export_scene
from drake_clutter.export.sdf_writer import PYBULLET_FILE
from drake_clutter.scenes.scene import Scene
from drake_clutter.scenes.scene_dataset import load_scene_dataset
from drake_clutter.statistics import wilson_interval
from drake_clutter.validation import CountOrZero, Finite
from training.results_file import ResultsFile, Row, collect_records
from training.script import SCENES, ResultsOption, WorkersOption, print_table, run_script

DATASETS = ("rg_25", "hill_climbing_25", "sg_25", "sg_star_25", "sg_14")
"""One dataset of each generator."""
MAX_DISPLACEMENT = 0.010
"""Largest displacement of an object that counts as at rest [m]."""
MIN_SHARE_AT_REST = 0.97
"""Share of the scenes of a dataset that are to stay in each simulator."""
DURATION = 10.0
"""Simulated time [s]."""
SAMPLE_PERIOD = 0.1
"""Time between two measurements of the displacements [s]."""
PYBULLET_TIME_STEP = 0.001
"""Time step of PyBullet [s].

With its default of 1/240 s, the solver does not converge for heavy stacks on lying markers.
"""
PYBULLET_ITERATIONS = 100
"""Iterations of PyBullet's solver in a step; its default is 50."""


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
    pybullet.connect(pybullet.DIRECT)
    try:
        with tempfile.TemporaryDirectory() as folder:
            path = export_scene(scene, ExportFormat.SDF, Path(folder)).with_name(PYBULLET_FILE)
            _, *objects = pybullet.loadSDF(str(path))
        pybullet.setGravity(0, 0, -9.81)
        pybullet.setTimeStep(PYBULLET_TIME_STEP)
        pybullet.setPhysicsEngineParameter(numSolverIterations=PYBULLET_ITERATIONS)

        def advance() -> None:
            for _ in range(round(SAMPLE_PERIOD / PYBULLET_TIME_STEP)):
                pybullet.stepSimulation()

        def positions() -> NDArray[np.float64]:
            return np.array([pybullet.getBasePositionAndOrientation(body)[0] for body in objects])

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
HEADER = {
    "max_displacement_mm": 1000 * MAX_DISPLACEMENT,
    "duration_s": DURATION,
    "pybullet_time_step_s": PYBULLET_TIME_STEP,
    "pybullet_solver_iterations": PYBULLET_ITERATIONS,
}
"""What all measurements have in common."""


class Displacement(BaseModel):
    """Record of one simulation; see `SceneSimulation`."""

    index: CountOrZero
    displacement_mm: Finite


class SceneSimulation:
    """Simulates scenes of a dataset; a worker for `map_ordered`."""

    def __init__(self, name: str, simulator: str) -> None:
        """Load the dataset.

        Args:
            name: Name of the dataset.
            simulator: Key of `SIMULATORS`.
        """
        self._dataset = load_scene_dataset(SCENES / f"{name}.json", load_catalog())
        self._simulate = SIMULATORS[simulator]

    def __call__(self, index: int) -> Row:
        """Return the record of the scene of an index.

        Returns:
            index: Index of the scene in its dataset.
            displacement_mm: Largest displacement of an object [mm].
        """
        scene = self._dataset.settled_scene(index, self._dataset.grammar, ClutterConfig())
        displacement = self._simulate(scene, DURATION)
        return {"index": index, "displacement_mm": round(1000 * displacement, 3)}


def measure(name: str, simulator: str, count: int, folder: Path, workers: int) -> Row:
    """Return how many scenes of a dataset stay at rest in a simulator.

    Args:
        name: Name of the dataset.
        simulator: Key of `SIMULATORS`.
        count: Number of scenes, the first of the dataset.
        folder: Folder of the record files.
        workers: Number of processes.
    """
    dataset = load_scene_dataset(SCENES / f"{name}.json", load_catalog())
    records = collect_records(
        folder / f"{name}_{simulator}.jsonl",
        HEADER | {"sha256": dataset.sha256, "simulator": simulator},
        partial(SceneSimulation, name, simulator),
        range(count),
        schema=Displacement,
        workers=workers,
    )
    displacements = [record["displacement_mm"] for record in records]
    num_at_rest = sum(displacement <= 1000 * MAX_DISPLACEMENT for displacement in displacements)
    return {
        "dataset": name,
        "sha256": dataset.sha256,
        "agent": dataset.metadata["agent"],
        "seed": dataset.metadata["seed"],
        "simulator": simulator,
        "scenes": count,
        "at_rest": num_at_rest,
        "at_rest_share": num_at_rest / count,
        "at_rest_ci95": wilson_interval(num_at_rest, count),
        "displacements_mm": displacements,
        **describe_machine(simulator),
        # Of the simulations, which an interrupted run may have made earlier.
        "software_version": records[-1]["software_version"],
        "commit": records[-1]["commit"],
    }


def main(
    folder: Annotated[Path, typer.Argument(metavar="FOLDER", help="Folder of the record files.")],
    count: Annotated[int, typer.Option(min=1, max=100, help="Scenes of each dataset.")] = 100,
    workers: WorkersOption = 1,
    out: ResultsOption = None,
) -> None:
    """Simulate the scenes of all datasets in both simulators."""
    rows = [
        measure(name, simulator, count, folder, workers)
        for simulator in SIMULATORS
        for name in DATASETS
    ]
    if out:
        ResultsFile(out, HEADER, ("dataset", "simulator")).add(*rows)
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
    if min(row["at_rest_share"] for row in rows) < MIN_SHARE_AT_REST:
        raise typer.Exit(1)


if __name__ == "__main__":
    run_script(main)
