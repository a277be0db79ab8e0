"""Parallel map: order, independence of the number of workers, and early termination."""

import os
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures.process import BrokenProcessPool
from functools import partial
from multiprocessing import active_children
from pathlib import Path

import pytest
from failing_workers import broken_factory, make_failing_worker

from drake_clutter.files import cli_error_handler
from drake_clutter.seeding import item_rng
from drake_clutter.workers.parallel_map import map_ordered

DEADLY = {0: signal.SIGKILL, 5: signal.SIGSEGV}
"""Items of `MortalNumbers`, and the signals that end their processes."""


class RandomNumbers:
    """Return a random number for an item; later items may overtake earlier ones."""

    def __call__(self, item: int) -> tuple[int, float]:
        time.sleep(0.02 if item % 4 == 0 else 0.0)
        return item, item_rng(7, item).normal()


class MortalNumbers(RandomNumbers):
    """Die at the first attempt of some items."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def __call__(self, item: int) -> tuple[int, float]:
        attempted = self._folder / f"{item}"
        if item in DEADLY and not attempted.exists():
            attempted.touch()
            os.kill(os.getpid(), DEADLY[item])
        return super().__call__(item)


class WorkerCounter:
    """Create a file named after the process of each new worker."""

    def __init__(self, folder: Path) -> None:
        (folder / f"{os.getpid()}").touch(exist_ok=False)

    def __call__(self, item: int) -> int:
        return os.getpid()


def sleep_or_die(item: float) -> float:
    if item < 0:
        os.kill(os.getpid(), signal.SIGKILL)
    time.sleep(item)
    return item


def make_sleeper() -> Callable[[float], float]:
    return sleep_or_die


def thread_setting(item: int) -> str | None:
    return os.environ.get("OMP_NUM_THREADS")


def make_thread_setting() -> Callable[[int], str | None]:
    return thread_setting


@pytest.mark.parametrize("workers", [1, 2])
def test_processes_are_replaced_after_a_number_of_items(workers: int, tmp_path: Path) -> None:
    done = list(
        map_ordered(
            partial(WorkerCounter, tmp_path), range(5), workers=workers, max_items_per_process=2
        )
    )
    assert len(done) == 5
    assert max(Counter(done).values()) == 2
    assert os.getpid() not in done


def test_order_and_results_do_not_depend_on_the_number_of_workers() -> None:
    alone = list(map_ordered(RandomNumbers, range(30), workers=1))
    assert [item for item, _ in alone] == list(range(30))
    assert list(map_ordered(RandomNumbers, range(30), workers=2)) == alone
    assert list(map_ordered(RandomNumbers, iter(range(30)), workers=3)) == alone


@pytest.mark.parametrize("workers", [1, 2])
def test_one_worker_is_made_per_process(workers: int, tmp_path: Path) -> None:
    used = set(map_ordered(partial(WorkerCounter, tmp_path), range(20), workers=workers))
    assert {int(file.name) for file in tmp_path.iterdir()} == used
    assert 1 <= len(used) <= workers
    assert (os.getpid() in used) == (workers == 1)


@pytest.mark.parametrize("workers", [1, 2])
def test_no_items(workers: int) -> None:
    assert list(map_ordered(broken_factory, [], workers=workers)) == []


@pytest.mark.parametrize("workers", [1, 2])
def test_an_exception_is_raised_in_the_order_of_items(workers: int) -> None:
    results = map_ordered(partial(make_failing_worker, 3), range(10), workers=workers)
    assert [next(results) for _ in range(3)] == [0, 1, 2]
    with pytest.raises(LookupError, match="item 3"):
        next(results)
    assert not active_children()


@pytest.mark.parametrize("workers", [1, 2])
def test_an_exception_of_the_factory_is_raised(workers: int) -> None:
    with pytest.raises(LookupError, match="no worker"):
        next(map_ordered(broken_factory, range(3), workers=workers))


def test_closing_early_does_not_wait_for_workers() -> None:
    results = map_ordered(make_sleeper, [0.0, *[60.0] * 100], workers=2)
    assert next(results) == 0.0
    start = time.monotonic()
    results.close()
    assert time.monotonic() - start < 10
    assert not active_children()


@pytest.mark.parametrize("signal_number", [signal.SIGINT, signal.SIGTERM, signal.SIGKILL])
def test_workers_end_with_their_parent_process(signal_number: signal.Signals) -> None:
    code = """
