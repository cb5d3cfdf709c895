"""A printer profile and programs for the tests of the link."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

from gcode.hosts.port import PrintReport
from gcode.hosts.serial import SerialPrinter
from gcode.moves import Program
from gcode.profiles import AxisLimits, EnvelopeSlice, PrinterProfile


def profile() -> PrinterProfile:
    """A plain Cartesian printer that extrudes cold, independent of the profile files."""
    return PrinterProfile(
        id="test",
        name="test",
        dialect="marlin",
        bed_size_mm=(200.0, 200.0),
        max_z_mm=200.0,
        nozzle_diameter_mm=0.4,
        max_speed_mm_s=AxisLimits(x=200, y=200, z=12, e=120),
        max_acceleration_mm_s2=AxisLimits(x=1000, y=1000, z=200, e=5000),
        max_jerk_mm_s=AxisLimits(x=8, y=8, z=2, e=4.5),
        max_hotend_c=280,
        min_extrude_c=0,
        max_bed_c=110,
        max_volumetric_mm3_s=15,
        max_bead_section_mm2=0.64,
        max_extrude_only_mm=50,
        travel_speed_mm_s=150,
        z_speed_mm_s=12,
        retraction_mm=0.8,
        retraction_speed_mm_s=35,
        z_hop_mm=0.2,
        park_mm=(5, 190, 150),
        prime_mm=(5, 5, 0.3),
        prime_length_mm=8,
        envelope=(
            EnvelopeSlice(part="nozzle", z_from_mm=0, polygon_mm=((-1, -1), (1, -1), (0, 1))),
        ),
        start_gcode=(),
        end_gcode=(),
    )


@dataclass(frozen=True)
class Unjudged:
    """A program that stands in for a checked one where the link alone is tested."""

    program: Program

    @cached_property
    def _lines(self) -> list[str]:
        return self.program.text.split("\n")

    def lines(self, first: int, end: int) -> list[str]:
        return self._lines[first:end]


def program(lines: list[str]) -> Unjudged:
    return Unjudged(Program("\n".join(lines) + "\n", "marlin"))


def moves(count: int) -> list[str]:
    """Short moves around a square, all different."""
    return [
        f"G1 X{50 + (i * 7919 % 1000) / 10:.2f} Y{50 + (i * 104729 % 1000) / 10:.2f} E0.01"
        for i in range(count)
    ]


def print_with_a_pause(
    printer: SerialPrinter,
    lines: list[str],
    meanwhile: Callable[[], object] = lambda: None,
    *,
    pauses: int = 1,
) -> PrintReport:
    """Pause on the way, so often at once; once it rests, do something, and go on."""
    asked = threading.Event()

    def tell(stage: str, count: float, total: float) -> None:
        if count and not asked.is_set():
            for _ in range(pauses):
                printer.pause()
            asked.set()

    def go_on() -> None:
        asked.wait(20)
        while "paused" not in printer.notes:
            asked.wait(0.01)
        meanwhile()
        printer.resume()

    thread = threading.Thread(target=go_on)
    thread.start()
    try:
        return printer.print(program(lines), progress=tell)
    finally:
        thread.join(20)
