"""Writes docs/results.md, every number of it from the files in training/results and benchmarks/results.

    python training/results_page.py

A table has the rows that have been measured so far; what is missing is not there.
"""

import json
import statistics
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import typer

from drake_clutter.files import cli_error_handler, write_text

ROOT = Path(__file__).parents[1]
RESULTS, CALIBRATION = ROOT / "training/results", ROOT / "benchmarks/results/calibration.json"
PAGE, IMAGES = ROOT / "docs/results.md", ROOT / "docs/images"
PAPER_GENERATORS = {
    ("random", "ycb7"): {10: (1.13, 0.84), 15: (1.64, 0.64), 20: (2.18, 0.55), 25: (2.51, 0.41)},
    ("sg", "ycb7"): {10: (2.12, 0.99), 15: (2.41, 0.99), 20: (2.46, 0.93), 25: (3.01, 0.81)},
    ("sg-star", "ycb7"): {10: (4.62, 0.97), 15: (5.88, 0.85), 20: (6.67, 0.97), 25: (7.45, 0.88)},
    ("random", "pantry14"): {25: (2.44, 0.09)},
    ("sg-14", "pantry14"): {25: (6.03, 0.70)},
}
"""Table I of the paper and its text: objects hidden and stability, by agent, object set, and nodes (SPEC section 5)."""

FEWEST_PAIRS = 10
"""Scenes that both of two explorers solve, at least, if their moves are compared."""
PAPER_EXPLORERS: dict[str, dict[str, tuple[float, float | None]]] = {
    "sg_star_10": {
        "random": (0.05, 0.76),
        "largest-first": (0.88, 2.93),
        "student-rg": (0.92, 3.06),
        "student": (0.91, 3.13),
    },
    "sg_star_15": {
        "random": (0.03, 1.15),
        "largest-first": (0.58, 3.33),
        "student-rg": (0.84, 4.40),
        "student": (0.82, 4.27),
    },
    "sg_star_20": {
        "random": (0.00, 0.93),
        "largest-first": (0.32, 3.64),
        "student-rg": (0.36, 4.24),
        "student": (0.64, 4.71),
    },
    "paper_hardness": {
        "random": (0.00, 0.90),
        "largest-first": (0.10, 2.70),
        "student-rg": (0.52, 4.87),
        "student": (0.91, 5.82),
    },
    "sg_14": {"random": (0.03, None), "largest-first": (0.56, None), "student-14": (0.64, 5.33)},
}
"""Tables II and III of the paper: success and objects found, by set (its 25 nodes hid as many as `paper_hardness`) and agent."""


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Markdown."""
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines) + "\n"


def number(value: float | None, digits: int = 2) -> str:
    """Or nothing."""
    return "" if value is None else f"{value:.{digits}f}"


def with_interval(row: dict[str, Any], name: str, interval: str, digits: int = 2) -> str:
    """A figure and its interval."""
    if row.get(name) is None or row.get(interval) is None:
        return number(row.get(name), digits)
    low, high = row[interval]
    return f"{row[name]:.{digits}f} ({low:.{digits}f} to {high:.{digits}f})"


def read(name: str) -> dict[str, Any]:
    """A file of results; {} if it is not there."""
    path = RESULTS / name
    found: dict[str, Any] = json.loads(path.read_text()) if path.exists() else {}
    return found


def picture(name: str, told: str) -> str:
    """A picture with a line below; nothing if it has not been drawn."""
    return (
        f"![{told}](images/{name}.png)\n\n*{told}.*\n\n"
        if (IMAGES / f"{name}.png").exists()
        else ""
    )


def sheets() -> str:
    """Links to 48 scenes of each agent."""
    links = [
        f"[{path.stem.removeprefix('sheet_')}](images/{path.name})"
        for path in sorted(IMAGES.glob("sheet_*.png"))
    ]
    return f"48 scenes of 25 nodes by each agent: {', '.join(links)}.\n\n" if links else ""


def generator_row(row: dict[str, Any], source: str) -> list[str]:
    """Of Table I."""
    hidden, stable = PAPER_GENERATORS.get((row["agent"], row["objects"]), {}).get(
        row["nodes"], (None, None)
    )
    if row.get("temperature") is not None:
        hidden = stable = None
    agent = Path(row["agent"]).stem
    name = agent if row.get("temperature") is None else f"{agent} at {row['temperature']:g}"
    told = [name, row["objects"], str(row["nodes"]), str(row["count"])]
    told += [laid_out(row), with_interval(row, "stability_rate", "stability_ci95"), number(stable)]
    told += [with_interval(row, "hidden_mean", "hidden_ci95", 1), number(hidden)]
    told += [
        with_interval(row, "solvable_share", "solvable_ci95"),
        number(row.get("distinct_share")),
    ]
    told += [number(row.get("mean_stacks"), 1), number(row.get("balanced_share"))]
    return [
        *told,
        number(row.get("class_entropy")),
        number(row.get("false_stable_of_called_stable"), 3),
        source,
    ]


def laid_out(row: dict[str, Any]) -> str:
    """The share of the derived graphs that can be laid out."""
    return (
        number(row["count"] / (row["count"] + sum(row["layout_failures"].values())))
        if "layout_failures" in row
        else ""
    )


def generators() -> str:
    """Table I, the trade-off and the seeds."""
    rows = list(read("table1.json").get("rows", []))
    order = ["sg-star", "sg", "hill-climbing", "random", "sg-14"]
    rows.sort(
        key=lambda row: (
            row["temperature"] or 0,
            order.index(row["agent"]) if row["agent"] in order else 9,
            row["nodes"],
        )
    )
    told = [generator_row(row, f"`table1.json`, {row['commit']}") for row in rows]
    measured = {(row["agent"], row["objects"], row["nodes"]) for row in rows}
    fourteen = read("sg_14_110.json")
    if ("sg-14", "pantry14", 25) not in measured:
        told.append(generator_row(fourteen["summary"], f"`sg_14_110.json`, {fourteen['commit']}"))
    earlier = json.loads(CALIBRATION.read_text())
    for row in earlier["rows"]:
        row = {"agent": "random", "objects": earlier["objects"], "count": earlier["count"], **row}
        if ("random", row["objects"], row["nodes"]) not in measured:
            told.append(generator_row(row, "`calibration.json`"))
    head = [
        "agent",
        "objects",
        "nodes",
        "scenes",
        "laid out",
        "stable",
        "paper",
        "hidden",
        "paper",
        "solvable",
        "distinct",
    ]
    head += ["stacks", "balanced", "class bits", "fast judge wrong", "from"]
    trainings, shown = [], (("stable", 3), ("hidden", 1), ("stacks", 2), ("balanced", 2))
    for path in [*sorted(RESULTS.glob("sg_star_seed_*.json")), RESULTS / "sg_star_paper.json"]:
        held = json.loads(path.read_text())
        last = held["history"][-1]
        figures = [number(last[key], digits) for key, digits in shown]
        rate = last["step"] / last["seconds"]
        name = path.stem.removeprefix("sg_star_").replace("_", " ")
        trainings.append(
            [
                f"SG*, {name}",
                str(last["step"]),
                number(held["minutes"], 0),
                number(rate, 0),
                *figures,
            ]
        )
    for agent, name in (("sg", "SG, 15 nodes"), ("sg_14", "SG-14")):
        last = json.loads((RESULTS.parent / f"checkpoints/{agent}.json").read_text())["metrics"]
        figures = [number(last[key], digits) for key, digits in shown]
        rate = last["step"] / last["seconds"]
        trainings.append(
            [name, str(last["step"]), number(last["seconds"] / 60, 0), number(rate, 0), *figures]
        )
    pictures = (
        picture("stacks", "How high stacks are, and of what objects scenes are, at 25 nodes")
        + sheets()
    )
    pictures += picture(
        "trade_off", "What SG* hides, and how varied its scenes are, over the temperature"
    )
    return f"""## Table I: scenes that hide things

