"""What a command's process is set to before it loads anything, and how long its workers live.

One thread in BLAS, memory kept.

Products of some thousand rows by three columns take less time than BLAS's threads need to wake;
and those, spinning for more work, hold a core that compiled loops would run on. And glibc gives
every large array back to the system as soon as it is let go: each new one then costs a fault per
page, a sixth of the processor's time at a look at half a million points.
"""

from __future__ import annotations

import contextlib
import ctypes
import gc
import os
import signal
import sys
from collections.abc import Callable, Iterator
from functools import wraps
from types import FrameType
from typing import ParamSpec, TypeVar

INTERRUPTED = 130  # exit code, as of a shell
_NAMES = ("SIGINT", "SIGTERM", "SIGHUP")  # the last of them is none of Windows'
_END_SIGNALS = [getattr(signal, name) for name in _NAMES if hasattr(signal, name)]
_heard: list[list[int]] = []  # what came, within each `signals_end_it` that is open

P = ParamSpec("P")
R = TypeVar("R")

# mallopt(3): what of the heap's top is kept; from what size on memory is mapped by itself, of which
# glibc allows no more; and how many heaps there are: with one for each of the threads that come and
# go a day of prints kept half as much again.
_TRIM_THRESHOLD, _MMAP_THRESHOLD, _ARENA_MAX = -1, -3, -8
_KEPT_BYTES, _MAPPED_BYTES, _ARENAS = 1 << 30, 32 << 20, 1


def prepare() -> None:
    """Set it; what the environment says comes first, and other C libraries are left as they are."""
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # read when numpy is loaded
    if any(name.startswith("MALLOC_") for name in os.environ):
        return
    try:
        mallopt = ctypes.CDLL("libc.so.6").mallopt
    except (AttributeError, OSError):
        return
    mallopt(_TRIM_THRESHOLD, _KEPT_BYTES)
    mallopt(_MMAP_THRESHOLD, _MAPPED_BYTES)
    mallopt(_ARENA_MAX, _ARENAS)


@contextlib.contextmanager
def signals_end_it() -> Iterator[None]:
    """Let Ctrl+C, SIGTERM and SIGHUP end what is under way as one interrupt, by its safe exits.

    One that is ignored (`nohup`), or that somebody else listens to, stays so.
    """
    usual = (signal.SIG_DFL, signal.default_int_handler)
    before = {number: signal.getsignal(number) for number in _END_SIGNALS}
    taken = {number: was for number, was in before.items() if was in usual}
    for number in taken:
        signal.signal(number, _end)
    _heard.append([])
    try:
        yield
    finally:
        _heard.pop()
        for number, was in taken.items():
            signal.signal(number, was)


def interrupted() -> bool:
    """Whether one of them has come: what it comes to is not always told as an interrupt."""
    return any(_heard[-1:])


def usual_signals() -> None:
    """In a forked worker: the parent alone hears of Ctrl+C; what ends a worker does so at once."""
    for number in _END_SIGNALS:
        if signal.getsignal(number) is _end:
            signal.signal(number, signal.SIG_DFL)
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def _end(number: int, _frame: FrameType | None) -> None:
    for heard in _heard[-1:]:
        heard.append(number)
    raise KeyboardInterrupt


@contextlib.contextmanager
def interrupt_told(name: str) -> Iterator[None]:
    """Within it, while libraries load, an interrupt is one sentence and its exit code."""
    try:
        with signals_end_it():
            yield
    except KeyboardInterrupt:
        sys.stderr.write(f"{name}: interrupted\n")
        sys.exit(INTERRUPTED)


_THREAD_COUNTS = (
    "MKL_NUM_THREADS",
    "NUMBA_NUM_THREADS",
    "OMP_NUM_THREADS",
    "OPENBLAS_NUM_THREADS",
)


def one_thread() -> dict[str, str]:
    """What the environment of a process says whose libraries are to use one thread each.

    Read when they are loaded: it is set before. Where as many processes work as there are cores,
    further threads only wait for each other; and sums of several threads differ in their last
    digits from those of one.
    """
    return dict.fromkeys(_THREAD_COUNTS, "1")


def gives_back(long_task: Callable[P, R]) -> Callable[P, R]:
    """Of a long task: what memory is kept is given back to the system at its end.

    What a day's tasks need differs, and what one leaves between two others stays unused: without
    this a process that runs them one after another holds three times what it uses.
    """

    @wraps(long_task)
    def task(*args: P.args, **named: P.kwargs) -> R:
        try:
            return long_task(*args, **named)
        finally:
            with contextlib.suppress(AttributeError, OSError):
                ctypes.CDLL("libc.so.6").malloc_trim(0)

    return task


@contextlib.contextmanager
def collector_held() -> Iterator[None]:
    """Hold Python's collector of circles in a short task, which makes many objects and few circles.

    Libraries that load make half a million objects that stay: to walk over all of them time and
    again took 0.15 s of a command's three.
    """
    was_on = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_on:
            gc.enable()


def peak_mb() -> float | None:
    """The most memory that this process has held so far, MB; None where the system tells nobody.

    Linux counts in kB, macOS in bytes (getrusage(2) of each).
    """
    try:
        import resource
    except ImportError:  # Windows
        return None
    most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return most / (1024.0**2 if sys.platform == "darwin" else 1024.0)


def end_with_parent() -> None:
    """In a worker of `multiprocessing`: end at once where the process that began it ends.

    A parent that was killed tells its workers nothing: they would finish what they do, wait for
    more for ever, and write into what the next run has begun.
    """
    import multiprocessing
    import threading

    parent = multiprocessing.parent_process()
    if parent is None:
        return

    def wait() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=wait, daemon=True).start()
