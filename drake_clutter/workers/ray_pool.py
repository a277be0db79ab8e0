"""Maps over the machines of a Ray cluster: the part that needs the extra `scale`."""

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
# Ray reads these when it is imported. Without them it tries for a quarter of an hour to reach a cluster that is not there.
SHORT_CONNECTION_TIMEOUTS = {
    "RAY_NUM_REDIS_GET_RETRIES": "1",
    "RAY_gcs_rpc_server_connect_timeout_s": "2",
    "RAY_py_gcs_connect_timeout_s": "5",
}


class _Actor:
    """Works on a machine of the cluster. It takes and gives pickles: arrays that Ray itself passes on may not be written to."""

    def __init__(self, make_worker: bytes, folder: str) -> None:
        self._make_worker = make_worker
        self._worker: Callable[[Any], Any] | None = None
        with suppress(
            OSError
        ):  # where the machines share the folder, relative paths in the items are right here, too
            os.chdir(folder)

    def ready(self) -> None:
        """Answers once the actor lives."""

    def work(self, item: bytes) -> bytes:
        """Makes the worker with the first item, so that an exception in that is told like one in the work."""
        from ray import cloudpickle

        if self._worker is None:
            self._worker = cloudpickle.loads(self._make_worker)()
        result: bytes = cloudpickle.dumps(self._worker(cloudpickle.loads(item)))
        return result


@dataclass
class _Job:
    """A pickled item, what becomes of it, and how often it was lost with its actor."""

    item: bytes
    result: Future[Any] = field(default_factory=Future)
    losses: int = 0


def map_on_ray(
    make_worker: Callable[[], Callable[[Item], Result]],
    items: Iterable[Item],
    workers: int,
    address: str,
) -> Generator[Result, None, None]:
    """See `drake_clutter.workers.parallel_map.map_ordered`."""
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
    """Ray, connected for the length of the block; a connection that the process already has is used, and kept."""
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
            f"--ray {address}: no cluster to work with ({error}); allowed is auto, for the cluster that runs on this machine, or "
            "HOST:PORT as `ray start --head` prints it (if the cluster asks for a token, with RAY_AUTH_MODE=token set)"
        ) from error
    try:
        yield ray
    finally:
        ray.shutdown()


def _map_over_actors(
    ray: Any, actors: list[Any], items: Iterable[Any]
) -> Generator[Any, None, None]:
    """Gives the items to the actors. Ray starts these, notices when one dies, and starts it anew where there is room.

    The items are not left to Ray's own retries. Those keep an item with its actor, which waits for ever if its machine is gone
    and the others have no room; and they are used up while an actor is being restarted. Here an item that was lost with its
    actor goes to the next actor that is ready.
    """
    remaining = iter(items)
    pending: deque[_Job] = deque()  # read, not yet yielded
    unassigned: deque[_Job] = deque()  # those of them that no actor works on
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
            actor, given = idle.pop(), unassigned.popleft()
            busy[actor.work.options(max_task_retries=0).remote(given.item)] = (actor, given)
        (done,), _ = ray.wait(list(busy))
        actor, job = busy.pop(done)
        try:
            result = ray.get(done)
        except ray.exceptions.RayTaskError as error:  # raised by the worker
            if job is None:
                raise
            error.cause.__cause__ = error  # it holds the worker's traceback
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
                    f"an item ended {MAX_WORKER_LOSSES} worker processes, the last so: {error}"
                )
                job.result.set_exception(BrokenProcessPool(message))
            # Where one died others may have, e.g. with their machine; they get no item before they have answered.
            busy |= {other.ready.remote(): (other, None) for other in (actor, *idle)}
            idle.clear()
        else:
            if job is not None:
                job.result.set_result(ray.cloudpickle.loads(result))
            idle.append(actor)
