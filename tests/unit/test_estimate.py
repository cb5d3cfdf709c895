"""Time and filament: against the formula of one move, and the emulated printer's own clock."""

from __future__ import annotations

import math

import numpy as np
import pytest

from gcode.estimate import estimate
from gcode.firmware import FirmwareCore
from gcode.moves import Program
from gcode.profiles import load_printer
from gcode.reader import read_job
from gcode.reader.blocks import blocks_of


def test_one_long_move_takes_what_the_formula_says() -> None:
    printer = load_printer("prusa_mk3s")
    program = Program("G90\nM83\nG1 X0 Y0 Z0.2 F6000\nG1 X100 E4 F6000\n", "prusa")
    a, v = printer.max_acceleration_mm_s2.x, 100.0
    assert estimate(program, printer).print_time_s == pytest.approx(100 / v + v / a, rel=1e-6)


def test_a_text_takes_what_the_job_read_from_it_takes(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(1)
    lines = ["G28", "M83", "G1 X100 Y100 Z0.2 F6000"]
    for k, (x, y, e) in enumerate(rng.uniform(0.0, 5.0, size=(3000, 3))):
        lines += [";LAYER_CHANGE", f"G1 Z{0.2 * k / 500:.1f}"] if k % 500 == 0 else []
        lines.append(f"G1 X{100 + x:.3f} Y{100 + y:.3f} E{e / 50:.4f} F{1200 + k}")
    program = Program("\n".join(lines), "prusa")
    printer = load_printer("prusa_mk3s")
    whole = estimate(read_job(program), printer)
    monkeypatch.setattr(blocks_of, "__defaults__", (1000,))
    assert estimate(program, printer) == whole
    assert whole.layers == 6


def test_filament_pulled_back_is_not_counted_twice() -> None:
    text = "G90\nM83\nG1 X0 Y0 Z0.2\nG1 X10 E1\n" + "G1 E-2\nG1 E2\n" * 5 + "G1 X20 E1\n"
    found = estimate(Program(text, "prusa"))
    assert found.filament_mm == pytest.approx(2.0)
    assert found.filament_mm3 == pytest.approx(2.0 * math.pi / 4 * 1.75**2)


def test_it_agrees_with_the_emulated_printers_clock() -> None:
    printer = load_printer("prusa_mk3s")
    rng = np.random.default_rng(0)
    walk = 100 + np.cumsum(rng.normal(size=(400, 2)), axis=0)
    lines = ["G90", "M83", "G1 X100 Y100 Z0.2 F6000"]
    lines += [f"G1 X{x:.3f} Y{y:.3f} E0.02 F2400" for x, y in walk]
    program = Program("\n".join(lines) + "\n", "prusa")
    core = FirmwareCore(printer, "prusa")
    core.power_up()
    core.feed(b"M302 S0\n" + program.text.encode() + b"M400\n")
    start_s = core.machine.clock_s
    core.run()
    core.drain()
    assert estimate(program, printer).print_time_s == pytest.approx(
        core.machine.clock_s - start_s, rel=0.1
    )
