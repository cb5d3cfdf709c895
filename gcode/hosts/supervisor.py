"""The supervisor's own program: standard library only, so that it starts in milliseconds.

Run by `safety.Supervisor` with the numbers of two inherited descriptors: the pipe whose end tells
of the sender's death, and the open port; the journal's path; and a line for each of several heads
that switches it off. It imports nothing of ours.
"""

import contextlib
import os
import re
import select
import sqlite3
import sys
import time
from collections.abc import Sequence

HEATERS_OFF = (b"M104 S0", b"M140 S0")
_OFF = dict(zip((b"T", b"B"), HEATERS_OFF, strict=True))
END_WAIT = b"M108"
"""Ends a wait for temperature, where the firmware lets it pass the queue."""
LIFT = (
    b"G21",  # the program may have been in inches
    b"G91",
    b"G1 Z5 F600",
    b"G90",
)
QUESTIONS = 6
_TARGET = re.compile(rb"\b([A-Z]\d{0,2}): ?-?[\d.]+ ?/ ?(-?[\d.]+)")
_KLIPPER_REFUSES = re.compile(rb"^!! *(.+?)\r?$", re.MULTILINE)
_NOT_MOVED = re.compile(rb"^(?:!!|Error:)", re.MULTILINE)
_KLIPPER_STARTS = re.compile(rb"^ok T:0\r?$", re.MULTILINE)
"""What Klipper answers to M105 before it knows its heaters (gcode.py, cmd_default)."""
STARTS_S = 20.0
"""So long a Klipper that starts anew may take to know them."""
PORT_ANSWERS_S = 0.5
SILENT_S = 0.1
"""The same for who has not answered so far: its receive buffer holds all that is said."""


def main() -> None:
    """Wait for the sender's end; act if it was not in order."""
    pipe_fd, port_fd, journal = int(sys.argv[1]), int(sys.argv[2]), sys.argv[3]
    if os.read(pipe_fd, 1):
        return
    outcome = f"supervisor: sender died; {make_safe(port_fd, heads_off=sys.argv[4:])}"
    if journal:
        with contextlib.suppress(sqlite3.Error), contextlib.closing(sqlite3.connect(journal)) as db:
            db.execute("INSERT INTO note SELECT MAX(id), ?, ? FROM job", (time.time(), outcome))
            db.commit()


def make_safe(port_fd: int, *, lift: bool = True, heads_off: Sequence[str] = ()) -> str:
    """Send the commands, each answered or given up on; return what became of them.

    Heaters first; then, with `lift`, the nozzle away from the part; heaters again, because a line
    may have been lost. `heads_off` are the lines for heads that are not chosen.
    """
    answered, refusal = 0, ""
    os.set_blocking(port_fd, False)  # the sender may have died while it waited in a read
    write(port_fd, b"\n")  # ends the half line that a killed sender may have left
    wait(port_fd, 0.05)
    off = (*HEATERS_OFF, *(line.encode() for line in heads_off))
    commands = (END_WAIT, *off, b"M107", *(LIFT if lift else ()), *off)
    for said, command in enumerate(commands):
        if not write(port_fd, command + b"\n"):
            return "THE PORT IS GONE, HEATERS COULD NOT BE REACHED"
        ok, heard = wait(port_fd, PORT_ANSWERS_S if answered or said < 2 else SILENT_S)
        answered += ok
        if command in off and (refused := _KLIPPER_REFUSES.search(heard)):
            refusal = refused.group(1).decode("ascii", "replace")
        if command in LIFT and _NOT_MOVED.search(heard):
            lift = False
    if not answered:
        return "heaters told to switch off, NO ANSWER"
    if confirmed_off(port_fd):
        return "heaters off (the printer reports targets of 0)" + ", nozzle lifted" * (
            lift and not refusal
        )
    if refusal:
        return (
            f"heaters told to switch off, nothing confirms it: the printer has stopped ({refusal}),"
            f" which should switch them off by itself; see that they cool"
        )
    return "heaters told to switch off, nothing confirms it"


def confirmed_off(port_fd: int) -> bool:
    """Whether the printer itself reports that its heaters aim at 0.

    An `ok` proves nothing: it may answer a line of the dead sender's. Nor does one report, which
    has no checksum: two in a row must say the same. A Klipper that starts anew is asked until it
    is there.
    """
    asked, starts, until_s = 0, False, time.monotonic() + STARTS_S
    before: dict[bytes, bytes] = {}
    while asked < QUESTIONS and not (starts and time.monotonic() > until_s):
        if not write(port_fd, b"M105\n"):
            return False
        heard = wait(port_fd, PORT_ANSWERS_S)[1]
        targets = targets_of(heard)
        if targets and targets == before:
            on = [name for name, value in targets.items() if float(value) != 0.0]
            if not on:
                return True
            send_off(port_fd, on)
        before = targets
        starts = _KLIPPER_STARTS.search(heard) is not None
        if starts:
            time.sleep(PORT_ANSWERS_S)
        else:
            asked += 1
    return False


def targets_of(heard: bytes) -> dict[bytes, bytes]:
    """What the last report says that nozzles and bed aim at; nothing where it is damaged."""
    for line in reversed(heard.split(b"\n")):
        targets = _TARGET.findall(line)
        heaters = {name: value for name, value in targets if name[:1] in b"TB"}
        if any(name[:1] == b"T" for name in heaters):
            return heaters if line.count(b"/") == len(targets) else {}
    return {}


def send_off(port_fd: int, on: list[bytes]) -> None:
    """Switch off what is on all the same: heads that nobody had told of, or a line was damaged."""
    for name in on:
        write(port_fd, _OFF.get(name, b"M104 %s S0" % name) + b"\n")
        wait(port_fd, PORT_ANSWERS_S)


def write(port_fd: int, data: bytes) -> bool:
    """Write all of `data`; False if the port is gone."""
    try:
        while data:
            if not select.select([], [port_fd], [], PORT_ANSWERS_S)[1]:
                return True
            data = data[os.write(port_fd, data) :]
    except OSError:
        return False
    return True


def wait(port_fd: int, seconds: float) -> tuple[bool, bytes]:
    """Read until an `ok` line or until time is up; whether there was one, and all that came."""
    until_s, heard = time.monotonic() + seconds, b""
    while (left_s := until_s - time.monotonic()) > 0:
        if not select.select([port_fd], [], [], left_s)[0]:
            break
        try:
            data = os.read(port_fd, 4096)
        except OSError:
            break
        if not data:
            break
        heard += data
        if any(line.startswith(b"ok") for line in heard.split(b"\n")[:-1]):
            return True, heard
    return False, heard


if __name__ == "__main__":
    main()
