"""Measure what a rule of placements means for explorers: room, collapses and successes.

    python benchmarks/placement_rule.py --rule packed --out benchmarks/results/placement_rule.json

The rule is that of the checkout that is run; `--rule` names it in the results file. To measure an
earlier rule, run this file with a checkout of that commit on PYTHONPATH. Every episode is a record
in the folder beside the results file; an interrupted run is resumed by the same command.

Scenes 160 to 259 of sg_star_25 are left out.
"""

from collections import Counter
from dataclasses import dataclass
from functools import partial
from typing import Annotated

import typer
from pydantic import BaseModel

from drake_clutter.agents.backend_factory import FIDELITIES, make_backend_factory
from drake_clutter.agents.explorers import PolicyFactory, make_policy_factory
from drake_clutter.catalog import load_catalog
from drake_clutter.config import ClutterConfig
from drake_clutter.files import InputError
from drake_clutter.scenes.interfaces import MoveResult
from drake_clutter.scenes.scene import TRAY
from drake_clutter.scenes.scene_dataset import load_scene_dataset
from drake_clutter.seeding import item_rng
from drake_clutter.statistics import wilson_interval
from drake_clutter.tasks.episode import run_episode
from drake_clutter.tasks.exploration_task import TerminationReason
from drake_clutter.validation import CountOrZero, NonEmptyText, to_plain
from training.results_file import ResultsFile, Row, collect_records
from training.script import (
    SCENES,
    ResultsOption,
    SeedOption,
    WorkersOption,
    format_number,
    print_table,
    run_script,
)

MAX_MOVES = 20
"""Maximum number of moves of an episode."""
MAX_SCENES = 160
"""Number of scenes of a set that may be used."""
AGENTS = {
    "sg_star_25": ("random", "largest-clear", "student"),
    "sg_star_40": ("random", "largest-clear", "student"),
    "sg_14": ("random", "largest-clear", "student-14"),
}
"""Explorers by scene dataset."""
PLACES = ("tray", "object")
"""Places of moves, as in the records."""


class PlacementRecord(BaseModel):
    """Record of an episode.

    Attributes:
        ended: Value of the `TerminationReason`.
        moves: Number of moves.
        counts: Number of moves, by place ("tray" or "object") and result.
    """

    ended: NonEmptyText
    moves: CountOrZero
    counts: dict[str, CountOrZero]
    commit: str


@dataclass(frozen=True)
class PlacementEpisode:
    """An episode to be run.

    Attributes:
        dataset: Name of the scene dataset.
        index: Index of the scene, from which the random generator is seeded.
        agent: See `make_policy_factory`.
    """

    dataset: str
    index: int
    agent: str


class PlacementRunner:
    """Runs episodes; a worker for `map_ordered`."""

    def __init__(self, dataset: str, fidelity: str, seed: int) -> None:
        """Load the scenes.

        Args:
            dataset: Name of the scene dataset.
            fidelity: See `make_backend_factory`.
            seed: Seed of the episodes.
        """
        self._config = ClutterConfig()
        self._scenes = load_scene_dataset(SCENES / f"{dataset}.json", load_catalog())
        self._make_backend = make_backend_factory(fidelity, self._config)
        self._seed = seed
        self._policy_factories: dict[str, PolicyFactory] = {}

    def __call__(self, episode: PlacementEpisode) -> Row:
        """Return the record of an episode, without its commit."""
        scenes = self._scenes
        scene = scenes.settled_scene(episode.index, scenes.grammar, self._config)
        backend = self._make_backend(scene, item_rng(self._seed, episode.index))
        if episode.agent not in self._policy_factories:
            factory = make_policy_factory(episode.agent, self._config)
            self._policy_factories[episode.agent] = factory
        policy = self._policy_factories[episode.agent](backend)
        task = run_episode(backend, policy, max_moves=MAX_MOVES)
        counts = Counter(
            f"{'tray' if t.move.place == TRAY else 'object'} {t.outcome.result.value}"
            for t in task.transitions
        )
        return {
            "ended": (task.termination or TerminationReason.GAVE_UP).value,
            "moves": len(task.transitions),
            "counts": dict(sorted(counts.items())),
        }


