"""Mutants of small modules, and the choice of their tests."""

import ast
import json
import os
import signal
import subprocess
import time
from importlib.util import module_from_spec
from pathlib import Path
from types import SimpleNamespace

import pytest

from benchmarks import mutation_testing
from benchmarks.mutation_operators import find_mutants, rank
from benchmarks.mutation_testing import TestCoverage, git_blobs, is_current, mutant_row
from benchmarks.mutation_worker import (
    Collection,
    Job,
    MutatedModule,
    Result,
    existing_functions,
    group_states,
    replace_code,
    run_job,
)
from training.results_file import ResultsFile
from training.script import ROOT

SOURCE = '''"""Module."""
LIMITS: dict[str, float] = {"ä": 0.5}


def nearest(values: list[int], limit: int = 3) -> int | None:
    """Return the smallest value."""
    found = [value for value in values if value < limit and not value == 7]
    if not values:
        raise ValueError(f"{len(values) + 1} values")
    total = -min(found)  # a comment with * and +
    total += 1
    for value in zip(values, values, strict=True):
        print(value)
        break
    return total * 2 if total > 0 else None
'''
MUTANTS = """
0.5 -> 1.0
3 -> 4
< -> <=
< -> >=
value < limit and not value == 7 -> (not (value < limit and not value == 7))
and -> or
not  -> #
== -> !=
7 -> 8
not  -> #
- -> #
min -> max
total += 1 -> pass
+= -> -=
1 -> 2
zip(values, values, strict=True) -> ()
print(value) -> pass
break -> continue
* -> /
2 -> 3
> -> >=
> -> <=
0 -> 1
"""


def test_all_mutants_of_a_module() -> None:
    """Messages, annotations and `strict` are left out."""
    mutants = find_mutants("module.py", SOURCE)
    listed = [f"{m.original} -> {m.replacement or '#'}" for m in mutants]
    assert sorted(listed) == sorted(MUTANTS.strip().splitlines())
    for mutant in mutants:
        changed = mutant.apply(SOURCE)
        ast.parse(changed)
        lines = list(zip(SOURCE.splitlines(), changed.splitlines(), strict=True))
        assert [k + 1 for k, (before, after) in enumerate(lines) if before != after] == [
            mutant.line
        ]
        assert mutant.statement[0] <= mutant.line <= mutant.statement[1]


def test_the_sample_does_not_depend_on_other_code() -> None:
    """Lines above a mutant do not change its key, and the seed changes the order."""
    mutants = find_mutants("module.py", SOURCE)
    moved = find_mutants("module.py", SOURCE.replace('"""Module."""', '"""Module.\n"""\nA = 5'))
    keys = [mutant.key for mutant in mutants]
    assert len(set(keys)) == len(keys)
    assert set(keys) < {mutant.key for mutant in moved}
    orders = [sorted(keys, key=lambda key: rank(key, seed)) for seed in (0, 1)]
    assert orders[0] != orders[1]


def test_the_tests_of_the_line_come_first_and_the_fastest_of_them_first(tmp_path: Path) -> None:
    (mutant,) = (m for m in find_mutants("module.py", SOURCE) if m.original == "*")
    first, _ = mutant.statement
    outcomes = {
        "slow": ("passed", 2.0),
        "fast": ("passed", 1.0),
        "beside": ("passed", 0.5),
        "fails": ("failed", 0.1),
        "too slow": ("passed", 100.0),
    }
    lines = {name: [first] for name in outcomes} | {"beside": [first - 1], "": [1, 2]}
    (tmp_path / "test_module.json").write_text(
        json.dumps({"outcomes": outcomes, "lines": {"module.py": lines}, "blobs": {}})
    )
    covered = TestCoverage.read(tmp_path)
    assert covered.tests(mutant, None) == (["fast", "slow", "beside"], 2)
    assert covered.tests(mutant, "slow") == (["slow", "fast", "beside"], 2)
    (tmp_path / "imports.json").write_text(
        json.dumps({"outcomes": {}, "lines": {"module.py": {"": [first]}}, "blobs": {}})
    )
    covered = TestCoverage.read(tmp_path)
    assert covered.tests(mutant, None) == (["beside", "fast", "slow"], 3)
    assert covered.runs_at_import(mutant)
    assert not covered.runs_at_import(find_mutants("module.py", SOURCE)[0])
    (tmp_path / "test_gone.json").write_text(
        json.dumps({"outcomes": {"gone": ("passed", 0.1)}, "lines": {}, "blobs": {"gone.py": "0"}})
    )
    assert "gone" not in TestCoverage.read(tmp_path).seconds


def test_a_mutant_is_caught_by_the_first_test_that_fails() -> None:
    (mutant,) = (
        m
        for m in find_mutants("drake_clutter/stability/nnls.py", "def f(x):\n    return x * 2\n")
        if m.original == "*"
    )
    outcomes = {"a": ("passed", 0.1), "b": ("failed", 0.1)}
    row = mutant_row(mutant, {"outcomes": outcomes}, 2)
    assert (row["outcome"], row["caught_by"], row["tests"]) == ("caught", "b", 2)
    assert row["group"] == "static judge"
    row = mutant_row(mutant, {"outcomes": {"a": ("passed", 0.1)}}, 1)
    assert (row["outcome"], row["caught_by"], row["tests"]) == ("survived", None, 1)
    row = mutant_row(mutant, {"failure": "process ended with status 9"}, 1)
    assert (row["outcome"], row["caught_by"]) == ("caught", "process ended with status 9")


