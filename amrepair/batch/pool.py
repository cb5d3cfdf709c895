"""A pool of spawned processes in which a worker may die: its task is done again by another.

`concurrent.futures` gives up all tasks under way when one worker dies, and does not tell which of
them killed it. Here every worker has a pipe of its own and one task at a time.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import os
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from typing import Any

from amrepair.batch.options import MOST_ATTEMPTS, Task, TaskOutcome, Work, given_up
from amrepair.errors import AmrepairError
from gcode.process import end_with_parent, one_thread

# Workers that die before they are ready, one after another: it is no scan's fault.
MOST_STILLBORN = 3
GRACE_S = 5.0


@dataclass(slots=True)
class _Worker:
    """A process, what it is doing, and whether it has ever been ready."""

    process: BaseProcess
    pipe: Connection
    task: Task | None = None
    ready: bool = False


class Pool:
    """As many processes as there are cores, or as asked.

    Parameters
    ----------
    workers
        At least 1.
    """

    def __init__(self, work: Work, *, workers: int) -> None:
        self._work = work
        self._count = workers
        self._workers: list[_Worker] = []
        self._stillborn = 0

    @property
    def processes(self) -> tuple[int, ...]:
        """Numbers of the workers' processes."""
        return tuple(one.process.pid or 0 for one in self._workers)

    def outcomes(self, tasks: Iterator[Task]) -> Iterator[TaskOutcome]:
        """Hand out one task a worker; the next is made ready while all are busy."""
        attempts: dict[str, int] = {}
        queue: deque[Task] = deque()
        more = True
        while True:
            while more and len(queue) < self._count:
                task = next(tasks, None)
                more = task is not None
                if task is not None:
                    queue.append(task)
            self._hire(len(queue))
            self._hand_out(queue)
            if not queue and not any(one.task for one in self._workers):
                if not more:
                    return
                continue
            yield from self._heard(queue, attempts)

    def close(self) -> None:
        """End the workers: politely where they wait, by force where they work."""
        for one in self._workers:
            with contextlib.suppress(OSError):
                one.pipe.send(None)
            if one.task is not None or not one.ready:
                one.process.kill()
        for one in self._workers:
            one.process.join(GRACE_S)
            if one.process.is_alive():
                one.process.kill()
                one.process.join()
            one.pipe.close()
        self._workers = []

    def _hire(self, waiting: int) -> None:
        busy = sum(one.task is not None for one in self._workers)
        while len(self._workers) < min(self._count, busy + waiting):
            here, there = multiprocessing.Pipe()
            process = spawned(_serve, there, self._work)
            there.close()
            self._workers.append(_Worker(process, here))

    def _hand_out(self, queue: deque[Task]) -> None:
        for one in self._workers:
            if queue and one.ready and one.task is None:
                one.task = queue.popleft()
                with contextlib.suppress(OSError):  # it is dead: heard of below
                    one.pipe.send(one.task)

    def _heard(self, queue: deque[Task], attempts: dict[str, int]) -> Iterator[TaskOutcome]:
        """Wait for a word, or for a worker's end."""
        for pipe in wait([one.pipe for one in self._workers]):
            one = next(worker for worker in self._workers if worker.pipe is pipe)
            try:
                said = one.pipe.recv()
            except (EOFError, OSError):
                yield from self._buried(one, queue, attempts)
                continue
            if one.ready:
                one.task = None
                yield said
            one.ready, self._stillborn = True, 0

    def _buried(
        self, one: _Worker, queue: deque[Task], attempts: dict[str, int]
    ) -> Iterator[TaskOutcome]:
        """A worker is gone; what it was doing is done next, or given up."""
        one.process.join(GRACE_S)
        self._workers.remove(one)
        one.pipe.close()
        if not one.ready:
            self._stillborn += 1
            if self._stillborn >= MOST_STILLBORN:
                raise AmrepairError(
                    f"{MOST_STILLBORN} workers died one after another before they could begin "
                    f"(the last with code {one.process.exitcode}); try --executor serial, which "
                    "says why"
                )
        if one.task is None:
            return
        attempts[one.task.scan_id] = attempts.get(one.task.scan_id, 0) + 1
        if attempts[one.task.scan_id] >= MOST_ATTEMPTS:
            yield given_up(one.task, MOST_ATTEMPTS)
        else:
            queue.appendleft(one.task)


def spawned(life: Callable[..., object], *about: Any) -> BaseProcess:
    """A started process with one thread a library, which ends with this one at the latest."""
    context = multiprocessing.get_context("spawn")  # open3d's threads survive no fork
    process = context.Process(target=life, args=about, daemon=True)
    with _with_one_thread():
        process.start()
    return process


@contextmanager
def _with_one_thread() -> Iterator[None]:
    """An environment that spawned processes inherit before they load anything."""
    before = dict(os.environ)
    os.environ.update(one_thread())
    try:
        yield
    finally:
        for name in one_thread():
            if name in before:
                os.environ[name] = before[name]
            else:
                del os.environ[name]


def _serve(pipe: Connection, work: Work) -> None:
    """A worker's life: a task, an outcome, until nothing more comes."""
    end_with_parent()
    from amrepair.batch.work import Bench

    bench = Bench(work)
    with contextlib.suppress(KeyboardInterrupt, BrokenPipeError, EOFError):
        pipe.send("ready")
        while (task := pipe.recv()) is not None:
            pipe.send(bench.do(task))
