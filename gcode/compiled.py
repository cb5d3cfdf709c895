"""Kernels compiled to machine code once and kept on disk, so that what is loaded is what was meant.

numba numbers the files it keeps by how many there are: two processes that compile one kernel for
two kinds of arrays at the same moment take the same number, and either then loads what the other
compiled, with wrong results and no error. Here every process names its files itself. And a kernel
is compiled again when any of the kernels has changed: it may have another one's code in its own.

Threads are OpenMP's, and sleep while they wait. Where numba finds a TBB it takes that first, whose
threads spin: beside one other busy process an alignment took six times as long, and a process that
was done did not end for minutes.
"""

from __future__ import annotations

import functools
import os
import secrets
import sys
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


def _load_without_scipy() -> None:
    """Load what numba loads with its first kernel, without SciPy's linear algebra.

    It looks whether there is a BLAS for inner products of vectors that its own helpers make, which
    no kernel here has; to look takes as long as to load all kernels of a slice, and 25 MB. A kernel
    that solves equations makes it look again when it is compiled or called.
    """
    if "scipy.linalg" in sys.modules:
        return
    # "there is none", to `import`
    sys.modules["scipy.linalg"] = None  # type: ignore[assignment]
    try:
        pass
    finally:
        del sys.modules["scipy.linalg"]


_load_without_scipy()


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
