"""Setups of a feasibility study: named work cells, from files and from sweeps of their fields."""

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from drake_clutter.cell.work_cell import WorkCell
from drake_clutter.feasibility.home_search import Home, HomeSearch
from drake_clutter.files import InputError, input_error
from drake_clutter.validation import load_config_as

MAX_SETUPS = 2000
"""Largest number of setups in a study."""


@dataclass(frozen=True)
class Sweep:
    """Values of a field of the work cell.

    Attributes:
        field: Name of the field, such as `robot.base.z`.
        values: Its values.
    """

    field: str
    values: tuple[float, ...]


@dataclass(frozen=True)
class SetupRequest:
    """A work cell to study.

    Attributes:
        cell: The work cell.
        keep_home: Whether its home is kept where it is clear; it is searched for otherwise.
    """

    cell: WorkCell
    keep_home: bool = True


@dataclass(frozen=True)
class Setup:
    """A work cell that can be studied.

    Attributes:
        name: Name of the setup.
        cell: The work cell, with the home of the study.
        home: The home.
    """

    name: str
    cell: WorkCell
    home: Home


@dataclass(frozen=True)
class UnusableSetup:
    """A work cell that cannot be studied.

    Attributes:
        name: Name of the setup.
        reason: Why.
    """

    name: str
    reason: str


def parse_sweep(option: str, text: str) -> Sweep:
    """Return the sweep of `FIELD=FIRST:LAST:STEP` or `FIELD=VALUE,VALUE,...`.

    Args:
        option: Option that the text was given to.
        text: The text.

    Raises:
        InputError: The text has another form, or too many values.
    """
    field, _, values = text.partition("=")
    try:
        if not field:
            raise ValueError
        if ":" not in values:
            return _checked_sweep(option, text, Sweep(field, tuple(map(float, values.split(",")))))
        first, last, step = map(float, values.split(":"))
        count = (last - first) / step
    except (ValueError, ZeroDivisionError):
        raise _sweep_error(option, text) from None
    if not 0 <= count < math.inf:
        raise _sweep_error(option, text)
    if count >= MAX_SETUPS:
        raise input_error(
            f"{option} {text}", f"{count + 1:.0f} values; expected at most {MAX_SETUPS}"
        )
    # The last value is reached where rounding puts it just beyond.
    steps = np.arange(math.floor(count + 1e-9) + 1)
    return _checked_sweep(
        option, text, Sweep(field, tuple((first + step * steps).round(9).tolist()))
    )


def _checked_sweep(option: str, text: str, sweep: Sweep) -> Sweep:
    if not all(map(math.isfinite, sweep.values)) or len({*sweep.values}) < len(sweep.values):
        raise _sweep_error(option, text)
    return sweep


def _sweep_error(option: str, text: str) -> InputError:
    allowed = "FIELD=FIRST:LAST:STEP, or FIELD=VALUE,VALUE,... with different values"
    return input_error(f"{option} {text}", f"expected {allowed}")


def sweep_setups(
    requests: Mapping[str, SetupRequest], sweeps: Sequence[Sweep]
) -> dict[str, SetupRequest]:
    """Return every combination of work cells and values of their fields, by name.

    Args:
        requests: Work cells by name.
        sweeps: Fields and their values; without any, the work cells are returned.

    Raises:
        InputError: A field or a value is not allowed, or there are too many combinations.
    """
    if not sweeps:
        return dict(requests)
    count = len(requests) * math.prod(len(sweep.values) for sweep in sweeps)
    if count > MAX_SETUPS:
        raise input_error("--sweep", f"{count} setups; expected at most {MAX_SETUPS}")
    swept = {}
    for name, request in requests.items():
        for values in itertools.product(*(sweep.values for sweep in sweeps)):
            settings = [f"{s.field}={v:g}" for s, v in zip(sweeps, values, strict=True)]
            try:
                cell = load_config_as(request.cell, settings=settings)
            except InputError as error:
                raise InputError(str(error).replace("--set", "--sweep", 1)) from error
            prefix = [name] if len(requests) > 1 else []
            swept[", ".join([*prefix, *settings])] = SetupRequest(cell, keep_home=False)
    return swept


def prepare_setup(name: str, request: SetupRequest) -> Setup | UnusableSetup:
    """Return a setup with its home, or the reason why it cannot be studied.

    Args:
        name: Name of the setup.
        request: The work cell.
    """
    cell = request.cell
    if cell.pedestal_overlaps_support:
        return UnusableSetup(name, "the base stands in the support")
    try:
        search = HomeSearch(cell)
    except InputError as error:
        return UnusableSetup(name, str(error))
    home = search.find_home(keep=request.keep_home)
    if isinstance(home, str):
        return UnusableSetup(name, home)
    robot = cell.robot.model_copy(update={"home": home.q})
    return Setup(name, cell.model_copy(update={"robot": robot}), home)
