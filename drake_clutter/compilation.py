"""Numba's compiler `njit`, with a cache that can be written.

numba keeps compiled functions beside their source or in the user's cache folder. Where neither can
be written, such as in a read-only container without a home folder, `njit(cache=True)` raises an
error. This module then sets NUMBA_CACHE_DIR, also for worker processes.
"""

import os

import numba
import numpy as np
from numba import njit
from numpy.typing import NDArray

from drake_clutter.files import private_temporary_folder

__all__ = ["cache_folder", "njit", "zero_records"]

IS_COMPILING = not numba.config.DISABLE_JIT  # type: ignore[attr-defined]
"""Whether `njit` compiles; false if NUMBA_DISABLE_JIT is set."""


def _compiled_for_its_cache() -> None:
    """Do nothing; numba looks for a cache folder when this function is decorated."""


def cache_folder() -> str | None:
    """Return the folder in which numba keeps the compiled functions of this module.

    Returns:
        The folder; None if numba finds no folder that can be written, or does not compile.
    """
    if not IS_COMPILING:
        return None
    try:
        return str(njit(cache=True)(_compiled_for_its_cache).stats.cache_path)
    except RuntimeError:
        return None


def zero_records(count: int, dtype: np.dtype[np.void]) -> NDArray[np.void]:
    """Return records whose fields `njit` functions read as attributes. Shape (count,).

    Functions that are not compiled need a record array. Compiled functions take both, but are
    called faster with a plain array.
    """
    records = np.zeros(count, dtype)
    return records if IS_COMPILING else records.view(np.recarray)


if IS_COMPILING and cache_folder() is None:
    os.environ["NUMBA_CACHE_DIR"] = str(private_temporary_folder("numba"))
    numba.config.reload_config()  # type: ignore[no-untyped-call]
