"""Draw the figures of the results pages from the results files.

python docs/scripts/results_figures.py
"""

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
from results_files import (
    ROOT,
    TRAINING,
    read_benchmark_results,
    read_episodes,
    read_training_results,
)

IMAGES = ROOT / "docs/images"
SEED_SUFFIX = ", seed "
"""Separates the name of a training from its seed, if that is not 0."""
DATASETS = {
    "paper_hardness": "as hard as the paper's, 25 nodes",
    "sg_star_25": "SG*, 25 nodes",
    "sg_star_40": "SG*, 40 nodes",
    "sg_14": "SG-14, 14 object classes, 25 nodes",
}
"""Titles of the panels of objects found, by scene dataset."""
POLICIES = {
    "full-knowledge": ("oracle", "black"),
    "student": ("SE*", "C0"),
    "student-14": ("SE-14", "C0"),
    "student-dagger": ("SE*, DAgger", "C1"),
    "student-rg": ("SE^r", "C2"),
    "largest-clear": ("LF-clear", "C3"),
    "largest-first": ("LF", "C4"),
    "random": ("RE", "C5"),
}
"""Labels and colors of policies, by their names in results files."""
GENERATORS = {"sg-star": "SG*", "sg": "SG", "hill-climbing": "HC", "random": "RG"}
"""Labels of generators, by their names in results files."""
SG_STAR_TEMPERATURE = 0.28
"""Temperature at which the shipped SG* is sampled."""
FRACTIONS = {
    "stability_rate": "stable",
    "solvable_share": "solvable",
    "distinct_share": "distinct",
    "balanced_share": "balanced",
}
"""Labels of fractions drawn over the temperature, by key."""
TIMED = {
    "judges": {
        "PyBullet, 480 steps": "PyBullet, 480 steps",
        "Drake": "Drake",
        "static judge, empty cache": "static judge",
    },
    "renderers": {
        "PyBullet TinyRenderer, label image": "PyBullet TinyRenderer",
        "Drake VTK, label image": "Drake VTK",
        "ray caster, label image": "ray caster",
    },
}
"""Labels of judges and renderers, by their names in the results file."""
MAX_MOVES = 20
"""Moves on the horizontal axis."""
MIN_EPISODES = 100
"""Fewest episodes of a policy on a scene dataset for it to be drawn."""


def draw_learning_curves(
    path: Path, histories: Mapping[str, Sequence[Mapping[str, float]]], labels: Mapping[str, str]
) -> None:
    """Draw metrics over the steps of trainings, other seeds than the first paler.

    Args:
        path: PNG to write.
        histories: Evaluations of each training, by name.
        labels: Axis labels of the metrics to draw, one panel each, by key.
    """
    plt.rcParams.update({"font.size": 18, "lines.linewidth": 2.5})
    figure, panels = plt.subplots(1, len(labels), figsize=(18, 5.5), layout="constrained")
    colors: dict[str, str] = {}
    for training, history in histories.items():
        name = training.split(SEED_SUFFIX)[0]
        is_first = name not in colors
        color = colors.setdefault(name, f"C{len(colors)}")
        steps = [row["step"] / 1000 for row in history]
        for panel, (key, label) in zip(panels, labels.items(), strict=True):
            panel.plot(
                steps,
                [row[key] for row in history],
                color=color,
                alpha=1 if is_first else 0.4,
                label=name if is_first else None,
            )
            panel.set(xlabel="steps / 1000", ylabel=label)
            panel.grid(alpha=0.4)
    panels[0].legend()
    figure.savefig(path, dpi=80)
    plt.close(figure)


def draw_stacks(path: Path) -> None:
    """Draw stack heights and object classes of each generator at 25 nodes of ycb7."""
    rows = [
        row
        for row in read_training_results("table1.json")["rows"]
        if (row["nodes"], row["objects"], row["temperature"]) == (25, "ycb7", None)
        and row["agent"] in GENERATORS
    ]
    plt.rcParams.update({"font.size": 18, "lines.linewidth": 2.5})
    figure, (left, right) = plt.subplots(1, 2, figsize=(18, 6.5), layout="constrained")
    width = 0.8 / len(rows)
    for index, row in enumerate(rows):
        label = GENERATORS[row["agent"]]
        heights = np.array(row["stack_heights_5cm"])
        edges = 5 * np.arange(len(heights) + 1)
        left.stairs(heights / heights.sum(), edges, label=label, linewidth=3)
        counts = np.array([*row["classes"].values()])
        positions = np.arange(len(counts)) + (index - (len(rows) - 1) / 2) * width
        right.bar(positions, counts / counts.sum(), width, label=label)
    left.set(xlabel="stack height [cm]", ylabel="fraction of the stacks")
    left.legend()
    names = [name.replace("_", "\n") for name in rows[0]["classes"]]
    right.set_xticks(range(len(names)), names)
    right.set_ylabel("fraction of the objects")
    for panel in (left, right):
        panel.grid(alpha=0.4, axis="y")
    figure.savefig(path, dpi=80)
    plt.close(figure)


