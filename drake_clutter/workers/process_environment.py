"""Settings of all worker processes: number of items in flight and environment variables."""

import os
from collections.abc import Iterator
from contextlib import contextmanager

IN_FLIGHT_PER_WORKER = 4
"""Number of items that are sent to each worker before the first result is read."""
SINGLE_THREAD_VARIABLES = {
    "OMP_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
    "LP_NUM_THREADS": "0",
}
"""Environment variables of a worker process.

More threads than cores slow each other down, and the rounding of a sum depends on the number of
threads. LP_NUM_THREADS turns off the threads of Mesa's software renderer (llvmpipe), which caused
deadlocks.
"""


@contextmanager
def temporary_environment(variables: dict[str, str]) -> Iterator[None]:
    """Set environment variables for the duration of the block."""
    previous = {name: os.environ.get(name) for name in variables}
    os.environ.update(variables)
    try:
        yield
    finally:
        for name, value in previous.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value
