"""Measure how many small faults of the modules that decide results the tests catch.

    python benchmarks/mutation_testing.py cover --out FOLDER
    python benchmarks/mutation_testing.py run --coverage FOLDER --out mutation_testing.json

`cover` records which lines each test executes; it needs the package `coverage`. `run` samples
mutants (`mutation_operators.py`) and runs, for each, the tests that execute the changed line, the
fastest first, until one fails. Tests that execute other lines of the module follow, up to
`MAX_SECONDS`. Both commands resume. `run --again caught` tests mutants again that were caught,
beginning with the test that caught them.

Modules with compiled functions are tested without the compiler: the tracer does not see compiled
code, and compiling every mutant takes longer than interpreting small cases.
"""

import hashlib
import importlib.util
import json
import os
import subprocess
import sys
import threading
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from queue import SimpleQueue
from typing import Annotated

import typer

from benchmarks.mutation_operators import Mutant, find_mutants, rank
from benchmarks.mutation_worker import NOT_REPLACED, Job, Result
from drake_clutter.files import InputError, write_json
from training.results_file import ResultsFile, Row, provenance
from training.script import (
    ROOT,
    ResultsOption,
    SeedOption,
    WorkersOption,
    print_table,
    progress,
    run_script,
)

GROUPS: Mapping[str, tuple[str, ...]] = {
    "static judge": (
        "stability/static_judge.py",
        "stability/equilibrium.py",
        "stability/contacts.py",
        "stability/nnls.py",
        "stability/shape_table.py",
        "stability/static_executor.py",
    ),
    "settling": (
        "simulation/settle.py",
        "simulation/settle_executor.py",
        "simulation/drop.py",
        "simulation/drake_judge.py",
        "simulation/hybrid.py",
    ),
    "placement": (
        "scenes/placement.py",
        "scenes/free_space.py",
        "scenes/release_orientation.py",
        "scenes/layout.py",
        "scenes/geometry.py",
        "stability/load_check.py",
    ),
    "tracking": ("systems/tracking.py",),
    "grammar": ("grammar/*.py",),
    "tasks": ("tasks/*.py",),
    "losses": ("agents/soft_q.py", "agents/ppo.py", "agents/behavior_cloning.py"),
    "occlusion": ("scenes/occlusion.py", "stability/ray_caster.py"),
    "suction": ("cell/suction.py",),
    "station": ("station/*.py",),
    "planning": ("planning/*.py",),
}
"""Files of the modules that decide results, below `drake_clutter`, by group."""
TESTS = (
    "nnls",
    "equilibrium",
    "contacts",
    "static_judge",
    "static_judge_columns",
    "static_executor",
    "settle",
    "settle_executor",
    "drop",
    "placement",
    "layout",
    "geometry",
    "tracking",
    "grammar",
    "canonical_form",
    "exploration_episodes",
    "exploration_graph",
    "clutter_exploration",
    "generation_task",
    "environment_interface",
    "oracle_search",
    "step_by_step",
    "feasibility",
    "earlier_names",
    "soft_q",
    "learned_generator",
    "generators",
    "occlusion",
    "rays",
    "camera_poses",
    "suction",
    "shelf",
    "images",
    "image_backend",
    "recorded_episode_file",
    "episode_recorder",
    "clutter_station",
    "body_sleep",
    "bellows",
    "vacuum",
    "parallel_jaw",
    "station_simulation",
    "collision_filters",
    "arm_executor",
    "tilted_grasps",
    "own_meshes",
    "convex_distance",
    "motion_limits",
    "time_parameterization",
    "place_check",
    "load_check",
    "motion_plans",
    "plan_export",
    "carry_clearance",
    "planner_robots",
    "pick_place_planner",
    "pick_place_search",
    "side_grasps",
    "trajectory_optimization",
    "arm_dynamics",
    "belief",
    "center_of_mass",
    "closed_loop",
    "inverse_reachability",
    "opposed_faces",
    "regrip",
    "target_search",
    "tilted_camera",
)
"""Test files that reach these modules in their own process."""
TESTS_OF_COMPILED_CODE = (
    "nnls",
    "equilibrium",
    "contacts",
    "static_judge",
    "static_judge_columns",
    "static_executor",
    "placement",
    "layout",
    "occlusion",
    "rays",
    "camera_poses",
    "shelf",
    "tilted_grasps",
    "own_meshes",
    "convex_distance",
    "motion_limits",
    "time_parameterization",
    "load_check",
    "planner_robots",
    "pick_place_planner",
    "carry_clearance",
    "place_check",
    "motion_plans",
    "trajectory_optimization",
)
"""Test files that reach the modules with compiled functions."""
COMPILED = "import njit"
"""Text in modules with compiled functions."""
TEST_LIMIT = 10.0
"""A test that takes longer is not used [s]."""
MAX_SECONDS = 30.0
"""Processor time of the tests of a mutant without the mutant [s]."""
OUTCOMES = ("caught", "timed out", "equivalent", "survived")
"""Outcomes of mutants. Of those that timed out, two runs exceeded a limit of processor time."""
MIN_SCORE = 0.9
"""Share of the mutants that are not equivalent which is to be caught or to time out."""
EQUIVALENT = ROOT / "benchmarks/equivalent_mutants.json"
"""Reasons why a mutant gives the same results as the original, by key of the mutant."""


