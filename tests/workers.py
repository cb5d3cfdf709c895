"""The suite by several processes: `pytest --workers 4`.

The tests are collected once. The process that did so forks its workers, which hold them all from
the start: else each would load and collect them for itself. A worker asks for the tests of one
module or class at a time, so that what they share is made once, and sends its reports back.
"""

from __future__ import annotations

import contextlib
import os
import signal
import traceback
from collections import deque
from multiprocessing import Pipe
from multiprocessing.connection import Connection, wait
from typing import Any, NoReturn

import pytest

# How often who ended is looked for.
LOOK_EVERY_S = 0.3


@pytest.hookimpl(tryfirst=True)
def pytest_runtestloop(session: pytest.Session) -> bool | None:
    """Run all that was collected by workers; none where pytest is to run it itself."""
    count = session.config.getoption("--workers")
    if count < 2 or session.testsfailed or session.config.option.collectonly:
        return None
    _Crew(session, count).run()
    return True


def in_groups(items: list[pytest.Item]) -> deque[list[int]]:
    """Indices of the tests that go to one worker together: of one module, or class; most first."""
    groups: dict[str, list[int]] = {}
    for index, item in enumerate(items):
        groups.setdefault(item.nodeid.partition("[")[0].rpartition("::")[0], []).append(index)
    return deque(sorted(groups.values(), key=lambda group: -len(group)))


class _Worker:
    """A forked process as its parent knows it."""

    def __init__(self, pid: int, link: Connection) -> None:
        self.pid, self.link = pid, link
        self.given: deque[int] = deque()  # what it has not finished


class _Crew:
    """Forks workers, gives them tests, and has pytest know their reports as if it ran them."""

    def __init__(self, session: pytest.Session, count: int) -> None:
        self._session, self._count = session, count
        self._groups = in_groups(session.items)
        self._workers: list[_Worker] = []

    def run(self) -> None:
        session, manager = self._session, self._session.config.pluginmanager
        reporter = manager.getplugin("terminalreporter")
        if reporter is not None:
            reporter.showfspath = False  # the reports of several files come in turn
        factory = getattr(session.config, "_tmp_path_factory", None)
        if factory is not None:
            factory.getbasetemp()  # one for all
        try:
            for _ in range(min(self._count, len(self._groups))):
                self._start()
            while self._workers:
                links = {worker.link: worker for worker in self._workers}
                for link in wait(list(links), timeout=LOOK_EVERY_S):
                    self._hear(links[link])
                self._reap()
                if session.shouldfail:
                    raise session.Failed(session.shouldfail)
                if session.shouldstop:
                    raise session.Interrupted(session.shouldstop)
        finally:
            for worker in self._workers:
                os.kill(worker.pid, signal.SIGKILL)
                os.waitpid(worker.pid, 0)

    def _start(self) -> None:
        ours, theirs = Pipe()
        pid = os.fork()
        if pid == 0:
            for other in (ours, *(worker.link for worker in self._workers)):
                other.close()
            _work(self._session, theirs)
        theirs.close()
        self._workers.append(_Worker(pid, ours))

    def _hear(self, worker: _Worker) -> bool:
        """Take one message of a worker; false where there will be none."""
        try:
            kind, told = worker.link.recv()
        except (EOFError, OSError):
            return False
        hooks = self._session.config.hook
        if kind == "report":
            report = hooks.pytest_report_from_serializable(config=self._session.config, data=told)
            hooks.pytest_runtest_logreport(report=report)
        elif kind == "done":
            worker.given.remove(told)
        else:
            group = self._groups.popleft() if self._groups else []
            worker.given.extend(group)
            with contextlib.suppress(OSError):
                worker.link.send(group)
        return True

    def _reap(self) -> None:
        """See which workers ended: what a test left running may hold a worker's link open."""
        for worker in list(self._workers):
            pid, status = os.waitpid(worker.pid, os.WNOHANG)
            if pid:
                while worker.link.poll() and self._hear(worker):
                    pass
                self._ended(worker, os.waitstatus_to_exitcode(status))

    def _ended(self, worker: _Worker, code: int) -> None:
        """A worker that died has failed the test it ran; another one runs what was left to it."""
        self._workers.remove(worker)
        worker.link.close()
        if code == 0 and not worker.given:
            return
        if not worker.given:
            raise RuntimeError(f"A worker ended with {code} after its last test.")
        item = self._session.items[worker.given.popleft()]
        report = pytest.TestReport(
            nodeid=item.nodeid,
            location=item.location,
            keywords={},
            outcome="failed",
            longrepr=f"The worker that ran {item.nodeid} ended with {code}.",
            when="call",
        )
        self._session.config.hook.pytest_runtest_logreport(report=report)
        if worker.given:
            self._groups.appendleft(list(worker.given))
        if self._groups:
            self._start()


class _Reports:
    """Sends each report of a worker to the process that forked it."""

    def __init__(self, config: pytest.Config, link: Connection) -> None:
        self._config, self._link = config, link

    @pytest.hookimpl
    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        data = self._config.hook.pytest_report_to_serializable(config=self._config, report=report)
        self._link.send(("report", data))


class _Silent:
    """In the place of pytest's reporter: what prints a test's stacks asks for its writer."""

    def __init__(self, writer: Any) -> None:
        self._tw = writer


def _work(session: pytest.Session, link: Connection) -> NoReturn:
    """Run what the other end gives, and end this process."""
    code = 1
    try:
        with contextlib.suppress(BrokenPipeError, EOFError):  # nobody is there to be told
            _alone(session.config, link)
            _run(session, link)
            code = 0
    except BaseException:  # noqa: BLE001 - whatever it is, it is told and the process ends
        traceback.print_exc()
    finally:
        os._exit(code)


def _alone(config: pytest.Config, link: Connection) -> None:
    """Let go of what is the parent's: its terminal, and the file that takes what tests print."""
    manager = config.pluginmanager
    reporter = manager.getplugin("terminalreporter")
    if reporter is not None:
        manager.unregister(reporter)
        manager.register(_Silent(reporter._tw), "terminalreporter")
    manager.register(_Reports(config, link))
    capture = manager.getplugin("capturemanager")
    capture.stop_global_capturing()
    capture.start_global_capturing()
    capture.suspend_global_capture()


def _run(session: pytest.Session, link: Connection) -> None:
    def more() -> list[int]:
        link.send(("more", None))
        return link.recv()

    waiting = deque(more())
    while waiting:
        index = waiting.popleft()
        if not waiting:
            waiting.extend(more())  # the next test says what of this one's is kept
        following = session.items[waiting[0]] if waiting else None
        item = session.items[index]
        session.config.hook.pytest_runtest_protocol(item=item, nextitem=following)
        link.send(("done", index))
