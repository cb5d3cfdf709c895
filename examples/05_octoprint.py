"""A printer behind OctoPrint: the program is uploaded, printed there, and followed to its end.

OCTOPRINT_API_KEY=… python examples/05_octoprint.py --port octoprint+http://octopi.local

The key comes from the environment or from a private file, never from the command line, where every
process of the machine could read it. Pausing and cancelling there are told apart from an end.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import manifold3d as m3

import gcode


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--port", required=True, help="octoprint+http://HOST[:PORT]")
    parser.add_argument("--printer", default="prusa_mk3s", help="Profile of the machine behind it.")
    parser.add_argument("--out", type=Path, default=Path("out/examples"))
    asked = parser.parse_args()
    asked.out.mkdir(parents=True, exist_ok=True)

    setup = gcode.load_setup(asked.printer, "pla", "repair_0.20")
    x, y = (0.5 * side for side in setup.printer.bed_size_mm)
    tile = m3.Manifold.cube((10.0, 10.0, 0.4)).translate((x, y, 0.0))
    program = gcode.write_program(gcode.slice_part(tile, setup), setup, title="tile")
    checked = gcode.check_program(program, setup)

    printer = gcode.connect(asked.port, wire_log=asked.out / "octoprint.log")
    printer.connect()  # refused where somebody else's print runs
    try:
        now = printer.temperatures()
        print(f"hotend at {now.hotend_c:.0f} °C")
        report = printer.print(checked)
    except BaseException:
        printer.abort()
        raise
    finally:
        printer.close()
    print(f"ok={report.ok}, {report.bytes_sent} bytes uploaded")


if __name__ == "__main__":
    main()