class Worker:
    """A process that runs jobs, see `mutation_worker.py`."""

    def __init__(self, kind: str, files: Sequence[str], *, compiled: bool) -> None:
        """Start the process.

        Args:
            kind: "collected" or "fresh".
            files: Test files that are collected.
            compiled: Whether functions are compiled.
        """
        environment = {
            "PYTHONPATH": os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")]),
            "NUMBA_DISABLE_JIT": "0" if compiled else "1",
            "PYTHONDONTWRITEBYTECODE": "1",
        }
        self._process = subprocess.Popen(
            [sys.executable, "-m", "benchmarks.mutation_worker", kind, *files],
            cwd=ROOT,
            env=os.environ | environment,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
        )

    def run(self, job: Job) -> Result:
        """Return the result of a job."""
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.write(json.dumps(job) + "\n")
        self._process.stdin.flush()
        line = self._process.stdout.readline()
        if not line:
            raise RuntimeError("the tests cannot be collected")
        result: Result = json.loads(line)
        return result

    def close(self) -> None:
        """End the process."""
        assert self._process.stdin is not None
        self._process.stdin.close()
        self._process.wait()


def run_jobs(workers: Sequence[Worker], jobs: Sequence[Job]) -> Iterator[tuple[int, Result]]:
    """Yield indices and results of jobs as they are done."""
    waiting = SimpleQueue[tuple[int, Job]]()
    done = SimpleQueue[tuple[int, Result] | BaseException]()
    for item in enumerate(jobs):
        waiting.put(item)

    def work(worker: Worker) -> None:
        while not waiting.empty():
            index, job = waiting.get()
            try:
                done.put((index, worker.run(job)))
            except BaseException as error:
                done.put(error)
                raise

    for worker in workers:
        threading.Thread(target=work, args=(worker,), daemon=True).start()
    for _ in jobs:
        result = done.get()
        if isinstance(result, BaseException):
            raise result
        yield result


@contextmanager
def worker_pool(
    count: int, kind: str, files: Sequence[str], *, compiled: bool
) -> Iterator[list[Worker]]:
    """Start workers, and end them with the context; see `Worker`."""
    with ExitStack() as stack:
        workers = [Worker(kind, files, compiled=compiled) for _ in range(count)]
        for worker in workers:
            stack.callback(worker.close)
        yield workers


def module_files() -> dict[str, str]:
    """Return the groups of all files, by path from the root of the repository."""
    return {
        str(path.relative_to(ROOT)): group
        for group, patterns in GROUPS.items()
        for pattern in patterns
        for path in sorted((ROOT / "drake_clutter").glob(pattern))
    }


