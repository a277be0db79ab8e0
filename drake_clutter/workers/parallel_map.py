"""Maps a function over many items in several processes, here or on a cluster, with the same results for any number of them."""

from collections.abc import Callable, Generator, Iterable
from typing import TypeVar

from drake_clutter.workers.process_pool import map_in_processes, map_in_recycled_processes

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
        max_items_per_process: After so many items, processes on this machine are replaced, also a
            single one; None: never. pydrake never frees a Diagram that holds a system written in
            Python: an episode of the closed loop keeps 340 MB.

    Raises:
        BrokenProcessPool: a worker process was killed; on a cluster, an item lost its worker three times.
        InputError: Ray is not installed, or there is no cluster at the address.
    """
    if workers < 1:
        raise ValueError(f"workers: {workers}; allowed is 1 or more")
    if ray_address is not None:
        from drake_clutter.workers.ray_pool import map_on_ray

        return map_on_ray(make_worker, items, workers, ray_address)
    if max_items_per_process is not None:
        return map_in_recycled_processes(make_worker, items, workers, max_items_per_process)
    return (
        _map_in_this_process(make_worker, items)
        if workers == 1
        else map_in_processes(make_worker, items, workers)
    )


def _map_in_this_process(
    make_worker: Callable[[], Callable[[Item], Result]], items: Iterable[Item]
) -> Generator[Result, None, None]:
    worker: Callable[[Item], Result] | None = None
    for item in items:
        if worker is None:
            worker = make_worker()
        yield worker(item)
