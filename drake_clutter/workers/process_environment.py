"""What every kind of worker process shares: how much is in flight, and its environment variables."""

import os
from collections.abc import Iterator
from contextlib import contextmanager

IN_FLIGHT_PER_WORKER = 4
"""Items that are sent to each worker before the first of their results is read."""
SINGLE_THREAD_VARIABLES = {
    "OMP_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
    "LP_NUM_THREADS": "0",
}
"""Environment variables of a worker process.

More threads than cores slow each other down, and the rounding of a sum depends on the number of threads. Mesa's software
renderer (LP: llvmpipe) was twice seen waiting for one of its own threads for ever.
"""


@contextmanager
def temporary_environment(variables: dict[str, str]) -> Iterator[None]:
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
