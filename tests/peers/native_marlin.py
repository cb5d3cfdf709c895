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
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType

import numpy as np
import pytest

from gcode.firmware import MotionBatch
from gcode.profiles import PrinterProfile, load_printer
from tests.gcode_text import steps_of

EXECUTED = re.compile(rb"echo:(?:N\d+ ?)?([GMT]\d[^*]*)")
"""Marlin tells every command that it carries out, after `M111 S1`."""


def native_marlin() -> str:
    """Return the program's path; skips, visibly, where there is none."""
    program = os.environ.get("AMREPAIR_MARLIN", "")
    if not Path(program).is_file():
        pytest.skip("AMREPAIR_MARLIN names no Marlin built for Linux")
    return program


# As its default configuration has it.
PROFILE = """
inherits = "generic_marlin"
name = "Native Marlin"
bed_size_mm = [200.0, 200.0]
max_z_mm = 200.0
park_mm = [5.0, 195.0, 20.0]
"""


def profile(folder: Path) -> PrinterProfile:
    """Its printer's profile, kept in a folder."""
    path = folder / "native_marlin.toml"
    path.write_text(PROFILE)
    return load_printer(str(path))


class Nozzle:
    """Where commands that were carried out have it go, and what it pushes out on its way."""

    def __init__(self) -> None:
        self._commands: list[str] = []
        self._taken = 0

    def follow(self, commands: Sequence[str]) -> MotionBatch:
        """The moves of further commands, as `steps_of` reads them; each as fast as it was told."""
        self._commands += commands
        steps = steps_of("\n".join(self._commands))
        took_s = [
            max(float(np.linalg.norm(step.end_mm - step.start_mm)), abs(step.e_mm)) / step.feed_mm_s
            for step in steps
        ]
        rows = [
            [*step.start_mm, *step.end_mm, step.e_mm, step.feed_mm_s, time_s]
            for step, time_s in zip(steps, np.cumsum(took_s), strict=True)
        ]
        new, self._taken = rows[self._taken :], len(rows)
        return MotionBatch.from_bytes(np.array(new, dtype=np.float64).tobytes())


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
