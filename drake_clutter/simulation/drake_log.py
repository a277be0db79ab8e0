"""Keeping Drake's log from telling users what is none of their business."""

import logging
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def suppress_drake_log(level: int) -> Iterator[None]:
    """Within it Drake logs nothing that is less than a level of `logging`."""
    logger = logging.getLogger("drake")
    previous_level = logger.level
    logger.setLevel(level)
    try:
        yield
    finally:
        logger.setLevel(previous_level)
