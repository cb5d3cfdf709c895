"""A Marlin built for Linux, behind a wire of ours: its own parser, queue, planner and heaters.

`AMREPAIR_MARLIN` names the program, built for Marlin's environment `linux_native` with its default
configuration (a bed of 200 mm; TEMP_SENSOR_BED 1). It speaks on standard input and output.
"""

from __future__ import annotations

import os
import pty
import random
import re
import select
import subprocess
import threading
import tty
from pathlib import Path
from types import TracebackType

import pytest

EXECUTED = re.compile(rb"echo:(?:N\d+ ?)?([GMT]\d[^*]*)")
"""Marlin tells every command that it carries out, after `M111 S1`."""


def native_marlin() -> str:
    """Return the program's path; skips, visibly, where there is none."""
    program = os.environ.get("AMREPAIR_MARLIN", "")
    if not Path(program).is_file():
        pytest.skip("AMREPAIR_MARLIN names no Marlin built for Linux")
    return program


class NativeMarlin:
    """Runs it; `executed` is what it carried out, heard before the wire damages anything.

    Parameters
    ----------
    damage
        Probability that a byte is lost, changed or preceded by another, in both directions.
    """

    def __init__(self, folder: Path, *, damage: float = 0.0, seed: int = 0) -> None:
        self.executed: list[str] = []
        self.said: list[str] = []
        self._damage, self._random = damage, random.Random(seed)
        ends = [pty.openpty() for _ in range(2)]
        for pair in ends:
            for end in pair:
                tty.setraw(end)
        (inner, self._firmware), (self._host, outer) = ends
        self.port = os.ttyname(outer)
        self._open = (self._firmware, self._host, outer)
        self._process = subprocess.Popen(
            [native_marlin()], stdin=inner, stdout=inner, stderr=subprocess.DEVNULL, cwd=folder
        )
        os.close(inner)
        self._ended = threading.Event()
        self._carrier = threading.Thread(target=self._carry, daemon=True)

    def __enter__(self) -> NativeMarlin:
        os.write(self._firmware, b"M111 S1\n")
        self._carrier.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._ended.set()
        self._carrier.join()
        self._process.kill()
        self._process.wait()
        for end in self._open:
            os.close(end)

    def _carry(self) -> None:
        rest = b""
        while not self._ended.is_set():
            ready = select.select([self._firmware, self._host], [], [], 0.1)[0]
            if self._host in ready:
                os.write(self._firmware, self._harm(os.read(self._host, 4096)))
            if self._firmware not in ready:
                continue
            *lines, rest = (rest + os.read(self._firmware, 4096)).split(b"\n")
            for line in lines:
                if told := EXECUTED.match(line):
                    self.executed.append(told.group(1).decode("latin-1").strip())
                else:
                    self.said.append(line.decode("latin-1"))
                    os.write(self._host, self._harm(line + b"\n"))

    def _harm(self, data: bytes) -> bytes:
        out = bytearray()
        for byte in data:
            how = self._random.randrange(3) if self._random.random() < self._damage else None
            if how is not None and how != 0:
                out.append(self._random.randrange(256))
            if how is None or how == 2:
                out.append(byte)
        return bytes(out)
