"""The page docs/results/generation.md."""

import json
import statistics
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from markdown_text import estimate, figure, number, section, table
from results_files import (
    ROOT,
    TRAINING,
    generator_name,
    read_benchmark_results,
    read_training_results,
)

PAPER = {
    ("random", "ycb7"): {10: (1.13, 0.84), 15: (1.64, 0.64), 20: (2.18, 0.55), 25: (2.51, 0.41)},
    ("sg", "ycb7"): {10: (2.12, 0.99), 15: (2.41, 0.99), 20: (2.46, 0.93), 25: (3.01, 0.81)},
    ("sg-star", "ycb7"): {10: (4.62, 0.97), 15: (5.88, 0.85), 20: (6.67, 0.97), 25: (7.45, 0.88)},
    ("random", "pantry14"): {25: (2.44, 0.09)},
    ("sg-14", "pantry14"): {25: (6.03, 0.70)},
}
"""Hidden objects and stability rate by generator, object set and nodes.

Source: Kumar et al. 2022, Table I.
"""
_NAMES = (
    ("RG", "random", "uniform choice among the feasible rules (paper)"),
    ("HC", "hill-climbing", "best of 150 random graphs by the static judge"),
    ("SG", "sg", "trained with 15 nodes of ycb7"),
    ("SG\\*", "sg-star", "trained with 25 nodes of ycb7"),
    ("SG-14", "sg-14", "trained with 25 nodes of pantry14"),
)
"""Short name, name on the command line and description of each generator."""
_ORDER = ["sg-star", "sg", "hill-climbing", "random", "sg-14"]
_TRAINING_FIGURES = (("stable", 3), ("hidden", 1), ("stacks", 2), ("balanced", 2))


def _success_row(row: Mapping[str, Any], name: str) -> list[str]:
    hidden, stable = PAPER.get((row["agent"], row["objects"]), {}).get(row["nodes"], (None, None))
    if row.get("temperature") is not None:
        hidden = stable = None
    return [
        name,
        row["objects"],
        str(row["nodes"]),
        str(row["count"]),
        estimate(row, "stability_rate", "stability_ci95"),
        number(stable),
        estimate(row, "hidden_mean", "hidden_ci95", 1),
        number(hidden),
        estimate(row, "solvable_share", "solvable_ci95"),
    ]


def _diversity_cells(row: Mapping[str, Any]) -> list[str]:
    return [
        layout_rate(row),
        number(row.get("distinct_share")),
        number(row.get("mean_stacks"), 1),
        number(row.get("balanced_share")),
        number(row.get("class_entropy")),
        number(row.get("false_stable_of_called_stable"), 3),
    ]


def layout_rate(row: Mapping[str, Any]) -> str:
    """Return the fraction of derived graphs that could be laid out; "" if it is not recorded."""
    if "layout_failures" not in row:
        return ""
    return number(row["count"] / (row["count"] + sum(row["layout_failures"].values())))


def _scenes() -> str:
    rows = sorted(
        read_training_results("table1.json")["rows"],
        key=lambda row: (
            row["temperature"] or 0,
            _ORDER.index(row["agent"]) if row["agent"] in _ORDER else len(_ORDER),
            row["nodes"],
        ),
    )
    own = [row for row in rows if row["temperature"] is None]
    sampled = [row for row in rows if row["temperature"] is not None]
    text = section(
        "Scenes judged by Drake",
        "Drake settles every scene; the camera's label image decides which objects are hidden. "
        "Graphs with a stack above 0.5 m or without room on the tray are replaced. "
        "*Stable* is a fraction of the laid-out scenes; *hidden* (objects per scene) and "
        "*solvable* (by the oracle search) are of the stable scenes. *(Paper)*: Table I of "
        "Kumar et al. 2022. *SG\\*, paper reward*: trained with the paper's reward, sampled at "
        "temperature 0.25; the other SG\\* at 0.28. "
        "[Intervals](intervals.md) are 95 %, of *hidden* by the normal approximation.",
        command="python training/evaluate_generators.py runs/table1",
        seed=1000,
        results=["training/results/table1.json"],
    )
    head = ["generator", "objects", "nodes", "scenes", "stable", "stable (paper)"]
    head += ["hidden", "hidden (paper)"]
    text += table([*head, "solvable"], [_success_row(row, generator_name(row)) for row in own])
    text += _seed_sentence(own)
    text += (
        "### Diversity\n\n"
        "*Laid out*: fraction of the derived graphs. *Distinct*: fraction of distinct graphs. "
        "*Balanced*: no stack holds more than 60 % of the objects. *Class entropy*: of the object "
        "classes [bits]. *False stable*: fraction of the scenes that the static judge "
        "(margin 2.05 mm) judges stable and Drake unstable.\n\n"
    )
    head = ["generator", "objects", "nodes", "laid out", "distinct", "stacks", "balanced"]
    head += ["class entropy", "false stable"]
    text += table(
        head,
        [
            [generator_name(row), row["objects"], str(row["nodes"]), *_diversity_cells(row)]
            for row in own
        ],
    )
    text += "\n" + figure(
        "stacks.png", "Stack heights and object classes of scenes with 25 nodes, by generator."
    )
    text += _sheets()
    text += (
        "### Sampling temperature\n\n"
        "SG\\* with 25 nodes of ycb7, sampled at temperatures other than its default, 0.28.\n\n"
    )
    head = ["temperature", "scenes", "stable", "hidden", "solvable", "laid out", "distinct"]
    head += ["stacks", "balanced", "class entropy", "false stable"]
    text += table(
        head,
        [
            [
                f"{row['temperature']:g}",
                str(row["count"]),
                estimate(row, "stability_rate", "stability_ci95"),
                estimate(row, "hidden_mean", "hidden_ci95", 1),
                estimate(row, "solvable_share", "solvable_ci95"),
                *_diversity_cells(row),
            ]
            for row in sampled
        ],
    )
    return (
        text
        + "\n"
        + figure("trade_off.png", "Hidden objects and diversity of SG\\* over the temperature.")
    )


