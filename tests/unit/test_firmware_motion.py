"""Motion that an emulated printer writes for another process to read."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from gcode.errors import InputError
from gcode.firmware import serve_forever
from gcode.firmware.motion import MotionFile
from gcode.hosts import connect
from gcode.profiles import load_setup

ROOT = Path(__file__).parents[2]


def test_what_was_carried_out_is_in_the_file_when_it_is_acknowledged(tmp_path: Path) -> None:
    link, path = tmp_path / "printer", tmp_path / "motion.bin"
    command = [
        *(sys.executable, "-c", "from gcode.cli import main; main()", "emulate"),
        *("--accelerated", "--firmware", "prusa", "--link", str(link), "--motion", str(path)),
    ]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    child = subprocess.Popen(command, stdout=subprocess.PIPE, env=environment)
    motion = MotionFile(path)
    try:
        assert child.stdout is not None
        child.stdout.readline()  # the port is there
        printer = connect(str(link), dialect="prusa", baud=load_setup().printer.baud)
        printer.connect()
        for line in ["G28", "M109 S210", "G90", "M83", "G1 X100 Y100 Z0.2 F6000", "M400"]:
            printer.command(line)
        before = motion.take()
        for line in ["G1 X120 Y100 E1.5 F3000", "G1 X120 Y110 E0.5 F3000", "M400"]:
            printer.command(line)
        laid = motion.take()
        printer.close()
    finally:
        child.terminate()
        child.communicate(timeout=10)
    np.testing.assert_allclose(before.end_mm[-1], [100, 100, 0.2])
    assert before.filament_mm.sum() == 0.0
    assert laid.filament_mm.sum() == pytest.approx(2.0)
    np.testing.assert_allclose(laid.start_mm[0], [100, 100, 0.2])
    np.testing.assert_allclose(laid.end_mm[-1], [120, 110, 0.2])
    assert len(motion.take()) == 0


def test_a_row_half_written_waits(tmp_path: Path) -> None:
    path = tmp_path / "motion.bin"
    file = MotionFile(path)
    assert len(file.take()) == 0  # nothing is printed yet
    rows = np.arange(27, dtype=np.float64)
    path.write_bytes(rows.tobytes()[: 2 * 72 + 5])
    assert len(file.take()) == 2
    path.write_bytes(rows.tobytes())
    last = file.take()
    assert len(last) == 1
    assert last.start_mm[0, 0] == 18.0
    assert last.time_s[0] == 26.0


def test_motion_that_cannot_be_written_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="cannot be written"):
        serve_forever(
            load_setup().printer, link=tmp_path / "port", motion=tmp_path / "none" / "motion.bin"
        )
