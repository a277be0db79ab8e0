"""Maps over processes of this machine."""

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

# In a worker process: the factory, and from the first item on the worker that it made.
_make_worker: Callable[[], Callable[[Any], Any]] | None = None
_worker: Callable[[Any], Any] | None = None


def map_in_processes(
    make_worker: Callable[[], Callable[[Item], Result]], items: Iterable[Item], workers: int
) -> Generator[Result, None, None]:
    """See `drake_clutter.workers.parallel_map.map_ordered`."""
    gc.collect()  # a renderer that is left for one of the pool's threads to collect can abort the process
    # A forked copy of a process that runs threads (VTK, torch) can hang: the processes are started afresh.
    pool = ProcessPoolExecutor(
        workers, get_context("spawn"), initializer=_initialize_process, initargs=(make_worker,)
    )
    remaining = iter(items)
    futures: deque[Future[Result]] = deque()
    num_results = 0
    try:
        while True:
            for item in islice(remaining, workers * IN_FLIGHT_PER_WORKER - len(futures)):
                with temporary_environment(
                    SINGLE_THREAD_VARIABLES
                ):  # a process starts, and copies it, when an item finds none idle
                    futures.append(pool.submit(_process_item, item))
            if not futures:
                break
            result = futures[0].result()
            futures.popleft()
            num_results += 1
            yield result
    except BrokenProcessPool as error:
        raise BrokenProcessPool(
            f"a worker process was killed after {num_results} results; was memory short? Try fewer workers than {workers}"
        ) from error
    finally:
        if futures:  # left early
            for process in list(
                (pool._processes or {}).values()
            ):  # from Python 3.14: pool.terminate_workers()
                process.terminate()
        pool.shutdown(cancel_futures=True)


def map_in_recycled_processes(
    make_worker: Callable[[], Callable[[Item], Result]],
    items: Iterable[Item],
    workers: int,
    max_items_per_process: int,
) -> Generator[Result, None, None]:
    """See `drake_clutter.workers.parallel_map.map_ordered`."""
    remaining = iter(items)
    while batch := list(islice(remaining, workers * max_items_per_process)):
        yield from map_in_processes(make_worker, batch, workers)


def _initialize_process(make_worker: Callable[[], Callable[[Any], Any]]) -> None:
    global _make_worker
    _make_worker = make_worker
    signal.signal(
        signal.SIGINT, signal.SIG_IGN
    )  # Ctrl-C reaches every process; the first one ends the others
    threading.Thread(target=_exit_with_parent, daemon=True).start()


def _exit_with_parent() -> None:
    """A first process that is killed cannot end its workers: they see to it themselves."""
    parent = parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)


def _process_item(item: Any) -> Any:
    """Makes the worker with the first item, not in `_begin`: there an exception would only say that the pool is broken."""
    global _worker
    if _worker is None:
        assert _make_worker is not None
        _worker = _make_worker()
    return _worker(item)
