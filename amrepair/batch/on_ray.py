"""Workers of a Ray cluster: a pool of actors that hold the templates.

Templates go to the cluster's object store once and are shared by reference; scans are read where
the worker is, so that on several machines they lie in an object store or on a shared disk. An actor
that dies is started again by Ray, and its task is retried there.
"""

from __future__ import annotations

import contextlib
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from amrepair.batch.options import MOST_ATTEMPTS, Task, TaskOutcome, Work, given_up
from amrepair.errors import InputError, MissingDependencyError
from gcode.process import one_thread

if TYPE_CHECKING:
    from amrepair.batch.work import Bench

# Tasks under way a worker: one that is done and one that waits, so that none is idle meanwhile.
TASKS_A_WORKER = 2


class OnRay:
    """A pool of Ray actors.

    Parameters
    ----------
    workers
        Actors; None takes as many as the cluster has processors.
    address
        Of a running cluster; None starts one on this machine for as long as the batch takes.

    Raises
    ------
    MissingDependencyError
        If Ray is not installed.
    InputError
        If the cluster does not answer, or runs another version.
    """

    def __init__(self, work: Work, *, workers: int | None, address: str | None) -> None:
        self._ray = _loaded()
        self._own = not self._ray.is_initialized()
        if self._own:
            _joined(self._ray, address, workers)
        count = workers or max(1, int(self._ray.cluster_resources().get("CPU", 1)))
        # held here as long as an actor may have to begin anew
        self._shared = [self._ray.put(one.path.read_bytes()) for one in work.templates]
        holder = self._ray.remote(num_cpus=1, max_restarts=-1, max_task_retries=MOST_ATTEMPTS - 1)(
            _Holder
        )
        bare = replace(work, templates=tuple(replace(t, path=Path()) for t in work.templates))
        self._actors = [holder.remote(bare) for _ in range(count)]

    def outcomes(self, tasks: Iterator[Task]) -> Iterator[TaskOutcome]:
        """Never more than two tasks a worker are under way."""
        free = [actor for _ in range(TASKS_A_WORKER) for actor in self._actors]
        under_way: dict[Any, tuple[Any, Task]] = {}
        more = True
        while more or under_way:
            while more and free:
                task = next(tasks, None)
                more = task is not None
                if task is not None:
                    actor = free.pop(0)
                    under_way[actor.do.remote(task, self._shared)] = (actor, task)
            if not under_way:
                return
            done, _ = self._ray.wait(list(under_way), num_returns=1)
            for reference in done:
                actor, task = under_way.pop(reference)
                free.append(actor)
                yield self._outcome(reference, task)

    def close(self) -> None:
        """Let the actors go, and the cluster if it was started here."""
        for actor in self._actors:
            with contextlib.suppress(Exception):
                self._ray.kill(actor)
        if self._own:
            self._ray.shutdown()

    def _outcome(self, reference: Any, task: Task) -> TaskOutcome:
        try:
            said: TaskOutcome = self._ray.get(reference)
        except self._ray.exceptions.RayError:  # an actor that did not survive its retries
            return given_up(task, MOST_ATTEMPTS)
        return said


class _Holder:
    """An actor: a bench with templates that came by reference."""

    def __init__(self, work: Work) -> None:
        self._work = work
        self._folder = tempfile.TemporaryDirectory(prefix="amrepair-ray-")
        self._bench: Bench | None = None

    def do(self, task: Task, references: Sequence[Any]) -> TaskOutcome:
        """Judge one scan; an actor that was started again fetches the templates again."""
        if self._bench is None:
            from amrepair.batch.work import Bench

            contents = _loaded().get(list(references))
            placed = _laid_down(self._work, contents, self._folder.name)
            self._bench = Bench(replace(self._work, templates=placed))
        return self._bench.do(task)


def _laid_down(work: Work, contents: Sequence[bytes], folder: str) -> tuple[Any, ...]:
    placed = []
    for k, (one, data) in enumerate(zip(work.templates, contents, strict=True)):
        path = Path(folder) / f"{k}.safetensors"
        path.write_bytes(data)
        placed.append(replace(one, path=path))
    return tuple(placed)


def _loaded() -> Any:
    try:
        import ray
    except ImportError as error:
        raise MissingDependencyError(
            f"--executor ray needs Ray, which cannot be loaded ({error}); pip install "
            "'amrepair[ray]'"
        ) from error
    return ray


def _joined(ray: Any, address: str | None, workers: int | None) -> None:
    """Start Ray here, or join a cluster."""
    # on a cluster the number of processors is the cluster's own
    local = {"num_cpus": workers, "include_dashboard": False} if address is None else {}
    try:
        ray.init(
            address=address,
            log_to_driver=False,
            configure_logging=False,
            runtime_env={"env_vars": one_thread()},
            **local,
        )
    except (RuntimeError, ConnectionError, ValueError, OSError) as error:
        said = " ".join(str(error).split())
        if "version mismatch" in said.lower():
            raise InputError(
                f"the cluster at {address} runs another version of Ray or Python than this "
                f"machine (here Ray {ray.__version__}): {said[:200]}; install the cluster's"
            ) from error
        where = "on this machine" if address is None else f"at {address}"
        raise InputError(f"Ray cannot be used {where} ({said[:200]})") from error
