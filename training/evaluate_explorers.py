"""Evaluate explorers on the shipped scene datasets, with moves settled in Drake.

    python training/evaluate_explorers.py --workers 2

Every episode is a record in `training/results/episodes`, in one file for each set and explorer. An
interrupted run is resumed by the same command.
"""

from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Annotated, Any

import typer

from drake_clutter.agents.episode_evaluation import EpisodeResult, summarize_episodes
from drake_clutter.agents.explorers import ORACLE, PRETRAINED_EXPLORERS, make_policy_factory
from drake_clutter.catalog import load_catalog
from drake_clutter.config import ClutterConfig
from drake_clutter.files import InputError
from drake_clutter.learning.pretrained import checkpoint_sha256
from drake_clutter.outputs import output_file
from drake_clutter.records import read_jsonl
from drake_clutter.reports.terminal_text import evaluation_table_rows
from drake_clutter.scenes.scene_dataset import SceneDataset, load_scene_dataset
from drake_clutter.statistics import ratio_interval
from drake_clutter.tasks.exploration_task import TerminationReason
from drake_clutter.validation import to_plain
from training.episode_files import (
    MAX_MOVES,
    AgentsOption,
    CountOption,
    EpisodesSeedOption,
    FidelityOption,
    SetNameOption,
    check_evaluation,
    collect_episodes,
    episodes_path,
)
from training.results_file import ResultsFile, Row
from training.script import (
    RESULTS,
    SCENES,
    ResultsOption,
    WorkersOption,
    format_number,
    print_table,
    run_script,
)

EPISODES = RESULTS / "episodes"
"""Folder of the published episodes."""
MOVE_LIMITS = (10, MAX_MOVES)
"""Numbers of moves within which a success counts."""
BASELINES = {"ceiling": ORACLE, "largest_clear": "largest-clear"}
"""Explorers whose numbers of moves the others' are divided by, by their names in results files."""
YCB7_EXPLORERS = (
    "random",
    "largest-first",
    "largest-clear",
    "student-rg",
    "student-dagger",
    "student",
    ORACLE,
)
"""Explorers that are evaluated on scenes of the object set ycb7."""
PANTRY14_EXPLORERS = ("random", "largest-first", "largest-clear", "student-14", ORACLE)
"""Explorers that are evaluated on scenes of the object set pantry14."""
YCB7_SETS = (
    "paper_hardness",
    "sg_star_10",
    "sg_star_15",
    "sg_star_20",
    "sg_star_25",
    "sg_star_40",
    "rg_25",
)
"""Scene datasets of the object set ycb7."""
PANTRY14_SETS = ("sg_14",)
"""Scene datasets of the object set pantry14."""
TABLES = dict.fromkeys(YCB7_SETS, ("table2", YCB7_EXPLORERS)) | dict.fromkeys(
    PANTRY14_SETS, ("table3", PANTRY14_EXPLORERS)
)
"""By scene dataset: the results file of its rows, and the explorers that are evaluated on it."""


def summarize(
    results: Sequence[EpisodeResult],
    baselines: Mapping[str, Sequence[EpisodeResult]],
    max_objects: int,
) -> Row:
    """Return the metrics of an explorer.

    Args:
        results: Results of the explorer, by scene.
        baselines: Results of the baselines on the first of these scenes, by name. The explorer's
            number of moves is divided by a baseline's, over the scenes in which both succeed.
        max_objects: Largest number of objects of a scene.
    """
    row = summarize_episodes(results, MOVE_LIMITS, max_objects)
    for name, baseline in baselines.items():
        moves = [
            (ours.moves, theirs.moves)
            for ours, theirs in zip(results, baseline, strict=False)
            if {ours.ended, theirs.ended} == {TerminationReason.ALL_FOUND.value}
        ]
        ratio = sum(m for m, _ in moves) / sum(m for _, m in moves) if moves else None
        row[f"moves_to_{name}"] = ratio
        row[f"moves_to_{name}_ci95"] = ratio_interval(
            [m for m, _ in moves], [m for _, m in moves], (1, MAX_MOVES), (MAX_MOVES, 1)
        )
        row[f"both_with_{name}"] = len(moves)
    return row


