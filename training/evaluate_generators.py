"""Table I: every generation agent at every size, judged by Drake; how temperature trades what is hidden for variety; pictures.

    python training/evaluate_generators.py runs/table1 --workers 2

Scenes stay in the folder; a run that was stopped goes on with what is missing.
"""

import json
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
import typer
from rich.console import Console
from rich.progress import track
from rich.table import Table

from drake_clutter.agents.generators import PRETRAINED_GENERATORS, GenerationJob
from drake_clutter.catalog import load_catalog
from drake_clutter.commands.generate_scenes import SCENES_FOLDER, generate_scenes
from drake_clutter.config import ClutterConfig
from drake_clutter.files import InputError, cli_error_handler, write_json
from drake_clutter.resources import git_commit, resource_path
from drake_clutter.scenes.interfaces import InconclusiveVerdict
from drake_clutter.scenes.scene_file import load_scene
from drake_clutter.stability.judge import FastJudge

RESULTS = Path(__file__).parent / "results"


@dataclass(frozen=True)
class Row:
    """Scenes of an agent at a size; `agent` as for `drake-clutter generate`."""

    agent: str
    nodes: int
    count: int
    objects: str = "ycb7"
    temperature: float | None = None

    @property
    def folder(self) -> str:
        """Its name."""
        warmth = "" if self.temperature is None else f"_at_{self.temperature:g}"
        return f"{Path(self.agent).stem}_{self.objects}_{self.nodes}{warmth}"


SIZES = {10: 300, 15: 300, 20: 300, 25: 1000, 40: 300}
TABLE = [
    Row(agent, nodes, count)
    for agent in ("random", "hill-climbing", "sg", "sg-star")
    for nodes, count in SIZES.items()
]
TABLE += [Row(agent, 25, 300, "pantry14") for agent in ("random", "sg-14")]
# As files, from the top folder: other seeds of SG*, and the paper's reward.
TABLE += [
    Row(f"training/checkpoints/sg_star_{name}.safetensors", 25, 300)
    for name in ("seed_1", "seed_2", "paper")
]
TRADE = [
    Row("sg-star", 25, 300, temperature=temperature)
    for temperature in (0.02, 0.05, 0.1, 0.2, 0.4, 0.8)
]


