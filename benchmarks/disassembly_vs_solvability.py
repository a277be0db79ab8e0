"""Compare two properties of stable scenes: can they be disassembled, and are they solvable.

    drake-clutter generate --agent sg-star --count 100 --seed 1000 --out out/scenes
    python benchmarks/disassembly_vs_solvability.py out/scenes --out disassembly.json

The generators' reward requires that a scene can be disassembled from the top, which is cheap to
test. A scene is solvable if the oracle search reveals all objects.
"""

from collections import Counter
from pathlib import Path
from typing import Annotated

import typer

from drake_clutter.catalog import load_catalog
from drake_clutter.commands.generate_scenes import (
    PROGRESS_FILE,
    SCENES_FOLDER,
    read_generation_progress,
)
from drake_clutter.commands.job_file import JOB_FILE
from drake_clutter.config import ClutterConfig
from drake_clutter.files import read_json, write_json
from drake_clutter.scenes.scene_file import load_scene
from drake_clutter.stability.static_judge import StaticStabilityJudge
from drake_clutter.statistics import wilson_interval
from drake_clutter.tasks.oracle_search import Solvability
from training.results_file import Row, provenance
from training.script import ROOT, print_table, run_script

RESULTS_FILE = ROOT / "benchmarks/results/come_apart.json"
"""Published results."""


def count_scenes(folder: Path) -> Row:
    """Return the counts of stable scenes by both properties.

    Args:
        folder: Folder that `drake-clutter generate` wrote.
    """
    job = read_json(folder / JOB_FILE, "the options of a job")
    answers = read_generation_progress(folder / PROGRESS_FILE).solvable
    catalog = load_catalog()
    judge = StaticStabilityJudge(ClutterConfig())
    counts = Counter[tuple[bool, bool]]()
    for index, answer in enumerate(answers):
        file = load_scene(folder / SCENES_FOLDER / f"{index:04d}.yaml", catalog)
        if file.verdict is not None and file.verdict.stable:
            is_disassemblable = judge.is_disassemblable(file.settled_scene) is True
            counts[is_disassemblable, answer is Solvability.SOLVABLE] += 1
    row: Row = {key: job[key] for key in ("agent", "objects", "nodes", "seed")}
    row["scenes"] = len(answers)
    for name, is_disassemblable in (("comes_apart", True), ("does_not", False)):
        num_solvable = counts[is_disassemblable, True]
        total = num_solvable + counts[is_disassemblable, False]
        row[name] = {
            "stable": total,
            "solvable": num_solvable,
            "solvable_ci95": wilson_interval(num_solvable, total),
        }
    return row


def table_row(row: Row) -> dict[str, str]:
    """Return a row of the results as cells of the printed table."""
    return {
        "agent": Path(row["agent"]).stem,
        "objects": row["objects"],
        "nodes": str(row["nodes"]),
        "scenes": str(row["scenes"]),
        "disassemblable": str(row["comes_apart"]["stable"]),
        "solvable of these": str(row["comes_apart"]["solvable"]),
        "not disassemblable": str(row["does_not"]["stable"]),
        "solvable of those": str(row["does_not"]["solvable"]),
    }


def main(
    folders: Annotated[
        list[Path], typer.Argument(metavar="DIR...", help="Folders of `drake-clutter generate`.")
    ],
    out: Annotated[
        Path, typer.Option(metavar="FILE", help="Results file to write (JSON).")
    ] = RESULTS_FILE,
) -> None:
    """Count scenes, and print and write the table."""
    rows = [count_scenes(folder) for folder in folders]
    write_json(out, {**provenance(), "rows": rows})
    print_table([table_row(row) for row in rows])


if __name__ == "__main__":
    run_script(main)
