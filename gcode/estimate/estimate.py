"""`estimate`: time, filament, bounds of a program."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gcode.estimate import planner_kernels as kernels
from gcode.moves import Program
from gcode.profiles import AxisLimits, PrinterProfile
from gcode.progress import Progress, silent
from gcode.reader import Job, read_job
from gcode.units import filament_area_mm2

# A plain desktop machine, for files whose printer nobody names.
_PLAIN_SPEED = AxisLimits(x=200, y=200, z=12, e=120)
_PLAIN_ACCELERATION = AxisLimits(x=1500, y=1500, z=200, e=5000)
_PLAIN_JERK = AxisLimits(x=8, y=8, z=0.4, e=4.5)
_PLAIN_DIAMETER_MM = 1.75


@dataclass(frozen=True, slots=True)
class Estimate:
    """What a program takes.

    Attributes
    ----------
    print_time_s
        Time of all moves; heating, homing and probing left out.
    filament_mm, filament_mm3
        Filament that ends up in the print and its purge, retraction balanced.
    bounds_mm
        (x_min, y_min, z_min, x_max, y_max, z_max) of the beads.
    """

    print_time_s: float
    filament_mm: float
    filament_mm3: float
    layers: int
    bounds_mm: tuple[float, float, float, float, float, float]


def estimate(
    program: Program | Job,
    printer: PrinterProfile | None = None,
    *,
    progress: Progress = silent,
) -> Estimate:
    """Estimate a program on a printer (a plain one where none is named).

    Raises
    ------
    ReadError
        If it extrudes nothing.

    Examples
    --------
    >>> from pathlib import Path
    >>> import gcode
    >>> job = gcode.Program(Path("job.gcode").read_text(), "prusa")
    >>> cost = gcode.estimate_program(job, gcode.load_setup().printer)
    >>> cost.layers, cost.print_time_s > 60.0
    (45, True)
    """
    diameter_mm = printer.filament_diameter_mm if printer is not None else _PLAIN_DIAMETER_MM
    job = program
    if isinstance(job, Program):
        job = read_job(job, filament_diameter_mm=diameter_mm, progress=progress)
    progress("estimate", 0.0, 1.0)
    speed, acceleration, jerk = (
        (printer.max_speed_mm_s, printer.max_acceleration_mm_s2, printer.max_jerk_mm_s)
        if printer is not None
        else (_PLAIN_SPEED, _PLAIN_ACCELERATION, _PLAIN_JERK)
    )
    steps, pushed, feed = job.moves()
    spent_s = kernels.seconds(
        steps, pushed, feed, _four(speed), _four(acceleration), _four(jerk), acceleration.x
    )
    low = np.minimum(job.beads.start_mm, job.beads.end_mm).min(axis=0)
    high = np.maximum(job.beads.start_mm, job.beads.end_mm).max(axis=0)
    x0, y0, z0, x1, y1, z1 = (float(v) for v in (*low, *high))
    # Filament that was retracted must come forward again before more of it counts.
    position = np.cumsum(pushed)
    used_mm = float(np.maximum.accumulate(np.maximum(position, 0.0))[-1])
    progress("estimate", 1.0, 1.0)
    return Estimate(
        print_time_s=float(spent_s.sum()),
        filament_mm=used_mm,
        filament_mm3=used_mm * filament_area_mm2(diameter_mm),
        layers=len(job.layers),
        bounds_mm=(x0, y0, z0, x1, y1, z1),
    )


def _four(limits: AxisLimits) -> np.ndarray:
    return np.array([limits.x, limits.y, limits.z, limits.e], dtype=np.float64)
