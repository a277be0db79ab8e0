"""Hashes of episodes on every backend and of generated scenes: whether all behavior is as it was.

    python benchmarks/behavior_hashes.py --count 3       # quick: the first three of each backend
    python benchmarks/behavior_hashes.py --only arm --only images
    python benchmarks/behavior_hashes.py --write         # records; where behavior is to change

Without --write it plays again what is recorded, tells of each episode whether it went the same way,
and if not with which move it first went another; then the exit code is 1. Of a move count its
result and texts, what it found, all poses afterwards to a nanometer, and the arm's joint angles.
"""

import os

# Before numpy is imported: how a sum is rounded depends on the number of threads.
os.environ.update(
    {
        "OMP_NUM_THREADS": "1",
        "OPENBLAS_NUM_THREADS": "1",
        "MKL_NUM_THREADS": "1",
        "LP_NUM_THREADS": "0",
    }
)

import json
import platform
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Any

import typer

from benchmarks import behavior_backends as backends
from benchmarks.behavior_backends import Case, Line, hash_of
from drake_clutter.files import InputError, cli_error_handler, write_json
from drake_clutter.resources import git_commit
from drake_clutter.workers.parallel_map import map_ordered

RECORD = Path(__file__).parent / "results" / "behavior_hashes.json"
EXPLORERS, GENERATORS = ("student", "largest-clear"), ("random", "sg-star")
LARGE, MIXED = ("sg_star_25", "rg_25"), ("sg_star_15", "sg_star_25")
EPISODES = 10
"""Of a process, where Diagrams hold systems written in Python: hundreds of MB each stay."""


@dataclass(frozen=True)
class Backend:
    """One way to play or make something.

    Attributes:
        play: does it, and tells of it line by line.
        scenes: as of `Case`, by turns.
        count: of cases.
        agents: likewise by turns.
        max_items_per_process: cases, after which a process is replaced; None: never.
    """

    play: Callable[[Case], list[Line]]
    scenes: tuple[str, ...]
    count: int
    agents: tuple[str, ...] = EXPLORERS
    max_items_per_process: int | None = None

    def cases(self) -> list[Case]:
        """All of it, in order."""
        made = list[Case]()
        for k in range(self.count):
            number, turn = divmod(k, len(self.scenes))
            made.append(Case(self.scenes[turn], number, self.agents[number % len(self.agents)]))
        return made


BACKENDS = {
    "static": Backend(backends.static, LARGE, 30),
    "generation": Backend(backends.generation, GENERATORS, 200, agents=("",)),
    "settle": Backend(backends.settle, LARGE, 30),
    "images": Backend(backends.images, MIXED, 30),
    "arm": Backend(backends.arm, MIXED, 30, max_items_per_process=EPISODES),
    "closed-loop-labels": Backend(
        backends.closed_loop_labels, MIXED, 15, max_items_per_process=EPISODES
    ),
    "closed-loop-depth": Backend(
        backends.closed_loop_depth, MIXED, 15, max_items_per_process=EPISODES
    ),
}
"""By name, the quickest first."""


@dataclass(frozen=True)
class Played:
    """How a case went: its lines, and s that it took."""

    lines: tuple[str, ...]
    seconds: float

    @property
    def hash(self) -> str:
        """Of all lines."""
        return hash_of("\n".join(self.lines))


class Player:
    """Plays cases of a backend; a worker for the runner."""

    def __init__(self, name: str) -> None:
        self._play = BACKENDS[name].play

    def __call__(self, case: Case) -> Played:
        """Plays one."""
        start = time.perf_counter()
        lines = tuple(str(line) for line in self._play(case))
        return Played(lines, time.perf_counter() - start)


Entry = dict[str, Any]
"""A case in the record."""


def named(case: Case) -> Entry:
    """What an entry is known by."""
    return {"scenes": case.scenes, "number": case.number, "agent": case.agent}


def difference(case: Case, played: Played, recorded: Sequence[Entry]) -> str:
    """Where a case went another way than is recorded; "" if it went the same."""
    found = next((entry for entry in recorded if named(case).items() <= entry.items()), None)
    if found is None:
        return "not recorded"
    if found["hash"] == played.hash:
        return ""
    old, new = [*found["moves"], "nothing"], [*played.lines, "nothing"]
    k = next((k for k, line in enumerate(old) if k >= len(new) or line != new[k]), None)
    if k is None:
        return "the hash differs, but no line: the record was changed"
    return f"differs from line {k} of {len(old) - 2} on\n  recorded {old[k]}\n  now      {new[k]}"


def about() -> dict[str, str]:
    """What a backend was recorded with."""
    packages = {name: version(name) for name in ("drake", "numpy", "scipy", "torch", "numba")}
    system = {"python": platform.python_version(), "system": platform.platform()}
    return {"commit": git_commit(), **system, **packages}


def read_record() -> dict[str, Any]:
    """The record, empty if there is none."""
    if not RECORD.exists():
        return {"about": {}, "backends": {}}
    try:
        document: dict[str, Any] = json.loads(RECORD.read_text(encoding="utf-8"))
    except ValueError as error:
        raise InputError(f"{RECORD}: no JSON ({error}); allowed is what --write wrote") from error
    return document


def main(
    only: Annotated[list[str] | None, typer.Option(help="A backend; may be repeated.")] = None,
    count: Annotated[int | None, typer.Option(min=1, help="The first of each backend.")] = None,
    workers: Annotated[int, typer.Option(min=1, help="Processes.")] = 1,
    write: Annotated[bool, typer.Option("--write", help="Record, do not compare.")] = False,
) -> None:
    """Plays, and compares with what is recorded."""
    if unknown := [name for name in only or [] if name not in BACKENDS]:
        raise InputError(f"--only {unknown[0]}; allowed are {', '.join(BACKENDS)}")
    record, different = read_record(), list[str]()
    for name, backend in BACKENDS.items():
        if only and name not in only:
            continue
        recorded, entries = record["backends"].get(name, []), list[Entry]()
        cases, start = backend.cases()[:count], time.perf_counter()
        fresh = backend.max_items_per_process
        made = map_ordered(
            partial(Player, name), cases, workers=workers, max_items_per_process=fresh
        )
        for case, played in zip(cases, made, strict=True):
            entries.append({**named(case), "hash": played.hash, "moves": [*played.lines]})
            found = "" if write else difference(case, played, recorded)
            if found:
                different.append(f"{name}: {case}: {found}")
            head = f"{name} {len(entries)}/{len(cases)}: {case}, {played.seconds:.1f} s"
            print(f"{head}: {found or ('played' if write else 'equal')}", flush=True)
        print(f"{name}: {time.perf_counter() - start:.0f} s", flush=True)
        if write:
            record["backends"][name] = entries + recorded[len(entries) :]
            record["about"][name] = about()
            write_json(RECORD, record)
            print(f"{name}: written to {RECORD}", flush=True)
    if different:
        print("\n".join([f"{len(different)} differ:", *different]))
        raise typer.Exit(1)
    if not write:
        print("all equal")


if __name__ == "__main__":
    with cli_error_handler():
        typer.run(main)
