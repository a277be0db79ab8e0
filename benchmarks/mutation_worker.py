"""Process that runs tests on mutants; a part of `benchmarks/mutation_testing.py`.

It reads jobs from standard input and writes results to standard output, one JSON document per line.
Every job runs in a process that is forked for it:

- "collected": this process has imported the software and collected the tests. The code of the
  mutated function is replaced in the forked process.
- "fresh": this process has imported the packages of others only. The forked process imports the
  software with the mutated module. This is for code that runs when a module is imported.

Files are not changed, so new processes that a test starts run the unchanged software. Times are
processor times, and do not depend on the load of the machine.

    python -m benchmarks.mutation_worker collected|fresh TEST_FILE ...
"""

import faulthandler
import gc
import importlib
import json
import os
import resource
import select
import shutil
import signal
import sys
import tempfile
import time
from collections.abc import Callable, Generator, Iterable, Sequence
from contextlib import suppress
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec, SourceFileLoader
from importlib.util import spec_from_file_location
from itertools import zip_longest
from pathlib import Path
from types import CodeType, FrameType, FunctionType, ModuleType
from typing import Any

import pytest

Job = dict[str, Any]
"""Fields: `files` of tests; `limits`: tests in the order of execution and their time limits [s], or
null for all of the files; `test_limit`: time limit of other tests [s]; `time_limit` of the process
[s]; `measured`: files whose executed lines are recorded; for a mutant `path`, `function` and
`source`."""
Result = dict[str, Any]
"""Fields: `outcomes`: outcome and time [s] by test; `lines` executed, by file and test, where an
empty name stands for imports; `is_too_slow` if a test or the process was stopped; `failure` of a
process that ended without outcomes; `error` of this program, which is no result of the mutant."""

ROOT = Path(__file__).parents[1]
PACKAGES = (
    "gymnasium",
    "h5py",
    "hypothesis",
    "matplotlib.pyplot",
    "networkx",
    "numba",
    "PIL.Image",
    "pydantic",
    "pydrake.all",
    "rich.progress",
    "scipy.optimize",
    "scipy.spatial",
    "torch",
    "trimesh",
    "typer",
)
"""Imported before forking."""
MEMORY_LIMIT = 16 << 30
"""Address space of a process [bytes]."""
NOT_REPLACED = "the function cannot be replaced"
"""Failure of a job whose function is not found, or has other enclosed variables."""
OPTIONS = ("-q", "-x", "--tb=native", "-p", "no:cacheprovider", "-p", "no:xdist")
"""Options of pytest.

Its own tracebacks cannot show `TooSlow` where Python has no number of a line.
"""
_STOPPED = (signal.SIGXCPU, signal.SIGKILL)
"""Signals that end a process that exceeds `time_limit` or idles."""
IDLE_TIME = 60.0
"""Time after which a process that neither runs nor waits for a processor is ended [s]."""


