"""Tables II and III: every explorer on every frozen set of scenes, moves settled by Drake.

    python training/evaluate_explorers.py --workers 2

Every episode is a line of a file in training/results/episodes, a file for each set and agent; what is there is not played again.
"""

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.progress import track
from rich.table import Table

from drake_clutter.agents.backend_factory import FIDELITIES
from drake_clutter.agents.episode_evaluation import (
    EpisodeResult,
    EpisodeRunner,
    EpisodeSpec,
    summarize_episodes,
)
from drake_clutter.agents.explorers import ORACLE, PRETRAINED_EXPLORERS, make_policy_factory
from drake_clutter.catalog import load_catalog
from drake_clutter.config import ClutterConfig, upgrade_head
from drake_clutter.files import InputError, cli_error_handler, write_json
from drake_clutter.learning.pretrained import checkpoint_sha256
from drake_clutter.records import resume_jsonl
from drake_clutter.reports.terminal_text import evaluation_table_rows
from drake_clutter.resources import git_commit
from drake_clutter.scenes.scene_dataset import SceneDataset, load_scene_dataset
from drake_clutter.statistics import bootstrap_ratio_interval
from drake_clutter.tasks.exploration_task import TerminationReason
from drake_clutter.validation import to_plain
from drake_clutter.workers.parallel_map import map_ordered

HERE = Path(__file__).parent
SCENES, RESULTS = HERE / "scenes", HERE / "results"
LIMITS = (10, 20)
COMPARED = {"ceiling": ORACLE, "largest_clear": "largest-clear"}
"""Whose moves the others' are compared with, by what the figures call them."""
SEVEN = (
    "random",
    "largest-first",
    "largest-clear",
    "student-rg",
    "student-dagger",
    "student",
    ORACLE,
)
FOURTEEN = ("random", "largest-first", "largest-clear", "student-14", ORACLE)
SETS_OF_SEVEN = (
    "paper_hardness",
    "sg_star_10",
    "sg_star_15",
    "sg_star_20",
    "sg_star_25",
    "sg_star_40",
    "rg_25",
)
TABLES = dict.fromkeys(SETS_OF_SEVEN, ("table2", SEVEN)) | {"sg_14": ("table3", FOURTEEN)}
"""Of every frozen set, the table that it belongs to, and who plays it."""


def played(
    scenes: SceneDataset, agent: str, count: int, fidelity: str, seed: int, workers: int, path: Path
) -> list[EpisodeResult]:
    """The episodes of an agent on a set's first scenes; those that the file has not got are played, and written as they end."""
    config = ClutterConfig()
    asked: dict[str, Any] = {
        "set": scenes.name,
        "sha256": scenes.sha256,
        "agent": agent,
        "weights": checkpoint_sha256(agent, PRETRAINED_EXPLORERS),
    }
    asked |= {"seed": seed, "fidelity": fidelity, "moves": max(LIMITS), "config": to_plain(config)}
    commit = git_commit()

    def play(done: int) -> Iterator[dict[str, Any]]:
        missing = [EpisodeSpec(SCENES / scenes.name, k, agent, k) for k in range(done, count)]
        results = map_ordered(
            partial(EpisodeRunner, config, None, max(LIMITS), seed, fidelity),
            missing,
            workers=workers,
        )
        for result in track(results, path.stem, count, done, console=Console(stderr=True)):
            yield asdict(result) | {"commit": commit}

    return [
        episode_of(record)
        for record in list(resume_jsonl(path, asked, play, upgrade_head))[1 : 1 + count]
    ]


def episode_of(record: Mapping[str, Any]) -> EpisodeResult:
    """From a record of a file of episodes."""
    fields = {key: value for key, value in record.items() if key != "commit"}
    return EpisodeResult(**fields | {"found_after": tuple(fields["found_after"])})


def file_of(folder: Path, name: str, agent: str) -> Path:
    """Of an agent's episodes on a set."""
    told = (
        f"{Path(agent).stem}_{checkpoint_sha256(agent, PRETRAINED_EXPLORERS)[:8]}"
        if agent.endswith(".safetensors")
        else agent
    )
    return folder / f"{name}_{told}.jsonl"


def commits_of(path: Path, count: int) -> list[str]:
    """At which a file's first episodes were played."""
    return list(
        dict.fromkeys(
            json.loads(line)["commit"] for line in path.read_text().splitlines()[1 : 1 + count]
        )
    )


def row_of(
    results: Sequence[EpisodeResult], others: Mapping[str, Sequence[EpisodeResult]]
) -> dict[str, Any]:
    """The figures of an agent on scenes; `others`: how those fared on the first of them whose moves its own are compared with."""
    row = summarize_episodes(results, LIMITS)
    for name, theirs in others.items():
        both = zip(results, theirs, strict=False)
        pairs = [
            (a.moves, b.moves)
            for a, b in both
            if {a.ended, b.ended} == {TerminationReason.ALL_FOUND.value}
        ]
        row[f"moves_to_{name}"] = (
            sum(m for m, _ in pairs) / sum(m for _, m in pairs) if pairs else None
        )
        row[f"moves_to_{name}_ci95"] = (
            bootstrap_ratio_interval(*zip(*pairs, strict=True)) if pairs else None
        )
        row[f"both_with_{name}"] = len(pairs)
    return row