def table_rows(row: Row) -> list[dict[str, str]]:
    """Return a row of the results as lines of the printed table, one for each limit of moves."""
    first = {
        "set": row["set"],
        "agent": row["agent"],
        "episodes": str(row["episodes"]),
        "hidden": format_number(row["hidden"], 1),
    }
    last = {f"moves / {name}": format_number(row.get(f"moves_to_{name}")) for name in BASELINES}
    return [first | cells | last for cells in evaluation_table_rows(row, MOVE_LIMITS)]


def evaluate_set(
    scenes: SceneDataset, agents: Sequence[str], folder: Path, count: int, **options: Any
) -> list[Row]:
    """Run the episodes of explorers on a scene dataset and return their rows of the results.

    Args:
        scenes: The scene dataset.
        agents: The explorers.
        folder: Folder of the record files.
        count: Number of episodes, on the first scenes of the set.
        options: Further options of `collect_episodes`.
    """
    set_name = Path(scenes.name).stem
    records = {
        agent: collect_episodes(
            episodes_path(folder, set_name, agent), scenes, agent, count, **options
        )
        for agent in agents
    }
    baselines = {}
    for name, agent in BASELINES.items():
        path = episodes_path(folder, set_name, agent)
        num_records = min(count, len(read_jsonl(path)) - 1)
        if num_records > 0:  # No episode of a baseline is run for a comparison.
            baseline = collect_episodes(path, scenes, agent, num_records, **options)
            baselines[name] = [EpisodeResult.from_record(record) for record in baseline]
    solvable = [k for k, scene in enumerate(scenes.scenes[:count]) if scene.solvable == "solvable"]
    solvable_baselines = {
        name: [results[k] for k in solvable if k < len(results)]
        for name, results in baselines.items()
    }
    max_objects = max(len(scene.settled_poses or ()) for scene in scenes.scenes)
    rows = []
    for agent in agents:
        results = [EpisodeResult.from_record(record) for record in records[agent]]
        solvable_results = [results[k] for k in solvable]
        rows.append(
            {
                "set": set_name,
                "sha256": scenes.sha256,
                "agent": agent,
                "weights": checkpoint_sha256(agent, PRETRAINED_EXPLORERS),
                **summarize(results, baselines, max_objects),
                "commits": list(dict.fromkeys(record["commit"] for record in records[agent])),
                "solvable": summarize(solvable_results, solvable_baselines, max_objects)
                if solvable
                else None,
            }
        )
    return rows


def main(
    folder: Annotated[
        Path, typer.Argument(metavar="DIR", help="Folder for the records of the episodes.")
    ] = EPISODES,
    workers: WorkersOption = 1,
    seed: EpisodesSeedOption = 2000,
    fidelity: FidelityOption = "settle",
    count: CountOption = None,
    only: SetNameOption = None,
    agents: AgentsOption = None,
    out: ResultsOption = None,
) -> None:
    """Run the episodes that are missing, and print the table.

    Without --out, the rows go into table2.json and table3.json in training/results.
    """
    fidelity = check_evaluation(fidelity, out, folder == EPISODES, bool(agents or count))
    names = [name for name in TABLES if only is None or only in name]
    if not names:
        raise InputError(f"--only {only}; expected a part of one of {', '.join(TABLES)}")
    folder.mkdir(parents=True, exist_ok=True)
    catalog = load_catalog()
    header = {"seed": seed, "fidelity": fidelity, "config": to_plain(ClutterConfig())}
    sets = {name: load_scene_dataset(SCENES / f"{name}.json", catalog) for name in names}
    results = {
        name: ResultsFile(out or RESULTS / f"{TABLES[name][0]}.json", header, ("set", "agent"))
        for name in names
    }
    for name, scenes in sets.items():  # Reports what is wrong before any episode is run.
        results[name].read()
        for agent in agents or TABLES[name][1]:
            make_policy_factory(agent, ClutterConfig(), [c.name for c in scenes.classes])
    printed = list[dict[str, str]]()
    with ExitStack() as locks:
        for path in {file.path for file in results.values()} - {out}:  # `--out` is locked
            locks.enter_context(output_file(path))
        for name, scenes in sets.items():
            rows = evaluate_set(
                scenes,
                agents or TABLES[name][1],
                folder,
                min(count or len(scenes.scenes), len(scenes.scenes)),
                fidelity=fidelity,
                seed=seed,
                workers=workers,
            )
            results[name].add(*rows)
            printed += [cells for row in rows for cells in table_rows(row)]
    print_table(printed)


if __name__ == "__main__":
    run_script(main)