class MutatedModule(MetaPathFinder):
    """Finds one module, with another source than its file's."""

    def __init__(self, path: str, source: str) -> None:
        """Prepare the import.

        Args:
            path: The module's file, from the root of the repository.
            source: Its mutated source.
        """
        self._path = str(ROOT / path)
        parts = Path(path).with_suffix("").parts
        self._name = ".".join(parts[:-1] if parts[-1] == "__init__" else parts)
        self._source = source

    def find_spec(
        self, name: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        """Return the spec of the mutated module; None for other modules."""
        if name != self._name:
            return None
        loader = _MutatedLoader(name, self._path)
        loader.code = compile(self._source, self._path, "exec")
        return spec_from_file_location(name, self._path, loader=loader)


class _MutatedLoader(SourceFileLoader):
    """Loads a module from given code."""

    code: CodeType

    def get_code(self, fullname: str) -> CodeType:
        return self.code


def existing_functions() -> list[FunctionType]:
    """Return all functions that the garbage collector knows."""
    return [thing for thing in gc.get_objects() if isinstance(thing, FunctionType)]


def replace_code(job: Job, functions: Iterable[FunctionType]) -> bool:
    """Replace the code of the mutated function wherever the function is referenced.

    Args:
        job: The job.
        functions: All functions.

    Returns:
        False if the function is not found, or the new code needs other enclosed variables.
    """
    path = str(ROOT / job["path"])
    code = _outermost(compile(job["source"], path, "exec"), job["function"])
    found = [
        function
        for function in functions
        if function.__code__.co_filename == path
        and function.__code__.co_qualname == code.co_qualname
    ]
    if any(function.__code__.co_freevars != code.co_freevars for function in found):
        return False
    for function in found:
        function.__code__ = code
    return bool(found)


def _outermost(code: CodeType, qualified_name: str) -> CodeType:
    """Return the code of the outermost function that contains a function."""
    for name in qualified_name.split("."):
        code = next(
            constant
            for constant in code.co_consts
            if isinstance(constant, CodeType) and constant.co_name == name
        )
        if code.co_flags & 0x02:  # CO_NEWLOCALS: a function, not a class.
            break
    return code


class TooSlow(BaseException):
    """A test takes longer than its limit."""


class TestRun:
    """Pytest plug-in that selects tests, limits their times, and records their outcomes."""

    __test__ = False

    def __init__(self, job: Job) -> None:
        """Prepare a run of the tests of a job.

        Only the measurement of executed lines needs the package `coverage`.
        """
        self._limits: dict[str, float] | None = job["limits"]
        self._test_limit: float = job["test_limit"]
        self._files: list[str] = job["files"]
        self._outcomes = dict[str, tuple[str, float]]()
        self._is_too_slow = False
        signal.signal(signal.SIGPROF, self._stop)
        self._coverage = None
        if job["measured"]:
            import coverage

            include = [str(ROOT / path) for path in job["measured"]]
            self._coverage = coverage.Coverage(data_file=None, config_file=False, include=include)
            self._coverage.start()

    def result(self) -> Result:
        """Return the outcomes and the executed lines."""
        lines = dict[str, dict[str, list[int]]]()
        if self._coverage is not None:
            self._coverage.stop()
            data = self._coverage.get_data()
            for path in data.measured_files():
                by_test = lines[str(Path(path).relative_to(ROOT))] = dict[str, list[int]]()
                for line, tests in data.contexts_by_lineno(path).items():
                    for test in tests:
                        by_test.setdefault(test, []).append(line)
        return {"outcomes": self._outcomes, "lines": lines, "is_too_slow": self._is_too_slow}

    def _stop(self, number: int, frame: FrameType | None) -> None:
        self._is_too_slow = True
        raise TooSlow

    def select(self, items: Sequence[pytest.Item]) -> list[pytest.Item]:
        """Return the tests of the job in the order of execution."""
        if self._limits is None:
            return [item for item in items if item.nodeid.partition("::")[0] in self._files]
        by_id = {item.nodeid: item for item in items}
        return [by_id[test] for test in self._limits if test in by_id]

    @pytest.hookimpl(trylast=True)
    def pytest_collection_modifyitems(self, items: list[pytest.Item]) -> None:
        """Select the tests."""
        items[:] = self.select(items)

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_protocol(self, item: pytest.Item) -> Generator[None, object, object]:
        """Limit and measure the time of a test."""
        if self._coverage is not None:
            self._coverage.switch_context(item.nodeid)
        start = time.process_time()
        limit = (self._limits or {}).get(item.nodeid, self._test_limit)
        signal.setitimer(signal.ITIMER_PROF, limit)
        try:
            return (yield)
        finally:
            signal.setitimer(signal.ITIMER_PROF, 0)
            outcome, _ = self._outcomes.get(item.nodeid, ("failed", 0.0))
            self._outcomes[item.nodeid] = outcome, time.process_time() - start
            if self._coverage is not None:
                self._coverage.switch_context("")

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Record the outcome of a phase of a test."""
        before, _ = self._outcomes.get(report.nodeid, ("passed", 0.0))
        worst = max(before, report.outcome, key=("passed", "skipped", "failed").index)
        self._outcomes[report.nodeid] = worst, 0.0

    def has_tests(self) -> bool:
        """Return whether there are tests to run."""
        return self._limits != {}

    def has_failed(self) -> bool:
        """Return whether a test has failed."""
        return any(outcome == "failed" for outcome, _ in self._outcomes.values())


def run_fresh(job: Job) -> Result:
    """Import the software with the mutated module, and run tests."""
    if "source" in job:
        sys.meta_path.insert(0, MutatedModule(job["path"], job["source"]))
    run = TestRun(job)
    exit_code = pytest.main([*OPTIONS, *job["files"]], plugins=[run])
    is_collected = exit_code == pytest.ExitCode.OK or run.has_failed() or not run.has_tests()
    return run.result() if is_collected else {"failure": "the tests cannot be collected"}


class Collection:
    """Pytest plug-in that reads jobs instead of running the collected tests.

    Attributes:
        session: The session with the collected tests.
    """

    def __init__(self, serve: Callable[[Callable[[Job], Result]], None]) -> None:
        """Store the function that reads jobs, given a function that runs one."""
        self._serve = serve

    @pytest.hookimpl(tryfirst=True)
    def pytest_runtestloop(self, session: pytest.Session) -> bool:
        """Read jobs until there are no more."""
        self._session = session
        self._functions = existing_functions()
        gc.collect()
        gc.freeze()  # Many tests collect garbage, which takes long with all tests in memory.
        self._serve(self._run)
        return True

    def _run(self, job: Job) -> Result:
        """Replace the code of the mutated function, and run tests."""
        if "source" in job and not replace_code(job, self._functions):
            return {"failure": NOT_REPLACED}
        config = self._session.config
        run = TestRun(job)
        config.pluginmanager.register(run)
        items = run.select(self._session.items)
        for item, following in zip_longest(items, items[1:]):
            config.hook.pytest_runtest_protocol(item=item, nextitem=following)
            if run.has_failed() and "source" in job:
                break
        return run.result()


def run_job(job: Job, run: Callable[[Job], Result]) -> Result:
    """Run a job in a forked process."""
    folder = tempfile.mkdtemp()
    reading, writing = os.pipe()
    child = os.fork()
    if not child:
        os.setsid()
        os.close(reading)
        with open(f"{folder}/log", "w") as log:
            os.dup2(log.fileno(), 1)
            os.dup2(log.fileno(), 2)
        faulthandler.enable()
        os.environ["PYTEST_DEBUG_TEMPROOT"] = folder
        resource.setrlimit(resource.RLIMIT_AS, (MEMORY_LIMIT, MEMORY_LIMIT))
        seconds = int(job["time_limit"])
        resource.setrlimit(resource.RLIMIT_CPU, (seconds, seconds))
        try:
            result = run(job)
        except Exception as error:
            result = {"error": f"{type(error).__name__}: {error}"}
        with os.fdopen(writing, "w") as stream:
            json.dump(result, stream)
        os._exit(0)
    os.close(writing)
    answer = _read_until_idle(reading, child)
    with suppress(ProcessLookupError):
        os.killpg(child, signal.SIGKILL)
    _, status = os.waitpid(child, 0)
    os.close(reading)
    shutil.rmtree(folder, ignore_errors=True)
    try:
        received: Result = json.loads(answer)
    except json.JSONDecodeError:
        stopped = os.WIFSIGNALED(status) and os.WTERMSIG(status) in _STOPPED
        return {"failure": f"process ended with status {status}", "is_too_slow": stopped}
    return received


def _read_until_idle(reading: int, child: int) -> bytes:
    """Return what a process group writes into a pipe, until the pipe is closed or the group idles.

    A group idles if none of its processes has run, or waited for a processor, for `IDLE_TIME`. On a
    loaded machine a process may wait for long.

    Args:
        reading: Descriptor of the pipe.
        child: Identifier of the process group.
    """
    answer = b""
    seconds, idle_since = -1.0, time.monotonic()
    while time.monotonic() - idle_since < IDLE_TIME:
        if select.select([reading], [], [], 1.0)[0]:
            block = os.read(reading, 1 << 16)
            answer += block
            if not block:
                break
        states = group_states(child)
        used = sum(states.values())
        if used != seconds or any(state == "R" for _, state in states):
            seconds, idle_since = used, time.monotonic()
    return answer


def group_states(group: int) -> dict[tuple[int, str], float]:
    """Return the processor times of the processes of a group [s], by identifier and state.

    The state is a letter of Linux, such as R for running and S for sleeping.
    """
    ticks = os.sysconf("SC_CLK_TCK")
    states = dict[tuple[int, str], float]()
    for path in Path("/proc").glob("[0-9]*/stat"):
        with suppress(OSError):  # The process has ended.
            fields = path.read_text().rpartition(")")[2].split()
            if int(fields[2]) == group:
                states[int(path.parent.name), fields[0]] = sum(map(int, fields[11:13])) / ticks
    return states


def main() -> None:
    """Run jobs until standard input ends."""
    kind, *files = sys.argv[1:]
    results = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(2, 1)
    sys.path[:0] = [str(ROOT)]
    os.chdir(ROOT)
    for package in PACKAGES:
        importlib.import_module(package)

    def serve(run: Callable[[Job], Result]) -> None:
        for line in sys.stdin:
            job = json.loads(line)
            result = run_job(job, run)
            is_doubtful = result.get("is_too_slow") or "outcomes" not in result
            if is_doubtful and "source" in job:
                # Perhaps because it compiled functions, which are in the cache from then on, or
                # because memory was short.
                result = run_job(job, run)
            print(json.dumps(result), file=results)

    if kind == "collected":
        # Without capturing, as the standard output of the forked processes is redirected anyway.
        pytest.main([*OPTIONS, "-s", *files], plugins=[Collection(serve)])
    else:
        serve(run_fresh)


if __name__ == "__main__":
    main()
