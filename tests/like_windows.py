"""A process as if the system were Windows: without what Python has on others alone.

    python -m tests.like_windows gcode check job.gcode

Libraries are loaded before, as they are; ours find no fcntl, termios or fork.
"""

from __future__ import annotations

import fcntl
import importlib
import os
import select
import signal
import socket
import sys
from types import ModuleType, SimpleNamespace

LIBRARIES = (
    *("numpy", "numba", "numba.core.caching", "numba.np.linalg", "numba.core.runtime.nrtdynmod"),
    *("scipy.spatial", "scipy.ndimage", "scipy.optimize", "scipy.stats", "trimesh", "manifold3d"),
    *("shapely", "skimage.measure", "typer", "rich.progress", "rich.console", "pydantic"),
    *("safetensors.numpy", "jaxtyping", "httpx", "serial", "serial.tools.list_ports", "sqlite3"),
    *(
        "multiprocessing.pool",
        "concurrent.futures",
        "tempfile",
        "http.server",
        "uuid",
        "lxml.etree",
    ),
)
ASK_FOR_THE_SYSTEM = (
    *("gcode.locks", "gcode.crew", "gcode.cli.console", "gcode.hosts.lock", "gcode.hosts.connect"),
    "gcode.firmware.serve",
)
NOT_THERE = ("fcntl", "termios", "tty", "pty", "resource", "pwd", "grp")
NOT_IN = {
    os: (
        *("fork", "forkpty", "openpty", "ttyname", "sched_getaffinity", "pread", "pwrite"),
        *("getuid", "geteuid", "getgid", "killpg", "setsid", "nice", "mkfifo", "wait4", "fchown"),
        *("O_CLOEXEC", "O_DIRECTORY", "O_NOFOLLOW"),
    ),
    signal: ("SIGHUP", "SIGKILL", "SIGUSR1", "SIGALRM", "SIGPIPE", "SIGCHLD", "setitimer", "alarm"),
    select: ("poll", "POLLIN", "epoll"),
    socket: ("AF_UNIX",),
}


def _msvcrt() -> ModuleType:
    """Its locks, by what this system has."""
    made = ModuleType("msvcrt")
    made.LK_NBLCK = fcntl.LOCK_EX | fcntl.LOCK_NB  # type: ignore[attr-defined]
    made.locking = lambda fd, mode, count: fcntl.flock(fd, mode)  # type: ignore[attr-defined]
    return made


def prepare() -> None:
    """Take away what Windows lacks."""
    for name in LIBRARIES:
        importlib.import_module(name)
    sys.modules["msvcrt"] = _msvcrt()
    for name in NOT_THERE:
        sys.modules[name] = None  # type: ignore[assignment]
    for module, names in NOT_IN.items():
        for name in names:
            if hasattr(module, name):
                delattr(module, name)
    for name in ASK_FOR_THE_SYSTEM:  # numba, too, asks for it, and must not be told
        sys.platform = "win32"
        module = importlib.import_module(name)
        sys.platform = "linux"
        vars(module)["sys"] = SimpleNamespace(**{**vars(sys), "platform": "win32"})


if __name__ == "__main__":
    prepare()
    sys.argv = sys.argv[1:]
    importlib.import_module(f"{sys.argv[0]}.cli").main()
