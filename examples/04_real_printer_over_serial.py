"""A printer on a serial port: check, connect, print with a journal, end cold.

python examples/04_real_printer_over_serial.py                      an emulated printer
python examples/04_real_printer_over_serial.py --port /dev/ttyACM0  a real one (it homes and heats)

The emulated printer loses an `ok` and garbles a line on purpose: the link finds out and mends it.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import manifold3d as m3

import gcode
from gcode.firmware import EmulatedPrinterProcess, parse_faults
from gcode.profiles import PrinterProfile

FAULTS = """
line 40 lose_ok
line 90 corrupt_in
"""


@contextmanager
def port_of(asked: str | None, printer: PrinterProfile) -> Iterator[str]:
    """The port asked for, or an emulated printer's pseudo-terminal."""
    if asked is not None:
        yield asked
        return
    script = parse_faults(FAULTS)
    with EmulatedPrinterProcess(printer.dialect, printer=printer, faults=script) as machine:
        yield machine.port


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--port", help="Device of a real printer.")
    parser.add_argument("--printer", default="prusa_mk3s", help="Its profile.")
    parser.add_argument("--out", type=Path, default=Path("out/examples"))
    asked = parser.parse_args()
    asked.out.mkdir(parents=True, exist_ok=True)

    setup = gcode.load_setup(asked.printer, "pla", "repair_0.20")
    x, y = (0.5 * side for side in setup.printer.bed_size_mm)
    tile = m3.Manifold.cube((12.0, 12.0, 0.8)).translate((x, y, 0.0))
    program = gcode.write_program(gcode.slice_part(tile, setup), setup, title="tile")
    checked = gcode.check_program(program, setup)  # nothing unchecked can be sent
    cost = gcode.estimate_program(program, setup.printer)
    print(f"{cost.print_time_s:.0f} s and {cost.filament_mm:.0f} mm of filament")

    with port_of(asked.port, setup.printer) as port:
        printer = gcode.connect(
            port,
            dialect=setup.printer.dialect,
            baud=setup.printer.baud,
            wire_log=asked.out / "wire.log",
            journal=asked.out / "job.journal",
        )
        printer.connect()
        try:
            print(f"connected to {printer.capabilities().firmware}")
            report = printer.print(checked)
            printer.finish_moves()
            now = printer.temperatures()
        except BaseException:
            printer.abort()  # heaters off, whatever it was
            raise
        finally:
            printer.close()
    print(f"{report.lines_acked} lines acknowledged, {report.resends} resent, ok={report.ok}")
    print(f"hotend target {now.hotend_target_c:g} °C, bed target {now.bed_target_c or 0:g} °C")


if __name__ == "__main__":
    main()
