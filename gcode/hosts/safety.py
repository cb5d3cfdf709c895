"""The supervisor: a small process that makes the printer safe when its sender is killed.

It inherits the open port and the lock, and waits on a pipe. If the sender ends without having
written its farewell, the pipe closes and the supervisor switches the heaters off and lifts the
nozzle. It uses unnumbered lines, which a firmware takes whatever number it is at, and so leaves
the printer's own line number as it was: the place a job can be resumed from.
"""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
from pathlib import Path

import gcode

SAFE_COMMANDS = ("M104 S0", "M140 S0", "M107")
"""The present head's heater, the bed's and the fan off."""

FAREWELL = b"."
_TIMEOUT_S = 5.0


class Supervisor:
    """Our end of the supervisor process."""

    def __init__(
        self,
        port_fd: int,
        lock_fd: int | None,
        journal: Path | None,
        heads_off: tuple[str, ...] = (),
    ) -> None:
        ours, theirs = os.pipe()
        fds = [ours, port_fd] + ([lock_fd] if lock_fd is not None else [])
        root = str(Path(gcode.__file__).parent.parent)
        self._process = subprocess.Popen(
            [
                sys.executable,
                "-S",
                "-E",
                str(Path(__file__).with_name("supervisor.py")),
                str(ours),
                str(port_fd),
                str(journal or ""),
                *heads_off,
            ],
            pass_fds=fds,
            stdin=subprocess.DEVNULL,
            start_new_session=True,  # an interrupt meant for the sender is not for us
            cwd=root,
        )
        os.close(ours)
        self._pipe = theirs

    def take_over(self) -> None:
        """Without a farewell: make the printer safe, whatever becomes of us; waits for nothing."""
        os.close(self._pipe)

    def stand_down(self) -> None:
        """Say farewell: the sender ends in order, nothing is to be done."""
        with contextlib.suppress(OSError):
            os.write(self._pipe, FAREWELL)
        os.close(self._pipe)
        try:
            self._process.wait(timeout=_TIMEOUT_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
