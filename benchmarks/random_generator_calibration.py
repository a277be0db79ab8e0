"""Compare the random generator with the paper's Table I, under a configuration.

    python benchmarks/random_generator_calibration.py --count 1000 --out calibration.json

For each size: the fraction of scenes that are stable in Drake, and the number of hidden objects by
visibility threshold. An interrupted run is resumed by the same command.
"""

import time
from functools import partial
from typing import Annotated

import typer

from drake_clutter.agents.generators import GenerationJob, SceneGenerator, summarize_scenes
from drake_clutter.config import ClutterConfig, load_config
from drake_clutter.validation import to_plain
from drake_clutter.workers.parallel_map import map_ordered
from training.results_file import ResultsFile, Row, provenance
from training.script import (
    ConfigOption,
    ResultsOption,
    SeedOption,
    WorkersOption,
    format_number,
    print_table,
    progress,
    run_script,
)

PAPER = {10: (0.84, 1.13), 15: (0.64, 1.64), 20: (0.55, 2.18), 25: (0.41, 2.51)}
"""Stability rate and mean number of hidden objects by nodes (Kumar et al. 2022, Table I, RG)."""
THRESHOLDS = (0.10, 0.20, 0.25, 0.30, 0.35, 0.40)
"""Visible fractions below which an object may count as hidden."""


def evaluate_size(
    nodes: int, count: int, objects: str, seed: int, workers: int, config: ClutterConfig
) -> Row:
    """Generate and judge scenes of one size and return their row.

    Args:
        nodes: Number of nodes of the scene graphs.
        count: Number of scenes.
        objects: Name of the object set.
        seed: Seed of the scenes.
        workers: Number of processes.
        config: Configuration of the scenes and the judge.
    """
    job = GenerationJob("random", objects, None, nodes, seed, config)
    start = time.monotonic()
    generated = map_ordered(partial(SceneGenerator, job), range(count), workers=workers)
    scenes = list(progress(generated, f"{nodes} nodes", count))
    row = summarize_scenes(job, [(scene.scene, scene.verdict) for scene in scenes])
    fractions = [s.verdict.visible_fractions.values() for s in scenes if s.verdict.stable]
    failures = sum((s.layout_failures for s in scenes), start=type(scenes[0].layout_failures)())
    hidden_by_threshold: dict[str, float | None] = {}
    for threshold in THRESHOLDS:
        num_hidden = sum(f < threshold for scene in fractions for f in scene)
        hidden_by_threshold[str(threshold)] = num_hidden / len(fractions) if fractions else None
    return row | {
        "hidden_by_threshold": hidden_by_threshold,
        "layout_failures": dict(failures),
        "seconds": time.monotonic() - start,
        **provenance(),
    }


def table_row(row: Row) -> dict[str, str]:
    """Return a row of the results as cells of the printed table."""
    stable, hidden = PAPER.get(row["nodes"], (None, None))
    return {
        "nodes": str(row["nodes"]),
        "stable": format_number(row["stability_rate"], 3),
        "stable (paper)": format_number(stable),
        "hidden": format_number(row["hidden_mean"]),
        "hidden (paper)": format_number(hidden),
        **{
            f"hidden below {threshold}": format_number(mean)
            for threshold, mean in row["hidden_by_threshold"].items()
        },
        "time (s)": format_number(row["seconds"], 0),
    }


def main(
    count: Annotated[int, typer.Option(min=1, help="Number of scenes of each size.")] = 150,
    seed: SeedOption = 0,
    workers: WorkersOption = 1,
    objects: Annotated[str, typer.Option(help="Name of the object set.")] = "ycb7",
    nodes: Annotated[
        list[int] | None, typer.Option(help="A size instead of the paper's. May be repeated.")
    ] = None,
    config: ConfigOption = None,
    out: ResultsOption = None,
) -> None:
    """Evaluate the sizes that are missing in the results file, and print the table."""
    world = load_config(config)
    header = {"count": count, "seed": seed, "objects": objects, "config": to_plain(world)}
    results = ResultsFile(out, header, ("nodes",)) if out else None
    rows = list[Row]()
    for size in nodes or PAPER:
        row = results.find({"nodes": size}) if results else None
        if row is None:
            row = evaluate_size(size, count, objects, seed, workers, world)
            if results:
                results.add(row)
        rows.append(row)
    print_table([table_row(row) for row in rows])


if __name__ == "__main__":
    run_script(main)
