"""Is what the generator's reward asks of a scene, that it can be taken apart from the top, what makes it solvable?

    drake-clutter generate --agent training/checkpoints/sg_star_paper.safetensors --count 100 --seed 1000 --out out/paper
    python benchmarks/disassembly_vs_solvability.py out/paper out/others

For each folder that `drake-clutter generate` wrote: its stable scenes by whether they come apart, and whether they are solvable.
"""

import json
from collections import Counter
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.table import Table

from drake_clutter.catalog import load_catalog
from drake_clutter.commands.generate_scenes import PROGRESS_FILE, SCENES_FOLDER
from drake_clutter.commands.job_file import JOB_FILE
from drake_clutter.config import ClutterConfig
from drake_clutter.files import cli_error_handler, write_json
from drake_clutter.resources import git_commit
from drake_clutter.scenes.scene_file import load_scene
from drake_clutter.stability.static_judge import StaticStabilityJudge
from drake_clutter.statistics import wilson_interval
from drake_clutter.tasks.oracle_search import Solvability

OUT = Path(__file__).parent / "results" / "come_apart.json"


def counted(folder: Path) -> dict[str, Any]:
    """A folder's row."""
    job, catalog, judge = (
        json.loads((folder / JOB_FILE).read_text()),
        load_catalog(),
        StaticStabilityJudge(ClutterConfig()),
    )
    counts: Counter[tuple[bool, bool]] = Counter()  # comes apart, solvable
    answers = json.loads((folder / PROGRESS_FILE).read_text())["solvable"]
    for index, answer in enumerate(answers):
        file = load_scene(folder / SCENES_FOLDER / f"{index:04d}.yaml", catalog)
        if file.verdict is not None and file.verdict.stable:
            counts[
                judge.is_disassemblable(file.settled_scene) is True,
                answer == Solvability.SOLVABLE.value,
            ] += 1
    told: dict[str, Any] = {"agent": job["agent"], "objects": job["objects"], "nodes": job["nodes"]}
    told |= {"seed": job["seed"], "scenes": len(answers)}
    for name, apart in (("comes_apart", True), ("does_not", False)):
        solved, total = counts[apart, True], counts[apart, True] + counts[apart, False]
        told[name] = {
            "stable": total,
            "solvable": solved,
            "solvable_ci95": wilson_interval(solved, total),
        }
    return told


def main(
    folders: Annotated[
        list[Path], typer.Argument(metavar="DIR...", help="Of `drake-clutter generate`.")
    ],
    out: Annotated[Path, typer.Option(help="JSON to write.")] = OUT,
) -> None:
    """Counts, and prints a table."""
    rows = [counted(folder) for folder in folders]
    write_json(out, {"commit": git_commit(), "rows": rows})
    table = Table(
        "agent",
        "objects",
        "nodes",
        "scenes",
        "stable, come apart",
        "of these solvable",
        "stable, do not",
        "of these solvable",
    )
    for row in rows:
        cells = [
            f"{row[name][key]}"
            for name in ("comes_apart", "does_not")
            for key in ("stable", "solvable")
        ]
        table.add_row(
            Path(row["agent"]).stem, row["objects"], str(row["nodes"]), str(row["scenes"]), *cells
        )
    Console().print(table)


if __name__ == "__main__":
    with cli_error_handler():
        typer.run(main)
