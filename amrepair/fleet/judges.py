"""`Judges`: processes under the supervisor that detect for whichever printer asks.

All of them listen at one local socket; whoever is free takes the next that asks, the rest waits in
the order in which it came. They run at low priority, so that links that print come first, own
nothing, and are replaced where they die, so often and no more: printers go on without them.
"""

from __future__ import annotations

import contextlib
import os
import pickle
import shutil
import signal
import socket
import tempfile
from collections import deque
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

from amrepair.batch.pool import spawned
from amrepair.errors import InputError

NICE = 10


class Judges:
    """A pool of them.

    Parameters
    ----------
    count
        How many.
    asking
        How many may wait besides: one for each printer.
    within_s
        When whoever asks stops waiting; what takes longer ends its process.
    restarts, restarts_within_s
        So many times in so many seconds one that died is replaced.
    nice
        How far they stand back for what prints.

    Raises
    ------
    InputError
        If the socket cannot be made.
    """

    def __init__(
        self,
        count: int,
        *,
        asking: int,
        within_s: float,
        restarts: int,
        restarts_within_s: float,
        nice: int = NICE,
    ) -> None:
        self._within_s, self._nice = within_s, nice
        self._restarts, self._restarts_within_s = restarts, restarts_within_s
        self._deaths: deque[float] = deque()
        self._workers: list[BaseProcess] = []
        self._folder = tempfile.mkdtemp(prefix="amrepair-judges-")  # for this user alone
        self._address = Path(self._folder) / "ask"
        self._listener: socket.socket | None = socket.socket(socket.AF_UNIX)
        try:
            self._listener.bind(str(self._address))
            self._listener.listen(asking)
        except OSError as error:
            self.close()
            raise InputError(
                f"no socket can be made at {self._address} ({error.strerror or error}); name a "
                "shorter folder in TMPDIR, or set judges = 0"
            ) from error
        for _ in range(count):
            self._hire()

    @property
    def note(self) -> dict[str, Any]:
        """Where to ask, and how long."""
        return {"address": str(self._address), "within_s": self._within_s}

    @property
    def processes(self) -> tuple[int, ...]:
        """Numbers of those that are there."""
        return tuple(one.pid or 0 for one in self._workers)

    def step(self, now_s: float) -> str:
        """Replace those that died; a sentence where there are to be none any more."""
        if self._listener is None:
            return ""
        for one in [one for one in self._workers if not one.is_alive()]:
            one.join()
            self._workers.remove(one)
            while self._deaths and now_s - self._deaths[0] > self._restarts_within_s:
                self._deaths.popleft()
            self._deaths.append(now_s)
            if len(self._deaths) > self._restarts:
                self.close()
                return (
                    f"the shared detection ended {len(self._deaths)} times in "
                    f"{self._restarts_within_s:.0f} s (the last with code {one.exitcode}); each "
                    "printer's process judges its own scans"
                )
            self._hire()
        return ""

    def close(self) -> None:
        """End them; whoever waits for an answer is let go at once."""
        for one in self._workers:
            one.kill()
        for one in self._workers:
            one.join()
        self._workers = []
        if self._listener is not None:
            self._listener.close()
            self._listener = None
        shutil.rmtree(self._folder, ignore_errors=True)

    def _hire(self) -> None:
        self._workers.append(spawned(serve, self._listener, self._within_s, self._nice))


def serve(listener: socket.socket, within_s: float, nice: int) -> None:
    """A worker's life: detect for one after another."""
    from gcode.process import end_with_parent

    end_with_parent()
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the terminal's is for the supervisor
    os.nice(nice)
    from amrepair.fleet.shared import mark

    own = mark()
    while True:
        pipe, _ = listener.accept()
        # whoever asks has gone by then: one that hangs ends, and another takes its place
        signal.setitimer(signal.ITIMER_REAL, within_s)
        with pipe, contextlib.suppress(OSError, EOFError):
            _answer(pipe, own, within_s)
        signal.setitimer(signal.ITIMER_REAL, 0.0)


def _answer(pipe: socket.socket, own: bytes, within_s: float) -> None:
    """Say who this is, take a question, send what it comes to, or why it does not."""
    from amrepair.fleet.shared import received, sent
    from amrepair.regions import detect
    from gcode.process import gives_back

    def left_s() -> float:
        return within_s  # for each word; the alarm ends it all

    sent(pipe, own, left_s)
    question = received(pipe, left_s)
    try:
        scan, template, said = pickle.loads(question)
        found: Any = gives_back(detect)(scan, template, **said)
    except Exception as error:  # noqa: BLE001  whoever asked does it again, and says it as it is
        found = f"it could not judge the scan ({type(error).__name__})"
    sent(pipe, pickle.dumps(found, pickle.HIGHEST_PROTOCOL), left_s)
