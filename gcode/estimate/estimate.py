"""`estimate`: time, filament, bounds of a program, read block by block."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gcode.errors import ReadError
from gcode.estimate import planner_kernels as kernels
from gcode.moves import Program
from gcode.profiles import AxisLimits, PrinterProfile
from gcode.progress import Progress, silent
from gcode.reader import Job
from gcode.reader.blocks import Block, blocks_of
from gcode.reader.job import NOTHING_LAID, layers_of, mark_of
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
    blocks = (program.block,) if isinstance(program, Job) else blocks_of(program)
    text = program.program.text if isinstance(program, Job) else program.text
    lines = text.count("\n") + 1
    taken = _Taken(printer, lines)
    for block in blocks:
        taken.add(block)
        progress("estimate", float(block.end_line), float(lines))
    return taken.told(diameter_mm)


class _Taken:
    """What the blocks of a program take so far: a few figures of each line, no states."""

    def __init__(self, printer: PrinterProfile | None, lines: int) -> None:
        speed, acceleration, jerk = (
            (printer.max_speed_mm_s, printer.max_acceleration_mm_s2, printer.max_jerk_mm_s)
            if printer is not None
            else (_PLAIN_SPEED, _PLAIN_ACCELERATION, _PLAIN_JERK)
        )
        self._limits = [np.array(one.xyze) for one in (speed, acceleration, jerk)]
        self._before = np.zeros(6)
        self._planned = np.zeros((4, lines))
        self._lines = 0
        self._pushed_mm = self._most_pushed_mm = 0.0
        self._marks: list[tuple[int, str]] = []
        self._laid = 0
        self._end_z_mm, self._filament_mm = np.zeros(lines), np.zeros(lines)
        self._line = np.zeros(lines, np.int64)
        self._box = np.array([[np.inf] * 3, [-np.inf] * 3])

    def add(self, block: Block) -> None:
        """The next one."""
        steps, pushed, feed = block.moves()
        pushed = np.ascontiguousarray(pushed)
        kernels.limits(
            steps, pushed, feed, *self._limits, self._before, self._planned, block.first_line
        )
        self._lines = block.end_line
        # Filament that was retracted must come forward again before more of it counts.
        sums_mm = np.cumsum(np.concatenate([[self._pushed_mm], pushed]))
        self._pushed_mm = float(sums_mm[-1])
        self._most_pushed_mm = max(self._most_pushed_mm, float(sums_mm.max()))
        self._marks += [(k, text) for k, text in block.comments if mark_of(text) is not None]
        self._keep(block)
        for ends_mm in (block.start_mm, block.end_mm):
            if len(ends_mm):
                np.minimum(self._box[0], ends_mm.min(axis=0), out=self._box[0])
                np.maximum(self._box[1], ends_mm.max(axis=0), out=self._box[1])

    def _keep(self, block: Block) -> None:
        """Of what extrudes where it ends, its line and its filament; of an arc's chords each."""
        first, self._laid = self._laid, self._laid + len(block.line)
        if self._laid > len(self._line):
            more = max(self._laid - len(self._line), len(self._line))
            self._end_z_mm = np.append(self._end_z_mm, np.zeros(more))
            self._filament_mm = np.append(self._filament_mm, np.zeros(more))
            self._line = np.append(self._line, np.zeros(more, np.int64))
        self._end_z_mm[first : self._laid] = block.end_mm[:, 2]
        self._filament_mm[first : self._laid] = block.filament_mm
        self._line[first : self._laid] = block.line

    def told(self, diameter_mm: float) -> Estimate:
        """All of them together.

        Raises
        ------
        ReadError
            If nothing is extruded.
        """
        if self._laid == 0:
            raise ReadError(NOTHING_LAID)
        spent_s = float(kernels.seconds(self._planned).sum())
        del self._planned  # half of what is held
        own = slice(self._laid)
        layers = layers_of(
            self._marks, self._end_z_mm[own], self._line[own], self._filament_mm[own], self._lines
        )
        used_mm = self._most_pushed_mm
        x0, y0, z0, x1, y1, z1 = (float(v) for v in self._box.ravel())
        return Estimate(
            print_time_s=spent_s,
            filament_mm=used_mm,
            filament_mm3=used_mm * filament_area_mm2(diameter_mm),
            layers=len(layers),
            bounds_mm=(x0, y0, z0, x1, y1, z1),
        )
