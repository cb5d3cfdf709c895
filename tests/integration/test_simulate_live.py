"""An emulated printer in another process, its motion in a file, a scanner that looks at it."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from amrepair.errors import InputError, ScannerError
from amrepair.frames import Transform
from amrepair.scans.scanner import Scanner, ScanRequest
from amrepair.simulate.live import PrintedScanner
from amrepair.simulate.parameters import load_world
from gcode.firmware.motion import MotionFile
from gcode.hosts import connect
from gcode.profiles import load_setup

ROOT = Path(__file__).parents[2]


def test_what_another_process_prints_is_seen(tmp_path: Path) -> None:
    link, motion = tmp_path / "printer", tmp_path / "motion.bin"
    setup = load_setup()
    eye = PrintedScanner(
        MotionFile(motion),
        printer=setup.printer,
        pose=Transform.identity("build", "scanner"),
        told=load_world(),
        scanner="structured-light",
    )
    assert isinstance(eye, Scanner)
    with pytest.raises(ScannerError, match="empty bed"):
        eye.scan(ScanRequest("early", None, 0.0))
    child = subprocess.Popen(
        [
            *(sys.executable, "-c", "from gcode.cli import main; main()", "emulate"),
            *("--accelerated", "--firmware", "prusa", "--link", str(link)),
            *("--motion", str(motion)),
        ],
        stdout=subprocess.PIPE,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
    )
    try:
        assert child.stdout is not None
        child.stdout.readline()  # the port is there
        printer = connect(str(link), dialect="prusa", baud=setup.printer.baud)
        printer.connect()
        lines = ["G28", "M109 S210", "G90", "M83", "G1 X100 Y100 Z0.2 F6000"]
        section_mm2 = 0.4 * 0.2
        e = 20 * section_mm2 / (np.pi / 4 * 1.75**2)
        for k in range(20):
            y = 100 + 0.4 * k
            lines += [f"G1 X{100 + 20 * (k % 2 == 0)} Y{y:.3f} E{e:.5f} F3000"]
            lines += [f"G1 X{100 + 20 * (k % 2 == 0)} Y{y + 0.4:.3f} F6000"]
        lines += ["G1 Z30 F6000", "M400"]
        for line in lines:
            printer.command(line)
        scan = eye.scan(ScanRequest("layer-000", 0, 0.2))
        printer.close()
    finally:
        child.terminate()
        child.communicate(timeout=10)
    points = eye.build_from_scanner.apply(scan.points_mm)
    inside = (np.abs(points[:, 0] - 110) < 8) & (np.abs(points[:, 1] - 104) < 3)
    # the layer's height, within the calibration's error and the mean of some thousand points
    assert points[inside, 2].mean() == pytest.approx(0.2, abs=0.13)
    assert eye.world.volume_mm3 == pytest.approx(20 * 20 * section_mm2, rel=0.06)  # flow wanders


def test_a_scanner_of_another_kind_is_refused() -> None:
    with pytest.raises(InputError, match="sonar"):
        load_world().scanner("sonar")
