"""Senders and printers that start in milliseconds and may be killed: forked from a warm process.

Importing takes longer than what the tests of kills want to do; so one process imports everything,
and forks itself for every sender and every printer it is asked for.
"""

from __future__ import annotations

import importlib
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

UNIT = Path(__file__).parent
ROOT = UNIT.parent.parent
DEADLINE_S = 60.0


class Forks:
    """The test's side."""

    def __init__(self, children: str = "link_children") -> None:
        self._process = subprocess.Popen(
            [sys.executable, "-W", "ignore", str(Path(__file__)), children],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env={**os.environ, "PYTHONPATH": os.pathsep.join((str(ROOT), str(UNIT)))},
        )
        self._living: set[int] = set()

    def __enter__(self) -> Forks:
        return self

    def __exit__(self, *_: object) -> None:
        for pid in tuple(self._living):
            self.kill(pid)
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.close()
        self._process.wait(10)
        self._process.stdout.close()

    def _ask(self, **request: object) -> Any:
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.write(json.dumps(request).encode() + b"\n")
        self._process.stdin.flush()
        return json.loads(self._process.stdout.readline())

    def printer(self, link: Path, record: Path, **options: object) -> int:
        """Start an emulated printer; returns its process id once its port is there."""
        pid = self._start(do="emulate", link=str(link), record=str(record), **options)
        until(link.exists)
        return pid

    def sender(self, port: Path, journal: Path, **options: object) -> int:
        """Start a sender; `outcome` tells what became of it."""
        return self._start(do="send", port=str(port), journal=str(journal), **options)

    def start(self, do: str, **request: object) -> int:
        """Start a child that does what `do` names in the module of children."""
        return self._start(do=do, **request)

    def _start(self, **request: object) -> int:
        pid = int(self._ask(**request))
        self._living.add(pid)
        return pid

    def wait(self, pid: int) -> int:
        """Wait until a child has ended; its status (negative: the signal)."""
        self._living.discard(pid)
        return int(self._ask(do="wait", pid=pid))

    def kill(self, pid: int) -> int:
        """SIGKILL a child that may have ended by itself; its status."""
        self._living.discard(pid)
        return int(self._ask(do="kill", pid=pid))


def until(true: Callable[[], object]) -> None:
    """Wait for something that another process does; that one may need this core to do it.

    To ask takes at most a fifth of the processor's time.
    """
    end_s = time.monotonic() + DEADLINE_S
    begun_s = time.thread_time()
    while not true():
        assert time.monotonic() < end_s, "it never happened"
        asked_s = time.thread_time() - begun_s
        time.sleep(max(0.002, 4.0 * asked_s))
        begun_s = time.thread_time()


def _serve() -> None:
    children = importlib.import_module(sys.argv[1])  # imports all that children need

    for line in sys.stdin.buffer:
        request = json.loads(line)
        what = request.pop("do")
        if what in ("wait", "kill"):
            if what == "kill":
                os.kill(request["pid"], 9)
            _, status = os.waitpid(request["pid"], 0)
            answer = os.waitstatus_to_exitcode(status)
        else:
            answer = os.fork()
            if answer == 0:
                code = 1
                try:
                    null = os.open(os.devnull, os.O_RDWR)
                    os.dup2(null, 0)
                    os.dup2(null, 1)
                    code = getattr(children, what)(**request)
                finally:
                    os._exit(code)
        sys.stdout.write(f"{answer}\n")
        sys.stdout.flush()


if __name__ == "__main__":
    _serve()
