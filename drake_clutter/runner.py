"""Maps a function over many items in several processes, here or on a cluster, with the same results for any number of them."""

import gc
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

IN_FLIGHT_PER_WORKER = 4
# More threads than cores slow each other down; and a sum's rounding depends on the number of threads. Mesa's software renderer
# (LP: llvmpipe) was twice seen waiting for one of its own threads for ever.
ONE_THREAD_EACH = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "MKL_NUM_THREADS": "1", "LP_NUM_THREADS": "0"}

# In a worker process: the factory, and from the first item on the worker that it made.
_make_worker: Callable[[], Callable[[Any], Any]] | None = None
_worker: Callable[[Any], Any] | None = None


def item_rng(seed: int, *path: int) -> np.random.Generator:
    """A random generator of its own for every path under a seed, e.g. ``item_rng(seed, episode, step)``."""
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=path))


def map_ordered(
    make_worker: Callable[[], Callable[[Item], Result]],
    items: Iterable[Item],
    *,
    workers: int,
    ray_address: str | None = None,
    fresh_after: int | None = None,
) -> Generator[Result, None, None]:
    """Yields `make_worker()(item)` for every item, in the order of the items, each as soon as it is there.

    Every process makes one worker, e.g. with a Diagram and a camera of its own, and uses it for all its items. So a worker's
    result may depend on nothing but the item; what is random in it comes from a seed in the item (see `item_rng`). A large
    sequence is read only a few items ahead. An exception in a worker is raised here; an exception and closing the generator
    end the processes without waiting for the items at hand.

    On a Ray cluster a worker that dies, alone or with its machine, is replaced, and its item is done again. A worker takes one
    CPU; those for which the cluster has no room wait for it, without holding up the others. The package is installed on every
    machine; files that the workers read are at the same place on all.

    Args:
        make_worker: a factory that can be pickled: a class, a module's function, or a functools.partial of one.
        items: the items; with more than one worker, or on a cluster, they and the results are pickled.
        workers: number of processes; 1 works in this process, or as one process on the cluster.
        ray_address: of the Ray cluster that the processes run on, e.g. "auto"; None: they run on this machine, without Ray.
        fresh_after: items, after which processes on this machine are replaced by fresh ones, also a single one. pydrake never
            frees a Diagram that holds a system written in Python: an episode of the closed loop keeps 340 MB.

    Raises:
        BrokenProcessPool: a worker process was killed; on a cluster, an item lost its worker three times.
        InputError: Ray is not installed, or there is no cluster at the address.
    """
    if workers < 1:
        raise ValueError(f"workers: {workers}; allowed is 1 or more")
    if ray_address is not None:
        from drake_clutter.runner_ray import map_on_ray

        return map_on_ray(make_worker, items, workers, ray_address)
    if fresh_after is not None:
        return _map_in_fresh_processes(make_worker, items, workers, fresh_after)
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
    gc.collect()  # a renderer that is left for one of the pool's threads to collect can abort the process
    # A forked copy of a process that runs threads (VTK, torch) can hang: the processes are started afresh.
    pool = ProcessPoolExecutor(workers, get_context("spawn"), initializer=_begin, initargs=(make_worker,))
    remaining = iter(items)
    futures: deque[Future[Result]] = deque()
    done = 0
    try:
        while True:
            for item in islice(remaining, workers * IN_FLIGHT_PER_WORKER - len(futures)):
                with environment(ONE_THREAD_EACH):  # a process starts, and copies it, when an item finds none idle
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


def _map_in_fresh_processes(
    make_worker: Callable[[], Callable[[Item], Result]], items: Iterable[Item], workers: int, fresh_after: int
) -> Generator[Result, None, None]:
    remaining = iter(items)
    while some := list(islice(remaining, workers * fresh_after)):
        yield from _map_in_processes(make_worker, some, workers)


@contextmanager
def environment(variables: dict[str, str]) -> Iterator[None]:
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