def draw_temperatures(path: Path) -> None:
    """Draw hidden objects and diversity of SG* over the sampling temperature."""
    rows = [
        row
        for row in read_training_results("table1.json")["rows"]
        if (row["agent"], row["objects"], row["nodes"]) == ("sg-star", "ycb7", 25)
    ]
    rows.sort(key=_temperature)
    temperatures = [_temperature(row) for row in rows]
    plt.rcParams.update({"font.size": 18, "lines.linewidth": 2.5})
    figure, (left, right) = plt.subplots(1, 2, figsize=(18, 6.5), layout="constrained")
    hidden = np.array([row["hidden_mean"] for row in rows])
    intervals = np.array([row["hidden_ci95"] for row in rows])
    left.errorbar(temperatures, hidden, np.abs(intervals.T - hidden), marker="o", capsize=6)
    left.set(ylabel="hidden objects per stable scene", ylim=(0, None))
    for marker, (key, label) in zip("osD^", FRACTIONS.items(), strict=True):
        right.plot(temperatures, [row[key] for row in rows], marker=marker, label=label)
    classes = max(len(row["classes"]) for row in rows)
    entropy = [row["class_entropy"] / np.log2(classes) for row in rows]
    right.plot(temperatures, entropy, marker="v", label="class entropy / maximum")
    right.set(ylabel="fraction", ylim=(0, 1.03))
    right.legend()
    for panel in (left, right):
        panel.set(xlabel="sampling temperature", xscale="log")
        panel.set_xticks(temperatures, [f"{value:g}" for value in temperatures], rotation=45)
        panel.minorticks_off()
        panel.grid(alpha=0.4)
    figure.savefig(path, dpi=80)
    plt.close(figure)


def _temperature(row: Mapping[str, Any]) -> float:
    return SG_STAR_TEMPERATURE if row["temperature"] is None else float(row["temperature"])


def draw_times(path: Path) -> None:
    """Draw the mean times of judges and renderers over the number of objects."""
    rows = read_benchmark_results("speed.json")["growth"]
    counts = [row["objects"] for row in rows]
    plt.rcParams.update({"font.size": 18, "lines.linewidth": 2.5})
    figure, panels = plt.subplots(1, 2, figsize=(18, 8), layout="constrained", sharey=True)
    for panel, (group, names) in zip(panels, TIMED.items(), strict=True):
        for marker, (name, label) in zip("sDo", names.items(), strict=True):
            times = [row[group][name]["mean_ms"] for row in rows]
            panel.plot(counts, times, marker=marker, markersize=10, label=label)
        panel.set(xlabel="objects in the scene", xscale="log", yscale="log")
        panel.set_xticks(counts, [str(count) for count in counts])
        panel.minorticks_off()
        panel.grid(alpha=0.4)
        panel.legend()
    panels[0].set_ylabel("mean time per scene [ms]")
    panels[1].set_ylabel("mean time per image [ms]")
    panels[1].tick_params(labelleft=True)
    figure.savefig(path, dpi=80)
    plt.close(figure)


def draw_objects_found(path: Path) -> None:
    """Draw the fraction of the hidden objects found over the moves, one panel per dataset."""
    plt.rcParams.update({"font.size": 18, "lines.linewidth": 2.5})
    figure, panels = plt.subplots(
        2, 2, figsize=(18, 12), layout="constrained", sharex=True, sharey=True
    )
    for panel, name in zip(panels.flat, DATASETS, strict=True):
        _draw_dataset(panel, name)
    handles = {
        label: line
        for panel in panels.flat
        for line, label in zip(*panel.get_legend_handles_labels(), strict=True)
    }
    figure.legend(handles.values(), handles, loc="outside lower center", ncols=4)
    figure.savefig(path, dpi=80)
    plt.close(figure)


def _draw_dataset(panel: Axes, name: str) -> None:
    """Draw one panel, on the scenes that all policies have explored."""
    runs: dict[str, list[dict[str, Any]]] = {}
    for policy in POLICIES:
        episodes = read_episodes(TRAINING / f"episodes/{name}_{policy}.jsonl.gz")
        if len(episodes) >= MIN_EPISODES:
            runs[policy] = episodes
    count = min(len(episodes) for episodes in runs.values())
    for policy, episodes in runs.items():
        hidden = sum(episode["hidden"] for episode in episodes[:count])
        found = np.zeros(MAX_MOVES + 1)
        for episode in episodes[:count]:
            after = [0, *episode["found_after"]]
            found += np.pad(after, (0, MAX_MOVES + 1 - len(after)), mode="edge")
        label, color = POLICIES[policy]
        style = "--" if policy == "full-knowledge" else "-"
        panel.plot(found / hidden, label=label, color=color, linestyle=style)
    panel.set(
        title=f"{DATASETS[name]}; {count} scenes",
        xlim=(0, MAX_MOVES),
        ylim=(0, 1.02),
        xticks=range(0, MAX_MOVES + 1, 5),
        xlabel="moves",
        ylabel="fraction of the hidden objects found",
    )
    panel.label_outer()
    panel.grid(alpha=0.4)


def main() -> None:
    """Draw all figures into docs/images."""
    seeds = {
        f"seed {path.stem[-1]}": read_training_results(path.name)["history"]
        for path in sorted(TRAINING.glob("sg_star_seed_*.json"))
    }
    draw_learning_curves(
        IMAGES / "learning_curves.png",
        seeds,
        {"score": "return", "hidden": "hidden objects", "stable": "fraction stable"},
    )
    trainings = {
        row["agent"].replace("collapse costs 1", "collapse penalty 1"): row["history"]
        for row in read_training_results("explorer_trainings.json")["rows"]
        if row["history"][-1]["step"] > 1000  # clones count rounds
    }
    draw_learning_curves(
        IMAGES / "explorer_curves.png",
        trainings,
        {
            "success": "success rate",
            "moves_of_successes": "moves of successes",
            "collapsed": "fraction collapsed",
        },
    )
    draw_stacks(IMAGES / "stacks.png")
    draw_temperatures(IMAGES / "trade_off.png")
    draw_times(IMAGES / "speed_growth.png")
    draw_objects_found(IMAGES / "explorers.png")


if __name__ == "__main__":
    with cli_error_handler():
        typer.run(main)
