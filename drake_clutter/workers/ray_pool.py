"""Ordered map over the machines of a Ray cluster; needs the optional dependency `scale`."""

import logging
import os
from collections.abc import Callable, Generator, Iterable, Iterator
from contextlib import contextmanager, suppress
from typing import Any, TypeVar

from drake_clutter.files import InputError
from drake_clutter.workers.job_queue import Job, Loss, map_jobs
from drake_clutter.workers.process_environment import (
    SINGLE_THREAD_VARIABLES,
    temporary_environment,
)

Item = TypeVar("Item")
Result = TypeVar("Result")

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
            yield from map_jobs(_ActorGroup(ray, actors), items, workers)
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


class _ActorGroup:
    """Actors of a Ray cluster, which Ray restarts when they die; a `WorkerGroup`.

    Ray's own retries are not used. They bind an item to its actor, which never continues if its
    machine is gone and the others have no room, and they are used up while an actor restarts. Here
    an item that was lost with its actor goes to the next actor that is ready.
    """

    def __init__(self, ray: Any, actors: list[Any]) -> None:
        """Wait for actors to become ready.

        Args:
            ray: The module.
            actors: The actors.
        """
        self._ray = ray
        self._idle = list[Any]()
        self._busy: dict[Any, tuple[Any, Job | None]] = {}
        self._await_readiness(actors)

    def _await_readiness(self, actors: Iterable[Any]) -> None:
        """Let actors get no item before they have responded."""
        self._busy |= {actor.ready.remote(): (actor, None) for actor in actors}

    def pickle(self, item: Any) -> bytes:
        """Return a pickled item; see `WorkerGroup`."""
        pickled: bytes = self._ray.cloudpickle.dumps(item)
        return pickled

    def assign(self, job: Job) -> bool:
        """Let an idle actor do a job; see `WorkerGroup`."""
        if not self._idle:
            return False
        actor = self._idle.pop()
        self._busy[actor.work.options(max_task_retries=0).remote(job.item)] = (actor, job)
        return True

    def wait(self) -> Loss | None:
        """Receive the result of an actor, or notice its death; see `WorkerGroup`."""
        (done,), _ = self._ray.wait(list(self._busy))
        actor, job = self._busy.pop(done)
        try:
            result = self._ray.get(done)
        except self._ray.exceptions.RayTaskError as error:  # The worker raised an exception.
            if job is None:
                raise
            error.cause.__cause__ = error  # It contains the worker's traceback.
            job.result.set_exception(error.cause)
        except self._ray.exceptions.RayError as error:
            if job is None:
                raise
            # Other actors may have died, too, for example with their machine.
            self._await_readiness([actor, *self._idle])
            self._idle.clear()
            return Loss(job, f"with the error: {error}")
        else:
            if job is not None:
                job.result.set_result(self._ray.cloudpickle.loads(result))
        self._idle.append(actor)
        return None
