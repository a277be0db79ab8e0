"""Ordered map over processes of this machine."""

import gc
import os
import signal
import threading
from collections import deque
from collections.abc import Callable, Generator, Iterable
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from itertools import islice
from multiprocessing import get_context, parent_process
from typing import Any, TypeVar

from drake_clutter.workers.process_environment import (
    IN_FLIGHT_PER_WORKER,
    SINGLE_THREAD_VARIABLES,
    temporary_environment,
)

Item = TypeVar("Item")
Result = TypeVar("Result")

# State of a worker process: the factory, and the worker, which is made with the first item.
_make_worker: Callable[[], Callable[[Any], Any]] | None = None
_worker: Callable[[Any], Any] | None = None


def map_in_processes(
    make_worker: Callable[[], Callable[[Item], Result]], items: Iterable[Item], workers: int
) -> Generator[Result, None, None]:
    """Map in several processes; see `drake_clutter.workers.parallel_map.map_ordered`."""
    # If a thread of the pool collects a renderer as garbage, the process can abort.
    gc.collect()
    # A forked copy of a process with threads (VTK, PyTorch) can deadlock; spawned ones do not.
    pool = ProcessPoolExecutor(
        workers, get_context("spawn"), initializer=_initialize_process, initargs=(make_worker,)
    )
    remaining = iter(items)
    futures: deque[Future[Result]] = deque()
    num_results = 0
    processes = pool._processes
    try:
        while True:
            for item in islice(remaining, workers * IN_FLIGHT_PER_WORKER - len(futures)):
                # The pool starts a process, which copies the environment, if none is idle.
                with temporary_environment(SINGLE_THREAD_VARIABLES):
                    futures.append(pool.submit(_process_item, item))
            if not futures:
                break
            result = futures[0].result()
            futures.popleft()
            num_results += 1
            yield result
    except BrokenProcessPool as error:
        pool.shutdown()  # Until all processes have ended, an exit code may be missing.
        exit_codes = {process.exitcode for process in processes.values()}
        raise BrokenProcessPool(
            f"a worker process was killed after {num_results} results, perhaps for lack of memory; "
            f"try fewer workers than {workers}"
            if -signal.SIGKILL in exit_codes
            else f"a worker process ended after {num_results} results, see its output above; each "
            "worker imports the script, so what a script runs belongs under "
            "`if __name__ == '__main__':`"
        ) from error
    finally:
        if futures:  # The caller did not read all results.
            # From Python 3.14 on, this is pool.terminate_workers().
            for process in list(processes.values()):
                process.terminate()
        pool.shutdown(cancel_futures=True)


def map_in_recycled_processes(
    make_worker: Callable[[], Callable[[Item], Result]],
    items: Iterable[Item],
    workers: int,
    max_items_per_process: int,
) -> Generator[Result, None, None]:
    """Map in processes that are replaced after a number of items; see `map_ordered`."""
    remaining = iter(items)
    while batch := list(islice(remaining, workers * max_items_per_process)):
        yield from map_in_processes(make_worker, batch, workers)


def _initialize_process(make_worker: Callable[[], Callable[[Any], Any]]) -> None:
    global _make_worker
    _make_worker = make_worker
    # Ctrl-C reaches every process; the parent process ends the others.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_exit_with_parent, daemon=True).start()


def _exit_with_parent() -> None:
    """End this process with its parent, which cannot end its workers if it is killed."""
    parent = parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)


def _process_item(item: Any) -> Any:
    """Process an item, and make the worker first if there is none.

    An exception of the factory in the initializer would only be reported as a broken pool.
    """
    global _worker
    if _worker is None:
        assert _make_worker is not None
        _worker = _make_worker()
    return _worker(item)
