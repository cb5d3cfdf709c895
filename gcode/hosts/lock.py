"""One sender per printer: an advisory lock that dies with its owner.

It is on a file named after the port's device; the kernel drops it when the last process that
holds the descriptor ends, however it ends. The supervisor of `safety` inherits the descriptor,
so that nobody takes the printer between a sender's death and the heaters being switched off.

Who is done removes the file while still holding the lock on it. Whoever opened it before that gets
the lock of a file without a name, which keeps nobody out; so a lock counts only if the file of that
name is the one that was locked, and is tried for again otherwise. A killed sender leaves its file,
one a printer, for the next. It lies in the temporary folder because that is shared by all users of
the machine, as the printer is.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import sys
import tempfile
import time
from pathlib import Path

from gcode.errors import LinkError, PortBusyError
from gcode.locks import try_lock

ORPHAN_S = 8.0
"""How long to wait for a dead sender's supervisor to finish."""


class PortLock:
    """The right to speak to one printer."""

    def __init__(self, port: str, *, folder: Path | None = None) -> None:
        real = port if "://" in port else str(Path(port).resolve())
        name = hashlib.sha256(real.encode()).hexdigest()[:16]
        self._port = port
        self._path = (folder or Path(tempfile.gettempdir())) / f"gcode-port-{name}.lock"
        self.fd: int | None = None

    def acquire(self) -> None:
        """Take the lock.

        Raises
        ------
        PortBusyError
            If a living sender holds it, or a dead one's supervisor does not finish.
        LinkError
            If the lock's file cannot be used.
        """
        until_s = time.monotonic() + ORPHAN_S
        while True:
            fd = self._open()
            if not try_lock(fd):
                owner = _owner(fd)
                os.close(fd)
                if time.monotonic() >= until_s or (owner is not None and _alive(owner)):
                    who = f"process {owner}" if owner is not None else "another process"
                    raise PortBusyError(
                        f"{self._port} is held by {who}; one printer takes one sender: end it "
                        f"or choose another port."
                    ) from None
                time.sleep(0.02)
                continue
            if self._is_named(fd):
                break
            os.close(fd)  # its last holder has removed it: try for the file that has the name now
        os.ftruncate(fd, 0)
        os.lseek(fd, 0, os.SEEK_SET)
        os.write(fd, str(os.getpid()).encode())
        self.fd = fd

    def release(self) -> None:
        """Give the lock back, and leave nothing behind."""
        if self.fd is not None:
            with contextlib.suppress(OSError):
                if self._is_named(self.fd):
                    self._path.unlink()
        self.hand_over()

    def hand_over(self) -> None:
        """Leave the lock to the supervisor, which has inherited it: nobody comes in between."""
        if self.fd is not None:
            os.close(self.fd)
            self.fd = None

    def _open(self) -> int:
        try:
            return os.open(self._path, os.O_RDWR | os.O_CREAT, 0o666)
        except OSError as error:
            raise LinkError(
                f"The lock of {self._port}, {self._path}, cannot be used ({error.strerror}); if "
                f"another user left it and sends nothing, remove it."
            ) from error

    def _is_named(self, fd: int) -> bool:
        """Whether the open file is the one that the path leads to."""
        try:
            return os.path.samestat(os.fstat(fd), self._path.stat())
        except FileNotFoundError:
            return False


def _owner(fd: int) -> int | None:
    os.lseek(fd, 0, os.SEEK_SET)
    text = os.read(fd, 32).strip()
    return int(text) if text.isdigit() else None


def _alive(pid: int) -> bool:
    """Whether a process lives; a zombie has no descriptors left and counts as dead.

    On Windows, where signal 0 is no question, and no supervisor outlives its sender: always.
    """
    if sys.platform == "win32":
        return True
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