Drake settles and sees every scene. *Laid out*: of the graphs that an agent derives, those whose stacks are at most 0.5 m high and
find room on the tray; others are drawn again, and not counted. Nothing else is drawn again; but HC takes the best of 150 graphs
by the fast judge. *Stable* is of what is laid out, hidden and solvable are of what is stable; intervals are 95 %. *Balanced*: no
stack holds more than 60 % of the objects. *Fast judge wrong*: of the scenes that it calls stable, with its margin of 2.05 mm, the
share that falls in Drake.
`python training/evaluate_generators.py runs/table1`

`sg_star_seed_1` and `_2` are other seeds of SG*, sampled at 0.28 like it; `sg_star_paper` is SG* with the paper's reward alone,
sampled at 0.25.
{spread("SG*, 25 nodes", of_seeds(rows))}
{table(head, told)}
{pictures}\
The trainings; figures of 256 scenes by the fast judge at the training's temperature; what is too high or does not come apart
counts as unstable, too (for the paper's reward: what is too high alone). Seed 0 is the shipped one. All had other work beside
them; docs/generation.md has the rates without.

{table(["training", "steps", "minutes", "steps/s", "stable", "hidden", "stacks", "balanced"], trainings)}
![Learning curves of SG*](images/learning_curves.png)
"""


def of_seeds(rows: Sequence[dict[str, Any]]) -> dict[str, tuple[list[float], int]]:
    """Figures of SG* as it was trained with one seed or another, at 25 nodes, from the rows of Table I."""
    at_25 = [row for row in rows if row["nodes"] == 25 and row["temperature"] is None]
    seeds = [
        row
        for row in at_25
        if row["agent"] == "sg-star" or Path(row["agent"]).stem.startswith("sg_star_seed_")
    ]
    shown = (
        ("stability_rate", "stable", 3),
        ("hidden_mean", "hidden", 2),
        ("balanced_share", "balanced", 2),
    )
    return {name: ([row[key] for row in seeds], digits) for key, name, digits in shown}


def spread(whose: str, figures: Mapping[str, tuple[Sequence[float], int]]) -> str:
    """A sentence on seeds, once there are several; of every figure the values and the digits to show."""
    count = min(len(values) for values, _ in figures.values())
    if count < 2:
        return ""
    told = [
        f"{name} {statistics.mean(values):.{digits}f} ({statistics.stdev(values):.{digits}f})"
        for name, (values, digits) in figures.items()
    ]
    return f"Over {count} seeds of {whose}, mean (standard deviation): {', '.join(told)}.\n"


def explorer_row(row: dict[str, Any]) -> list[str]:
    """Of Tables II and III."""
    success, found = PAPER_EXPLORERS.get(row["set"], {}).get(row["agent"], (None, None))
    cells = [row["set"], Path(row["agent"]).stem, str(row["episodes"]), number(row["hidden"], 1)]
    for limit, in_paper in (("within_10", True), ("within_20", False)):
        cells += [
            with_interval(row[limit], "success", "success_ci95"),
            *([number(success)] if in_paper else []),
        ]
        cells += [number(row[limit]["found"], 1), *([number(found, 1)] if in_paper else [])]
    solvable = row["solvable"] or {}
    cells += [
        number(solvable.get("within_20", {}).get("success")),
        number(row["within_20"]["found_of_hidden"]),
    ]
    cells += [
        with_interval(row["within_20"], "collapsed", "collapsed_ci95"),
        number(row["moves_of_successes"], 1),
    ]
    for name in ("ceiling", "largest_clear"):
        cells.append(
            number(row[f"moves_to_{name}"])
            if row.get(f"both_with_{name}", 0) >= FEWEST_PAIRS
            else ""
        )
    return cells


def gap_row(fast: dict[str, Any], settled: dict[str, Any]) -> list[str]:
    """How the same explorer fares on the same scenes when they are judged fast, and when Drake settles them."""
    cells = [fast["set"], Path(fast["agent"]).stem, str(fast["episodes"])]
    for limit, name in (
        ("within_10", "success"),
        ("within_20", "success"),
        ("within_20", "found_of_hidden"),
        ("within_20", "collapsed"),
    ):
        cells.append(f"{number(fast[limit][name])} / {number(settled[limit][name])}")
    return [
        *cells,
        f"{number(fast['moves_of_successes'], 1)} / {number(settled['moves_of_successes'], 1)}",
    ]


def of_explorer_seeds(
    rows: Sequence[dict[str, Any]], agent: str
) -> dict[str, tuple[list[float], int]]:
    """Figures of an explorer as it was trained with one seed or another."""
    seeds = [
        row for row in rows if Path(row["agent"]).stem.split("_seed_")[0].replace("_", "-") == agent
    ]
    return {
        "success in 10 moves": ([row["within_10"]["success"] for row in seeds], 3),
        "in 20": ([row["within_20"]["success"] for row in seeds], 3),
        "collapsed": ([row["within_20"]["collapsed"] for row in seeds], 3),
        "moves": ([row["moves_of_successes"] for row in seeds], 2),
    }


def explorers() -> str:
    """Tables II and III, other seeds of SE*, and the trainings."""
    rows = [row for name in ("table2.json", "table3.json") for row in read(name).get("rows", [])]
    told = [explorer_row(row) for row in sorted(rows, key=lambda row: str(row["set"]))]
    settled = {(row["set"], row["agent"], row["episodes"]): row for row in rows}
    judged_fast = read("explorers_fast.json").get("rows", [])
    gaps = [
        gap_row(row, there)
        for row in judged_fast
        if (there := settled.get((row["set"], row["agent"], row["episodes"])))
    ]
    trainings = []
    for row in read("explorer_trainings.json").get("rows", []):
        last = row["history"][-1]
        cells = [row["agent"], str(last["step"]), number(row["minutes"], 0)]
        cells += [number(last[key], 3) for key in ("success", "found_share", "collapsed")]
        trainings.append([*cells, number(last["moves_of_successes"], 1)])
    head = [
        "set",
        "agent",
        "episodes",
        "hidden",
        "success in 10",
        "paper",
        "found",
        "paper",
        "success in 20",
        "found",
    ]
    head += ["of solvable", "of hidden", "collapsed", "moves", "to ceiling", "to LF-clear"]
    seeds = read("explorers_seeds.json").get("rows", [])
    spreads = "".join(
        spread(name, of_explorer_seeds(seeds, agent))
        for agent, name in (("student", "SE*"), ("student-dagger", "its clone"))
    )
    return f"""## Tables II and III: explorers

Moves settled by Drake, perfect detector; *of solvable*: success in 20 moves on the scenes that the full-knowledge search solves;
*to ceiling*, *to LF-clear*: moves on the scenes that both solve, if these are ten at least, to those of full knowledge and of
LF-clear. Every episode is a line of `training/results/episodes/`, with its commit.
`python training/evaluate_explorers.py`

{table(head, told)}
![What was found over the moves](images/explorers.png)

From `fast` to `settle`: the same scenes, chances and explorers, judged fast (`training/results/explorers_fast.json`) / settled by
Drake.

{table(["set", "agent", "scenes", "success in 10", "in 20", "of hidden", "collapsed", "moves"], gaps)}
SE* trained with other seeds, teacher and clone included; the first 100 scenes, settled by Drake.
`training/results/explorers_seeds.json`
{spreads}
{table(head, [explorer_row(row) for row in seeds])}
The trainings, and 200 episodes as they ended, at fidelity `equilibrium` and within 20 moves. All had other work beside them. A
step is a move; of a clone, a round. `training/results/explorer_trainings.json`

{table(["training", "steps", "minutes", "success", "found of hidden", "collapsed", "moves"], trainings)}
![How explorers learn](images/explorer_curves.png)
"""


def closed_loop() -> str:
    """The loop's table."""
    told = []
    for path in sorted(RESULTS.glob("closed_loop*.json")):
        held = json.loads(path.read_text())
        for row in held["rows"]:
            cells = [row["scenes"], row["perception"], row["motion"], str(row["episodes"])]
            cells += [with_interval(row, "success", "success_ci95"), number(row["arm_can"])]
            cells += [
                with_interval(row, "success_of_arm_can", "success_of_arm_can_ci95"),
                number(row["found_of_hidden"]),
            ]
            cells += [
                number(row.get("list_recall")),
                number(row.get("list_precision")),
                number(row["moves_of_successes"], 1),
            ]
            failures = ", ".join(f"{count} {reason}" for reason, count in row["failed_of"].items())
            commits = ", ".join(row.get("commits", [held.get("commit")]))
            minutes = number(row["robot_minutes"], 1) if row["motion"] == "arm" else ""
            told.append(
                [
                    *cells,
                    minutes,
                    number(row["wall_seconds"], 0),
                    failures or "none",
                    f"`{path.name}`, {commits}",
                ]
            )
    head = [
        "set",
        "perception",
        "motion",
        "episodes",
        "success",
        "arm can",
        "success of these",
        "found of hidden",
        "list recall",
    ]
    head += ["list precision", "moves", "robot min", "wall s", "the others", "from"]
    return f"""## The closed loop

Within 20 moves. *Arm can*: scenes in which nothing stays hidden behind what no cup holds. *List*: of the objects that the agent
knows by class and place when all has been in view.
`python training/evaluate_closed_loop.py --workers 2`

{table(head, told)}"""


def detectors() -> str:
    """What a trained detector sees."""
    told = []
    for path in sorted(RESULTS.glob("detector_*.json")):
        held = json.loads(path.read_text())
        for name, row in held["rows"].items() if isinstance(held, dict) else ():
            cells = [
                held["detector"],
                name,
                str(row["images"]),
                with_interval(row["in_view"], "recall", "ci95"),
            ]
            cells += [number(row["precision"]), number(row["class_accuracy_of_found"])]
            for key in ("translation_mm", "rotation_deg", "ms_per_frame"):
                cells.append(" / ".join(number(value, 1) for value in row[key]))
            told.append([*cells, f"`{path.name}`, {held['commit']}"])
    head = [
        "detector",
        "images of",
        "images",
        "recall, in view",
        "precision",
        "class right",
        "translation mm",
        "rotation deg",
    ]
    return f"""## Learned perception

Objects of which at least 30 % are seen; found is one that a detection of its class covers with an IoU of 0.5. Errors and ms per
frame: median / 95th percentile.
`python training/evaluate_detector.py --detector FILE --scenes SET --out FILE`

{table([*head, "ms", "from"], told)}"""


PARTS: tuple[Callable[[], str], ...] = (generators, explorers, closed_loop, detectors)


def page() -> str:
    """The whole page."""
    told = "Written by `training/results_page.py`, and drawn by `training/results_pictures.py`, from `training/results/`; files\n"
    told += "or checkpoints name config, seed and commit."
    return f"# Results\n\n{told}\n\n" + "\n".join(part() for part in PARTS)


def main(out: Annotated[Path, typer.Option(help="Page to write.")] = PAGE) -> None:
    """Writes the page."""
    write_text(out, page())


if __name__ == "__main__":
    with cli_error_handler():
        typer.run(main)
