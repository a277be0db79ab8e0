"""Distribution of items among worker processes that may die, with results in the items' order."""

import textwrap
from collections import deque
from collections.abc import Generator, Iterable
from concurrent.futures import Future
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, field
from itertools import islice
from typing import Any, Protocol

from drake_clutter.workers.process_environment import IN_FLIGHT_PER_WORKER

MAX_WORKER_LOSSES = 3
"""Number of worker processes that an item may lose before it fails."""


@dataclass
class Job:
    """A pickled item and its processing.

    Attributes:
        name: The item, for messages.
        item: Pickled item.
        result: Result of the item.
        losses: Number of workers that died with the item.
    """

    name: str
    item: bytes
    result: Future[Any] = field(default_factory=Future)
    losses: int = 0


@dataclass(frozen=True)
class Loss:
    """Death of a worker.

    Attributes:
        job: The job that the worker was processing.
        reason: How the worker ended, for messages.
    """

    job: Job
    reason: str


class WorkerGroup(Protocol):
    """Workers that process one job at a time each, and are replaced when they die."""

    def pickle(self, item: Any) -> bytes:
        """Return a pickled item."""

    def assign(self, job: Job) -> bool:
        """Let a worker process a job; return False if none is idle."""

    def wait(self) -> Loss | None:
        """Wait until the state of a worker changes; set the result of its job, or return it."""


def map_jobs(group: WorkerGroup, items: Iterable[Any], workers: int) -> Generator[Any, None, None]:
    """Yield the results of all items in their order.

    An item whose worker dies is given to another worker. If it loses `MAX_WORKER_LOSSES` workers,
    a BrokenProcessPool is raised in its place.

    Args:
        group: The workers.
        items: The items.
        workers: Number of workers.
    """
    remaining = iter(items)
    pending: deque[Job] = deque()  # Jobs whose results are not yielded yet.
    unassigned: deque[Job] = deque()  # Pending jobs that no worker is processing.
    while True:
        for item in islice(remaining, workers * IN_FLIGHT_PER_WORKER - len(pending)):
            name = textwrap.shorten(str(item), 150, placeholder=" ...")
            pending.append(Job(name, group.pickle(item)))
            unassigned.append(pending[-1])
        if not pending:
            return
        if pending[0].result.done():
            yield pending.popleft().result.result()
            continue
        while unassigned and group.assign(unassigned[0]):
            unassigned.popleft()
        if (loss := group.wait()) is None:
            continue
        job = loss.job
        job.losses += 1
        if job.losses < MAX_WORKER_LOSSES:
            unassigned.appendleft(job)
        else:
            job.result.set_exception(
                BrokenProcessPool(
                    f"item {job.name}: {MAX_WORKER_LOSSES} worker processes ended while they "
                    f"processed it, the last one {loss.reason}"
                )
            )
