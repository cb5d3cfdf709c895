"""Equal work shared out over forked processes, its results in order.

A forked process shares what its parent holds, and begins in milliseconds. It is for commands: a
thread of the parent's that holds a lock when it forks would leave it held in the child for ever.
"""

from __future__ import annotations

import gc
import os
import sys
from collections import deque
from collections.abc import Callable, Iterator
from typing import Any, TypeVar

from gcode.errors import WorkerError
from gcode.process import end_with_parent, usual_signals

R = TypeVar("R")
PIECES = 12  # a worker: few enough that each is worth its way, enough that none waits long for one
_asked: Callable[[int], Any] | None = None  # in a worker


def cores() -> int:
    """How many this process may use."""
    allowed = getattr(os, "sched_getaffinity", None)  # Linux's alone
    return len(allowed(0)) if allowed is not None else os.cpu_count() or 1


def forks() -> int:
    """How many processes may share work by forking; 1 where that is not safe."""
    return cores() if sys.platform == "linux" else 1


def nothing() -> None:
    """What there is to do meanwhile, where nobody says what."""


def in_order(
    ask: Callable[[int], R],
    count: int,
    *,
    workers: int,
    meanwhile: Callable[[], object] = nothing,
) -> Iterator[R]:
    """`ask(0)` to `ask(count - 1)`, worked out by so many processes at once.

    The first is worked out here: what is loaded for it is then there for all of them. What is to be
    done `meanwhile` this process does once the others are at work; not at all where it is alone.

    Raises
    ------
    WorkerError
        Where a worker ended before its work did, as when memory was short.
    """
    if workers < 2 or count < 2 * workers:
        yield from map(ask, range(count))
        return
    yield ask(0)
    # as long as half of what is shared out may be
    import multiprocessing
    from concurrent.futures import ProcessPoolExecutor
    from concurrent.futures.process import BrokenProcessPool

    size, told = max(1, -(-count // (workers * PIECES))), [ask]
    gc.freeze()  # what is there already is not looked through, and so not copied, by the children
    pool = ProcessPoolExecutor(
        workers, multiprocessing.get_context("fork"), initializer=_begin, initargs=(told,)
    )
    try:
        pieces = deque(
            pool.submit(_piece, start, min(start + size, count)) for start in range(1, count, size)
        )
        gc.unfreeze()
        meanwhile()
        while pieces:
            yield from pieces.popleft().result()
    except BrokenProcessPool as error:
        raise WorkerError(
            f"One of {workers} processes ended before its work was done, as when memory is short; "
            "use fewer workers."
        ) from error
    finally:
        pool.shutdown(cancel_futures=True)
        told.clear()  # a pool may outlive its use, and with it all that was asked about


def _begin(told: list[Callable[[int], Any]]) -> None:
    """In a worker: what it will be asked."""
    global _asked  # noqa: PLW0603 - one process, one task
    _asked = told[0]
    usual_signals()
    end_with_parent()


def _piece(start: int, end: int) -> list[Any]:
    if _asked is None:
        raise RuntimeError("a worker was asked before it was told what")
    return [_asked(k) for k in range(start, end)]
