"""Compare the behavior of all backends and generators with recorded traces.

    python benchmarks/behavior_hashes.py --count 3
    python benchmarks/behavior_hashes.py --only arm --only images
    python benchmarks/behavior_hashes.py --write

Episodes and generated scenes are repeated, and their traces compared with the records. A trace
holds of every move its result and texts, the objects found, the poses of all objects afterwards to
a nanometer, and the arm's joint angles. For each case that differs, the first differing line is
printed; the exit code is then 1. `--write` records the traces, where a change of behavior is
intended.
"""

import os

# Before numpy is imported: the rounding of sums depends on the number of threads.
os.environ.update(
    {
        "OMP_NUM_THREADS": "1",
        "OPENBLAS_NUM_THREADS": "1",
        "MKL_NUM_THREADS": "1",
        "LP_NUM_THREADS": "0",
    }
)

import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from itertools import zip_longest
from pathlib import Path
from typing import Annotated, Any

import typer

from benchmarks import behavior_backends as backends
from benchmarks.behavior_backends import Case, Line, hash_of
from benchmarks.measurement import describe_machine
from drake_clutter.files import InputError
from drake_clutter.records import read_jsonl, write_jsonl
from drake_clutter.workers.parallel_map import map_ordered
from training.results_file import provenance
from training.script import ROOT, WorkersOption, run_script

RECORDS = ROOT / "benchmarks/results/behavior_hashes"
"""Folder of the records, one file for each backend."""
EXPLORERS = ("student", "largest-clear")
"""Explorers of the episodes, which take turns."""
LARGE_SETS = ("sg_star_25", "rg_25")
"""Scene datasets of the cheap backends, which take turns."""
MIXED_SETS = ("sg_star_15", "sg_star_25")
"""Scene datasets of the costly backends, which take turns."""
GENERATORS = ("random", "sg-star")
"""Scene generators, which take turns."""
EPISODES_PER_PROCESS = 10
"""Episodes after which a process is replaced: Diagrams with systems in Python are never freed."""

Entry = dict[str, Any]
"""Record of a case: the fields of `Case`, the `hash` of its trace, and the lines as `moves`."""


@dataclass(frozen=True)
class Backend:
    """One way to run episodes or to generate scenes.

    Attributes:
        run: Runs a case and returns its trace.
        scenes: Values of `Case.scenes`, which take turns.
        count: Number of cases.
        agents: Values of `Case.agent`, which take turns.
        max_items_per_process: See `map_ordered`.
    """

    run: Callable[[Case], list[Line]]
    scenes: tuple[str, ...]
    count: int
    agents: tuple[str, ...] = EXPLORERS
    max_items_per_process: int | None = None

    def cases(self) -> list[Case]:
        """Return all cases in order."""
        cases = list[Case]()
        for k in range(self.count):
            number, position = divmod(k, len(self.scenes))
            agent = self.agents[number % len(self.agents)]
            cases.append(Case(self.scenes[position], number, agent))
        return cases


BACKENDS = {
    "static": Backend(backends.static, LARGE_SETS, 30),
    "generation": Backend(backends.generation, GENERATORS, 200, agents=("",)),
    "settle": Backend(backends.settle, LARGE_SETS, 30),
    "images": Backend(backends.images, MIXED_SETS, 30),
    "arm": Backend(backends.arm, MIXED_SETS, 30, max_items_per_process=EPISODES_PER_PROCESS),
    "closed-loop-labels": Backend(
        backends.closed_loop_labels, MIXED_SETS, 15, max_items_per_process=EPISODES_PER_PROCESS
    ),
    "closed-loop-depth": Backend(
        backends.closed_loop_depth, MIXED_SETS, 15, max_items_per_process=EPISODES_PER_PROCESS
    ),
}
"""Backends by name, the quickest first."""


@dataclass(frozen=True)
class Trace:
    """Trace of a case.

    Attributes:
        lines: The lines.
        seconds: Time that the case took [s].
    """

    lines: tuple[str, ...]
    seconds: float

    @property
    def hash(self) -> str:
        """Hash of all lines."""
        return hash_of("\n".join(self.lines))


