"""RG's row of the paper's Table I under a config: stability and hidden objects by size, judged by Drake.

python benchmarks/random_generator_calibration.py --count 1000 --workers 2 --out benchmarks/results/calibration.json
"""

import json
import time
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.progress import track
from rich.table import Table

from drake_clutter.agents.generators import GenerationJob, SceneGenerator, summarize_scenes
from drake_clutter.config import load_config
from drake_clutter.files import InputError, write_json
from drake_clutter.resources import git_commit
from drake_clutter.validation import config_yaml
from drake_clutter.workers.parallel_map import map_ordered

PAPER_RG = {10: (0.84, 1.13), 15: (0.64, 1.64), 20: (0.55, 2.18), 25: (0.41, 2.51)}
"""Stability rate and mean hidden objects of RG by nodes (Table I)."""
THRESHOLDS = (0.10, 0.20, 0.25, 0.30, 0.35, 0.40)


class _Size:
    """Makes the worker of a job; picklable."""

    def __init__(self, job: GenerationJob) -> None:
        self.job = job

    def __call__(self) -> SceneGenerator:
        return SceneGenerator(self.job)


def main(
    count: Annotated[int, typer.Option(help="Scenes of each size.")] = 150,
    seed: int = 0,
    workers: int = 1,
    objects: str = "ycb7",
    nodes: Annotated[
        list[int] | None, typer.Option(help="Sizes; the paper's four if not given.")
    ] = None,
    config: Annotated[
        Path | None, typer.Option(help="YAML with fields to put over the defaults.")
    ] = None,
    out: Annotated[Path | None, typer.Option(help="JSON to write.")] = None,
) -> None:
    """Prints the table, and hidden objects by threshold, and writes both with what is needed to repeat them.

    A run that was stopped goes on with the sizes that its file lacks.
    """
    world = load_config(config)
    head = {
        "count": count,
        "seed": seed,
        "objects": objects,
        "workers": workers,
        "config": config_yaml(world),
    }
    rows: list[dict[str, Any]] = []
    if out is not None and out.exists():
        earlier = json.loads(out.read_text())
        if {key: earlier[key] for key in head} != head:
            raise InputError(
                f"--out {out}: holds results of other options; give the same options or another file"
            )
        rows = earlier["rows"]
    for size in nodes or PAPER_RG:
        if any(row["nodes"] == size for row in rows):
            continue
        job = GenerationJob("random", objects, None, size, seed, world)
        start = time.monotonic()
        scenes = map_ordered(_Size(job), range(count), workers=workers)
        made = list(track(scenes, f"{size} nodes", total=count, console=Console(stderr=True)))
        row = summarize_scenes(job, [(m.scene, m.verdict) for m in made])
        shares = [m.verdict.visible_fractions.values() for m in made if m.verdict.stable]
        row["hidden_by_threshold"] = {
            str(t): sum(sum(v < t for v in s) for s in shares) / len(shares) for t in THRESHOLDS
        }
        failures = sum((m.layout_failures for m in made), start=type(made[0].layout_failures)())
        row |= {
            "layout_failures": dict(failures),
            "seconds": time.monotonic() - start,
            "commit": git_commit(),
        }
        rows.append(row)
        if out is not None:
            write_json(out, head | {"rows": rows})
    table = Table(
        "nodes", "stable", "paper", "hidden", "paper", *(f"< {t:g}" for t in THRESHOLDS), "s"
    )
    for row in rows:
        paper = PAPER_RG.get(row["nodes"], (float("nan"),) * 2)
        cells = [
            f"{row['stability_rate']:.3f}",
            f"{paper[0]:.2f}",
            f"{row['hidden_mean']:.2f}",
            f"{paper[1]:.2f}",
        ]
        cells += [f"{h:.2f}" for h in row["hidden_by_threshold"].values()]
        table.add_row(str(row["nodes"]), *cells, f"{row['seconds']:.0f}")
    Console().print(table)


if __name__ == "__main__":
    typer.run(main)