def _seed_sentence(rows: Sequence[Mapping[str, Any]]) -> str:
    seeds = [
        row
        for row in rows
        if row["nodes"] == 25
        and (row["agent"] == "sg-star" or Path(row["agent"]).stem.startswith("sg_star_seed_"))
    ]
    keys = (
        ("stability_rate", "stable", 3),
        ("hidden_mean", "hidden", 2),
        ("balanced_share", "balanced", 2),
    )
    figures = {name: ([row[key] for row in seeds], digits) for key, name, digits in keys}
    return "\n" + spread("SG\\*, 25 nodes", figures) + "\n"


def spread(subject: str, figures: Mapping[str, tuple[Sequence[float], int]]) -> str:
    """Return a sentence with mean and standard deviation over training seeds.

    Args:
        subject: What was trained.
        figures: Values, one for each seed, and decimals to show, by name.
    """
    count = min(len(values) for values, _ in figures.values())
    cells = [
        f"{name} {statistics.mean(values):.{digits}f} ({statistics.stdev(values):.{digits}f})"
        for name, (values, digits) in figures.items()
    ]
    return (
        f"Mean and standard deviation over {count} training seeds of {subject}: "
        f"{', '.join(cells)}.\n"
    )


def _sheets() -> str:
    links = [
        f"[{name}](../images/sheet_{stem}.png)"
        for stem, name in (
            ("random", "RG"),
            ("hill_climbing", "HC"),
            ("sg", "SG"),
            ("sg_star", "SG\\*"),
            ("sg_14", "SG-14"),
        )
    ]
    return f"Contact sheets of 48 scenes with 25 nodes each: {', '.join(links)}.\n\n"


def _trainings() -> str:
    rows = []
    for path in [*sorted(TRAINING.glob("sg_star_seed_*.json")), TRAINING / "sg_star_paper.json"]:
        training = read_training_results(path.name)
        name = path.stem.removeprefix("sg_star_").replace("_", " ")
        name = "paper reward" if name == "paper" else name
        rows.append(_training_row("SG\\*, " + name, training["history"][-1], training["minutes"]))
    for stem, name in (("sg", "SG, 15 nodes"), ("sg_14", "SG-14")):
        checkpoint = ROOT / f"training/checkpoints/{stem}.json"
        last = json.loads(checkpoint.read_text(encoding="utf-8"))["metrics"]
        rows.append(_training_row(name, last, last["seconds"] / 60))
    text = section(
        "Trainings",
        "Metrics of 256 scenes at the end of each training, by the static judge (margin 3 mm) at "
        "the training's temperature. A stack that is too high or cannot be disassembled counts as "
        "unstable. Other processes ran on the same two cores.",
        command="python training/train_generator.py --config training/configs/sg_star.yaml"
        " --out runs/sg_star",
        seed="0 unless stated",
        results=["training/results/sg_star_seed_0.json", "training/checkpoints/sg.json"],
    )
    head = ["training", "steps", "minutes", "steps/s", "stable", "hidden", "stacks", "balanced"]
    text += table(head, rows)
    return text + "\n" + figure("learning_curves.png", "Learning curves of SG\\*, three seeds.")


def _training_row(name: str, last: Mapping[str, Any], minutes: float) -> list[str]:
    return [
        name,
        str(last["step"]),
        number(minutes, 0),
        number(last["step"] / last["seconds"], 0),
        *(number(last[key], digits) for key, digits in _TRAINING_FIGURES),
    ]


