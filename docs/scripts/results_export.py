"""The page docs/results/export.md."""

import statistics

from markdown_text import estimate, number, section, table
from results_files import has_benchmark_results, read_benchmark_results

SIMULATORS = {"mujoco": "MuJoCo", "pybullet": "PyBullet"}
"""Names of the simulators, by their names in the results file."""
MOTION = "mujoco_motion.json"
"""Results file of recorded motions in MuJoCo."""
CONTROLS = {
    "station": "positions, velocities and torques",
    "delayed": "the same, one time step of Drake later",
    "positions only": "positions",
}
"""What is commanded, by the controls of the results file."""


def _motions() -> str:
    results = read_benchmark_results(MOTION)
    text = section(
        "Recorded motions in MuJoCo",
        "Random collision-free motions of the UR10 over two tool poses above the empty tray, "
        f"recorded in Drake at {results['rate_hz']:g} Hz and commanded in MuJoCo with the exported "
        "cell. *Deviation*: distance of the tools at the same time. *Same end*: the tools end "
        f"within {results['max_final_deviation_mm']:g} mm. Drake's implicit position control "
        "follows its command by one time step of 2.5 ms.",
        command="python " + results["command"] + " --out FILE",
        seed=results["seed"],
        results=[f"benchmarks/results/{MOTION}"],
    )
    header = ["commanded", "motions", "same end"]
    header += ["end, median [mm]", "end, largest [mm]", "way, median [mm]", "way, largest [mm]"]
    rows = [
        [
            CONTROLS[row["control"]],
            str(row["same_end"]["of"]),
            number(row["same_end"]["fraction"]),
            *(
                f"{row[key][statistic]:.4g}"
                for key in ("final_mm", "max_mm")
                for statistic in ("median", "max")
            ),
        ]
        for row in results["rows"]
    ]
    return text + table(header, rows)


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
    if has_benchmark_results(MOTION):
        text += "\n" + _motions()
    return (
        "# Exported scenes\n\nHow exported scenes behave in other simulators "
        "([how to export](../how_to/export_scenes.md)).\n\n" + text
    )