class CaseRunner:
    """Runs cases of a backend; a worker for `map_ordered`."""

    def __init__(self, name: str) -> None:
        """Look up the backend.

        Args:
            name: Key of `BACKENDS`.
        """
        self._run = BACKENDS[name].run

    def __call__(self, case: Case) -> Trace:
        """Run a case and return its trace."""
        start = time.perf_counter()
        lines = tuple(str(line) for line in self._run(case))
        return Trace(lines, time.perf_counter() - start)


def describe_difference(case: Case, trace: Trace, records: Sequence[Entry]) -> str:
    """Return how a trace differs from the recorded one; "" if they are equal.

    Args:
        case: The case.
        trace: Its trace.
        records: The recorded cases of the backend.
    """
    entry = next((entry for entry in records if asdict(case).items() <= entry.items()), None)
    if entry is None:
        return "not recorded"
    if entry["hash"] == trace.hash:
        return ""
    lines = zip_longest(entry["moves"], trace.lines, fillvalue="nothing")
    for k, (recorded, current) in enumerate(lines):
        if recorded != current:
            return (
                f"differs from line {k} of {len(entry['moves']) - 1} on\n"
                f"  recorded {recorded}\n  now      {current}"
            )
    return "the hash differs, but no line: the record was edited"


def records_path(name: str) -> Path:
    """Return the record file of a backend."""
    return RECORDS / f"{name}.jsonl.gz"


def compare_backend(name: str, count: int | None, workers: int, write: bool) -> list[str]:
    """Run the cases of a backend and return those that differ from the records.

    Args:
        name: Key of `BACKENDS`.
        count: Number of cases; None for all.
        workers: Number of processes.
        write: Whether the traces are recorded instead of compared.
    """
    backend = BACKENDS[name]
    cases = backend.cases()[:count]
    records = read_jsonl(records_path(name))[1:]
    traces = map_ordered(
        partial(CaseRunner, name),
        cases,
        workers=workers,
        max_items_per_process=backend.max_items_per_process,
    )
    start = time.perf_counter()
    entries = list[Entry]()
    differences = list[str]()
    for case, trace in zip(cases, traces, strict=True):
        entries.append({**asdict(case), "hash": trace.hash, "moves": [*trace.lines]})
        difference = "" if write else describe_difference(case, trace, records)
        if difference:
            differences.append(f"{name}: {case}: {difference}")
        result = difference or ("recorded" if write else "equal")
        position = f"{name} {len(entries)}/{len(cases)}"
        print(f"{position}: {case}, {trace.seconds:.1f} s: {result}", flush=True)
    print(f"{name}: {time.perf_counter() - start:.0f} s", flush=True)
    if write:
        header = describe_machine("drake", "numpy", "scipy", "torch", "numba") | provenance()
        write_jsonl(records_path(name), header, entries + records[len(entries) :])
        print(f"{name}: written to {records_path(name)}", flush=True)
    return differences


def main(
    only: Annotated[list[str] | None, typer.Option(help="A backend. May be repeated.")] = None,
    count: Annotated[
        int | None, typer.Option(min=1, help="Only the first N cases of each backend.")
    ] = None,
    workers: WorkersOption = 1,
    write: Annotated[
        bool, typer.Option("--write", help="Record the traces, do not compare them.")
    ] = False,
) -> None:
    """Run the cases and compare their traces with the records."""
    if unknown := [name for name in only or [] if name not in BACKENDS]:
        raise InputError(f"--only {unknown[0]}; expected {', '.join(BACKENDS)}")
    differences = list[str]()
    for name in BACKENDS:
        if not only or name in only:
            differences += compare_backend(name, count, workers, write)
    if differences:
        print("\n".join([f"{len(differences)} differ:", *differences]))
        raise typer.Exit(1)
    if not write:
        print("all equal")


if __name__ == "__main__":
    run_script(main)
