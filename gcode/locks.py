"""Locks on open files: advisory, and gone with the process that holds one, however it ends."""

from __future__ import annotations

import os
import sys

if sys.platform == "win32":
    import msvcrt
else:
    import fcntl

_BYTE = 1 << 30  # Windows locks bytes, and keeps others from reading them: one that nobody writes


def try_lock(fd: int) -> bool:
    """Take the lock of an open file, if nobody holds it; closing the file gives it back."""
    try:
        if sys.platform == "win32":
            os.lseek(fd, _BYTE, os.SEEK_SET)
            msvcrt.locking(fd, msvcrt.LK_NBLCK, 1)
        else:
            fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        return False
    return True
