"""The page docs/results/calibration.md."""

from collections.abc import Mapping
from typing import Any

from markdown_text import estimate, number, section, table
from results_files import read_benchmark_results
from results_generation import PAPER

SETTINGS = {
    "no early stop, 2.5 s": "no early stop, 2.5 s",
    "calm, or 2 s": "early stop by speed alone, without the displacement criterion",
    "1 ms steps": "time step 1 ms",
    "4 ms steps": "time step 4 ms",
    "other random offsets": "other random offsets",
}
"""Names of settings of the settling, by their names in the results file."""
EXPLORED = {
    'standing pairs 40 mm apart; "at rest" still by instantaneous speed (5 mm/s)': (
        "40",
        "speed below 5 mm/s",
    ),
    "standing pairs 40 mm apart; at rest by drift over 0.5 s": ("40", "displacement over 0.5 s"),
    "as A, 60 mm apart": ("60", "displacement over 0.5 s"),
    "as A, 20 mm apart": ("20", "displacement over 0.5 s"),
    "as A, and the marker lies in all ten orientations": (
        "40",
        "displacement over 0.5 s; marker always lying",
    ),
}
"""Gap of standing pairs [mm] and rest criterion, by the description in the results file."""


def _scenes() -> str:
    results = read_benchmark_results("calibration.json")
    text = section(
        "Random scenes and the paper's",
        "RG scenes judged by Drake; *hidden* is the mean number of hidden objects in a stable "
        "scene. *Paper*: Table I of Kumar et al. 2022. "
        "[Intervals](intervals.md) are 95 %, of *hidden* by the normal approximation.",
        command="python benchmarks/random_generator_calibration.py --count 1000 --workers 2 --out "
        "FILE",
        seed=results["seed"],
        results=["benchmarks/results/calibration.json"],
    )
    rows = results["rows"]
    text += table(
        ["nodes", "scenes", "stable", "paper", "hidden", "paper"],
        [_scene_row(row) for row in rows],
    )
    thresholds = [*rows[0]["hidden_by_threshold"]]
    text += (
        "\n### Visibility threshold\n\nMean number of hidden objects in a stable scene, by the "
        "fraction of its pixels below which an object counts as hidden (default 0.3).\n\n"
    )
    return text + table(
        ["nodes", *(f"below {float(threshold):g}" for threshold in thresholds)],
        [
            [str(row["nodes"]), *(number(row["hidden_by_threshold"][t]) for t in thresholds)]
            for row in rows
        ],
    )


def _scene_row(row: Mapping[str, Any]) -> list[str]:
    hidden, stable = PAPER["random", "ycb7"][row["nodes"]]
    return [
        str(row["nodes"]),
        str(row["count"]),
        estimate(row, "stability_rate", "stability_ci95"),
        number(stable),
        estimate(row, "hidden_mean", "hidden_ci95"),
        number(hidden),
    ]


def _settings() -> str:
    results = read_benchmark_results("settle_settings.json")
    text = section(
        "Settings of the settling",
        f"Verdicts on {results['count']} RG stacks of at least two objects, compared with the "
        "default settings.",
        command="python benchmarks/settle_sensitivity.py --count 100 --out FILE",
        seed=results["seed"],
        results=["benchmarks/results/settle_settings.json"],
    )
    text += table(
        ["setting", "verdicts equal"],
        [
            [SETTINGS[row["setting"]], number(row["agreement"], 3)]
            for row in results["settings"]
            if row["setting"] in SETTINGS
        ],
    )
    text += (
        "\n### Stacks on lying cylinders\n\nStacks that rest on lying markers, settled for the "
        "full "
        "time with rolling resistance.\n\n"
    )
    return text + table(
        ["support", "stacks", "stable"],
        [
            [
                f"{name} of lying markers" if name == "pair" else f"{name} lying marker",
                str(row["stacks"]),
                str(row["stable"]),
            ]
            for name, row in results["on_lying_markers"].items()
        ],
    )


def _explored() -> str:
    rows = read_benchmark_results("calibration_explored.json")
    text = section(
        "Explored parameters",
        "Exploratory runs on RG scenes before the parameters were fixed; the final gap of standing "
        "pairs, 50 mm, was not among them.",
        seed=1,
        results=["benchmarks/results/calibration_explored.json"],
    )
    return text + table(
        ["gap of standing pairs [mm]", "rest criterion", "nodes", "scenes", "stable", "hidden"],
        [
            [
                *EXPLORED[row["tried"]],
                str(row["nodes"]),
                str(row["count"]),
                estimate(row, "stability_rate", "stability_ci95"),
                estimate(row, "hidden_mean", "hidden_ci95"),
            ]
            for row in rows
        ],
    )


def page() -> str:
    """Return the page."""
    intro = (
        "# Calibration\n\nDifficulty of random scenes compared with the paper, and sensitivity of "
        "the verdicts ([why the defaults are what they are](../explanation/calibration.md)). "
        "Intervals of means are those of the [normal approximation](intervals.md).\n\n"
    )
    return intro + "\n".join([_scenes(), _settings(), _explored()])