import signal
from test_workers import make_sleeper, map_ordered
# A background process of a shell ignores SIGINT by default.
signal.signal(signal.SIGINT, signal.default_int_handler)
for result in map_ordered(make_sleeper, [0.0, 60.0], workers=2):
    print(result, flush=True)
"""
    with subprocess.Popen(
        [sys.executable, "-c", code],
        env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
        start_new_session=True,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
    ) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == b"0.0\n"
        if signal_number == signal.SIGINT:
            os.killpg(process.pid, signal_number)  # Like a terminal.
        else:
            process.send_signal(signal_number)
        # This returns when the last process that holds the pipes has ended.
        _, errors = process.communicate(timeout=10)
    assert (signal_number == signal.SIGINT) == errors.rstrip().endswith(b"KeyboardInterrupt")


def test_a_killed_worker_is_replaced(tmp_path: Path) -> None:
    """Its item is repeated, and the results are those of workers that live."""
    expected = list(map_ordered(RandomNumbers, range(8), workers=1))
    results = map_ordered(partial(MortalNumbers, tmp_path), range(8), workers=2)
    assert list(results) == expected
    assert sorted(int(file.name) for file in tmp_path.iterdir()) == [0, 5]
    assert not active_children()


def test_an_item_that_kills_its_workers_is_named_in_its_turn() -> None:
    results = map_ordered(make_sleeper, [0.0, 0.1, -1.0, 60.0], workers=2)
    assert [next(results) for _ in range(2)] == [0.0, 0.1]
    reason = "the last one killed by SIGKILL, perhaps for lack of memory; try fewer workers than 2$"
    with pytest.raises(BrokenProcessPool, match=rf"^item -1\.0: 3 .*{reason}"):
        next(results)
    assert not active_children()


def test_a_command_reports_such_an_item_in_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as end, cli_error_handler():
        list(map_ordered(make_sleeper, [-1.0], workers=2))
    assert end.value.code == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("error item -1.0: 3 worker processes ended")
    assert line.endswith("; finished results are kept")


class UnpicklableError(Exception):
    """An error that cannot be restored in another process."""

    def __init__(self, first: str, second: str) -> None:
        super().__init__(f"{first}{second}")


def raise_unpicklable(item: int) -> int:
    raise UnpicklableError("o", "dd")


def make_raiser() -> Callable[[int], int]:
    return raise_unpicklable


def test_an_error_that_cannot_be_transferred_is_an_error() -> None:
    with pytest.raises(TypeError, match="missing 1 required positional argument: 'second'"):
        list(map_ordered(make_raiser, [1], workers=2))


def test_reads_only_a_few_items_ahead() -> None:
    read = []

    def endless() -> Iterator[int]:
        item = 0
        while True:
            read.append(item)
            yield item
            item += 1

    results = map_ordered(RandomNumbers, endless(), workers=2)
    for _ in range(5):
        next(results)
    results.close()
    assert len(read) <= 5 + 8


def test_workers_have_one_thread_and_the_parent_is_unchanged(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    assert list(map_ordered(make_thread_setting, range(2), workers=2)) == ["1", "1"]
    assert "OMP_NUM_THREADS" not in os.environ


def test_zero_workers_are_rejected_immediately() -> None:
    with pytest.raises(ValueError, match="workers: 0"):
        map_ordered(RandomNumbers, [], workers=0)


def test_item_rng_depends_on_the_whole_path() -> None:
    numbers = {
        item_rng(*path).integers(2**62)
        for path in [(0,), (0, 0), (0, 1), (0, 0, 0), (1,), (1, 0), (0, 1, 0)]
    }
    assert len(numbers) == 7
    assert item_rng(3, 4).normal() == item_rng(3, 4).normal()


def test_a_script_without_a_guard_is_named_as_the_cause(tmp_path: Path) -> None:
    """Each worker imports the script that starts the workers, and would start workers, too."""
    script = tmp_path / "study.py"
    script.write_text(
        "from functools import partial\n"
        "from drake_clutter.workers.parallel_map import map_ordered\n"
        "print(list(map_ordered(partial(partial, int), range(2), workers=2)))\n"
    )
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[1])}
    result = subprocess.run(
        [sys.executable, script], env=environment, capture_output=True, text=True, check=False
    )
    assert result.returncode == 1
    assert "a worker process ended before it started to work" in result.stderr
    assert "what a script runs belongs under `if __name__ == '__main__':`" in result.stderr
    assert "lack of memory" not in result.stderr
