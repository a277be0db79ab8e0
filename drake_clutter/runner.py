"""Maps a function over many items in several processes, in order and with the same results for any number of them."""

import os
import signal
import threading
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from itertools import islice
from multiprocessing import get_context, parent_process
from typing import Any, TypeVar

import numpy as np

Item = TypeVar("Item")
Result = TypeVar("Result")

_IN_FLIGHT_PER_WORKER = 4
# More threads than cores slow each other down; and a sum's rounding depends on the number of threads.
_ONE_THREAD_EACH = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}

# In a worker process: the factory, and from the first item on the worker that it made.
_make_worker: Callable[[], Callable[[Any], Any]] | None = None
_worker: Callable[[Any], Any] | None = None


def item_rng(seed: int, *path: int) -> np.random.Generator:
    """A random generator of its own for every path under a seed, e.g. ``item_rng(seed, episode, step)``."""
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=path))


def map_ordered(
    make_worker: Callable[[], Callable[[Item], Result]], items: Iterable[Item], *, workers: int
) -> Generator[Result, None, None]:
    """Yields `make_worker()(item)` for every item, in the order of the items, each as soon as it is there.

    Every process makes one worker, e.g. with a Diagram and a camera of its own, and uses it for all its items. So a worker's
    result may depend on nothing but the item; what is random in it comes from a seed in the item (see `item_rng`). A large
    sequence is read only a few items ahead. An exception in a worker is raised here; an exception and closing the generator
    end the processes without waiting for the items at hand.

    Args:
        make_worker: a factory that can be pickled: a class, a module's function, or a functools.partial of one.
        items: the items; with more than one worker they and the results are pickled.
        workers: number of processes; 1 works in this process.

    Raises:
        BrokenProcessPool: a worker process was killed.
    """
    if workers < 1:
        raise ValueError(f"workers: {workers}; allowed is 1 or more")
    return _map_here(make_worker, items) if workers == 1 else _map_in_processes(make_worker, items, workers)


def _map_here(make_worker: Callable[[], Callable[[Item], Result]], items: Iterable[Item]) -> Generator[Result, None, None]:
    worker: Callable[[Item], Result] | None = None
    for item in items:
        if worker is None:
            worker = make_worker()
        yield worker(item)


def _map_in_processes(
    make_worker: Callable[[], Callable[[Item], Result]], items: Iterable[Item], workers: int
) -> Generator[Result, None, None]:
    # A forked copy of a process that runs threads (VTK, torch) can hang: the processes are started afresh.
    pool = ProcessPoolExecutor(workers, get_context("spawn"), initializer=_begin, initargs=(make_worker,))
    remaining = iter(items)
    futures: deque[Future[Result]] = deque()
    done = 0
    try:
        while True:
            for item in islice(remaining, workers * _IN_FLIGHT_PER_WORKER - len(futures)):
                with _environment(_ONE_THREAD_EACH):  # a process starts, and copies it, when an item finds none idle
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
            for process in list((pool._processes or {}).values()):  # from Python 3.14: pool.terminate_workers()
                process.terminate()
        pool.shutdown(cancel_futures=True)


@contextmanager
def _environment(variables: dict[str, str]) -> Iterator[None]:
    """Sets environment variables for the length of the block."""
    before = {name: os.environ.get(name) for name in variables}
    os.environ.update(variables)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def _begin(make_worker: Callable[[], Callable[[Any], Any]]) -> None:
    global _make_worker
    _make_worker = make_worker
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches every process; the first one ends the others
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
