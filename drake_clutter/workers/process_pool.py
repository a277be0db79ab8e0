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

from drake_clutter.workers.environment import IN_FLIGHT_PER_WORKER, ONE_THREAD_EACH, environment

Item = TypeVar("Item")
Result = TypeVar("Result")

# In a worker process: the factory, and from the first item on the worker that it made.
_make_worker: Callable[[], Callable[[Any], Any]] | None = None
_worker: Callable[[Any], Any] | None = None


def map_in_processes(
    make_worker: Callable[[], Callable[[Item], Result]], items: Iterable[Item], workers: int
) -> Generator[Result, None, None]:
    """See `drake_clutter.workers.mapping.map_ordered`."""
    gc.collect()  # a renderer that is left for one of the pool's threads to collect can abort the process
    # A forked copy of a process that runs threads (VTK, torch) can hang: the processes are started afresh.
    pool = ProcessPoolExecutor(
        workers, get_context("spawn"), initializer=_begin, initargs=(make_worker,)
    )
    remaining = iter(items)
    futures: deque[Future[Result]] = deque()
    done = 0
    try:
        while True:
            for item in islice(remaining, workers * IN_FLIGHT_PER_WORKER - len(futures)):
                with environment(
                    ONE_THREAD_EACH
                ):  # a process starts, and copies it, when an item finds none idle
                    futures.append(pool.submit(_work, item))
            if not futures:
                break
            result = futures[0].result()
            futures.popleft()
            done += 1
            yield result
    except BrokenProcessPool as error:
        raise BrokenProcessPool(
            f"a worker process was killed after {done} results; was memory short? Try fewer workers than {workers}"
        ) from error
    finally:
        if futures:  # left early
            for process in list(
                (pool._processes or {}).values()
            ):  # from Python 3.14: pool.terminate_workers()
                process.terminate()
        pool.shutdown(cancel_futures=True)


def map_in_fresh_processes(
    make_worker: Callable[[], Callable[[Item], Result]],
    items: Iterable[Item],
    workers: int,
    fresh_after: int,
) -> Generator[Result, None, None]:
    """See `drake_clutter.workers.mapping.map_ordered`."""
    remaining = iter(items)
    while some := list(islice(remaining, workers * fresh_after)):
        yield from map_in_processes(make_worker, some, workers)


def _begin(make_worker: Callable[[], Callable[[Any], Any]]) -> None:
    global _make_worker
    _make_worker = make_worker
    signal.signal(
        signal.SIGINT, signal.SIG_IGN
    )  # Ctrl-C reaches every process; the first one ends the others
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    """A first process that is killed cannot end its workers: they see to it themselves."""
    parent = parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)


def _work(item: Any) -> Any:
    """Makes the worker with the first item, not in `_begin`: there an exception would only say that the pool is broken."""
    global _worker
    if _worker is None:
        assert _make_worker is not None
        _worker = _make_worker()
    return _worker(item)
