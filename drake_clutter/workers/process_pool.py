"""Ordered map over processes of this machine, which are replaced when they die."""

import os
import pickle
import signal
import threading
import traceback
from collections.abc import Callable, Generator, Iterable
from concurrent.futures.process import BrokenProcessPool
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing import get_context, parent_process
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from typing import Any, TypeVar

from drake_clutter.workers.job_queue import Job, Loss, map_jobs
from drake_clutter.workers.process_environment import (
    SINGLE_THREAD_VARIABLES,
    temporary_environment,
)

Item = TypeVar("Item")
Result = TypeVar("Result")

_STARTED = b""
"""Message of a process that has imported what it needs."""


def map_in_processes(
    make_worker: Callable[[], Callable[[Item], Result]],
    items: Iterable[Item],
    workers: int,
    max_items_per_process: int | None,
) -> Generator[Result, None, None]:
    """Map in several processes; see `drake_clutter.workers.parallel_map.map_ordered`."""
    group = _ProcessGroup(make_worker, workers, max_items_per_process)
    try:
        yield from map_jobs(group, items, workers)
    finally:
        group.close()


@dataclass
class _Worker:
    """A worker process.

    Attributes:
        process: The process.
        connection: Connection to it.
        job: The job that it is processing; None if it is idle.
        has_started: Whether it has imported what it needs.
        num_done: Number of jobs that it has finished.
    """

    process: BaseProcess
    connection: Connection
    job: Job | None = None
    has_started: bool = False
    num_done: int = 0

    def end(self) -> int | None:
        """End the process, at once if it is busy, and return its exit code."""
        if self.job is not None:
            self.process.terminate()
        self.connection.close()
        self.process.join()
        return self.process.exitcode


class _ProcessGroup:
    """Worker processes of this machine; a `WorkerGroup`."""

    def __init__(
        self,
        make_worker: Callable[[], Callable[[Any], Any]],
        max_workers: int,
        max_items_per_process: int | None,
    ) -> None:
        self._make_worker = make_worker
        self._max_workers = max_workers
        self._max_items_per_process = max_items_per_process
        self._workers = list[_Worker]()

    def pickle(self, item: Any) -> bytes:
        """Return a pickled item; see `WorkerGroup`."""
        return pickle.dumps(item)

    def assign(self, job: Job) -> bool:
        """Let an idle or a new process do a job; see `WorkerGroup`."""
        worker = next((worker for worker in self._workers if worker.job is None), None)
        if worker is None:
            if len(self._workers) == self._max_workers:
                return False
            worker = self._start_worker()
            self._workers.append(worker)
        worker.job = job
        with suppress(OSError):  # The process has died, which `wait` notices.
            worker.connection.send_bytes(job.item)
        return True

    def wait(self) -> Loss | None:
        """Receive a message of a process, or notice its death; see `WorkerGroup`."""
        by_connection = {worker.connection: worker for worker in self._workers if worker.job}
        worker = by_connection[wait(list(by_connection))[0]]  # type: ignore[index]
        assert worker.job is not None
        try:
            message = worker.connection.recv_bytes()
        except (EOFError, OSError):
            return self._replace(worker)
        if message == _STARTED:
            worker.has_started = True
            return None
        _set_result(worker.job, message)
        worker.job = None
        worker.num_done += 1
        if worker.num_done == self._max_items_per_process:
            self._workers.remove(worker)
            worker.end()
        return None

    def close(self) -> None:
        """End all processes; busy ones do not finish their jobs."""
        for worker in self._workers:
            worker.end()

    def _replace(self, worker: _Worker) -> Loss:
        """Remove a process that has died, so that another one can be started.

        Raises:
            BrokenProcessPool: The process failed to start.
        """
        assert worker.job is not None
        self._workers.remove(worker)
        worker.process.join()
        worker.connection.close()
        exit_code = worker.process.exitcode or 0
        if exit_code >= 0 and not worker.has_started:
            raise BrokenProcessPool(
                "a worker process ended before it started to work, see its output above; each "
                "worker imports the script, so what a script runs belongs under "
                "`if __name__ == '__main__':`"
            )
        reason = f"with exit code {exit_code}, see its output above"
        if exit_code < 0:
            reason = f"killed by {signal.Signals(-exit_code).name}"
        if exit_code == -signal.SIGKILL:
            reason += f", perhaps for lack of memory; try fewer workers than {self._max_workers}"
        return Loss(worker.job, reason)

    def _start_worker(self) -> _Worker:
        """Start a process."""
        # A forked copy of a process with threads (VTK, PyTorch) can deadlock; spawned ones do not.
        context = get_context("spawn")
        ours, theirs = context.Pipe()
        # A daemon process is terminated if the generator is abandoned at the end of the program.
        process = context.Process(target=_serve, args=(self._make_worker, theirs), daemon=True)
        with temporary_environment(SINGLE_THREAD_VARIABLES):
            process.start()
        theirs.close()
        return _Worker(process, ours)


def _set_result(job: Job, message: bytes) -> None:
    """Set the result of a job from the message of its worker."""
    try:
        result, error = pickle.loads(message)
    except Exception as unpickling_error:  # of any type: the classes of the result raise it
        error = unpickling_error
    if error is None:
        job.result.set_result(result)
    else:
        job.result.set_exception(error)


def _serve(make_worker: Callable[[], Callable[[Any], Any]], connection: Connection) -> None:
    """Process items until the connection is closed; the main function of a worker process."""
    # Ctrl-C reaches every process; the parent process ends the others.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_exit_with_parent, daemon=True).start()
    connection.send_bytes(_STARTED)
    worker: Callable[[Any], Any] | None = None
    with suppress(EOFError):
        while True:
            item = connection.recv_bytes()
            try:
                if worker is None:
                    worker = make_worker()
                message = pickle.dumps((worker(pickle.loads(item)), None))
            except Exception as error:  # of any type: it is raised in the parent process
                message = _pickle_error(error)
            connection.send_bytes(message)


def _pickle_error(error: Exception) -> bytes:
    """Return the message that transfers an error, with its traceback as a note."""
    error.add_note(f"In a worker process:\n{traceback.format_exc()}")
    try:
        return pickle.dumps((None, error))
    except Exception:  # of any type: the classes of the error's arguments raise it
        return pickle.dumps((None, RuntimeError("".join(traceback.format_exception(error)))))


def _exit_with_parent() -> None:
    """End this process with its parent, which cannot end its workers if it is killed."""
    parent = parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)
