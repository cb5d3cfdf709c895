"""`amrepair calibrate --port`: the target is printed through the serial adapter, then scanned."""

from __future__ import annotations

import json
import threading
import time
from pathlib import Path

import numpy as np
import pytest
import trimesh

from amrepair.cli import pose_calibration
from amrepair.frames import Transform, rotation_from_vector
from amrepair.loop.calibrate import read_calibration, target_solid
from gcode.firmware import EmulatedPrinterProcess
from gcode.profiles import load_printer

IDS = ("prusa_mk3s", "pla", "repair_0.20")


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_the_scanner_is_found_from_a_printed_target(tmp_path: Path) -> None:
    printer = load_printer(IDS[0])
    target = target_solid(printer).to_mesh64()
    mesh = trimesh.Trimesh(np.array(target.vert_properties)[:, :3], np.array(target.tri_verts))
    points, _ = trimesh.sample.sample_surface(mesh, 60_000, seed=1)
    rng = np.random.default_rng(0)
    x, y = printer.bed_size_mm
    bed = np.column_stack([rng.uniform(0, x, 60_000), rng.uniform(0, y, 60_000), np.zeros(60_000)])
    seen = np.concatenate([np.asarray(points)[np.asarray(points)[:, 2] > 0.05], bed])
    pose = Transform.from_rotation_translation(
        "build", "scanner", rotation=rotation_from_vector(np.array([0.1, -0.05, 2.0])),
        translation_mm=np.array([30.0, -12.0, 8.0]),
    )  # fmt: skip
    noisy = pose.inverse().apply(seen + rng.normal(scale=0.03, size=seen.shape))
    drop, out = tmp_path / "scans", tmp_path / "calibration.json"
    drop.mkdir()
    over = threading.Event()

    def look() -> None:
        """A sensor that looks every second: while the target is printed it sees a bare bed."""
        k = 0
        while not over.wait(1.0):
            k += 1
            whole = machine.clock_s() > finished_s
            cloud = noisy if whole else pose.inverse().apply(bed)
            jitter = rng.normal(scale=1e-4, size=(1, 3))
            np.save(tmp_path / "aside.npy", (cloud + jitter) / 1000.0)  # as robots have it: metres
            (tmp_path / "aside.npy").rename(drop / f"{k:04d}.npy")

    with EmulatedPrinterProcess("prusa", printer=printer) as machine:
        finished_s = 0.7 * calibrating_seconds()
        eye = threading.Thread(target=look)
        eye.start()
        began = time.monotonic()
        try:
            source = pose_calibration.Source(
                machine.port, f"watch:{drop}", None, None, 0, 60.0, "m"
            )
            pose_calibration.run(out, IDS, source, max_residual_mm=0.15, seed=0, as_json=False)
        finally:
            over.set()
            eye.join()
        print(f"{machine.clock_s():.0f} s of the printer's clock in {time.monotonic() - began:.0f}")
        laid_mm = float(machine.take_motion().filament_mm.clip(min=0).sum())
    assert laid_mm > 100.0  # the target was printed
    found, unit = read_calibration(out)
    assert unit == "m"  # so the loop reads this scanner's files
    off = found @ pose.inverse()
    corners = np.array([[0.0, 0, 0], [x, 0, 0], [0, y, 0], [x, y, 0]])
    assert np.abs(off.apply(corners) - corners).max() < 0.1
    assert json.loads(out.read_text())["residual_mm"] < 0.15


def calibrating_seconds() -> float:
    """How long the target takes to print."""
    from gcode.estimate import estimate
    from gcode.profiles import load_setup

    setup = load_setup(*IDS)
    program = pose_calibration._target(setup).program
    return estimate(program, setup.printer).print_time_s
