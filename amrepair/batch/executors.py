"""The port of an executor, and the one that works in this process.

An executor takes tasks one by one, never many more than it has workers, and yields outcomes in
whatever order they come. It knows nothing of results on disks: the supervisor keeps them.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Protocol, runtime_checkable

from amrepair.batch.options import Task, TaskOutcome, Work
from amrepair.errors import InputError
from gcode.crew import cores

EXECUTOR_NAMES = ("process", "serial", "ray")


@runtime_checkable
class Executor(Protocol):
    """Somebody who does tasks."""

    def outcomes(self, tasks: Iterator[Task]) -> Iterator[TaskOutcome]:
        """An outcome for each task, as they are done."""

    def close(self) -> None:
        """Let the workers go; what they were doing is dropped."""


class Serial:
    """This process."""

    def __init__(self, work: Work) -> None:
        self._work = work

    def outcomes(self, tasks: Iterator[Task]) -> Iterator[TaskOutcome]:
        """One after another."""
        from amrepair.batch.work import Bench

        bench = Bench(self._work)
        for task in tasks:
            yield bench.do(task)

    def close(self) -> None:
        """Nothing is held."""


def make_executor(
    name: str, work: Work, *, workers: int | None = None, address: str | None = None
) -> Executor:
    """An executor by name.

    Raises
    ------
    InputError
        If there is none of that name, or Ray's cluster cannot be used.
    MissingDependencyError
        If Ray is not installed.
    """
    if name not in EXECUTOR_NAMES:
        raise InputError(f"--executor is {name!r}; it is one of {', '.join(EXECUTOR_NAMES)}")
    if address is not None and name != "ray":
        raise InputError(f"--address belongs to --executor ray, the executor is {name}")
    count = workers or cores()
    if name == "serial":
        return Serial(work)
    if name == "process":
        from amrepair.batch.pool import Pool

        return Pool(work, workers=count)
    from amrepair.batch.on_ray import OnRay

    return OnRay(work, workers=workers if address is not None else count, address=address)
