"""A job gone on with over what stands on the bed: a cold machine brought to where its nozzle is.

Z is never homed. It lifts, homes X and Y above everything, heats, primes beside the part, comes
straight down, and says again what the job had set.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from jaxtyping import Float

from gcode.check import CheckedProgram, check, policy_of
from gcode.dialects import dialect_of, fan_command, heaters_off, number
from gcode.errors import InputError
from gcode.moves import ModalState, Program
from gcode.profiles import PrinterProfile, PrintSetup
from gcode.progress import Progress
from gcode.reader import Job
from gcode.resumption.settings import Settings, settings_before
from gcode.slicing.room import bare_place, room_for_line
from gcode.surfaces import HeightField
from gcode.units import filament_area_mm2, mm_min_from_mm_s
from gcode.writer import modes_restored

RESUME_LIFT_MM = 10.0
LEAST_LIFT_MM = 2.0
PRIME_MM3_S = 4.0


@dataclass(frozen=True, slots=True)
class Continued:
    """A checked program that goes on with a job.

    Attributes
    ----------
    hotend_c
        Of the head that prints first.
    primed
        `on the bed`, or `in the air` where the head does not fit beside the part.
    """

    checked: CheckedProgram
    hotend_c: float
    bed_c: float
    primed: str


def continued(
    job: Job,
    line: int,
    body: Sequence[str],
    setup: PrintSetup,
    *,
    state: ModalState,
    standing: HeightField,
    reach: HeightField,
    about: Sequence[str],
    about_printer: Sequence[str],
    progress: Progress,
) -> Continued:
    """Bring a cold machine to where a job's nozzle is before a line, and go on from there.

    Parameters
    ----------
    body
        What is printed then: the job's lines from `line` on, perhaps changed.
    state
        The machine's before them.
    standing, reach
        What stands on the bed; the same on all of the nozzle's reach, where there is to be room to
        prime.
    about
        Comments at the program's head.
    about_printer
        Comment lines that tell of the printer and that stand before `line` in the job.

    Raises
    ------
    InputError, CheckRefusedError
        If there is no room to lift, home or prime; if what would be printed is refused.
    """
    printer, settings = setup.printer, settings_before(job, line)
    hotends_c, bed_c = _temperatures(settings, setup)
    head = Head(setup, state, clear_mm=height_over(standing.top_mm, state, printer))
    told = "Z is not homed: the printer has been on all the time, or has been told its Z anew"
    head.comment(*about, told)
    head.lines += about_printer
    head.lift_and_home(settings)
    head.heat(hotends_c, bed_c)
    primed = _prime(head, reach, printer)
    head.come_down(pulled_back_mm(job, line))
    head.restore(settings)
    off = heaters_off(job.program.dialect, printer.nozzles)
    program = Program("\n".join([*head.lines, *body, *off]) + "\n", job.program.dialect)
    checked = check(
        program, setup, as_built=standing, policy=policy_of(job.program), progress=progress
    )
    return Continued(checked, hotends_c[state.heater], bed_c, primed)


def _prime(head: Head, field: HeightField, printer: PrinterProfile) -> str:
    """Prime where there is room; says where that was."""
    place = room_for_line(field, printer, head.prime_length_mm)
    if place is not None:
        head.prime_on_bed(*place)
        return "on the bed"
    aside = bare_place(field, printer)
    if aside is None:
        raise InputError(
            "There is no bare place on the bed to prime at; take something off the bed and leave "
            "it out of the job."
        )
    head.prime_in_air(*aside)
    return "in the air"


def _temperatures(settings: Settings, setup: PrintSetup) -> tuple[tuple[float, ...], float]:
    """The job's own, of each head and the bed; the material's where a macro keeps them secret."""
    hotends_c = (setup.material.hotend_c if c is None else c for c in settings.hotends_c)
    bed_c = setup.material.bed_c if settings.bed_c is None else settings.bed_c
    return tuple(hotends_c), min(bed_c, setup.printer.max_bed_c)


def height_over(top_mm: float, state: ModalState, printer: PrinterProfile) -> float:
    """Height at which the nozzle passes over everything."""
    top_mm = max(top_mm, state.position_mm[2])
    clear_mm = min(top_mm + RESUME_LIFT_MM, printer.max_z_mm)
    if clear_mm < top_mm + LEAST_LIFT_MM:
        raise InputError(
            f"The part stands {top_mm:g} mm high and the nozzle goes up to {printer.max_z_mm:g} "
            f"mm: there is no room to home X and Y above it, {LEAST_LIFT_MM:g} mm are needed."
        )
    return round(clear_mm, 3)


def filament_back_mm(job: Job) -> Float[np.ndarray, " m"]:
    """(m + 1,) filament that is back in the nozzle before each line of a job, and at its end.

    Another filament is loaded as far as it has to be, by whatever changes it; a head keeps its own.
    """
    if job.nozzles > 1:
        return _back_by_head_mm(job)
    pushed_mm = np.concatenate([[0.0], np.cumsum(job.moves()[1])])
    starts = [0, *(np.flatnonzero(np.diff(job.tools)) + 1), len(pushed_mm)]
    back_mm = np.empty(len(pushed_mm))
    for first, end in pairwise(starts):
        of_one_mm = pushed_mm[first:end]
        back_mm[first:end] = np.maximum.accumulate(of_one_mm) - of_one_mm
    return back_mm


def _back_by_head_mm(job: Job) -> Float[np.ndarray, " m"]:
    pushed_mm, tools = job.moves()[1], job.tools
    back_mm = np.zeros(len(tools))
    for tool in np.unique(tools):
        own_mm = np.where(tools[:-1] == tool, pushed_mm, 0.0)
        so_far_mm = np.concatenate([[0.0], np.cumsum(own_mm)])
        of_head_mm = np.maximum.accumulate(so_far_mm) - so_far_mm
        back_mm[tools == tool] = of_head_mm[tools == tool]
    return back_mm


def pulled_back_mm(job: Job, line: int) -> float:
    """Filament that the job has pulled back and not yet pushed out again."""
    return float(filament_back_mm(job)[line])


def state_at_rest(job: Job, line: int, *, paused_mm: float = 0.0) -> ModalState:
    """The machine's state after lines [0, line) of a job, with what filament is pulled back.

    By the job, and `paused_mm` more by the pause in which it rests.
    """
    return replace(job.state_after(line), pulled_mm=pulled_back_mm(job, line) + paused_mm)


class Head:
    """The lines that bring the machine to where the job's nozzle was."""

    def __init__(self, setup: PrintSetup, state: ModalState, *, clear_mm: float) -> None:
        self.lines: list[str] = []
        self._state, self._clear_mm = state, clear_mm
        self._printer = setup.printer
        self._area_mm2 = filament_area_mm2(setup.printer.filament_diameter_mm)
        self._section_mm2 = 0.5 * setup.printer.max_bead_section_mm2
        self._flow_mm3_s = min(PRIME_MM3_S, setup.max_volumetric_mm3_s)
        self._travel = f" F{feed(setup.printer.travel_speed_mm_s)}"
        self._z_feed = f" F{feed(setup.printer.z_speed_mm_s)}"

    @property
    def prime_length_mm(self) -> float:
        """Length of the line that the profile's priming filament makes."""
        return self._printer.prime_length_mm * self._area_mm2 / self._section_mm2

    def comment(self, *texts: str) -> None:
        """Write comment lines."""
        self.lines += [f"; {text}" for text in texts]

    def lift_and_home(self, settings: Settings) -> None:
        """Lift above everything, then home X and Y; never Z."""
        self.lines += ["G21", "G90", "M83", "G92 E0"]
        self.lines += [f"G1 Z{number(self._clear_mm, 3)}{self._z_feed}", "G28 X Y"]
        if settings.levelled and (mesh_again := dialect_of(self._printer.dialect).mesh_again):
            self.lines.append(mesh_again)

    def heat(self, hotends_c: Sequence[float], bed_c: float) -> None:
        """Bed first, the nozzle above the bed's edge meanwhile.

        Of several heads the one that printed is taken before it is heated, as it may lie in its
        dock, and each other one is as hot as the job had it, so that the job may take it at any
        time; of several filaments to one nozzle a hot one takes its own.
        """
        x, y, _ = self._printer.park_mm
        docked = self._printer.docks
        if docked:
            self.lines.append(f"T{self._state.tool}")
            self.lines.append(f"G1 Z{number(self._clear_mm, 3)}{self._z_feed}")
        if bed_c > 0:
            self.lines.append(f"M140 S{number(bed_c, 1)}")
        own, others = (
            self._state.heater,
            {k: number(c, 1) for k, c in enumerate(hotends_c) if c > 0},
        )
        hotend = others.pop(own, "0")
        heats, waits = dialect_of(self._printer.dialect).head_heats
        self.lines += [heats.format(k=k, c=target) for k, target in others.items()]
        self.lines.append(f"G1 X{number(x, 3)} Y{number(y, 3)}{self._travel}")
        if bed_c > 0:
            self.lines.append(f"M190 S{number(bed_c, 1)}")
        self.lines.append(f"M104 S{hotend}")
        self.lines += [waits.format(k=k, c=target) for k, target in others.items()]
        self.lines.append(f"M109 S{hotend}")
        if self._state.tool and not docked:
            self.lines.append(f"T{self._state.tool}")

    def prime_on_bed(self, x: float, y: float, dx: float, dy: float) -> None:
        """Draw a line on the bed, then lift."""
        length_mm, e_mm = self.prime_length_mm, self._printer.prime_length_mm
        self.lines += [
            f"G1 X{number(x, 3)} Y{number(y, 3)}{self._travel}",
            f"G1 Z{number(self._printer.prime_mm[2], 3)}{self._z_feed}",
            f"G1 X{number(x + dx * length_mm, 3)} Y{number(y + dy * length_mm, 3)}"
            f" E{number(e_mm, 5)} F{feed(self._flow_mm3_s / self._section_mm2)}",
        ]
        self._leave()

    def prime_in_air(self, x: float, y: float) -> None:
        """Push out filament that falls on the bare bed."""
        e_mm = self._printer.prime_length_mm
        speed_mm_s = self._flow_mm3_s / self._area_mm2
        self.lines += [
            f"G1 X{number(x, 3)} Y{number(y, 3)}{self._travel}",
            f"G1 E{number(e_mm, 5)} F{feed(speed_mm_s)}",
        ]
        self._leave()

    def _leave(self) -> None:
        self._filament(-self._printer.retraction_mm)
        self.lines.append(f"G1 Z{number(self._clear_mm, 3)}{self._z_feed}")

    def _filament(self, length_mm: float) -> None:
        if abs(length_mm) >= 5e-6:
            speed = feed(self._printer.retraction_speed_mm_s)
            self.lines.append(f"G1 E{number(length_mm, 5)} F{speed}")

    def come_down(self, pulled_mm: float) -> None:
        """Over everything, then straight down, the filament as the job had it."""
        x, y, z = self._state.position_mm
        self.lines += [
            f"G1 X{number(x, 5)} Y{number(y, 5)}{self._travel}",
            f"G1 Z{number(z, 5)}{self._z_feed}",
        ]
        self._filament(self._printer.retraction_mm - pulled_mm)

    def restore(self, settings: Settings) -> None:
        """Limits, fan, extruder position, feed and modes, as the job set them."""
        state = self._state
        self.lines += settings.commands
        self.lines.append(fan_command(state.fan_ratio))
        self.lines += modes_restored(state)


def feed(speed_mm_s: float) -> str:
    """A speed as F has it, mm/min, never 0."""
    return number(max(1.0, mm_min_from_mm_s(speed_mm_s)), 0)
