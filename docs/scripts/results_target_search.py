"""The page docs/results/target_search.md."""

from collections.abc import Mapping
from typing import Any

from markdown_text import estimate, number, section, table
from results_files import has_training_results, policy_name, read_training_results

FILES = {
    "target_search.json": ("Moves settled in Drake", "Drake settles every move."),
    "target_search_static.json": (
        "Moves by the static model",
        "Moves have the fidelity `static_or_drake`: static equilibrium decides about stability, or "
        "Drake where that is inconclusive.",
    ),
}
"""Heading and fidelity of the measurements by results file; a file that is missing is left out."""
PUBLISHED = (
    (
        "[X-Ray](https://sites.google.com/berkeley.edu/x-ray) (Danielczuk et al. 2020)",
        "0.82",
        "1,000 heaps of 15 objects in a bin, seen from above, poses not known; the target, which "
        "may be partly visible at the start, is extracted",
    ),
    (
        "[LAX-RAY](https://sites.google.com/berkeley.edu/lax-ray) (Huang et al. 2021), best of "
        "three policies: DER-MT, two steps of prediction",
        "0.873",
        "800 shelves of upright objects, seen from the front, pushed aside; the target is revealed",
    ),
    (
        "[StAX-RAY](https://sites.google.com/berkeley.edu/stax-ray) (Huang et al. 2022), range of "
        "two policies: DARSS and MCTSSS",
        "0.82 to 1.00",
        "1,200 trials on shelves with stacks, seen from the front, moved by a blade and a suction "
        "cup; the target is revealed",
    ),
)
"""Method, success rate in simulation, and scenes, as the abstracts of the papers state them."""
REFERENCES = (
    'M. Danielczuk et al., "X-Ray: Mechanical Search for an Occluded Object by Minimizing Support '
    'of Learned Occupancy Distributions", IROS 2020.',
    'H. Huang et al., "Mechanical Search on Shelves using Lateral Access X-RAY", IROS 2021.',
    'H. Huang et al., "Mechanical Search on Shelves with Efficient Stacking and Destacking of '
    'Objects", ISRR 2022.',
)
"""Papers of `PUBLISHED`."""
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


def _rows(name: str) -> list[dict[str, Any]]:
    rows: list[dict[str, Any]] = read_training_results(name)["rows"]
    return sorted(rows, key=lambda row: str(row["set"]))


def _measured(name: str) -> str:
    """Return the section of a results file."""
    title, fidelity = FILES[name]
    results = read_training_results(name)
    is_static = results["fidelity"] != "settle"
    options = f" --fidelity {results['fidelity']} --out FILE" if is_static else ""
    text = section(
        title,
        fidelity,
        command=f"python training/evaluate_target_search.py runs/target_search{options}",
        seed=results["seed"],
        results=[f"training/results/{name}"],
    )
    return text + table(_HEAD, [_row(row) for row in _rows(name)]) + "\n"


def page() -> str:
    """Return the page."""
    names = [name for name in FILES if has_training_results(name)]
    text = (
        "# Search for one object\n\n"
        "In each scene of a frozen dataset, the policy searches for one hidden object, in at most "
        "20 moves ([how to](../how_to/find_one_object.md)). The policy knows the object's class. "
        "*Revealed*: fraction of the episodes in which the object is seen. *Of the solvable*: "
        "fraction of those that the oracle search solves. *Moves*: mean over the episodes that "
        "reveal the object. *Moves / oracle*: ratio to the fewest moves that reveal the object, "
        "found from the true state, over the revealed solvable pairs. *Within 1.25 of the "
        "oracle*: fraction of the solvable pairs that are revealed with at most 1.25 times those "
        "moves. *Moves / area*: ratio to the area policy, over the pairs that both reveal. "
        "Intervals are 95 %.\n\n"
        "The oracle knows where the object is; the other policies do not. More than half of its "
        "plans have a single move. Under `static_or_drake`, its row is no independent measurement: "
        "the model with which it plans also decides the outcomes of its moves.\n\n"
    )
    text += "".join(map(_measured, names))
    ours = [
        (
            f"{policy_name(row['agent'])}, {row['set']}",
            number(row["revealed"]),
            "stacks on a tray, overhead camera, poses of visible objects known, moved by pick and "
            "place; the target is revealed",
        )
        for row in _rows(names[0])
        if row["agent"] not in ("random", "full-knowledge")
    ]
    text += "## Published searches\n\nSuccess rates in simulation, on tasks that differ.\n\n"
    text += table(["method", "success", "scenes"], [*PUBLISHED, *ours])
    return text + "\n" + "".join(f"- {reference}\n" for reference in REFERENCES)
