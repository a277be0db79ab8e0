"""Parallel, ordered map whose results do not depend on the number of processes."""

from collections.abc import Callable, Generator, Iterable
from typing import TypeVar

from drake_clutter.workers.process_pool import map_in_processes

Item = TypeVar("Item")
Result = TypeVar("Result")


def map_ordered(
    make_worker: Callable[[], Callable[[Item], Result]],
    items: Iterable[Item],
    *,
    workers: int,
    ray_address: str | None = None,
    max_items_per_process: int | None = None,
) -> Generator[Result, None, None]:
    """Yield `make_worker()(item)` for every item, in the order of the items.

    Each process makes one worker, which may hold expensive objects such as a Diagram, and uses it
    for all of its items. The result of a worker must depend only on the item; random numbers come
    from a seed in the item (see `item_rng`). Items are read only a few ahead. An exception in a
    worker is raised here. After an exception, or when the generator is closed, the processes end
    without finishing their current items.

    A worker process that dies, on a Ray cluster also with its machine, is replaced, and its item is
    repeated. On a cluster, a worker takes one CPU; workers for which the cluster has no room wait
    without blocking the others. All machines need the package, and the workers' files at the same
    paths.

    Args:
        make_worker: Picklable factory of a worker: a class, a module-level function, or a
            functools.partial of one.
        items: The items. With several workers or on a cluster, they and the results are pickled.
        workers: Number of processes. With 1, the work is done in this process, or in one process of
            the cluster.
        ray_address: Address of the Ray cluster, such as "auto"; None: this machine without Ray.
        max_items_per_process: Number of items after which processes on this machine are replaced,
            also a single one; None: never. pydrake does not free a Diagram with a system written in
            Python: an episode of the closed loop keeps 340 MB.

    Raises:
        BrokenProcessPool: An item lost its worker process `MAX_WORKER_LOSSES` times, or a process
            could not be started.
        InputError: Ray is not installed, or there is no cluster at the address.
    """
    if workers < 1:
        raise ValueError(f"workers: {workers}; expected 1 or more")
    if ray_address is not None:
        from drake_clutter.workers.ray_pool import map_on_ray

        return map_on_ray(make_worker, items, workers, ray_address)
    if workers == 1 and max_items_per_process is None:
        return _map_in_this_process(make_worker, items)
    return map_in_processes(make_worker, items, workers, max_items_per_process)


def _map_in_this_process(
    make_worker: Callable[[], Callable[[Item], Result]], items: Iterable[Item]
) -> Generator[Result, None, None]:
    worker: Callable[[Item], Result] | None = None
    for item in items:
        if worker is None:
            worker = make_worker()
        yield worker(item)