def summarize(records: list[Row]) -> Row:
    """Return the statistics of episodes."""
    count = len(records)
    row: Row = {"episodes": count}
    for name, reason in (
        ("success", TerminationReason.ALL_FOUND),
        ("collapsed", TerminationReason.COLLAPSED),
    ):
        number = sum(record["ended"] == reason.value for record in records)
        row |= {name: number / count, f"{name}_ci95": wilson_interval(number, count)}
    moves = [r["moves"] for r in records if r["ended"] == TerminationReason.ALL_FOUND.value]
    row["moves_of_successes"] = sum(moves) / len(moves) if moves else None
    total = Counter[str]()
    for record in records:
        total.update(record["counts"])
    for place in PLACES:
        asked = sum(n for key, n in total.items() if key.startswith(place))
        room = asked - total[f"{place} {MoveResult.NO_FREE_PLACEMENT.value}"]
        row |= {
            f"{place}_moves": asked,
            f"{place}_room": room / asked if asked else None,
            f"{place}_room_ci95": wilson_interval(room, asked) if asked else None,
            f"{place}_collapses": total[f"{place} {MoveResult.COLLAPSED.value}"],
        }
    row["commits"] = list(dict.fromkeys(record["commit"] for record in records))
    return row


def table_row(row: Row) -> dict[str, str]:
    """Return a row of the results as cells of the printed table."""
    return {
        **{key: str(row[key]) for key in ("rule", "set", "agent", "fidelity", "episodes")},
        "success": format_number(row["success"]),
        "collapsed": format_number(row["collapsed"]),
        "moves": format_number(row["moves_of_successes"], 1),
        "room on the tray": format_number(row["tray_room"]),
        "room on objects": format_number(row["object_room"]),
        "moves onto objects": str(row["object_moves"]),
    }


def main(
    rule: Annotated[str, typer.Option(help="Name of the rule of the checkout that is run.")],
    out: ResultsOption,
    fidelity: Annotated[
        str, typer.Option(help=f"Model of the moves: {', '.join(FIDELITIES)}.")
    ] = "static",
    only: Annotated[
        str | None, typer.Option(metavar="TEXT", help="Only sets whose name contains this text.")
    ] = None,
    agents: Annotated[
        list[str] | None, typer.Option("--agent", help="Only this explorer. May be repeated.")
    ] = None,
    count: Annotated[
        int, typer.Option(min=1, max=MAX_SCENES, help="Number of scenes of each set.")
    ] = 100,
    seed: SeedOption = 2000,
    workers: WorkersOption = 1,
) -> None:
    """Run the episodes that are missing, and add their rows to the results file."""
    if fidelity not in FIDELITIES:
        raise InputError(f"--fidelity {fidelity}; expected {', '.join(FIDELITIES)}")
    assert out is not None
    folder = out.with_suffix("")
    folder.mkdir(parents=True, exist_ok=True)
    results = ResultsFile(
        out, {"seed": seed, "moves": MAX_MOVES}, ("rule", "set", "agent", "fidelity")
    )
    rows = list[Row]()
    for name in (name for name in AGENTS if only is None or only in name):
        scenes = load_scene_dataset(SCENES / f"{name}.json", load_catalog())
        for agent in (agent for agent in AGENTS[name] if agents is None or agent in agents):
            key = {"rule": rule, "set": name, "agent": agent, "fidelity": fidelity}
            records = collect_records(
                folder / f"{rule}_{name}_{agent}_{fidelity}.jsonl.gz",
                key | {"sha256": scenes.sha256, "seed": seed, "config": to_plain(ClutterConfig())},
                partial(PlacementRunner, name, fidelity, seed),
                [PlacementEpisode(name, k, agent) for k in range(min(count, len(scenes.scenes)))],
                schema=PlacementRecord,
                workers=workers,
            )
            rows.append(key | summarize(records))
            results.add(rows[-1])
    print_table([table_row(row) for row in rows])


if __name__ == "__main__":
    run_script(main)
