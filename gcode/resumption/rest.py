"""What is left of a job that is under way when some of its objects are given up.

The nozzle rests beside the job. From there it goes, lifted over all that stands there, to where the
job lays its next bead of another object; so it does over every gap that an object leaves, and on
every travel of the job that would cross what stands of one. Filament is as far back as the job has
it, fans, limits and temperatures are as its lines say.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np
from jaxtyping import Bool, Int

from gcode.check import CheckedProgram, check, policy_of
from gcode.dialects import number
from gcode.errors import InputError
from gcode.moves import ModalState, Program
from gcode.profiles import PrintSetup
from gcode.reader import Job, JobObjects, objects_of, read_job
from gcode.reader.objects import box_of_beads_mm
from gcode.resumption.head import feed, filament_back_mm
from gcode.resumption.leaving_out import (
    LEAST_MOVE_MM,
    MOVE_OR_ARC,
    modes_as,
    require_same_head,
)
from gcode.stretches import stretches_of
from gcode.surfaces import HeightField

OVER_PART_MM = 2.0
"""Over all that stands there: what has come loose once may stand up a little more."""
OFF_OBJECT_MM = 5.0
"""Around what stands of an object: half a nozzle's tip and a strand."""
_FIRMWARE_RETRACTION = re.compile(r"^\s*[Gg]1[01](?!\d)", re.MULTILINE)


@dataclass(frozen=True, slots=True)
class Rest:
    """A job from a line on, without some of its objects.

    Attributes
    ----------
    job
        The lines before, and the rest: as if it had been sliced so.
    checked
        The rest alone, beginning where the nozzle rests.
    first_line
        Of `job`: the rest's first.
    line_of
        (m + 1,) by line of the job before, and its end: the line of `job` that stands for it.
    """

    job: Job
    checked: CheckedProgram
    first_line: int
    line_of: Int[np.ndarray, " m"]


def rest_without(
    job: Job,
    names: Sequence[str],
    setup: PrintSetup,
    *,
    first: int,
    parked: ModalState,
    pulled_mm: float,
    standing: HeightField,
    stops: Sequence[int] = (),
) -> Rest:
    """What is printed from here on where some objects are given up.

    Parameters
    ----------
    names
        Objects of the job of which nothing more is laid.
    first
        The job's next line.
    parked
        The machine's state now, beside the job.
    pulled_mm
        Filament that is back in the nozzle now.
    standing
        What stands on the bed, of the given up objects too.
    stops
        Lines of the job before which the nozzle will rest again.

    Raises
    ------
    InputError
        If nothing would be left, the job retracts by its firmware, or it changes heads over a gap.
    CheckRefusedError
        If what is left cannot be printed past what stands there.
    """
    lines = job.program.text.split("\n")
    if _FIRMWARE_RETRACTION.search("\n".join(lines[first:])):
        raise InputError("the job retracts by G10 and G11, which cannot be followed over a gap")
    objects = objects_of(job)
    given_up = objects.own(names)
    later = job.beads.line >= first
    if not (later & ~given_up).any():
        raise InputError("nothing of the job would be left")
    pen = _Pen(job, setup, first, given_up & ~later, standing, pulled_mm)
    for start, stop, kept in _pieces(job, given_up, first, stops):
        (pen.keep if kept else pen.pass_over)(start, stop)
    pen.line_of[len(lines) - 1 :] = first + len(pen.text)
    pen.line_of[:first] = np.arange(first)
    rest = "\n".join(pen.text) + "\n"
    checked = check(
        Program(rest, job.program.dialect), setup, as_built=standing, initial=parked,
        policy=policy_of(job.program),
    )  # fmt: skip
    before = "".join(f"{line}\n" for line in lines[:first])
    whole = read_job(
        Program(before + checked.program.text, job.program.dialect),
        filament_diameter_mm=job.filament_diameter_mm,
        nozzles=job.nozzles,
    )
    return Rest(whole, checked, first, pen.line_of)


def given_up_box_mm(
    job: Job, given_up: Bool[np.ndarray, " n"]
) -> tuple[float, float, float, float] | None:
    """(x_min, y_min, x_max, y_max) of some beads and what is beside them; None where none are."""
    if not given_up.any():
        return None
    x0, y0, x1, y1 = box_of_beads_mm(job, given_up)
    return x0 - OFF_OBJECT_MM, y0 - OFF_OBJECT_MM, x1 + OFF_OBJECT_MM, y1 + OFF_OBJECT_MM


def _pieces(
    job: Job, given_up: Bool[np.ndarray, " n"], first: int, stops: Sequence[int]
) -> list[tuple[int, int, bool]]:
    """Lines [start, stop) that are kept, or passed over; the first are always passed over.

    A gap reaches to the next bead that is kept, so that the nozzle goes there at once; a stop
    within it parts it.
    """
    later = np.flatnonzero(job.beads.line >= first)
    kept, lines = ~given_up[later], job.beads.line[later]
    pieces: list[tuple[int, int, bool]] = []
    at, end = first, job.program.line_count

    def gap(until: int) -> None:
        bounds = [at, *(s for s in sorted(stops) if at < s < until), until]
        pieces.extend((a, b, False) for a, b in pairwise(bounds))

    for start, stop in stretches_of(kept):
        gap(int(lines[start]))
        last = stop == len(lines)
        at = end if last else int(lines[stop - 1]) + 1
        pieces.append((int(lines[start]), at, True))
    if at < end:  # the end script is everybody's
        gap(job.footer_start_line)
        pieces.append((job.footer_start_line, end, True))
    return pieces


