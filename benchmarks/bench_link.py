"""Lines per second through one pseudo-terminal: our sender beside a bare send-and-wait loop.

Both talk to the same responder, a child that answers `ok` to every line and does nothing else; a
third run goes through the emulated firmware. Run: python benchmarks/bench_link.py [LINES]

Three runs on a shared two-core machine (medians of five, lines/s), which do not agree, because
the scheduler's wake-ups dominate: none of them settles the target of 70 % of the bare loop.

    lines   bare   ours, 1   ours, 4   emulated   ours, 1 / bare
     4000  70392     42966     52075      12033             61 %
     5000  11030      9549     26285       4953             87 %   (one fast path added before)
     8000  15050      8048     28322       4638             53 %
"""

from __future__ import annotations

import os
import platform
import select
import statistics
import subprocess
import sys
import time
import tty
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent.parent / "tests" / "unit"))
from link_helpers import moves, profile

from gcode.firmware import EmulatedPrinterProcess
from gcode.protocol import Link, LinkTiming

ROUNDS = 5
_RESPONDER = """
import os, sys
fd = int(sys.argv[1])
while True:
    data = os.read(fd, 65536)
    os.write(fd, b"ok\\n" * data.count(b"\\n"))
"""


def responder() -> tuple[int, subprocess.Popen[bytes]]:
    master, slave = os.openpty()
    tty.setraw(slave)
    child = subprocess.Popen(
        [sys.executable, "-S", "-c", _RESPONDER, str(master)], pass_fds=(master,)
    )
    os.close(master)
    return slave, child


def bare(fd: int, lines: list[str]) -> float:
    """Write, wait for a newline, no numbers, no checksums."""
    blobs = [line.encode() + b"\n" for line in lines]
    start_s = time.perf_counter()
    for blob in blobs:
        os.write(fd, blob)
        while not os.read(fd, 4096).endswith(b"\n"):
            pass
    return len(lines) / (time.perf_counter() - start_s)


def ours(fd: int, lines: list[str], window: int) -> float:
    """The protocol machine with the serial host's own loop."""
    link, clock, poll = Link(window=window, timing=LinkTiming()), time.monotonic, select.poll()
    poll.register(fd, select.POLLIN)

    def pump() -> None:
        if poll.poll(1000):
            link.receive(os.read(fd, 65536), clock())

    os.write(fd, link.hello(clock()))
    while not link.ready:
        pump()
    time.sleep(0.05)
    link.receive(os.read(fd, 4096), clock()) if poll.poll(0) else None
    start_s = time.perf_counter()
    for line in lines:
        os.write(fd, link.send(line, clock()))
        while not link.ready:
            pump()
    while not link.idle:
        pump()
    return len(lines) / (time.perf_counter() - start_s)


def emulated(lines: list[str]) -> float:
    from link_helpers import program

    import gcode.hosts.serial as host

    host.require_checked = lambda checked: None
    with (
        EmulatedPrinterProcess(printer=profile()) as emulator,
        host.SerialPrinter(emulator.port) as printer,
    ):
        report = printer.print(program(["M302 S0", "M83", *lines]))
        return report.lines_acked / report.seconds


def main() -> None:
    count = int(sys.argv[1]) if len(sys.argv) > 1 else 20_000
    lines = moves(count)
    runs: dict[str, list[float]] = {}
    for _ in range(ROUNDS):
        for name, run in (
            ("bare loop", lambda fd: bare(fd, lines)),
            ("our link, one line", lambda fd: ours(fd, lines, 1)),
            ("our link, window of 4", lambda fd: ours(fd, lines, 4)),
        ):
            fd, child = responder()
            runs.setdefault(name, []).append(run(fd))
            child.kill()
            child.wait()
            os.close(fd)
        runs.setdefault("serial host, emulated firmware", []).append(emulated(lines))
    print(f"{platform.processor() or platform.machine()}, {os.cpu_count()} cores, {count} lines")
    for name, rates in runs.items():
        spread = f"{min(rates):.0f} to {max(rates):.0f}"
        print(f"{name:32s} {statistics.median(rates):8.0f} lines/s   ({spread})")


if __name__ == "__main__":
    main()
