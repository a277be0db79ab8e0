"""The page docs/results/target_search.md."""

from collections.abc import Mapping
from typing import Any

from markdown_text import estimate, number, section, table
from results_files import policy_name, read_training_results

PUBLISHED = (
    (
        "X-Ray (Danielczuk et al. 2020)",
        "0.82",
        "heaps of 15 objects in a bin, overhead depth images; the target is also grasped",
    ),
    (
        "LAX-RAY (Huang et al. 2021)",
        "0.873",
        "objects side by side on a shelf, seen from the front, pushed aside",
    ),
    (
        "StAX-RAY (Huang et al. 2022)",
        "0.82 to 1.00",
        "stacks on a shelf, seen from the front, moved by blade and suction cup",
    ),
)
"""Method, success rate in simulation, and what differs, as their abstracts state them."""
_HEAD = ["targets", "policy", "episodes", "revealed", "of the solvable", "collapsed", "moves"]
_HEAD += ["moves / oracle", "within 1.25 of the oracle", "moves / area"]


def _row(row: Mapping[str, Any]) -> list[str]:
    solvable = row["solvable"]
    is_area = row["agent"] == "area-reduction"
    return [
        row["set"],
        policy_name(row["agent"]),
        str(row["episodes"]),
        estimate(row, "revealed", "revealed_ci95"),
        number(solvable["revealed"]),
        number(row["collapsed"]),
        estimate(row, "moves", "moves_ci95", 1),
        estimate(row["to_oracle"], "ratio", "ci95"),
        number(solvable["efficient"]),
        "" if is_area else estimate(row["to_area"], "ratio", "ci95"),
    ]


def page() -> str:
    """Return the page."""
    results = read_training_results("target_search.json")
    rows = sorted(results["rows"], key=lambda row: str(row["set"]))
    text = "# Search for one object\n\n"
    text += section(
        "Frozen targets",
        "A hidden object of each scene of a frozen dataset is looked for, at most 20 moves; Drake "
        "settles every move. The policy is told the object's class. *Oracle*: the fewest moves "
        "that reveal the object, from the true state. *Of the solvable*: pairs that the oracle "
        "solves. *Moves*: mean over the revealed. *Moves / oracle*: over the revealed "
        "solvable pairs. *Within 1.25 of the oracle*: fraction of the solvable pairs that are "
        "revealed with at most 1.25 times the oracle's moves. *Moves / area*: ratio to the area "
        "policy, over the pairs that both reveal. Intervals are 95 %.",
        command="python training/evaluate_target_search.py",
        seed=results["seed"],
        results=["training/results/target_search.json"],
    )
    text += table(_HEAD, [_row(row) for row in rows])
    text += (
        "\nThe oracle knows where the object is, the other policies do not: a search of stacks "
        "that are equally promising needs more moves than a plan.\n\n"
        "## Published searches\n\nSuccess rates in simulation, on tasks that differ.\n\n"
    )
    ours = [
        (
            f"{policy_name(row['agent'])}, {row['set']}",
            number(row["revealed"]),
            "stacks on a tray, poses of visible objects known, moved by pick and place; the target "
            "is revealed",
        )
        for row in rows
        if row["agent"] not in ("random", "full-knowledge")
    ]
    return text + table(["method", "success", "scenes"], [*PUBLISHED, *ours])