@dataclass(slots=True)
class _Pen:
    """The rest's text so far."""

    job: Job
    setup: PrintSetup
    first: int
    gone: Bool[np.ndarray, " n"]
    standing: HeightField
    pulled_mm: float
    text: list[str] = field(default_factory=list)
    line_of: Int[np.ndarray, " m"] = field(init=False)
    _lines: list[str] = field(init=False)
    _pushed_mm: np.ndarray = field(init=False)
    _back_mm: np.ndarray = field(init=False)
    _box_mm: tuple[float, float, float, float] | None = field(init=False)

    def __post_init__(self) -> None:
        self._lines = self.job.program.text.split("\n")
        self.line_of = np.zeros(len(self._lines) + 1, dtype=np.int64)
        self._pushed_mm = self.job.moves()[1]
        self._back_mm = filament_back_mm(self.job)
        self._box_mm = given_up_box_mm(self.job, self.gone)

    def pass_over(self, start: int, stop: int) -> None:
        """Lay nothing, and go, lifted, to where the job is after it."""
        for line in range(start, stop):
            self._note(line)
            if not MOVE_OR_ARC.match(self._lines[line]):
                self.text.append(self._lines[line])
        require_same_head(self.job, start, stop)
        after, machine = self.job.state_after(stop), self.setup.printer
        more_mm = machine.retraction_mm - self.pulled_mm
        self.text += ["G90", "M83"]
        if more_mm > LEAST_MOVE_MM:
            self._push(-more_mm)
        up, *there = self._way_to(after.position_mm)
        self.text.append(up)
        if self._lays_next(stop):
            self.text += there
            self._push(self.pulled_mm - self._as_the_job(stop))
        self.text += modes_as(after)

    def keep(self, start: int, stop: int) -> None:
        """The job's own lines; travels over what stands of a given up object are lifted."""
        steps = self.job.moves()[0]
        for line in range(start, stop):
            self._note(line)
            crossing = (
                np.isfinite(steps[line]).all()
                and np.hypot(*steps[line, :2]) > 0
                and self._pushed_mm[line] == 0
                and self._crosses(line)
            )
            self.text += self._lifted(line) if crossing else [self._lines[line]]
        self.pulled_mm = self._as_the_job(stop)

    def _note(self, line: int) -> None:
        self.line_of[line] = self.first + len(self.text)

    def _lays_next(self, line: int) -> bool:
        return bool(np.isin(line, self.job.beads.line))

    def _as_the_job(self, line: int) -> float:
        """Filament that is back in the job before a line."""
        return float(self._back_mm[line])

    def _push(self, filament_mm: float) -> None:
        if abs(filament_mm) >= LEAST_MOVE_MM:
            speed = feed(self.setup.printer.retraction_speed_mm_s)
            self.text.append(f"G1 E{number(filament_mm, 5)} F{speed}")
            self.pulled_mm -= filament_mm

    def _over(self, z_mm: float) -> float:
        """A height over all that stands there and is laid meanwhile."""
        return min(max(self.standing.top_mm, z_mm) + OVER_PART_MM, self.setup.printer.max_z_mm)

    def _crosses(self, line: int) -> bool:
        """Whether a travel passes what stands of a given up object, not above it."""
        box = self._box_mm
        before, after = self.job.state_after(line), self.job.state_after(line + 1)
        if box is None or not before.absolute_xyz or not after.units_mm:
            return False
        if min(before.position_mm[2], after.position_mm[2]) > self.standing.top_mm + OVER_PART_MM:
            return False
        start, end = np.array(before.position_mm[:2]), np.array(after.position_mm[:2])
        share = np.linspace(0.0, 1.0, max(2, int(np.hypot(*(end - start))) + 1))[:, None]
        on = start + share * (end - start)
        return bool(((on >= box[:2]) & (on <= box[2:])).all(axis=1).any())

    def _lifted(self, line: int) -> list[str]:
        after = self.job.state_after(line + 1)
        found = self._way_to(after.position_mm)
        return [*found, f"G1 F{feed(after.feed_mm_s)}"] if after.feed_mm_s > 0 else found

    def _way_to(self, place_mm: tuple[float, float, float]) -> list[str]:
        """Up over all that stands there, across, and straight down."""
        machine, (x, y, z) = self.setup.printer, place_mm
        down = f"F{feed(machine.z_speed_mm_s)}"
        return [
            f"G1 Z{number(self._over(z), 3)} {down}",
            f"G1 X{number(x, 5)} Y{number(y, 5)} F{feed(machine.travel_speed_mm_s)}",
            f"G1 Z{number(z, 5)} {down}",
        ]


def without_beads(job: Job, objects: JobObjects, names: Sequence[str], first: int) -> Job:
    """The same job, as far as what it lays is asked for: of some objects nothing from a line on."""
    gone = objects.own(names)
    return replace(job, beads=job.beads.subset(~(gone & (job.beads.line >= first))))
