"""The host as it is, on a port and a clock that are numbers: a whole job takes milliseconds.

Everything that host code asks of a port, it asks of `os`, `select` and `serial`; those names are
replaced in its modules. Behind them is the emulated firmware, in this process. Whatever moment is
asked for, somebody can act in it (`VirtualPort.at`): an interrupt, a kill, a pause.
"""

from __future__ import annotations

import errno
import math
import os
import select
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from gcode.firmware import FirmwareCore
from gcode.hosts import conversation, fast_path, line_query, supervisor
from gcode.hosts.journal import Journal
from gcode.hosts.lock import PortLock
from gcode.hosts.serial import SerialPrinter

FD = 1_000_003
"""Of no file."""
TRIP_S = 0.0005
READ_WAITS_S = 0.5
"""The port's VTIME, where reads wait."""
MOST_CALLS = 300_000


class VirtualPort:
    """A port to one emulated printer.

    Attributes
    ----------
    at
        What somebody does at the so manieth read or write; it may raise.
    written
        Share of a write that is done where that is raised in it.
    damage
        What becomes of what the printer says.
    """

    def __init__(self, core: FirmwareCore) -> None:
        self.core = core
        self.now_s = 1000.0
        self.calls = 0
        self.at: dict[int, Callable[[], object]] = {}
        self.written = 0.0
        self.damage: Callable[[bytes], bytes] = bytes
        self._waits = self._gone = False
        self._heard = b""
        core.power_up()
        core.take_output()

    def install(self, patch: pytest.MonkeyPatch) -> None:
        """Have the host's modules find this port, and this clock, until the patch is undone."""
        system, selects, clock = _System(self), _Selects(self), _Clock(self)
        for module in (conversation, fast_path, line_query, supervisor):
            patch.setattr(module, "os", system)
            if hasattr(module, "select"):
                patch.setattr(module, "select", selects)
        patch.setattr(supervisor, "time", clock)
        patch.setattr(conversation, "serial", _Serials(self))

    def clock(self) -> float:
        """What the host is told of time."""
        return self.now_s

    def open(self) -> None:
        """Open the port: what was said before is gone, as with any port."""
        self._gone = self._waits = False
        self._heard = b""

    def set_waiting(self, waits: bool) -> None:
        """Have reads wait, or not."""
        self._waits = waits

    def pass_time(self, until_s: float) -> bool:
        """Let time pass until something can be read; whether it can."""
        while not self._listen() and self.now_s < until_s:
            mute_s = self.core.mute_until_s
            self.now_s = min(until_s, mute_s) if mute_s > self.now_s else until_s
            self.core.feed(b"", self.now_s)
            self.core.drain()  # nothing comes: the printer goes on with what it has buffered
        return bool(self._heard)

    def _listen(self) -> bytes:
        if not self._heard:
            self.core.run(wall_s=self.now_s)
            said = self.core.take_output()
            self._heard = self.damage(said) if said else b""
        if self.core.hang_up_s is not None:
            self._gone, self.core.hang_up_s = True, None
        return self._heard

    def read(self) -> bytes:
        """What came, as a read of the port gives it."""
        self._act()
        self._listen()
        if self._gone:
            raise OSError(errno.EIO, os.strerror(errno.EIO))
        if not self._heard and (not self._waits or not self.pass_time(self.now_s + READ_WAITS_S)):
            if self._waits:
                return b""
            raise BlockingIOError
        said, self._heard = self._heard, b""
        self.now_s += TRIP_S
        return said

    def write(self, data: bytes) -> int:
        """All of `data` is taken; who is stopped meanwhile has written `written` of it."""
        if self._gone:
            raise OSError(errno.EIO, os.strerror(errno.EIO))
        try:
            self._act()
        except BaseException:
            self.core.feed(data[: round(self.written * len(data))], self.now_s)
            raise
        self.core.feed(data, self.now_s)
        return len(data)

    def _act(self) -> None:
        self.calls += 1
        assert self.calls < MOST_CALLS, "no end"
        if (act := self.at.pop(self.calls, None)) is not None:
            act()


class _Instead:
    """A module of which some names lead to the port."""

    def __init__(self, port: VirtualPort, module: Any) -> None:
        self._port, self._module = port, module

    def __getattr__(self, name: str) -> Any:
        return getattr(self._module, name)


class _System(_Instead):
    def __init__(self, port: VirtualPort) -> None:
        super().__init__(port, os)

    def read(self, fd: int, most: int) -> bytes:
        return self._port.read() if fd == FD else os.read(fd, most)

    def write(self, fd: int, data: bytes) -> int:
        return self._port.write(data) if fd == FD else os.write(fd, data)

    def set_blocking(self, fd: int, blocking: bool) -> None:
        self._port.set_waiting(blocking)


class _Selects(_Instead):
    def __init__(self, port: VirtualPort) -> None:
        super().__init__(port, select)

    def select(self, read: list[int], write: list[int], odd: list[int], wait_s: float) -> Any:
        if write:
            return [], write, []
        return (read if self._port.pass_time(self._port.now_s + wait_s) else []), [], []

    def poll(self) -> _Poll:
        return _Poll(self._port)


class _Poll:
    def __init__(self, port: VirtualPort) -> None:
        self._port = port

    def register(self, fd: int, events: int) -> None:
        """The one port there is."""

    def poll(self, wait_ms: float = math.inf) -> list[int]:
        return [FD] if self._port.pass_time(self._port.now_s + wait_ms / 1000) else []


class _Clock(_Instead):
    def __init__(self, port: VirtualPort) -> None:
        super().__init__(port, time)

    def monotonic(self) -> float:
        return self._port.now_s

    def sleep(self, seconds: float) -> None:
        self._port.now_s += seconds


class _Serials(_Instead):
    def __init__(self, port: VirtualPort) -> None:
        super().__init__(port, conversation.serial)

    def Serial(self, **settings: Any) -> _Serial:
        return _Serial(self._port)


class _Serial:
    port = ""
    dtr = rts = True

    def __init__(self, port: VirtualPort) -> None:
        self._port = port

    def open(self) -> None:
        self._port.open()

    def fileno(self) -> int:
        return FD

    def close(self) -> None:
        """The printer goes on."""


def virtual_printer(
    port: VirtualPort,
    folder: Path,
    *,
    dialect: str = "marlin",
    window: int = 1,
    journal: Journal | None = None,
) -> SerialPrinter:
    """The host's printer on such a port; its lock lies in a folder of the test's."""
    printer = SerialPrinter(
        "/dev/ttyVIRTUAL",
        dialect=dialect,
        window=window,
        journal=journal,
        clock=port.clock,
        supervise=False,
    )
    printer._lock = PortLock("/dev/ttyVIRTUAL", folder=folder)
    return printer
