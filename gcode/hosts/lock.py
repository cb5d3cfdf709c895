"""One sender per printer: an advisory lock that dies with its owner.

`flock` on a file named after the port's device; the kernel drops it when the last process that
holds the descriptor ends, however it ends. The supervisor of `safety` inherits the descriptor,
so that nobody takes the printer between a sender's death and the heaters being switched off.
"""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import os
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

from gcode.errors import PortBusyError

ORPHAN_S = 8.0
"""How long to wait for a dead sender's supervisor to finish."""


class PortLock:
    """The right to speak to one printer."""

    def __init__(self, port: str, *, folder: Path | None = None) -> None:
        real = str(Path(port).resolve()) if port.startswith("/") else port
        name = hashlib.sha256(real.encode()).hexdigest()[:16]
        self._port = port
        self._path = (folder or Path(tempfile.gettempdir())) / f"gcode-port-{name}.lock"
        self.fd: int | None = None

    def acquire(
        self,
        *,
        clock: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        """Take the lock.

        Raises
        ------
        PortBusyError
            If a living sender holds it, or a dead one's supervisor does not finish.
        """
        fd = os.open(self._path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o666)
        until_s = clock() + ORPHAN_S
        while True:
            try:
                fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
                break
            except OSError:
                owner = _owner(fd)
                if clock() >= until_s or (owner is not None and _alive(owner)):
                    os.close(fd)
                    who = f"process {owner}" if owner is not None else "another process"
                    raise PortBusyError(
                        f"{self._port} is held by {who}; one printer takes one sender: end it "
                        f"or choose another port."
                    ) from None
                sleep(0.02)
        os.ftruncate(fd, 0)
        os.pwrite(fd, str(os.getpid()).encode(), 0)
        self.fd = fd

    def release(self) -> None:
        """Give the lock back."""
        if self.fd is not None:
            with contextlib.suppress(OSError):
                os.ftruncate(self.fd, 0)
            os.close(self.fd)
            self.fd = None


def _owner(fd: int) -> int | None:
    text = os.pread(fd, 32, 0).strip()
    return int(text) if text.isdigit() else None


def _alive(pid: int) -> bool:
    """Whether a process lives; a zombie has no descriptors left and counts as dead."""
    try:
        state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except OSError:
        state = ""
    if state == "Z":
        return False
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    return True
