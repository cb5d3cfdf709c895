"""Detection asked of the fleet's shared processes, by a deadline; late, dead or full: done here.

A printer's process sends a scan and what it is held against over a local socket, and takes the
answer only from a process that has the same program and the same threads, so that it is what it
would have come to itself, bit for bit. Nothing else is shared: deficit, program and check are made
by the process that owns the printer, and the processes that are asked know of no printer.
"""

from __future__ import annotations

import hashlib
import os
import pickle
import socket
import struct
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from amrepair import __version__
from amrepair.fleet.desk import JUDGES, read_note
from amrepair.regions import AnomalyMap, detect
from amrepair.scans import Scan
from amrepair.template.port import Template
from gcode.compiled import get_num_threads, sources_stamp
from gcode.progress import Progress, silent

BY_ITSELF = "no shared detection"
_SIZE = struct.Struct("!Q")
_PIPE_BYTES = 1 << 20


def mark() -> bytes:
    """What two processes must have in common to come to the same bits: program and threads."""
    threads = get_num_threads(), os.environ.get("OPENBLAS_NUM_THREADS")
    return hashlib.sha256(f"{__version__} {sources_stamp(('.py',))} {threads}".encode()).digest()


@dataclass(frozen=True, slots=True)
class SharedDetection:
    """`detect`, wherever it is done.

    Attributes
    ----------
    desk
        Folder with the note on where to ask; read at every scan, since a supervisor that was
        started again says something else.
    told
        Called with each scan: why it was judged here; empty where it was not.
    own
        This process's mark, of the program as it was loaded.
    """

    desk: Path
    told: Callable[[str], None] = lambda why: None
    clock: Callable[[], float] = time.monotonic
    own: bytes = field(default_factory=mark)

    def __call__(
        self, scan: Scan, template: Template, *, progress: Progress = silent, **said: Any
    ) -> AnomalyMap:
        """As `detect`."""
        note = read_note(self.desk / JUDGES)
        if note is None:
            self.told(BY_ITSELF)
            return detect(scan, template, progress=progress, **said)
        progress("detect", 0.0, 1.0)
        try:
            answer = self._asked(note, (scan, template, said))
        except TimeoutError:
            answer = f"no answer within {note.get('within_s')} s"
        except Exception as error:  # noqa: BLE001  whatever is wrong there, it can be done here
            answer = f"it cannot be asked ({type(error).__name__}: {error})"
        if isinstance(answer, AnomalyMap):
            self.told("")
            progress("detect", 1.0, 1.0)
            return answer
        self.told(answer)
        return detect(scan, template, progress=progress, **said)

    def _asked(self, note: dict[str, Any], question: Any) -> AnomalyMap | str:
        """The answer, or why there is none."""
        end_s = self.clock() + float(note["within_s"])

        def left_s() -> float:
            left = end_s - self.clock()
            if left <= 0.0:
                raise TimeoutError
            return left

        with socket.socket(socket.AF_UNIX) as pipe:
            pipe.settimeout(left_s())
            pipe.connect(str(note["address"]))
            if received(pipe, left_s) != self.own:  # waits until one of them is free
                return "it has another program or other threads than this process"
            sent(pipe, pickle.dumps(question, pickle.HIGHEST_PROTOCOL), left_s)
            answer: AnomalyMap | str = pickle.loads(received(pipe, left_s))
        return answer


def sent(pipe: socket.socket, data: bytes, left_s: Callable[[], float]) -> None:
    """Send a message, its size first.

    Raises
    ------
    TimeoutError
        If it takes longer than is left.
    """
    pipe.settimeout(left_s())
    pipe.sendall(_SIZE.pack(len(data)))
    pipe.settimeout(left_s())
    pipe.sendall(data)


def received(pipe: socket.socket, left_s: Callable[[], float]) -> bytes:
    """Receive a message that `sent` sent.

    Raises
    ------
    TimeoutError
        If it takes longer than is left.
    EOFError
        If the other side has gone.
    """
    (size,) = _SIZE.unpack(_exactly(pipe, _SIZE.size, left_s))
    return _exactly(pipe, size, left_s)


def _exactly(pipe: socket.socket, size: int, left_s: Callable[[], float]) -> bytes:
    data = bytearray()
    while len(data) < size:
        pipe.settimeout(left_s())
        chunk = pipe.recv(min(size - len(data), _PIPE_BYTES))
        if not chunk:
            raise EOFError("the other side has gone")
        data += chunk
    return bytes(data)