def is_compiled(path: str) -> bool:
    """Return whether a module has compiled functions."""
    return COMPILED in (ROOT / path).read_text(encoding="utf-8")


def test_files(*, compiled: bool) -> list[str]:
    """Return the test files of the modules with or without compiled functions."""
    names = TESTS if compiled else TESTS_OF_COMPILED_CODE
    return [f"tests/test_{name}.py" for name in names]


@dataclass(frozen=True)
class TestCoverage:
    """Executed lines by test.

    Attributes:
        seconds: Processor time of each test that passes [s].
        lines: Lines by test and file. An empty name of a test stands for imports.
    """

    __test__ = False

    seconds: dict[str, float]
    lines: dict[str, dict[str, frozenset[int]]]

    @classmethod
    def read(cls, folder: Path) -> "TestCoverage":
        """Read the files of a folder, but those of tests that do not exist."""
        seconds = dict[str, float]()
        lines = defaultdict[str, dict[str, frozenset[int]]](dict)
        for file in sorted(folder.glob("*.json")):
            result = json.loads(file.read_text())
            if not all((ROOT / name).exists() for name in result["blobs"]):
                continue
            passed = {
                test: time
                for test, (outcome, time) in result["outcomes"].items()
                if outcome == "passed"
            }
            seconds |= passed
            for path, by_test in result["lines"].items():
                for test, executed in by_test.items():
                    if test in passed or (not test and file.stem == "imports"):
                        lines[path][test] = frozenset(executed)
        return cls(seconds, dict(lines))

    def runs_at_import(self, mutant: Mutant) -> bool:
        """Return whether the changed statement runs when modules are imported."""
        first, last = mutant.statement
        return any(first <= line <= last for line in self.lines.get(mutant.path, {}).get("", ()))

    def tests(self, mutant: Mutant, first_test: str | None) -> tuple[list[str], int]:
        """Return the tests of a mutant in the order of execution.

        Of code that runs on import, all tests of the module may show the result.

        Args:
            mutant: The mutant.
            first_test: A test that is to be the first; None for the fastest one.

        Returns:
            The tests, and how many of them execute the changed statement.
        """
        first, last = mutant.statement
        at_import = self.runs_at_import(mutant)
        executing = list[str]()
        others = list[str]()
        for test, lines in self.lines.get(mutant.path, {}).items():
            if test:
                executes = at_import or any(first <= line <= last for line in lines)
                (executing if executes else others).append(test)
        total = 0.0
        chosen = list[str]()
        for tests in (executing, others):
            for test in sorted(tests, key=lambda test: (test != first_test, self.seconds[test])):
                if total + self.seconds[test] <= MAX_SECONDS:
                    total += self.seconds[test]
                    chosen.append(test)
        return chosen, len(set(chosen) & set(executing))


def cover(
    out: Annotated[Path, typer.Option("--out", metavar="FOLDER", help="Folder of the coverage.")],
    workers: WorkersOption = 1,
) -> None:
    """Record which lines each test executes.

    Test files are skipped if neither they nor the modules they execute have changed.
    """
    if importlib.util.find_spec("coverage") is None:
        raise InputError("the package coverage is missing; install it with pip")
    for compiled in (False, True):
        folder = out / ("compiled" if compiled else "interpreted")
        folder.mkdir(parents=True, exist_ok=True)
        files = test_files(compiled=compiled)
        measured = [path for path in module_files() if is_compiled(path) != compiled]
        job: Job = {
            "measured": measured,
            "test_limit": TEST_LIMIT,
            "time_limit": 1200.0,
            "limits": None,
        }
        for kind, jobs in (
            ("fresh", {"imports": job | {"files": files, "limits": {}}}),
            ("collected", {Path(file).stem: job | {"files": [file]} for file in files}),
        ):
            missing = [name for name in jobs if not is_current(folder / f"{name}.json")]
            if not missing:
                continue
            with worker_pool(min(workers, len(missing)), kind, files, compiled=compiled) as pool:
                results = run_jobs(pool, [jobs[name] for name in missing])
                for index, result in progress(results, folder.name, len(missing)):
                    if "outcomes" not in result:
                        reason = result.get("failure", result.get("error"))
                        print(f"{missing[index]}: {reason}", file=sys.stderr)
                    else:
                        blobs = git_blobs([*jobs[missing[index]]["files"], *result["lines"]])
                        write_json(folder / f"{missing[index]}.json", result | {"blobs": blobs})