def rows_there(path: Path, held: Mapping[str, Any]) -> list[dict[str, Any]]:
    """The rows of a file of results; none if there is no such file.

    Raises:
        InputError: they were measured otherwise, or it is another file.
    """
    try:
        there = upgrade_head(json.loads(path.read_text()))
        rows: list[dict[str, Any]] = there["rows"]
        same = all(there[key] == value for key, value in held.items())
    except FileNotFoundError:
        return []
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(
            f"--out {path}: is no file of results ({error}); allowed is one, or a new file"
        ) from error
    if not same:
        raise InputError(
            f"--out {path}: holds rows of other chances, fidelity or config; give another file"
        )
    return rows


def add_rows(path: Path, held: Mapping[str, Any], rows: Sequence[dict[str, Any]]) -> None:
    """Writes the rows into a file of results, in the place of those of the same sets and agents."""
    new = {(row["set"], row["agent"]) for row in rows}
    kept = [row for row in rows_there(path, held) if (row["set"], row["agent"]) not in new]
    path.parent.mkdir(parents=True, exist_ok=True)
    write_json(path, {**held, "rows": sorted([*kept, *rows], key=lambda row: row["set"])})


def table_of(rows: Sequence[dict[str, Any]]) -> Table:
    """For the screen."""
    told = []
    for row in rows:
        begin = {
            "set": row["set"],
            "agent": row["agent"],
            "episodes": str(row["episodes"]),
            "hidden": f"{row['hidden']:.1f}",
        }
        ratios = {f"to {name}": row.get(f"moves_to_{name}") for name in COMPARED}
        end = {name: "" if ratio is None else f"{ratio:.2f}" for name, ratio in ratios.items()}
        told += [begin | cells | end for cells in evaluation_table_rows(row, LIMITS)]
    table = Table(*told[0])
    for cells in told:
        table.add_row(*cells.values())
    return table


def main(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Where the episodes go.")] = RESULTS
    / "episodes",
    workers: Annotated[int, typer.Option(min=1)] = 1,
    seed: Annotated[int, typer.Option(min=0, help="Of the episodes' chances.")] = 2000,
    fidelity: Annotated[
        str, typer.Option(help="fast or settle; the published tables are settle.")
    ] = "settle",
    count: Annotated[
        int | None, typer.Option(min=1, help="Of each set's scenes; all if not given.")
    ] = None,
    only: Annotated[str | None, typer.Option(help="Of sets whose name contains this.")] = None,
    agents: Annotated[
        list[str] | None,
        typer.Option("--agent", help="These instead of the tables'; may be repeated."),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE", help="JSON to write; table2.json and table3.json if not given."
        ),
    ] = None,
) -> None:
    """Measures what is missing and prints the table."""
    if folder == RESULTS / "episodes" and fidelity != "settle":
        raise InputError(f"DIR: {folder}: is for episodes under settle; give another folder")
    if out is None and (agents or count or fidelity != "settle"):
        raise InputError(
            "--out: is missing; the published tables are all agents' on all scenes under settle: give a file for others"
        )
    if fidelity not in FIDELITIES:
        raise InputError(f"--fidelity {fidelity}; allowed are {', '.join(FIDELITIES)}")
    folder.mkdir(parents=True, exist_ok=True)
    catalog, shown = load_catalog(), list[dict[str, Any]]()
    names = [name for name in TABLES if only is None or only in name]
    if not names:
        raise InputError(f"--only {only}; allowed is a part of one of {', '.join(TABLES)}")
    held = {"seed": seed, "fidelity": fidelity, "config": to_plain(ClutterConfig())}
    sets = {name: load_scene_dataset(SCENES / f"{name}.json", catalog) for name in names}
    for name, scenes in sets.items():  # says what is wrong before anything is played
        rows_there(out or RESULTS / f"{TABLES[name][0]}.json", held)
        for agent in agents or TABLES[name][1]:
            make_policy_factory(agent, ClutterConfig(), [c.name for c in scenes.classes])
    for name, scenes in sets.items():
        table, agents_of_table = TABLES[name]
        number = min(count or len(scenes.scenes), len(scenes.scenes))
        chosen = agents or agents_of_table
        found = {
            agent: played(
                scenes, agent, number, fidelity, seed, workers, file_of(folder, name, agent)
            )
            for agent in chosen
        }
        others = {}
        for label, agent in COMPARED.items():
            path = file_of(folder, name, agent)
            if path.exists():  # what the yardstick has played; nothing is played for it
                there = min(number, path.read_text().count("\n") - 1)
                others[label] = played(scenes, agent, there, fidelity, seed, workers, path)
        solvable = [
            k for k, scene in enumerate(scenes.scenes[:number]) if scene.solvable == "solvable"
        ]
        rows = []
        for agent in chosen:
            row: dict[str, Any] = {
                "set": name,
                "sha256": scenes.sha256,
                "agent": agent,
                "weights": checkpoint_sha256(agent, PRETRAINED_EXPLORERS),
            }
            row |= row_of(found[agent], others) | {
                "commits": commits_of(file_of(folder, name, agent), number)
            }
            part = [found[agent][k] for k in solvable]
            compared = {
                label: [o[k] for k in solvable if k < len(o)] for label, o in others.items()
            }
            row["solvable"] = row_of(part, compared) if part else None
            rows.append(row)
        add_rows(out or RESULTS / f"{table}.json", held, rows)
        shown += rows
    Console(width=150).print(table_of(shown))


if __name__ == "__main__":
    with cli_error_handler():
        typer.run(main)
