"""The page docs/results/export.md."""

import statistics

from markdown_text import estimate, number, section, table
from results_files import read_benchmark_results

SIMULATORS = {"mujoco": "MuJoCo", "pybullet": "PyBullet"}
"""Names of the simulators, by their names in the results file."""


def page() -> str:
    """Return the page."""
    results = read_benchmark_results("exported_stability.json")
    text = section(
        "Stable scenes in other simulators",
        "Frozen stable scenes of every generator at their settled poses, exported and simulated "
        f"for {results['duration_s']:g} s. *At rest*: no object is ever farther than "
        f"{results['max_displacement_mm']:g} mm from where it was. *Displacement*: median over the "
        f"scenes of the largest displacement. PyBullet: {results['pybullet_solver_iterations']} "
        f"solver iterations, time step {1000 * results['pybullet_time_step_s']:g} ms. Intervals "
        "are 95 %.",
        command="python benchmarks/exported_stability.py FOLDER --workers 2 --out FILE",
        seed=", ".join(str(seed) for seed in sorted({row["seed"] for row in results["rows"]})),
        results=["benchmarks/results/exported_stability.json"],
    )
    text += table(
        ["scenes", "generator", "simulator", "count", "at rest", "displacement [mm]"],
        [
            [
                row["dataset"],
                row["agent"],
                SIMULATORS[row["simulator"]],
                str(row["scenes"]),
                estimate(row, "at_rest_share", "at_rest_ci95"),
                number(statistics.median(row["displacements_mm"])),
            ]
            for row in results["rows"]
        ],
    )
    return (
        "# Exported scenes\n\nHow exported scenes behave in other simulators "
        "([how to export](../how_to/export_scenes.md)).\n\n" + text
    )