def is_current(path: Path) -> bool:
    """Return whether a file of coverage exists and the files that it measured are unchanged."""
    if not path.exists():
        return False
    blobs = json.loads(path.read_text())["blobs"]
    return all((ROOT / name).exists() for name in blobs) and git_blobs(blobs) == blobs


def sample_mutants(count: int, seed: int) -> list[Mutant]:
    """Return sampled mutants in the order of the groups."""
    files = module_files()
    mutants = [
        mutant
        for path in files
        for mutant in find_mutants(path, (ROOT / path).read_text(encoding="utf-8"))
    ]
    sample = sorted(mutants, key=lambda mutant: rank(mutant.key, seed))[:count]
    order = list(files)
    return sorted(sample, key=lambda mutant: (order.index(mutant.path), mutant.start))


def mutant_job(mutant: Mutant, covered: TestCoverage, first_test: str | None) -> Job:
    """Return the job of a mutant; see `TestCoverage.tests`."""
    tests, _ = covered.tests(mutant, first_test)
    return {
        "path": mutant.path,
        "function": mutant.function,
        "source": mutant.apply((ROOT / mutant.path).read_text(encoding="utf-8")),
        "files": sorted({test.partition("::")[0] for test in tests}),
        "limits": {test: 5 * covered.seconds[test] + 3 for test in tests},
        "test_limit": TEST_LIMIT,
        "time_limit": 5 * sum(covered.seconds[test] for test in tests) + 60,
        "measured": [],
    }


def git_blobs(paths: Iterable[str]) -> dict[str, str]:
    """Return the abbreviated names of files' contents in Git, as `git hash-object` does.

    Args:
        paths: Paths from the root of the repository.
    """
    contents = {path: (ROOT / path).read_bytes() for path in paths}
    return {
        path: hashlib.sha1(b"blob %d\0" % len(content) + content).hexdigest()[:12]
        for path, content in contents.items()
    }


def mutant_row(mutant: Mutant, result: Result, num_executing: int) -> Row:
    """Return the row of a mutant in the results file."""
    text = (ROOT / mutant.path).read_text(encoding="utf-8").splitlines()[mutant.line - 1]
    outcomes = result.get("outcomes", {})
    failed = [test for test, (outcome, _) in outcomes.items() if outcome == "failed"]
    caught_by = failed[0] if failed else result.get("failure")
    outcome = "timed out" if result.get("is_too_slow") else "caught"
    return {
        "key": mutant.key,
        "group": module_files()[mutant.path],
        "path": mutant.path,
        "function": mutant.function,
        "line": mutant.line,
        "code": text.strip(),
        "operator": mutant.operator,
        "original": mutant.original,
        "replacement": mutant.replacement,
        "outcome": outcome if caught_by else "survived",
        "caught_by": caught_by,
        "tests": len(outcomes),
        "tests_of_the_line": num_executing,
        "blob": git_blobs([mutant.path])[mutant.path],
    }


