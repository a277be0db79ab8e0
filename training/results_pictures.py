"""Draws the pictures of docs/results.md from the files in training/results.

python training/results_pictures.py
"""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
import typer
from matplotlib.axes import Axes

from drake_clutter.files import cli_error_handler
from drake_clutter.records import read_jsonl
from training.results_page import IMAGES, RESULTS, read

OF_SEED = ", seed "
"""Between a training's name and its seed, if that is not 0."""
SETS = {
    "paper_hardness": "as hard as the paper's: 25 nodes",
    "sg_star_25": "SG*, 25 nodes",
    "sg_star_40": "SG*, 40 nodes",
    "sg_14": "SG-14, fourteen objects, 25 nodes",
}
"""Sets of which it is drawn what was found, and what they are called."""
AGENTS = {
    "full-knowledge": ("full knowledge", "black"),
    "student": ("student, SE*", "C0"),
    "student-14": ("student-14", "C0"),
    "student-dagger": ("student-dagger, its clone", "C1"),
    "student-rg": ("student-rg, SE^r", "C2"),
    "largest-clear": ("LF-clear", "C3"),
    "largest-first": ("LF", "C4"),
    "random": ("RE", "C5"),
}
"""Whose finds are drawn, what they are called, and in which colour."""
MOVES, FEWEST = 20, 100
"""Moves that are drawn, and scenes that an agent must have played to be drawn."""


def episodes_of(name: str, agent: str) -> list[dict[str, Any]]:
    """Those that an agent has played on a set."""
    return read_jsonl(RESULTS / f"episodes/{name}_{agent}.jsonl.gz")[1:]


def draw_curves(
    path: Path, histories: Mapping[str, Sequence[Mapping[str, float]]], labels: Mapping[str, str]
) -> None:
    """How trainings went, each a line, other seeds paler: a panel for every figure that has a label."""
    plt.rcParams.update({"font.size": 18, "lines.linewidth": 2.5})
    figure, panels = plt.subplots(1, len(labels), figsize=(18, 5.5), layout="constrained")
    colours: dict[str, str] = {}
    for training, history in histories.items():
        whose = training.split(OF_SEED)[0]
        first = whose not in colours
        colour = colours.setdefault(whose, f"C{len(colours)}")
        for panel, (name, label) in zip(panels, labels.items(), strict=True):
            steps, values = [row["step"] / 1000 for row in history], [row[name] for row in history]
            panel.plot(
                steps,
                values,
                color=colour,
                alpha=1 if first else 0.4,
                label=whose if first else None,
            )
            panel.set(xlabel="steps / 1000", ylabel=label)
            panel.grid(alpha=0.4)
    panels[0].legend()
    figure.savefig(path, dpi=80)
    plt.close(figure)


def draw_stacks(path: Path) -> None:
    """How high the stacks of each agent are, and of what classes its scenes are, at 25 nodes."""
    rows = [
        row
        for row in read("table1.json")["rows"]
        if row["nodes"] == 25 and row["objects"] == "ycb7"
    ]
    rows = [row for row in rows if row["temperature"] is None and "/" not in row["agent"]]
    plt.rcParams.update({"font.size": 18, "lines.linewidth": 2.5})
    figure, (left, right) = plt.subplots(1, 2, figsize=(18, 6.5), layout="constrained")
    for k, row in enumerate(rows):
        share = [count / sum(row["stack_heights_5cm"]) for count in row["stack_heights_5cm"]]
        left.stairs(share, range(0, 5 * len(share) + 1, 5), label=row["agent"], linewidth=3)
        places = [
            n + (k - (len(rows) - 1) / 2) * 0.8 / len(rows) for n in range(len(row["classes"]))
        ]
        shares = [count / sum(row["classes"].values()) for count in row["classes"].values()]
        right.bar(places, shares, 0.8 / len(rows), label=row["agent"])
    left.set(xlabel="height of a stack, cm", ylabel="share of the stacks")
    left.legend()
    names = [name.replace("_", "\n") for name in rows[0]["classes"]]
    right.set_xticks(range(len(names)), names)
    right.set_ylabel("share of the objects")
    for panel in (left, right):
        panel.grid(alpha=0.4, axis="y")
    figure.savefig(path, dpi=80)
    plt.close(figure)


def draw_found(path: Path) -> None:
    """What was found over the moves, of what was hidden: a panel for each set, on the scenes that all agents have played."""
    plt.rcParams.update({"font.size": 18, "lines.linewidth": 2.5})
    figure, panels = plt.subplots(
        2, 2, figsize=(18, 12), layout="constrained", sharex=True, sharey=True
    )
    for panel, name in zip(panels.flat, SETS, strict=True):
        draw_set(panel, name)
    handles = {
        label: line
        for panel in panels.flat
        for line, label in zip(*panel.get_legend_handles_labels(), strict=True)
    }
    figure.legend(handles.values(), handles, loc="outside lower center", ncols=4)
    figure.savefig(path, dpi=80)
    plt.close(figure)


def draw_set(panel: Axes, name: str) -> None:
    """A panel of `draw_found`."""
    played = {
        agent: episodes for agent in AGENTS if len(episodes := episodes_of(name, agent)) >= FEWEST
    }
    count = min(len(episodes) for episodes in played.values())
    for agent, episodes in played.items():
        hidden, found = sum(e["hidden"] for e in episodes[:count]), np.zeros(MOVES + 1)
        for e in episodes[:count]:
            after = [0, *e["found_after"]]
            found += np.pad(after, (0, MOVES + 1 - len(after)), mode="edge")
        label, colour = AGENTS[agent]
        panel.plot(
            found / hidden,
            label=label,
            color=colour,
            linestyle="--" if agent == "full-knowledge" else "-",
        )
    panel.set(
        title=f"{SETS[name]}; {count} scenes",
        xlim=(0, MOVES),
        ylim=(0, 1.02),
        xticks=range(0, MOVES + 1, 5),
    )
    panel.set(xlabel="moves", ylabel="found, of the hidden objects")
    panel.label_outer()
    panel.grid(alpha=0.4)


def main() -> None:
    """Draws all of them."""
    seeds = {
        f"seed {f.stem[-1]}": json.loads(f.read_text())["history"]
        for f in sorted(RESULTS.glob("sg_star_seed_*.json"))
    }
    labels = {"score": "return of a scene", "hidden": "hidden objects", "stable": "stable, share"}
    draw_curves(IMAGES / "learning_curves.png", seeds, labels)
    explorers = {row["agent"]: row["history"] for row in read("explorer_trainings.json")["rows"]}
    by_moves = {
        agent: history for agent, history in explorers.items() if history[-1]["step"] > 1000
    }  # clones count rounds
    labels = {
        "success": "everything found, share",
        "moves_of_successes": "moves of successes",
        "collapsed": "collapsed, share",
    }
    draw_curves(IMAGES / "explorer_curves.png", by_moves, labels)
    draw_stacks(IMAGES / "stacks.png")
    draw_found(IMAGES / "explorers.png")


if __name__ == "__main__":
    with cli_error_handler():
        typer.run(main)
