"""Suppression of Drake's log messages."""

import logging
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def suppress_drake_log(level: int) -> Iterator[None]:
    """Suppress Drake's log messages below a level of `logging` in this context."""
    logger = logging.getLogger("drake")
    previous_level = logger.level
    logger.setLevel(level)
    try:
        yield
    finally:
        logger.setLevel(previous_level)
