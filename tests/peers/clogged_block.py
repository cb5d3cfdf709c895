"""A slicer's job of a block, a nozzle that clogs in it, and what must have become of it."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

from gcode.firmware.motion import MotionFile

SLICER = """\
gcode_flavor = {flavour}
bed_shape = 0x0,220x0,220x220,0x220
use_relative_e_distances = 1
layer_gcode = ;AFTER_LAYER\\nG92 E0
layer_height = 0.2
first_layer_height = 0.2
fill_density = 100%
fill_pattern = rectilinear
skirts = 0
temperature = 210
first_layer_temperature = 210
bed_temperature = 60
first_layer_bed_temperature = 60
retract_length = 0.8
start_gcode = G28\\nM190 S[first_layer_bed_temperature]\\nM109 S[first_layer_temperature]
end_gcode = G91\\nG1 Z10 F600\\nG90\\nG1 X10 Y200 F6000\\nM104 S0\\nM140 S0\\nM107
"""
CLOG_MM = (106.0, 107.0, 2.3, 114.0, 114.0, 3.05)
PRUSA_SLICER = shutil.which("prusa-slicer")
ENVIRONMENT = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
AMREPAIR = (sys.executable, "-m", "amrepair")
GCODE = (sys.executable, "-m", "gcode")


def command(*words: str | Path) -> None:
    """One of the user's commands."""
    done = subprocess.run(
        [str(word) for word in words], capture_output=True, text=True, check=False, timeout=300,
        env=ENVIRONMENT,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr


def sliced(
    folder: Path,
    *,
    flavour: str,
    reads: str,
    size_mm: tuple[float, float, float] = (24.0, 20.0, 4.0),
    at_mm: tuple[str, ...] = ("3",),
    copies: int = 1,
) -> Path:
    """The first two of the user's commands: slice, and put looks in; copies are labelled."""
    part, job, settings = folder / "block.stl", folder / "block.gcode", folder / "slicer.ini"
    trimesh.creation.box(size_mm).export(part)
    settings.write_text(SLICER.format(flavour=flavour))
    more = ["--duplicate", str(copies), "--gcode-label-objects"] if copies > 1 else []
    command(str(PRUSA_SLICER), "--export-gcode", "--load", settings, "--center", "110,110",
            *more, "--output", job, part)  # fmt: skip
    looks = [word for z in at_mm for word in ("--at-z", z)]
    command(*AMREPAIR, "postprocess", "--for", reads, "--every", "0", *looks, "--no-final", job)
    return job


def filament_of(lines: list[str]) -> float:
    """What lines push, mm; all of them are relative."""
    pushed = (re.search(r"^G1 .*E([-\d.]+)", line) for line in lines)
    return sum(float(found.group(1)) for found in pushed if found is not None)


def judge(motion: Path, job: Path, look: str, *, within: float = 0.3) -> None:
    """What the firmware executed: the void is filled, and no line of the job came twice.

    `within` is for what straddles the void's edges, and what the scanner has not seen.
    """
    batch = MotionFile(motion).take()
    area_mm2 = np.pi / 4 * 1.75**2
    middle = 0.5 * (batch.start_mm + batch.end_mm)
    low, high = np.array(CLOG_MM[:3]), np.array(CLOG_MM[3:])
    level = np.hypot(*(batch.end_mm - batch.start_mm)[:, :2].T) > 0  # beads, not retractions
    inside = ((middle > low) & (middle < high)).all(axis=1) & level
    clogged_mm3 = float(np.prod(high[:2] - low[:2])) * 0.8  # layers at 2.4 to 3.0 mm
    filled_mm3 = float(batch.filament_mm[inside].sum()) * area_mm2
    told = f"filled {filled_mm3:.1f} of {clogged_mm3:.1f} mm³"
    print(told)
    assert filled_mm3 == pytest.approx(clogged_mm3, rel=within), told
    lines = job.read_text().split("\n")
    first = next(k for k, line in enumerate(lines) if line.startswith(look))
    above = batch.end_mm[:, 2] > 3.15
    planned = [line for line in lines[first:] if re.match(r"G1 (X|Y).*E", line)]
    assert float(batch.filament_mm[above & level].sum()) == pytest.approx(
        filament_of(planned), rel=1e-4
    )


def events(folder: Path) -> list[dict[str, Any]]:
    """The run's record so far."""
    runs = list((folder / "runs").glob("*/run.jsonl"))
    return [json.loads(line) for line in runs[0].read_text().splitlines()] if runs else []
