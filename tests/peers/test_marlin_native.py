"""Our sender prints on a native Marlin: nobody here wrote what answers."""

from __future__ import annotations

import math
import os
import signal
import threading
import time
from dataclasses import replace
from pathlib import Path

import pytest
from link_helpers import program
from native_marlin import NativeMarlin, Nozzle, profile
from void_loop import fills_a_void

import gcode.hosts.serial as serial_host
from gcode.errors import PrinterError
from gcode.firmware import MotionBatch
from gcode.hosts.serial import SerialPrinter
from gcode.profiles import load_setup

pytestmark = pytest.mark.peers

MOVES = [
    f"G1 X{100 + 40 * math.cos(i / 20):.3f} Y{100 + 40 * math.sin(i / 17):.3f}" for i in range(400)
]
HEAD = ["G21", "G90", "M83", "G28", "G1 Z5 F300", "G1 F12000"]


@pytest.fixture(autouse=True)
def _no_proof(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(serial_host, "require_checked", lambda checked: None)


@pytest.mark.parametrize(
    ("damage", "seed"), [(0.0, 0), (0.002, 1), (0.005, 2), (0.005, 3), (0.005, 4)]
)
def test_every_line_is_carried_out_once_and_in_order(
    tmp_path: Path, damage: float, seed: int
) -> None:
    with (
        NativeMarlin(tmp_path, damage=damage, seed=seed) as marlin,
        SerialPrinter(marlin.port) as printer,
    ):
        report = printer.print(program([*HEAD, *MOVES]))
        place = printer.position_mm()
    assert report.ok
    assert [line for line in marlin.executed if line.startswith("G1 X")] == MOVES
    last = dict(zip("XY", (float(word[1:]) for word in MOVES[-1].split()[1:]), strict=True))
    assert place == pytest.approx((last["X"], last["Y"], 5.0), abs=0.006)  # it says two decimals
    print(f"{damage:.1%} of bytes: {report.resends} resent, {report.stalls} stalls")


def test_an_interrupt_leaves_its_heaters_off(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with NativeMarlin(tmp_path) as marlin:
        printer = SerialPrinter(marlin.port, supervise=False)

        def interrupt() -> None:
            while MOVES[40] not in marlin.executed:
                time.sleep(0.05)
            os.kill(os.getpid(), signal.SIGINT)

        threading.Thread(target=interrupt, daemon=True).start()
        with pytest.raises(KeyboardInterrupt), printer:
            printer.print(program([*HEAD[:3], "M104 S80", *HEAD[3:], *MOVES]))
        time.sleep(0.5)
    assert "printer: heaters off (the printer reports targets of 0), nozzle lifted" in caplog.text
    assert marlin.executed[-1].startswith("M105")
    assert MOVES[-1] not in marlin.executed


def test_inches_that_it_was_built_without_end_the_job(tmp_path: Path) -> None:
    """As its default configuration has it: INCH_MODE_SUPPORT is off."""
    with NativeMarlin(tmp_path) as marlin:
        printer = SerialPrinter(marlin.port, supervise=False)
        with pytest.raises(PrinterError, match="does not know G20"), printer:
            printer.print(program([*HEAD, "G20", "G1 X2 Y2"]))
    assert "G1 X2 Y2" not in marlin.executed


@pytest.mark.timeout(900)  # it moves in real time
def test_a_void_is_found_and_filled(tmp_path: Path) -> None:
    setup = replace(load_setup(process="repair_0.20"), printer=profile(tmp_path))
    nozzle = Nozzle()
    with NativeMarlin(tmp_path) as marlin:

        def moved() -> MotionBatch:
            told, marlin.executed[:] = marlin.executed[:], []
            return nozzle.follow(told)

        fills_a_void(
            setup, marlin.port, moved,
            dialect="marlin", baud=115200, wire_log=tmp_path / "wire.log",
        )  # fmt: skip