def measured(row: Row, folder: Path, workers: int, seed: int) -> dict[str, Any]:
    """Generates a row's scenes and says all that is to be said of them."""
    job = GenerationJob(
        row.agent, row.objects, None, row.nodes, seed, ClutterConfig(), row.temperature
    )

    def progress(made: Iterable[Any], done: int, total: int) -> Iterable[Any]:
        return track(made, row.folder, total=total, completed=done, console=Console(stderr=True))

    summary = generate_scenes(job, row.count, folder, workers, progress)
    catalog, judge = load_catalog(), FastJudge(job.config)
    confusion: Counter[str] = Counter()
    heights: Counter[int] = Counter()
    for path in sorted((folder / SCENES_FOLDER).iterdir())[: row.count]:
        file = load_scene(path, catalog)
        assert file.verdict is not None
        assert file.scene.graph is not None
        found = judge.stability(file.scene)
        fast = (
            "cannot judge"
            if isinstance(found, InconclusiveVerdict)
            else "stable"
            if found is None
            else "falls"
        )
        confusion[f"fast {fast}, drake {'stable' if file.verdict.stable else 'falls'}"] += 1
        top = {o.node: o.top_height for o in file.scene.objects}
        for nodes in file.scene.graph.stack_objects():
            heights[int(max(top[node] for node in nodes) // 0.05)] += 1
    called = confusion["fast stable, drake stable"] + confusion["fast stable, drake falls"]
    summary |= {
        "row": asdict(row),
        "fast_judge": dict(confusion),
        "false_stable_of_called_stable": confusion["fast stable, drake falls"] / called
        if called
        else None,
        "stack_heights_5cm": [heights[k] for k in range(10)],
        "commit": git_commit(),
    }
    return summary


def show(rows: list[dict[str, Any]], console: Console) -> None:
    """Prints the table."""
    columns = {
        "stable": "stability_rate",
        "hidden": "hidden_mean",
        "solvable": "solvable_share",
        "distinct": "distinct_share",
    }
    columns |= {"stacks": "mean_stacks", "balanced": "balanced_share", "bits": "class_entropy"}
    table = Table("agent", "objects", "nodes", "scenes", *columns)
    for row in rows:
        agent = (
            row["agent"]
            if row["temperature"] is None
            else f"{row['agent']} at {row['temperature']:g}"
        )
        values = ["" if row[key] is None else f"{row[key]:.3g}" for key in columns.values()]
        table.add_row(agent, row["objects"], str(row["nodes"]), str(row["count"]), *values)
    console.print(table)


def of_temperatures(found: Mapping[str, dict[str, Any]]) -> list[dict[str, Any]]:
    """The rows of SG* at 25 nodes in the order of their temperatures; Table I's is at that of the checkpoint."""
    rows = [found[row.folder] for row in TRADE if row.folder in found]
    if (as_shipped := found.get(Row("sg-star", 25, 1000).folder)) is not None:
        about = json.loads(
            resource_path(PRETRAINED_GENERATORS["sg-star"]).with_suffix(".json").read_text()
        )
        rows.append(as_shipped | {"temperature": about["temperature"]})
    return sorted(rows, key=lambda row: float(row["temperature"]))


def draw_trade(rows: list[dict[str, Any]], path: Path) -> None:
    """Hidden objects, stability and variety over the temperature."""
    plt.rcParams.update({"font.size": 20, "lines.linewidth": 3, "lines.markersize": 11})
    figure, (left, right) = plt.subplots(1, 2, figsize=(15, 6.5), layout="constrained")
    warmth = [row["temperature"] for row in rows]
    hidden = np.array(
        [[row["hidden_mean"], *(row["hidden_ci95"] or (np.nan, np.nan))] for row in rows]
    )
    left.errorbar(
        warmth, hidden[:, 0], np.abs(hidden[:, 1:] - hidden[:, :1]).T, marker="o", capsize=6
    )
    left.set(
        xscale="log",
        xlabel="temperature of the policy",
        ylabel="hidden objects in a stable scene",
        ylim=(0, None),
    )
    for key, name, marker in (
        ("stability_rate", "stable", "o"),
        ("solvable_share", "solvable", "s"),
        ("distinct_share", "distinct", "D"),
        ("balanced_share", "balanced", "^"),
    ):
        right.plot(warmth, [row[key] for row in rows], marker=marker, label=name)
    even = [
        row["class_entropy"] / np.log2(len(load_catalog().object_set(row["objects"])))
        for row in rows
    ]
    right.plot(warmth, even, marker="v", label="classes, of the\ngreatest entropy")
    right.set(
        xscale="log",
        xlabel="temperature of the policy",
        ylabel="share of the scenes",
        ylim=(0, 1.03),
    )
    right.legend(loc="lower right", fontsize=16)
    for panel in (left, right):
        panel.grid(alpha=0.4)
        panel.set_xticks(warmth, [f"{value:g}" for value in warmth], rotation=45)
        panel.minorticks_off()
    figure.savefig(path, dpi=100)
    plt.close(figure)


def main(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Where the scenes go.")],
    workers: int = 1,
    seed: Annotated[int, typer.Option(help="Of the scenes; trainings have others.")] = 1000,
    only: Annotated[
        str | None, typer.Option(help="Of rows whose folder's name contains this.")
    ] = None,
    at_most: Annotated[
        int | None, typer.Option(help="Scenes of a row for now; a later run adds the others.")
    ] = None,
    out: Annotated[Path, typer.Option(help="JSON to write.")] = RESULTS / "table1.json",
    picture: Annotated[
        Path | None, typer.Option(help="PNG to write: the temperature's trade-off.")
    ] = None,
) -> None:
    """Measures what is missing and prints the table."""
    console = Console()
    found: dict[str, dict[str, Any]] = {}
    if out.exists():
        earlier = json.loads(out.read_text())
        if earlier["seed"] != seed:
            raise InputError(
                f"--out {out}: holds results of seed {earlier['seed']}; give the same seed or another file"
            )
        found = {Row(**row["row"]).folder: row for row in earlier["rows"]}
    for row in TABLE + TRADE:
        count = min(row.count, at_most or row.count)
        held = found[row.folder]["count"] if row.folder in found else 0
        if held < count and (only is None or only in row.folder):
            found[row.folder] = measured(
                replace(row, count=count), folder / row.folder, workers, seed
            )
            out.parent.mkdir(parents=True, exist_ok=True)
            write_json(out, {"seed": seed, "rows": list(found.values())})
    show(list(found.values()), console)
    if picture is not None:
        draw_trade(of_temperatures(found), picture)


if __name__ == "__main__":
    with cli_error_handler():
        typer.run(main)