def _sampled() -> str:
    results = read_training_results("sg_star_seed_0.json")
    text = section(
        "Temperatures near the default",
        f"{results['sampled_scenes']} scenes of SG\\*, seed 0, by the static judge; stacks that "
        "are too high or cannot be disassembled count as unstable. *Rarest class*: fraction of the "
        "objects that are of the rarest class.",
        seed=results["sampled_seed"],
        results=["training/results/sg_star_seed_0.json"],
    )
    return text + table(
        ["temperature", "stable", "hidden", "stacks", "balanced, of the stable", "rarest class"],
        [
            [
                f"{row['temperature']:g}",
                number(row["stable"]),
                number(row["hidden"], 1),
                number(row["stacks"], 1),
                number(row["balanced"]),
                f"{100 * row['rarest_class']:.1f} %",
            ]
            for row in results["sampled"]
        ],
    )


def _disassembly() -> str:
    rows = read_benchmark_results("come_apart.json")["rows"]
    text = section(
        "Disassembly and solvability",
        "Stable scenes (Drake), split by whether every stack can be disassembled from the top, "
        "object by object, while the rest stays stable; *solvable* by the oracle search.",
        command="python benchmarks/disassembly_vs_solvability.py runs/table1/* --out FILE",
        seed=rows[0]["seed"],
        results=["benchmarks/results/come_apart.json"],
    )

    def cells(part: Mapping[str, Any]) -> list[str]:
        return [str(part["stable"]), str(part["solvable"])]

    groups = ("comes_apart", "does_not")
    total = [
        [sum(row[group][key] for row in rows) for key in ("stable", "solvable")] for group in groups
    ]
    body = [
        [generator_name(row), row["objects"], str(row["nodes"])]
        + [cell for group in groups for cell in cells(row[group])]
        for row in rows
    ]
    body.append(["all", "", "", *(str(count) for group in total for count in group)])
    head = ["generator", "objects", "nodes", "can be disassembled", "of these solvable"]
    return text + table([*head, "cannot", "of these solvable"], body)


def _speed() -> str:
    results = read_benchmark_results("generator_training.json")
    one, two = results["rows"]
    text = section(
        "Speed of training",
        f"{results['steps']} environment steps after the replay buffer is warm; one update of 128 "
        "steps for every four environment steps. With two threads, losses run in parallel.",
        command="python benchmarks/generator_training_speed.py --out FILE",
        results=["benchmarks/results/generator_training.json"],
    )

    def fraction(row: Mapping[str, Any], *parts: str) -> str:
        return number(sum(row["parts"][part] for part in parts) / row["seconds"])

    updates = "of updates: losses and gradients"
    memory = "of updates: drawing from memory"
    return text + table(
        ["", "one thread", "two threads"],
        [
            ["steps/s", number(one["steps_per_s"], 0), number(two["steps_per_s"], 0)],
            ["updates, fraction of the time", fraction(one, "updates"), fraction(two, "updates")],
            [
                "losses and gradients, fraction of the updates",
                number(one["parts"][updates] / one["parts"]["updates"]),
                "",
            ],
            [
                "replay sampling, fraction of the updates",
                number(one["parts"][memory] / one["parts"]["updates"]),
                number(two["parts"][memory] / two["parts"]["updates"]),
            ],
            [
                "environments with the static judge, fraction of the time",
                fraction(one, "environments", "new episodes"),
                fraction(two, "environments", "new episodes"),
            ],
        ],
    )


def _maskable_ppo() -> str:
    results = read_benchmark_results("maskable_ppo.json")
    text = section(
        "MaskablePPO",
        f"sb3-contrib's `MaskablePPO` on graphs of {results['nodes']} nodes, trained by "
        "`examples/09_train_maskable_ppo.py`, after some minutes of processor time. Untrained, it "
        "chooses rules at random. Scenes are judged by the static model; *hidden*: objects per "
        "scene, 0 if it is not stable. [Intervals](intervals.md) are 95 %.",
        command="python benchmarks/maskable_ppo.py FOLDER --out FILE",
        seed=results["seed"],
        results=["benchmarks/results/maskable_ppo.json"],
    )
    return text + table(
        ["time [min]", "steps", "episodes", "return", "hidden", "stable"],
        [
            [
                str(row["minutes"]),
                str(row["steps"]),
                str(row["episodes"]),
                number(row["return_mean"]),
                estimate(row, "hidden_mean", "hidden_ci95"),
                estimate(row, "stable", "stable_ci95"),
            ]
            for row in results["rows"]
        ],
    )


def page() -> str:
    """Return the page."""
    intro = (
        "# Scene generation\n\nScene generators compared by Drake. Intervals of means are "
        "those of the [normal approximation](intervals.md), except for MaskablePPO.\n\n"
    ) + table(
        ["name", "`--agent`", "generator"],
        [[name, f"`{agent}`", text] for name, agent, text in _NAMES],
    )
    parts = (_scenes(), _trainings(), _sampled(), _disassembly(), _speed(), _maskable_ppo())
    return intro + "\n" + "\n".join(parts)
