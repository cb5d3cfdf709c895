"""Emulated printers that start in a hundredth of a second: forked from a warm process.

To load Python and what an emulated printer needs takes longer than most tests want of it.
"""

from __future__ import annotations

import functools
import json
import os
import select
import signal
import socket
import subprocess
import sys
from typing import Any

# Reads the places of standard input and error and of the control socket, with the files themselves.
SERVER = """
import fcntl, gc, json, os, signal, socket, sys, traceback
from gcode.firmware import child
asked = socket.socket(fileno=int(sys.argv[1]))
signal.signal(signal.SIGCHLD, signal.SIG_IGN)  # nobody waits for them here
gc.freeze()
while True:
    told, given, _, _ = socket.recv_fds(asked, 1 << 16, 3)
    if not told:
        break
    pid = os.fork()
    if pid:
        for one in given:
            os.close(one)
        asked.sendall(pid.to_bytes(4, "little"))
        continue
    asked.close()
    signal.signal(signal.SIGCHLD, signal.SIG_DFL)
    os.setsid()
    places, environ = json.loads(told)
    apart = [fcntl.fcntl(one, fcntl.F_DUPFD, 500) for one in given]
    for one in given:
        os.close(one)
    for one, place in zip(apart, places):
        os.dup2(one, place)
        os.close(one)
    os.environ.clear()
    os.environ.update(environ)
    try:
        child.main()
    except BaseException:
        traceback.print_exc()
        os._exit(1)
    os._exit(0)
"""


@functools.cache
def _server() -> tuple[socket.socket, subprocess.Popen[bytes]]:
    """Where to ask for a printer, and who answers: it ends when nobody can ask any more."""
    ours, theirs = socket.socketpair()
    with theirs:
        process = subprocess.Popen(
            [sys.executable, "-c", SERVER, str(theirs.fileno())],
            pass_fds=(theirs.fileno(),),
            start_new_session=True,
        )
    return ours, process


class Forked:
    """What `EmulatedPrinterProcess` asks of a `subprocess.Popen`, for a printer that is forked."""

    def __init__(
        self, words: list[str], *, pass_fds: tuple[int], env: dict[str, str], **_: Any
    ) -> None:
        assert words[1:] == ["-m", "gcode.firmware.child"]
        read, write = os.pipe()
        self.stdin = os.fdopen(write, "wb")
        told = json.dumps([[0, 2, *pass_fds], env]).encode()
        asked, _ = _server()
        socket.send_fds(asked, [told], [read, 2, *pass_fds])
        os.close(read)
        self.pid = int.from_bytes(asked.recv(4), "little")
        try:
            self._ended = os.pidfd_open(self.pid)
        except ProcessLookupError:
            self._ended = -1

    def wait(self, timeout: float | None = None) -> None:
        """Wait until it is gone."""
        if self._ended < 0:
            return
        gone = select.poll()
        gone.register(self._ended, select.POLLIN)
        if not gone.poll(None if timeout is None else 1e3 * timeout):
            raise subprocess.TimeoutExpired("gcode.firmware.child", timeout or 0.0)
        os.close(self._ended)
        self._ended = -1

    def kill(self) -> None:
        """Kill it, unless it is gone."""
        if self._ended >= 0:
            signal.pidfd_send_signal(self._ended, signal.SIGKILL)