def run(
    coverage: Annotated[
        Path, typer.Option("--coverage", metavar="FOLDER", help="Folder that `cover` wrote.")
    ],
    count: Annotated[int, typer.Option(min=1, help="Number of mutants.")] = 500,
    seed: SeedOption = 0,
    workers: WorkersOption = 1,
    group: Annotated[
        list[str] | None, typer.Option("--group", help="Only these groups. May be repeated.")
    ] = None,
    again: Annotated[
        list[str] | None,
        typer.Option(
            "--again", help="Test also mutants again that have this outcome. May be repeated."
        ),
    ] = None,
    out: ResultsOption = None,
) -> None:
    """Sample mutants and test those that the results file lacks.

    The sample is drawn anew from the code as it is. A mutant whose line has not changed has the
    same key, and its result is kept. One whose line has changed leaves the sample, its result is
    removed, and the next mutant in the order of the seed takes its place.

    Exits with code 1 if the score of the file is below `MIN_SCORE`.
    """
    if unknown := {*(again or ())} - {*OUTCOMES}:
        raise InputError(f"--again {min(unknown)}; expected {', '.join(OUTCOMES)}")
    out = out or ROOT / "benchmarks/results/mutation_testing.json"
    results = ResultsFile(out, {"seed": seed, "count": count}, ("key",))
    software = provenance()
    sample = sample_mutants(count, seed)
    num_removed = results.keep({(mutant.key,) for mutant in sample})
    known = {row["key"]: row for row in results.read()}
    outdated = [path for path in coverage.glob("*/*.json") if not is_current(path)]
    print(
        f"{num_removed} results removed: their mutants are no longer in the sample\n"
        f"{len(known)} of {count} mutants have results; "
        f"{len(outdated)} files of coverage are outdated" + "; run `cover`" * bool(outdated),
        file=sys.stderr,
    )
    missing = [
        mutant
        for mutant in sample
        if (mutant.key not in known or known[mutant.key]["outcome"] in (again or ()))
        and (not group or module_files()[mutant.path] in group)
    ]
    caught_by = {key: row["caught_by"] for key, row in known.items()}
    for compiled in (False, True):
        covered = TestCoverage.read(coverage / ("compiled" if compiled else "interpreted"))
        remaining = [mutant for mutant in missing if is_compiled(mutant.path) != compiled]
        by_kind = {
            "collected": [m for m in remaining if not covered.runs_at_import(m)],
            "fresh": [m for m in remaining if covered.runs_at_import(m)],
        }
        for kind, mutants in by_kind.items():
            if not mutants:
                continue
            jobs = [mutant_job(mutant, covered, caught_by.get(mutant.key)) for mutant in mutants]
            files = sorted({file for job in jobs for file in job["files"]})
            with worker_pool(min(workers, len(jobs)), kind, files, compiled=compiled) as pool:
                for index, result in progress(run_jobs(pool, jobs), kind, len(jobs)):
                    mutant = mutants[index]
                    if result.get("failure") == NOT_REPLACED:
                        by_kind["fresh"].append(mutant)
                    elif "error" in result:
                        print(f"{mutant.key}: {result['error']}", file=sys.stderr)
                    else:
                        row = mutant_row(mutant, result, covered.tests(mutant, None)[1])
                        results.add(row | software)
    reasons = json.loads(EQUIVALENT.read_text(encoding="utf-8"))
    survivors = [row for row in results.read() if row["outcome"] == "survived"]
    results.add(
        *(
            row | {"outcome": "equivalent", "reason": reasons[row["key"]]}
            for row in survivors
            if row["key"] in reasons
        )
    )
    if show(results.read()) < MIN_SCORE:
        raise typer.Exit(1)


def show(rows: Sequence[Row]) -> float:
    """Print the survivors and the score of each group, and return the score of all."""
    score = 1.0
    for row in rows:
        if row["outcome"] == "survived":
            print(f"{row['key']} {row['path']}:{row['line']}: {row['code']}")
            print(f"    {row['original']} -> {row['replacement']}")
    table = list[Row]()
    for name in (*GROUPS, "all"):
        of_group = [row for row in rows if name in (row["group"], "all")]
        counts = Counter(dict.fromkeys(OUTCOMES, 0))
        counts.update(row["outcome"] for row in of_group)
        judged = len(of_group) - counts["equivalent"]
        score = (counts["caught"] + counts["timed out"]) / judged if judged else 1.0
        table.append(
            {
                "group": name,
                "mutants": len(of_group),
                **{outcome: counts[outcome] for outcome in OUTCOMES},
                "score": f"{score:.3f}",
            }
        )
    print_table(table)
    return score


if __name__ == "__main__":
    run_script(cover, run)
