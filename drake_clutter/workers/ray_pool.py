"""Ordered map over the machines of a Ray cluster; needs the optional dependency `scale`."""

import logging
import os
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import Future
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from itertools import islice
from typing import Any, TypeVar

from drake_clutter.files import InputError
from drake_clutter.workers.process_environment import (
    IN_FLIGHT_PER_WORKER,
    SINGLE_THREAD_VARIABLES,
    temporary_environment,
)

Item = TypeVar("Item")
Result = TypeVar("Result")

MAX_WORKER_LOSSES = 3
"""Number of worker processes that an item may lose before it fails."""
SHORT_CONNECTION_TIMEOUTS = {
    "RAY_NUM_REDIS_GET_RETRIES": "1",
    "RAY_gcs_rpc_server_connect_timeout_s": "2",
    "RAY_py_gcs_connect_timeout_s": "5",
}
"""Environment variables that Ray reads when it is imported.

Without them it tries to reach an absent cluster for a quarter of an hour.
"""


class _Actor:
    """Worker process of the cluster.

    Items and results are pickled, because arrays that Ray itself transfers are read-only.
    """

    def __init__(self, make_worker: bytes, folder: str) -> None:
        self._make_worker = make_worker
        self._worker: Callable[[Any], Any] | None = None
        # If the machines share the folder, relative paths in the items are valid here, too.
        with suppress(OSError):
            os.chdir(folder)

    def ready(self) -> None:
        """Return once the actor is running."""

    def work(self, item: bytes) -> bytes:
        """Process an item; the worker is made with the first one, so its errors are reported."""
        from ray import cloudpickle

        if self._worker is None:
            self._worker = cloudpickle.loads(self._make_worker)()
        result: bytes = cloudpickle.dumps(self._worker(cloudpickle.loads(item)))
        return result


@dataclass
class _Job:
    """A pickled item and its processing.

    Attributes:
        item: Pickled item.
        result: Result of the item.
        losses: Number of actors that died with the item.
    """

    item: bytes
    result: Future[Any] = field(default_factory=Future)
    losses: int = 0


def map_on_ray(
    make_worker: Callable[[], Callable[[Item], Result]],
    items: Iterable[Item],
    workers: int,
    address: str,
) -> Generator[Result, None, None]:
    """Map on a Ray cluster; see `drake_clutter.workers.parallel_map.map_ordered`."""
    with _ray_session(address) as ray:
        options = {
            "num_cpus": 1,
            "max_restarts": -1,
            "max_task_retries": -1,
            "runtime_env": {"env_vars": SINGLE_THREAD_VARIABLES},
        }
        actor_class = ray.remote(**options)(_Actor)
        factory = ray.cloudpickle.dumps(make_worker)
        actors = [actor_class.remote(factory, os.getcwd()) for _ in range(workers)]
        try:
            yield from _map_over_actors(ray, actors, items)
        finally:
            for actor in actors:
                ray.kill(actor)


@contextmanager
def _ray_session(address: str) -> Iterator[Any]:
    """Connect to Ray for the duration of the block, or keep using an existing connection."""
    try:
        with temporary_environment(SHORT_CONNECTION_TIMEOUTS):
            import ray
    except ModuleNotFoundError as error:
        raise InputError(
            f'--ray {address}: Ray is not installed; pip install "drake-clutter[scale]"'
        ) from error
    if ray.is_initialized():
        yield ray
        return
    try:
        ray.init(address, include_dashboard=False, log_to_driver=False, logging_level=logging.ERROR)
    except (ConnectionError, RuntimeError, ValueError) as error:
        raise InputError(
            f"--ray {address}: cannot connect to a cluster ({error}); expected auto, for the "
            "cluster on this machine, or HOST:PORT as `ray start --head` prints it (set "
            "RAY_AUTH_MODE=token if the cluster requires a token)"
        ) from error
    try:
        yield ray
    finally:
        ray.shutdown()


def _map_over_actors(
    ray: Any, actors: list[Any], items: Iterable[Any]
) -> Generator[Any, None, None]:
    """Distribute the items among the actors, which Ray restarts when they die.

    Ray's own retries are not used. They bind an item to its actor, which never continues if its
    machine is gone and the others have no room, and they are used up while an actor restarts. Here
    an item that was lost with its actor goes to the next actor that is ready.
    """
    remaining = iter(items)
    pending: deque[_Job] = deque()  # Jobs whose results are not yielded yet.
    unassigned: deque[_Job] = deque()  # Pending jobs that no actor is working on.
    idle: list[Any] = []
    busy: dict[Any, tuple[Any, _Job | None]] = {
        actor.ready.remote(): (actor, None) for actor in actors
    }
    while True:
        for item in islice(remaining, len(actors) * IN_FLIGHT_PER_WORKER - len(pending)):
            pending.append(_Job(ray.cloudpickle.dumps(item)))
            unassigned.append(pending[-1])
        if not pending:
            return
        if pending[0].result.done():
            yield pending.popleft().result.result()
            continue
        while idle and unassigned:
            actor = idle.pop()
            next_job = unassigned.popleft()
            busy[actor.work.options(max_task_retries=0).remote(next_job.item)] = (actor, next_job)
        (done,), _ = ray.wait(list(busy))
        actor, job = busy.pop(done)
        try:
            result = ray.get(done)
        except ray.exceptions.RayTaskError as error:  # The worker raised an exception.
            if job is None:
                raise
            error.cause.__cause__ = error  # It contains the worker's traceback.
            job.result.set_exception(error.cause)
            idle.append(actor)
        except ray.exceptions.RayError as error:
            if job is None:
                raise
            job.losses += 1
            if job.losses < MAX_WORKER_LOSSES:
                unassigned.appendleft(job)
            else:
                message = (
                    f"an item ended {MAX_WORKER_LOSSES} worker processes; "
                    f"the last error was: {error}"
                )
                job.result.set_exception(BrokenProcessPool(message))
            # Other actors may have died, too, for example with their machine. They get no item
            # before they have responded.
            busy |= {other.ready.remote(): (other, None) for other in (actor, *idle)}
            idle.clear()
        else:
            if job is not None:
                job.result.set_result(ray.cloudpickle.loads(result))
            idle.append(actor)
