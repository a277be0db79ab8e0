"""Measurement of wall-clock times, and description of the machine."""

import platform
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from importlib.metadata import version
from pathlib import Path
from typing import Any, TypeVar

Result = TypeVar("Result")


class Stopwatch:
    """Measures the wall-clock times of calls.

    Attributes:
        seconds: Times of all calls by name [s].
    """

    def __init__(self) -> None:
        """Create a stopwatch without measurements."""
        self.seconds = defaultdict[str, list[float]](list)

    def measure(self, name: str, call: Callable[[], Result], num_items: int = 1) -> Result:
        """Call a function and return its result.

        Args:
            name: Name of the measurement.
            call: The function.
            num_items: Number of items by which the time is divided.
        """
        start = time.perf_counter()
        try:
            return call()
        finally:
            self.seconds[name].append((time.perf_counter() - start) / num_items)

    def total(self, name: str) -> float:
        """Return the sum of the times of a name [s]."""
        return sum(self.seconds[name])

    @contextmanager
    def watch(self, functions: Mapping[str, tuple[Any, Callable[..., Any]]]) -> Iterator[None]:
        """Measure all calls of some functions while the context is open.

        Args:
            functions: Owner (class or module) and function, by the name of the measurement. The
                attribute of the owner is replaced while the context is open.
        """
        for name, (owner, function) in functions.items():
            setattr(owner, function.__name__, self._wrap(name, function))
        try:
            yield
        finally:
            for owner, function in functions.values():
                setattr(owner, function.__name__, function)

    def _wrap(self, name: str, function: Callable[..., Any]) -> Callable[..., Any]:
        def call(*args: Any, **options: Any) -> Any:
            return self.measure(name, lambda: function(*args, **options))

        return call


def describe_machine(*packages: str) -> dict[str, Any]:
    """Return the processor, the system, and the versions of Python and some packages."""
    cpu_info = Path("/proc/cpuinfo")
    lines = cpu_info.read_text().splitlines() if cpu_info.exists() else []
    names = [line.partition(": ")[2] for line in lines if line.startswith("model name")]
    return {
        "cpu": names[0] if names else platform.processor(),
        "system": platform.platform(),
        "python": platform.python_version(),
        **{package: version(package) for package in packages},
    }
