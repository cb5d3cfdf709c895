"""Kernels compiled to machine code once and kept on disk, so that what is loaded is what was meant.

numba numbers the files it keeps by how many there are: two processes that compile one kernel for
two kinds of arrays at the same moment take the same number, and either then loads what the other
compiled, with wrong results and no error. Here every process names its files itself. And a kernel
is compiled again when any of the kernels has changed: it may have another one's code in its own.

A kernel that may add up in any order (`fastmath`) and is called by another is inlined there
(`inline="always"`). Else the process that compiles both uses the code that stands alone, and a
process that loads the caller from disk the caller's copy, which adds up in another order: the same
scan, judged twice, differed in its fourteenth digit.

Threads are OpenMP's, and sleep while they wait. Where numba finds a TBB it takes that first, whose
threads spin: beside one other busy process an alignment took six times as long, and a process that
was done did not end for minutes.
"""

from __future__ import annotations

import functools
import os
import secrets
from collections.abc import Callable
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_WAIT_POLICY", "passive")  # read when the first of its threads starts

import numba
from numba import get_num_threads, prange, set_num_threads

__all__ = ["get_num_threads", "njit", "prange", "set_num_threads"]

_PACKAGES = ("gcode", "amrepair")
_TOKEN = secrets.token_hex(4)

if "NUMBA_THREADING_LAYER_PRIORITY" not in os.environ:
    numba.config.THREADING_LAYER_PRIORITY = ["omp", "tbb", "workqueue"]  # type: ignore[attr-defined]


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
    # A forked process has its parent's token, but a process number of its own.
    kept._data_name = lambda number: f"{base}.{os.getpid():x}-{_TOKEN}.{number}.nbc"
    kept._source_stamp = (*kept._source_stamp, kernels_stamp())


def kernels_stamp() -> tuple[tuple[str, int, int], ...]:
    """Name, time of change and size of every file with kernels."""
    return sources_stamp("_kernels.py")


@functools.cache
def sources_stamp(ending: str) -> tuple[tuple[str, int, int], ...]:
    """Name, time of change and size of every file of both packages that ends so."""
    root = Path(__file__).parents[1]
    found = []
    for package in _PACKAGES:
        for folder, _, names in os.walk(root / package):
            for name in names:
                if name.endswith(ending):
                    stat = Path(folder, name).stat()
                    found.append((name, stat.st_mtime_ns, stat.st_size))
    return tuple(sorted(found))
