"""Lines per second through one pseudo-terminal: our sender beside a bare send-and-wait loop.

Both talk to a responder, a child that answers every line and does nothing else. They take turns
every 500 lines, so that whatever else the machine does happens to both; the share is the bare
loop's time over ours, of all turns together, and the median of the turns.
Run: python benchmarks/bench_link.py [LINES] [ROUNDS]
"""

from __future__ import annotations

import os
import platform
import select
import statistics
import subprocess
import sys
import tempfile
import time
import tty
from collections.abc import Callable
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent.parent / "tests" / "unit"))
from link_helpers import moves, profile, program

import gcode.hosts.serial as host
from gcode.firmware import EmulatedPrinterProcess
from gcode.hosts.journal import Journal
from gcode.protocol import Link, LinkTiming

TURN_LINES = host.BATCH_LINES
_RESPONDER = """
import os, re, sys
fd = int(sys.argv[1])
says = {b"M114": b"X:0 Y:0 Z:0 E:0\\n", b"M115": b"FIRMWARE_NAME:responder\\n"}
question = re.compile(rb"M11[45]")
while True:
    data = os.read(fd, 65536)
    if b"M11" in data:
        for word in question.findall(data):
            os.write(fd, says[word])
    os.write(fd, b"ok\\n" * data.count(b"\\n"))
"""


class Responder:
    """A child behind a pseudo-terminal that answers `ok` to every line."""

    def __enter__(self) -> Responder:
        master, self.fd = os.openpty()
        tty.setraw(self.fd)
        self._child = subprocess.Popen(
            [sys.executable, "-S", "-c", _RESPONDER, str(master)], pass_fds=(master,)
        )
        os.close(master)
        return self

    def __exit__(self, *_: object) -> None:
        self._child.kill()
        self._child.wait()
        os.close(self.fd)

    @property
    def path(self) -> str:
        return os.ttyname(self.fd)


class BareLoop:
    """Write, wait for a newline; no numbers, no checksums, no deadline."""

    def __init__(self, fd: int, lines: list[str]) -> None:
        self._fd = fd
        self._blobs = [line.encode() + b"\n" for line in lines]
        os.write(fd, b"\n")
        os.read(fd, 4096)  # it is there
        self.turns_s: list[float] = []

    def turn(self) -> None:
        """Send the next lines."""
        fd = self._fd
        first = len(self.turns_s) * TURN_LINES
        start_s = time.perf_counter()
        for blob in self._blobs[first : first + TURN_LINES]:
            os.write(fd, blob)
            while not os.read(fd, 4096).endswith(b"\n"):
                pass
        self.turns_s.append(time.perf_counter() - start_s)


class Turns:
    """Times of ours, with a turn of the bare loop after each of them."""

    def __init__(self, loop: BareLoop) -> None:
        self._loop = loop
        self._since_s = 0.0
        self.ours_s: list[float] = []

    def __call__(self, stage: str, done: float, total: float) -> None:
        """Called every `TURN_LINES` lines, at the beginning and at the end."""
        if done:
            self.ours_s.append(time.perf_counter() - self._since_s)
            self._loop.turn()
        self._since_s = time.perf_counter()

    def rates(self) -> tuple[float, float, float, float]:
        """Ours and the bare loop's lines/s; share of all turns; median share."""
        bare_s = self._loop.turns_s
        ours, bare = (TURN_LINES * len(bare_s) / sum(times) for times in (self.ours_s, bare_s))
        shares = [b / o for o, b in zip(self.ours_s, bare_s, strict=True)]
        return ours, bare, ours / bare, statistics.median(shares)


def machine(lines: list[str], window: int, turns: Turns) -> None:
    """The protocol machine in the smallest loop that drives it."""
    link, clock, poll = Link(window=window, timing=LinkTiming()), time.monotonic, select.poll()
    with Responder() as responder:
        fd = responder.fd
        poll.register(fd, select.POLLIN)

        def pump() -> None:
            if poll.poll(1000):
                link.receive(os.read(fd, 65536), clock())

        os.write(fd, link.hello(clock()))
        while not link.ready:
            pump()
        while poll.poll(50):
            link.receive(os.read(fd, 4096), clock())
        for first in range(0, len(lines), TURN_LINES):
            turns("", first, 0)
            for line in link.prepare(lines[first : first + TURN_LINES]):
                os.write(fd, link.send(line, clock()))
                while not link.ready:
                    pump()
        while not link.idle:
            pump()
        turns("", len(lines), 0)


def sender(lines: list[str], window: int, turns: Turns, *, journal: bool) -> None:
    """`SerialPrinter.print`."""
    with Responder() as responder, tempfile.TemporaryDirectory() as folder:
        book = Journal(Path(folder) / "journal.sqlite") if journal else None
        printer = host.SerialPrinter(
            responder.path, window=window, journal=book, guard=False, supervise=False
        )
        with printer:
            printer.print(program(lines), progress=turns)


def emulated(lines: list[str]) -> float:
    """The same through the emulated firmware, which plans and executes every move."""
    with (
        EmulatedPrinterProcess(printer=profile()) as emulator,
        host.SerialPrinter(emulator.port) as printer,
    ):
        report = printer.print(program(["M302 S0", "M83", *lines]))
        return report.lines_acked / report.seconds


def main() -> None:
    count = int(sys.argv[1]) if len(sys.argv) > 1 else 20_000
    rounds = int(sys.argv[2]) if len(sys.argv) > 2 else 5
    host.require_checked = lambda checked: None
    lines = moves(count)
    runs: dict[str, Callable[[Turns], None]] = {
        "protocol machine, one line": lambda turns: machine(lines, 1, turns),
        "protocol machine, window of 4": lambda turns: machine(lines, 4, turns),
        "serial host, one line": lambda turns: sender(lines, 1, turns, journal=False),
        "serial host, journal, one line": lambda turns: sender(lines, 1, turns, journal=True),
        "serial host, journal, window of 4": lambda turns: sender(lines, 4, turns, journal=True),
    }
    print(f"{platform.processor() or platform.machine()}, {os.cpu_count()} cores, {count} lines,")
    print(f"load {os.getloadavg()[0]:.1f}, median of {rounds} rounds")
    print(f"{'':34s} {'lines/s':>8s} {'bare':>8s} {'share':>6s} {'median turn':>12s}")
    for name, run in runs.items():
        rates = []
        for _ in range(rounds):
            with Responder() as responder:
                turns = Turns(BareLoop(responder.fd, lines))
                run(turns)
                rates.append(turns.rates())
        ours, bare, share, turn = (statistics.median(column) for column in zip(*rates, strict=True))
        print(f"{name:34s} {ours:8.0f} {bare:8.0f} {share:6.0%} {turn:12.0%}", flush=True)
    rate = statistics.median(emulated(lines) for _ in range(rounds))
    print(f"{'serial host, emulated firmware':34s} {rate:8.0f}")


if __name__ == "__main__":
    main()
