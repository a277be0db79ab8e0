"""Workers that fail, for the tests of parallel maps; importing them is quick."""

from collections.abc import Callable
from functools import partial


def fail_at(bad: int, item: int) -> int:
    if item == bad:
        raise LookupError(f"item {item}")
    return item


def make_failing_worker(bad: int) -> Callable[[int], int]:
    return partial(fail_at, bad)


def broken_factory() -> Callable[[int], int]:
    raise LookupError("no worker")
