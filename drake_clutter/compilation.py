"""Numba's compiler `njit`, with a cache that can be written.

numba keeps compiled functions beside their source or in the user's cache folder. Where neither can
be written, such as in a read-only container without a home folder, `njit(cache=True)` raises an
error. This module then sets NUMBA_CACHE_DIR, also for worker processes.
"""

import os

import numba
from numba import njit

from drake_clutter.files import private_temporary_folder

__all__ = ["cache_folder", "njit"]


def _compiled_for_its_cache() -> None:
    """Do nothing; numba looks for a cache folder when this function is decorated."""


def cache_folder() -> str | None:
    """Return the folder in which numba keeps the compiled functions of this module.

    Returns:
        The folder; None if numba finds no folder that can be written.
    """
    try:
        return str(njit(cache=True)(_compiled_for_its_cache).stats.cache_path)
    except RuntimeError:
        return None


if cache_folder() is None:
    os.environ["NUMBA_CACHE_DIR"] = str(private_temporary_folder("numba"))
    numba.config.reload_config()  # type: ignore[no-untyped-call]
