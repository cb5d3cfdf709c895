"""Runs the peers: every one a process of its own, in an environment of its own."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import httpx
import pytest
from environments import PEERS, python_of

HERE = Path(__file__).parent

START_S = 90.0
# Of Moonraker; dev_mode: nothing is looked up outside.
MOONRAKER = """\
[server]
host: 127.0.0.1
port: {port}
klippy_uds_address: {klippy}
[machine]
provider: none
validate_service: False
[announcements]
dev_mode: True
"""


def peer(name: str) -> str:
    """Return a peer's interpreter; skips, visibly, where it is not installed."""
    assert name in PEERS
    if not python_of(name).exists():
        pytest.skip(f"{name} is not installed: run make peers")
    return str(python_of(name))


def free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        return int(listener.getsockname()[1])


@contextmanager
def process(*command: str | Path, log: Path) -> Iterator[subprocess.Popen[bytes]]:
    """Run a server in a group of its own, and end the whole group."""
    with log.open("ab") as output:
        running = subprocess.Popen(
            [str(word) for word in command],
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=output,
            start_new_session=True,
        )
    try:
        yield running
    finally:
        end(running)


def end(running: subprocess.Popen[bytes]) -> None:
    if running.poll() is None:
        os.killpg(running.pid, signal.SIGKILL)
    running.wait()


def wait_for(what: str, ready: Callable[[], bool], log: Path, within_s: float = START_S) -> None:
    """Poll a peer that has no other way to say that it is there."""
    until_s = time.monotonic() + within_s
    while not ready():
        if time.monotonic() > until_s:
            pytest.fail(
                f"{what} not within {within_s:g} s; its log ends:\n{log.read_text()[-2000:]}"
            )
        time.sleep(0.1)


class Web:
    """Plain requests to a server, independent of our adapters."""

    def __init__(self, base: str, key: str) -> None:
        self.base = base
        self.http = httpx.Client(base_url=base, headers={"X-Api-Key": key}, trust_env=False)

    def get(self, path: str) -> dict[str, Any]:
        try:
            answer = self.http.get(path)
        except httpx.HTTPError:
            return {}
        return dict(answer.json()) if answer.status_code == 200 else {}


class Printing(threading.Thread):
    """A `print` call in a thread of its own, with its report or its error."""

    def __init__(self, printer: Any, job: Any) -> None:
        super().__init__(daemon=True)
        self.printer, self.job = printer, job
        self.report: Any = None
        self.error: Exception | None = None
        self.reached = threading.Condition()
        self.done_bytes = 0.0
        self.start()

    def run(self) -> None:
        try:
            self.report = self.printer.print(self.job, progress=self.note)
        except Exception as error:  # noqa: BLE001 - the test looks at it
            self.error = error
        with self.reached:
            self.done_bytes = float("inf")
            self.reached.notify_all()

    def note(self, stage: str, done: float, total: float) -> None:
        with self.reached:
            self.done_bytes = max(self.done_bytes, done)
            self.reached.notify_all()

    def wait_until(self, done_bytes: float) -> None:
        with self.reached:
            assert self.reached.wait_for(lambda: self.done_bytes >= done_bytes, 60)
        assert self.error is None, self.error

    def finish(self) -> Any:
        self.join(120)
        assert not self.is_alive()
        return self.report
