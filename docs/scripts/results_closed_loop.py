"""The page docs/results/closed_loop.md."""

from typing import Any

from markdown_text import estimate, number, quantiles, section, table
from results_files import (
    TRAINING,
    has_benchmark_results,
    read_benchmark_results,
    read_episodes,
    read_training_results,
)

FAILURES = {
    "what is left lies behind what no cup holds": "remaining objects unreachable by suction"
}
"""Current wording of reasons in results files of version 0.1."""
SPEED = "closed_loop_speed.json"
"""Results file of `benchmarks/closed_loop_speed.py`."""
_SETUP = ["dataset", "perception", "motion", "cups", "episodes"]


def _setup(row: dict[str, Any]) -> list[str]:
    cups = "" if row["motion"] != "arm" else "2" if row.get("cell") == "two_cups" else "1"
    return [row["scenes"], row["perception"], row["motion"], cups, str(row["episodes"])]


def failures_text(row: dict[str, Any]) -> str:
    """Return the numbers of failed episodes by reason."""
    reasons = row["failed_of"].items()
    return (
        ", ".join(f"{count} {FAILURES.get(reason, reason)}" for reason, count in reasons) or "none"
    )


def _episodes() -> str:
    rows = read_training_results("closed_loop.json")["rows"]
    text = section(
        "Success rates",
        "Episodes of at most 20 moves on frozen scenes that neither policy nor detector was "
        "trained on. *Motion*: the arm in the Drake Diagram, or teleported objects settled by "
        "Drake. "
        "*Cups*: of the tool, one of 25 mm, or another of 6 mm beside it. "
        "Rows with one cup and those without an arm were recorded with the placement rule "
        "*outermost* ([exploration](exploration.md)), bellows that do not bend, and carries "
        "without clearance from hidden objects, and their images are drawn by VTK; those of two "
        "cups by the raster renderer ([rendering](../explanation/rendering.md)). "
        "*Reachable by suction*: fraction of the scenes in which no object stays hidden behind "
        "objects that no cup can hold. Intervals are 95 %.",
        command="python training/evaluate_closed_loop.py runs/closed_loop --workers 2",
        seed="number of the scene",
        results=["training/results/closed_loop.json", "training/results/closed_loop/"],
    )
    head = [*_SETUP, "success", "reachable by suction", "success of these", "failures"]
    text += table(
        head,
        [
            [
                *_setup(row),
                estimate(row, "success", "success_ci95"),
                number(row["arm_can"]),
                estimate(row, "success_of_arm_can", "success_of_arm_can_ci95"),
                failures_text(row),
            ]
            for row in rows
        ],
    )
    text += (
        "\n### Objects found and times\n\n"
        "*Recall*, *precision*: of the belief, matched by class and position, when all "
        "objects have been in view. *Moves*: mean over the successes. *Robot time*: simulated "
        "motion, median. *Wall time*: per episode, median, of the version that recorded the "
        "row, on two cores shared with other work.\n\n"
    )
    head = [*_SETUP, "fraction found", "recall", "precision", "moves"]
    return text + table(
        [*head, "robot time [min]", "wall time [s]"],
        [
            [
                *_setup(row),
                number(row["found_of_hidden"]),
                number(row.get("list_recall")),
                number(row.get("list_precision")),
                number(row["moves_of_successes"], 1),
                number(row["robot_minutes"], 1) if row["motion"] == "arm" else "",
                number(row["wall_seconds"], 0),
            ]
            for row in rows
        ],
    )


def _speed() -> str:
    results = read_benchmark_results(SPEED)
    text = section(
        "Wall time and its parts",
        "Scenes of sg_star_25 from number 60 on, two cups, one process, nothing else on the "
        "machine. The other columns are shares of the time of all episodes; *simulation* is "
        "steps of the diagram and of motions that are simulated apart.",
        command=f"python {results['command']} --out FILE",
        seed="number of the scene",
        results=[f"benchmarks/results/{SPEED}"],
    )
    parts = [*results["rows"][0]["shares"]]
    return text + table(
        ["perception", "episodes", "moves, median", "wall time, median / 95th [s]", *parts],
        [
            [
                row["perception"],
                str(row["episodes"]),
                number(row["moves"]["p50"], 0),
                quantiles(row["wall_s"], 1),
                *(number(row["shares"][part]) for part in parts),
            ]
            for row in results["rows"]
        ],
    )


def page() -> str:
    """Return the page."""
    intro = (
        "# Closed loop\n\n"
        "Camera images in, arm motion out, in one Drake Diagram "
        "([closed loop](../explanation/closed_loop.md)). *labels*: perfect detections; *depth*, "
        "*depth-color*: the shipped detectors on noisy images.\n\n"
    )
    sections = [_episodes()]
    if has_benchmark_results(SPEED):
        sections.append(_speed())
    return intro + "\n".join(sections)


def closed_loop_episodes(name: str) -> dict[int, dict[str, Any]]:
    """Return the episodes of a run of training/results/closed_loop, by number of the scene."""
    path = TRAINING / f"closed_loop/{name}.jsonl.gz"
    return {episode["number"]: episode for episode in read_episodes(path)}
