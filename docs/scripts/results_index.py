"""The page docs/results/index.md."""

from typing import Any

from markdown_text import estimate, number, table
from results_exploration import PAPER as PAPER_POLICIES
from results_files import read_benchmark_results, read_training_results
from results_generation import PAPER as PAPER_GENERATORS

PAGES = (
    ("generation.md", "Scene generation", "Stability, hidden objects and diversity of generators"),
    ("exploration.md", "Exploration", "Success rates and moves of exploration policies"),
    ("target_search.md", "Search for one object", "Moves until a hidden object is seen"),
    ("closed_loop.md", "Closed loop", "Success rates with images and the arm"),
    ("arm.md", "Arm", "Planning and execution of pick-and-place moves"),
    ("perception.md", "Perception", "Recall and accuracy of the trained detectors"),
    ("rendering.md", "Rendering", "Compiled renderer compared with Drake's"),
    ("judge_agreement.md", "Judge agreement", "Static stability judge compared with Drake; speed"),
    ("calibration.md", "Calibration", "Random scenes compared with the paper's"),
    ("intervals.md", "Confidence intervals", "Methods, and their coverage for few values"),
    ("export.md", "Exported scenes", "Stable scenes and recorded motions in other simulators"),
    ("feasibility.md", "Feasibility studies", "Inverse reachability map compared with the planner"),
    (
        "recording.md",
        "Recording",
        "Moves per hour with and without images, and where the time goes",
    ),
    ("mutation_testing.md", "Mutation testing", "Small faults of the code that the tests catch"),
    ("negative_results.md", "Negative results", "What did not help"),
)
"""File, title and content of the other pages of results."""


def _row(rows: list[dict[str, Any]], **values: Any) -> dict[str, Any]:
    return next(row for row in rows if all(row.get(key) == value for key, value in values.items()))


def _headlines() -> list[list[str]]:
    scenes = read_training_results("table1.json")["rows"]
    generator = _row(scenes, agent="sg-star", nodes=25, temperature=None)
    hidden, stable = PAPER_GENERATORS["sg-star", "ycb7"][25]
    policies = read_training_results("table2.json")["rows"]
    student = _row(policies, agent="student", set="paper_hardness")
    rule = _row(policies, agent="largest-clear", set="paper_hardness")
    success, _ = PAPER_POLICIES["paper_hardness"]["student"]
    loop = _row(
        read_training_results("closed_loop.json")["rows"],
        scenes="sg_star_25",
        perception="depth",
        motion="arm",
        cell="two_cups",
    )
    detector = read_training_results("detector_depth.json")["rows"]["sg_star_25"]
    judges = read_benchmark_results("judges.json")["scenes"][0]
    return [
        [
            "Stable scenes of SG\\*, 25 nodes",
            estimate(generator, "stability_rate", "stability_ci95"),
            number(stable),
        ],
        [
            "Hidden objects per stable scene of SG\\*, 25 nodes",
            estimate(generator, "hidden_mean", "hidden_ci95", 1),
            number(hidden),
        ],
        [
            "Success of the student in 10 moves, scenes as hard as the paper's",
            estimate(student["within_10"], "success", "success_ci95"),
            number(success),
        ],
        [
            "Success of the best rule-based policy, the same scenes",
            estimate(rule["within_10"], "success", "success_ci95"),
            "",
        ],
        [
            "Success of the closed loop with depth images and arm, all scenes",
            estimate(loop, "success", "success_ci95"),
            "",
        ],
        [
            "Recall of the depth detector, objects in view",
            estimate(detector["in_view"], "recall", "ci95"),
            "",
        ],
        [
            "Verdicts of the static judge equal to Drake's, 25 nodes",
            estimate(judges, "agreement", "agreement_ci95", 3),
            "",
        ],
    ]


def page() -> str:
    """Return the page."""
    return (
        "# Results\n\nThe measurements on these pages are read from results files in "
        "`training/results/` and `benchmarks/results/`; each section names its command, seed and "
        "files. [Intervals](intervals.md) are 95 %; those of mean numbers of hidden "
        "objects are of the normal approximation.\n\n"
        + table(
            ["page", "content"],
            [[f"[{title}]({file})", content] for file, title, content in PAGES],
        )
        + "\n## Summary\n\n"
        + table(["measurement", "this package", "paper"], _headlines())
        + "\nHow to repeat the measurements: "
        "[reproduce the results](../how_to/reproduce_results.md).\n"
    )
