"""Kernels compiled to machine code once and kept on disk, so that what is loaded is what was meant.

numba numbers the files it keeps by how many there are: two processes that compile one kernel for
two kinds of arrays at the same moment take the same number, and either then loads what the other
compiled, with wrong results and no error. Here every process names its files itself. And a kernel
is compiled again when any of the kernels has changed: it may have another one's code in its own.
"""

from __future__ import annotations

import functools
import os
import secrets
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numba
from numba import get_num_threads, prange

__all__ = ["get_num_threads", "njit", "prange"]

_PACKAGES = ("gcode", "amrepair")
_TOKEN = secrets.token_hex(4)


def njit(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """`numba.njit`, kept safely where it is kept (`cache=True`)."""

    def compiled(function: Callable[..., Any]) -> Any:
        dispatcher = numba.njit(**options)(function)
        kept = getattr(dispatcher._cache, "_cache_file", None)
        if kept is not None:
            keep_safely(kept)
        return dispatcher

    return compiled


def keep_safely(kept: Any) -> None:
    """Names of its own, and the state of all kernels, for one of numba's caches on disk.

    Parameters
    ----------
    kept
        A `numba.core.caching.IndexDataCacheFile` that has not loaded anything yet.
    """
    base = kept._data_name(0).removesuffix(".0.nbc")
    # a forked process has the token of its parent, but not its number
    kept._data_name = lambda number: f"{base}.{os.getpid():x}-{_TOKEN}.{number}.nbc"
    kept._source_stamp = (*kept._source_stamp, kernels_stamp())


@functools.cache
def kernels_stamp() -> tuple[tuple[str, int, int], ...]:
    """Name, time of change and size of every file with kernels."""
    root = Path(__file__).parents[1]
    found = []
    for package in _PACKAGES:
        for folder, _, names in os.walk(root / package):
            for name in names:
                if name.endswith("_kernels.py"):
                    stat = Path(folder, name).stat()
                    found.append((name, stat.st_mtime_ns, stat.st_size))
    return tuple(sorted(found))
