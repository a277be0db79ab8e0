"""Evaluate scene generators in Drake (Table I of the paper), and the effect of the temperature.

    python training/evaluate_generators.py runs/table1 --workers 2

The scenes stay in the folder. An interrupted run is resumed by the same command.
"""

from collections import Counter
from collections.abc import Iterable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import typer

from drake_clutter.agents.generators import GenerationJob
from drake_clutter.catalog import load_catalog
from drake_clutter.commands.generate_scenes import SCENES_FOLDER, generate_scenes
from drake_clutter.config import ClutterConfig
from drake_clutter.scenes.interfaces import InconclusiveVerdict, Instability
from drake_clutter.scenes.scene_file import load_scene
from drake_clutter.stability.static_judge import StaticStabilityJudge
from training.results_file import ResultsFile, Row, provenance
from training.script import (
    RESULTS,
    WorkersOption,
    format_number,
    print_table,
    progress,
    run_script,
)


@dataclass(frozen=True)
class GeneratorEvaluation:
    """One row of the table: scenes of one generator and size.

    Attributes:
        agent: Name of the generator, or file of a checkpoint relative to the checkout.
        nodes: Number of nodes of the scene graphs.
        count: Number of scenes.
        objects: Name of the object set.
        temperature: Temperature of the policy; None for that of the checkpoint.
    """

    agent: str
    nodes: int
    count: int
    objects: str = "ycb7"
    temperature: float | None = None

    @property
    def name(self) -> str:
        """Name of the folder that holds the scenes."""
        suffix = "" if self.temperature is None else f"_at_{self.temperature:g}"
        return f"{Path(self.agent).stem}_{self.objects}_{self.nodes}{suffix}"


SCENES_BY_NODES = {10: 300, 15: 300, 20: 300, 25: 1000, 40: 300}
"""Number of scenes of each size."""
TABLE = [
    *(
        GeneratorEvaluation(agent, nodes, count)
        for agent in ("random", "hill-climbing", "sg", "sg-star")
        for nodes, count in SCENES_BY_NODES.items()
    ),
    *(GeneratorEvaluation(agent, 25, 300, "pantry14") for agent in ("random", "sg-14")),
    # SG* trained with other seeds, and with the paper's reward.
    *(
        GeneratorEvaluation(f"training/checkpoints/sg_star_{name}.safetensors", 25, 300)
        for name in ("seed_1", "seed_2", "paper")
    ),
]
"""Rows of Table I."""
TEMPERATURES = [
    GeneratorEvaluation("sg-star", 25, 300, temperature=temperature)
    for temperature in (0.02, 0.05, 0.1, 0.2, 0.4, 0.8)
]
"""Rows that show the effect of the temperature."""
STACK_HEIGHT_BIN = 0.05
"""Width of the bins of the histogram of stack heights [m]."""
NUM_STACK_HEIGHT_BINS = 10
"""Bins of that histogram: stacks are at most 0.5 m high."""


def verdict_name(verdict: Instability | InconclusiveVerdict | None) -> str:
    """Return the name of a judge's verdict in results files.

    Args:
        verdict: How the scene is unstable; None if it is stable.
    """
    if isinstance(verdict, InconclusiveVerdict):
        return "inconclusive"
    return "stable" if verdict is None else "unstable"


def evaluate_generator(
    evaluation: GeneratorEvaluation, folder: Path, workers: int, seed: int
) -> Row:
    """Generate the scenes of a row and return the row.

    Args:
        evaluation: The row.
        folder: Folder for the scenes; scenes that it already holds are kept.
        workers: Number of processes.
        seed: Seed of the scenes.
    """
    job = GenerationJob(
        evaluation.agent,
        evaluation.objects,
        None,
        evaluation.nodes,
        seed,
        ClutterConfig(),
        evaluation.temperature,
    )

    def show_progress(scenes: Iterable[Any], done: int, total: int) -> Iterable[Any]:
        return progress(scenes, evaluation.name, total, done)

    summary = generate_scenes(job, evaluation.count, folder, workers, show_progress)
    catalog = load_catalog()
    static_judge = StaticStabilityJudge(job.config)
    confusion = Counter[str]()
    heights = Counter[int]()
    for path in sorted((folder / SCENES_FOLDER).iterdir())[: evaluation.count]:
        file = load_scene(path, catalog)
        assert file.verdict is not None
        assert file.scene.graph is not None
        static = verdict_name(static_judge.find_instability(file.scene))
        confusion[f"static {static}, Drake {'stable' if file.verdict.stable else 'unstable'}"] += 1
        top = {o.node: o.top_height for o in file.scene.objects}
        for nodes in file.scene.graph.stack_objects():
            heights[int(max(top[node] for node in nodes) // STACK_HEIGHT_BIN)] += 1
    false_stable = confusion["static stable, Drake unstable"]
    called_stable = confusion["static stable, Drake stable"] + false_stable
    return summary | {
        "row": asdict(evaluation),
        "static_judge": dict(confusion),
        "false_stable_of_called_stable": false_stable / called_stable if called_stable else None,
        "stack_heights_5cm": [heights[k] for k in range(NUM_STACK_HEIGHT_BINS)],
        **provenance(),
    }


def table_row(row: Row) -> dict[str, str]:
    """Return a row of the results as cells of the printed table."""
    agent = Path(row["agent"]).stem
    columns = {
        "stable": "stability_rate",
        "hidden": "hidden_mean",
        "solvable": "solvable_share",
        "distinct": "distinct_share",
        "stacks": "mean_stacks",
        "balanced": "balanced_share",
        "class entropy (bits)": "class_entropy",
    }
    return {
        "agent": agent if row["temperature"] is None else f"{agent} at {row['temperature']:g}",
        "objects": row["objects"],
        "nodes": str(row["nodes"]),
        "scenes": str(row["count"]),
    } | {title: format_number(row[key], 3) for title, key in columns.items()}


def main(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Folder for the scenes.")],
    workers: WorkersOption = 1,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the scenes.")] = 1000,
    only: Annotated[
        str | None, typer.Option(metavar="TEXT", help="Only rows whose name contains this text.")
    ] = None,
    max_scenes: Annotated[
        int | None,
        typer.Option(min=1, help="Scenes per row at most; a later run adds the remaining ones."),
    ] = None,
    out: Annotated[
        Path, typer.Option(metavar="FILE", help="Results file to write (JSON).")
    ] = RESULTS / "table1.json",
) -> None:
    """Evaluate the generators, as far as it has not been done, and print the table."""
    results = ResultsFile(out, {"seed": seed}, ("agent", "objects", "nodes", "temperature"))
    for evaluation in TABLE + TEMPERATURES:
        count = min(evaluation.count, max_scenes or evaluation.count)
        row = results.find(asdict(evaluation))
        has_all = row is not None and row["count"] >= count
        if has_all or (only is not None and only not in evaluation.name):
            continue
        part = replace(evaluation, count=count)
        results.add(evaluate_generator(part, folder / evaluation.name, workers, seed))
    print_table([table_row(row) for row in results.read()])


if __name__ == "__main__":
    run_script(main)