def double(value: int) -> int:
    """Return twice a value."""
    return value * 2


def test_the_code_of_a_function_is_replaced_wherever_it_is_referenced() -> None:
    references = [double]
    path = Path(__file__).relative_to(Path(__file__).parents[1])
    source = Path(__file__).read_text()
    (mutant,) = (
        m for m in find_mutants(str(path), source) if (m.function, m.original) == ("double", "*")
    )
    original = double.__code__
    job = {"path": str(path), "function": "double"}
    try:
        assert replace_code(job | {"source": mutant.apply(source)}, existing_functions())
        assert references[0](6) == 3
    finally:
        double.__code__ = original
    assert double(6) == 12


def test_a_module_is_imported_with_another_source() -> None:
    finder = MutatedModule("drake_clutter/limits.py", "VALUE = 5\n")
    assert finder.find_spec("drake_clutter.seeding", None) is None
    spec = finder.find_spec("drake_clutter.limits", None)
    assert spec is not None
    assert spec.loader is not None
    module = module_from_spec(spec)
    spec.loader.exec_module(module)
    assert module.VALUE == 5


def test_a_test_that_is_stopped_for_its_time_is_no_failure() -> None:
    (mutant,) = (
        m
        for m in find_mutants("drake_clutter/stability/nnls.py", "def f(x):\n    return x * 2\n")
        if m.original == "*"
    )
    outcomes = {"a": ("passed", 0.1), "b": ("failed", 3.5)}
    row = mutant_row(mutant, {"outcomes": outcomes, "is_too_slow": True}, 2)
    assert (row["outcome"], row["caught_by"]) == ("timed out", "b")
    row = mutant_row(mutant, {"failure": "process ended with status 24", "is_too_slow": True}, 1)
    assert row["outcome"] == "timed out"


def test_a_process_that_exceeds_its_processor_time_is_too_slow() -> None:
    def run(job: Job) -> Result:
        while True:
            pass

    result = run_job({"time_limit": 1.0}, run)
    assert result["is_too_slow"]
    assert result["failure"].startswith("process ended with status")

    def end(job: Job) -> Result:
        os.kill(os.getpid(), signal.SIGSEGV)
        return {}

    result = run_job({"time_limit": 60.0}, end)
    assert not result["is_too_slow"]


def test_a_mutant_without_tests_is_not_caught() -> None:
    """Neither is one whose tests could not be run for a fault of the worker."""
    job = {"measured": [], "limits": {}, "files": [], "test_limit": 1.0}
    collection = Collection(lambda run: None)
    collection._session = SimpleNamespace(
        items=[], config=SimpleNamespace(pluginmanager=pytest.PytestPluginManager())
    )  # type: ignore[assignment]
    collection._functions = []
    result = collection._run(job)
    assert result["outcomes"] == {}
    (mutant, *_) = find_mutants("drake_clutter/stability/nnls.py", "def f(x):\n    return x * 2\n")
    row = mutant_row(mutant, result, 0)
    assert (row["outcome"], row["caught_by"], row["tests"]) == ("survived", None, 0)


def test_an_exception_in_the_process_of_a_job_is_its_result() -> None:
    def run(job: Job) -> Result:
        if job["files"]:
            raise ValueError("no tests")
        return {"outcomes": {}}

    job = {"time_limit": 60.0, "files": []}
    assert run_job(job, run) == {"outcomes": {}}
    assert run_job(job | {"files": ["a"]}, run) == {"error": "ValueError: no tests"}


def test_processor_times_of_a_process_group() -> None:
    before = time.process_time()
    states = group_states(os.getpgrp())
    assert before - 0.1 < states[os.getpid(), "R"] < time.process_time() + 0.1
    assert group_states(os.getpid() + 1_000_000_000) == {}


def test_coverage_is_outdated_when_a_measured_file_changes(tmp_path: Path) -> None:
    path, name = tmp_path / "test_nnls.json", "drake_clutter/stability/nnls.py"
    assert not is_current(path)
    content = (ROOT / name).read_bytes()
    blob = subprocess.run(
        ["git", "hash-object", "--stdin"], input=content, capture_output=True, check=True
    ).stdout.decode()
    assert git_blobs([name]) == {name: blob[:12]}
    for blobs, expected in (
        ({name: blob[:12]}, True),
        ({name: "0" * 12}, False),
        ({name: blob[:12], "no_such_file.py": blob[:12]}, False),
    ):
        path.write_text(json.dumps({"blobs": blobs}))
        assert is_current(path) == expected


@pytest.mark.parametrize("compiled", [False, True])
def test_the_listed_test_files_exist(compiled: bool) -> None:
    paths = mutation_testing.test_files(compiled=compiled)
    assert [path for path in paths if not (ROOT / path).exists()] == []


def test_results_outside_the_sample_are_removed(tmp_path: Path) -> None:
    results = ResultsFile(tmp_path / "results.json", {"seed": 0}, ("key",))
    assert results.keep([("a",)]) == 0
    results.add({"key": "a", "x": 1}, {"key": "b", "x": 2})
    assert results.keep([("b",), ("c",)]) == 1
    assert results.read() == [{"key": "b", "x": 2}]
