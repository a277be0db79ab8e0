"""Workers of the tests on a Ray cluster.

Every actor imports this module when it starts: it imports little, so that actors start quickly.
"""

import os
import signal
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np
import ray
from numpy.typing import NDArray

from drake_clutter.seeding import item_rng

ItemNumbers = tuple[int, NDArray[np.float64]]
Found = TypeVar("Found")


@dataclass(frozen=True)
class RandomNumbers:
    """Return so many random numbers that Ray transfers them in shared memory.

    Attributes:
        started: Folder that gets a file for every item that was started.
        deadly: Items that kill their process at the first attempt.
        deadliest: Item that kills its process at every attempt.
        trap: Node on which an item takes a minute; then the folder contains the file "sprung". The
            other node waits for that.
    """

    started: Path
    deadly: tuple[int, ...] = ()
    deadliest: int | None = None
    trap: str | None = None

    def __call__(self, item: int) -> ItemNumbers:
        is_first_attempt = not (self.started / f"{item}").exists()
        (self.started / f"{item}").touch()
        time.sleep(0.1 if item % 4 == 0 else 0.0)
        if (item in self.deadly and is_first_attempt) or item == self.deadliest:
            os.kill(os.getpid(), signal.SIGKILL)
        if self.trap is not None:
            sprung = self.started / "sprung"
            if ray.get_runtime_context().get_node_id() == self.trap:
                sprung.touch()
                time.sleep(60.0)
            wait_for(sprung.exists)
        return item, item_rng(7, item).normal(size=20_000)


def read_environment(file: str) -> tuple[int, str, str | None]:
    return os.getpid(), Path(file).read_text(), os.environ.get("OPENBLAS_NUM_THREADS")


def make_environment_reader() -> Callable[[str], tuple[int, str, str | None]]:
    return read_environment


def sleep(seconds: float) -> int:
    time.sleep(seconds)
    return os.getpid()


def make_sleeper() -> Callable[[float], int]:
    return sleep


def wait_for(condition: Callable[[], Found]) -> Found:
    deadline = time.monotonic() + 240  # Starting a worker may take a minute.
    while not (found := condition()):
        assert time.monotonic() < deadline
        time.sleep(0.02)
    return found
