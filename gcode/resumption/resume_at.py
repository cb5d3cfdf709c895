"""A job from a layer on, for a part that already stands there up to that layer.

Z is never homed: it must still be true. The head is lifted above everything first, homes X and Y
there, is heated and primed beside the part, travels above everything and comes straight down to
where the job's nozzle was; modes, extruder, fan, limits are the job's, and so is every line from
there on, unchanged. The result is judged by the checker with what stands there.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from gcode.check import CheckedProgram, check, policy_of
from gcode.dialects import number
from gcode.errors import InputError
from gcode.moves import ModalState, Program
from gcode.profiles import PrinterProfile, PrintSetup
from gcode.progress import Progress, silent
from gcode.reader import Job, read_job
from gcode.reader.job import JobLayer
from gcode.resumption.settings import Settings, settings_before
from gcode.resumption.standing import standing_field
from gcode.slicing.room import bare_place, room_for_line
from gcode.surfaces import HeightField
from gcode.units import filament_area_mm2, mm_min_from_mm_s

LIFT_MM = 10.0
LEAST_LIFT_MM = 2.0
PRIME_MM3_S = 4.0
SAME_LAYER = 0.5
"""A measured height means the nearest layer: parts shrink, and bend."""


@dataclass(frozen=True, slots=True)
class Resumption:
    """A checked program that goes on with a job.

    Attributes
    ----------
    layer
        The first layer that is printed.
    first_line
        The job's line that the program goes on with, from 0.
    standing
        What must stand on the bed already.
    primed
        `on the bed`, or `in the air` where the head does not fit beside the part.
    """

    checked: CheckedProgram
    standing: HeightField
    layer: JobLayer
    first_line: int
    hotend_c: float
    bed_c: float
    primed: str


def resume_at(
    program: Program,
    setup: PrintSetup,
    *,
    z_mm: float | None = None,
    layer: int | None = None,
    title: str = "a job",
    progress: Progress = silent,
) -> Resumption:
    """Make the job that is left when a part stands up to a layer.

    Parameters
    ----------
    program
        The whole job, of any slicer.
    z_mm
        Height of what stands there; the layers up to it are left out.
    layer
        Instead of a height: index of the first layer to be printed, from 0.

    Raises
    ------
    InputError
        If there is no such layer, or no room to lift, home or prime.
    ReadError, CheckRefusedError
        If the job cannot be understood, or what would be printed is refused.
    """
    diameter_mm = setup.printer.filament_diameter_mm
    job = read_job(program, filament_diameter_mm=diameter_mm, progress=progress)
    progress("what stands", 0.0, 1.0)
    first = first_layer(job, z_mm, layer)
    line = first.first_line
    state, settings = job.state_after(line), settings_before(job, line)
    field = standing_field(job.beads, line, setup.printer)
    progress("what stands", 1.0, 1.0)
    hotend_c, bed_c = _temperatures(settings, setup)
    head = _Head(setup, state, clear_mm=clear_mm(field.top_mm, state, setup.printer))
    head.comment(
        f"{title}, from layer {first.index} on, whose top is at {first.z_mm:g} mm",
        f"up to {field.top_mm:g} mm the part stands there already",
        "Z is not homed: the printer has been on all the time, or has been told its Z anew",
    )
    head.lift_and_home(settings)
    head.heat(hotend_c, bed_c)
    primed = _prime(head, field, setup.printer)
    head.come_down(_pulled_mm(job, line))
    head.restore(settings)
    body = program.text.rstrip().split("\n")[line:]
    text = "\n".join([*head.lines, *body, "M104 S0", "M140 S0", "M107"]) + "\n"
    whole = Program(text, program.dialect)
    return Resumption(
        checked=check(whole, setup, as_built=field, policy=policy_of(program), progress=progress),
        standing=field,
        layer=first,
        first_line=line,
        hotend_c=hotend_c,
        bed_c=bed_c,
        primed=primed,
    )


def _prime(head: _Head, field: HeightField, printer: PrinterProfile) -> str:
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


def first_layer(job: Job, z_mm: float | None, index: int | None) -> JobLayer:
    """The first layer that is left to print, by the height that stands there or its index."""
    layers = job.layers
    if (z_mm is None) == (index is None):
        raise InputError("Say either a height or a layer to go on from, one of the two.")
    if z_mm is not None:
        tops = [one.z_mm for one in layers]
        if any(b < a for a, b in pairwise(tops)):
            raise InputError(
                "The job prints one object after another, so that a height names no single "
                "layer; name the layer instead."
            )
        over = [one for one in layers if one.z_mm - z_mm > SAME_LAYER * one.height_mm]
        if not over:
            raise InputError(
                f"At {z_mm:g} mm nothing is left to print: the job's last layer ends at "
                f"{tops[-1]:g} mm."
            )
        index = over[0].index
    if not 0 <= (index or 0) < len(layers):
        raise InputError(
            f"There is no layer {index}; the job has layers 0 to {len(layers) - 1}, up to "
            f"{layers[-1].z_mm:g} mm."
        )
    if index == 0:
        raise InputError("Before the first layer nothing stands there; send the whole job.")
    return layers[index or 0]


def _temperatures(settings: Settings, setup: PrintSetup) -> tuple[float, float]:
    """The job's own; the material's where a macro keeps them to itself."""
    hotend_c = settings.hotend_c or setup.material.hotend_c
    bed_c = setup.material.bed_c if settings.bed_c is None else settings.bed_c
    return hotend_c, min(bed_c, setup.printer.max_bed_c)


def clear_mm(top_mm: float, state: ModalState, printer: PrinterProfile) -> float:
    """Height at which the nozzle passes over everything."""
    top_mm = max(top_mm, state.position_mm[2])
    clear_mm = min(top_mm + LIFT_MM, printer.max_z_mm)
    if clear_mm < top_mm + LEAST_LIFT_MM:
        raise InputError(
            f"The part stands {top_mm:g} mm high and the nozzle goes up to {printer.max_z_mm:g} "
            f"mm: there is no room to home X and Y above it, {LEAST_LIFT_MM:g} mm are needed."
        )
    return round(clear_mm, 3)


def _pulled_mm(job: Job, line: int) -> float:
    """Filament that the job has pulled back and not yet pushed out again."""
    pulled_mm = 0.0
    pushed = job.moves()[1][:line]
    for step in pushed[np.flatnonzero(pushed)]:
        pulled_mm = max(0.0, pulled_mm - float(step))
    return pulled_mm


class _Head:
    """The lines that bring the machine to where the job's nozzle was."""

    def __init__(self, setup: PrintSetup, state: ModalState, *, clear_mm: float) -> None:
        self.lines: list[str] = []
        self._state, self._clear_mm = state, clear_mm
        self._printer = setup.printer
        self._area_mm2 = filament_area_mm2(setup.printer.filament_diameter_mm)
        self._section_mm2 = 0.5 * setup.printer.max_bead_section_mm2
        self._flow_mm3_s = min(PRIME_MM3_S, setup.max_volumetric_mm3_s)
        self._travel = f" F{_feed(setup.printer.travel_speed_mm_s)}"
        self._z_feed = f" F{_feed(setup.printer.z_speed_mm_s)}"

    @property
    def prime_length_mm(self) -> float:
        """Length of the line that the profile's priming filament makes."""
        return self._printer.prime_length_mm * self._area_mm2 / self._section_mm2

    def comment(self, *texts: str) -> None:
        """Comments."""
        self.lines += [f"; {text}" for text in texts]

    def lift_and_home(self, settings: Settings) -> None:
        """Above everything, then X and Y; never Z."""
        self.lines += ["G21", "G90", "M83", "G92 E0"]
        self.lines += [f"G1 Z{number(self._clear_mm, 3)}{self._z_feed}", "G28 X Y"]
        if settings.levelled and self._printer.dialect == "marlin":
            self.lines.append("M420 S1")  # Marlin's G28 switches the mesh off (G28.md)

    def heat(self, hotend_c: float, bed_c: float) -> None:
        """Bed first, the nozzle above the bed's edge meanwhile."""
        x, y, _ = self._printer.park_mm
        if bed_c > 0:
            self.lines.append(f"M140 S{number(bed_c, 1)}")
        self.lines.append(f"G1 X{number(x, 3)} Y{number(y, 3)}{self._travel}")
        if bed_c > 0:
            self.lines.append(f"M190 S{number(bed_c, 1)}")
        self.lines += [f"M104 S{number(hotend_c, 1)}", f"M109 S{number(hotend_c, 1)}"]
        if self._state.tool:
            self.lines.append(f"T{self._state.tool}")

    def prime_on_bed(self, x: float, y: float, dx: float, dy: float) -> None:
        """A line on the bed, then up again."""
        length_mm, e_mm = self.prime_length_mm, self._printer.prime_length_mm
        self.lines += [
            f"G1 X{number(x, 3)} Y{number(y, 3)}{self._travel}",
            f"G1 Z{number(self._printer.prime_mm[2], 3)}{self._z_feed}",
            f"G1 X{number(x + dx * length_mm, 3)} Y{number(y + dy * length_mm, 3)}"
            f" E{number(e_mm, 5)} F{_feed(self._flow_mm3_s / self._section_mm2)}",
        ]
        self._leave()

    def prime_in_air(self, x: float, y: float) -> None:
        """What is pushed out falls on the bare bed."""
        e_mm = self._printer.prime_length_mm
        speed_mm_s = self._flow_mm3_s / self._area_mm2
        self.lines += [
            f"G1 X{number(x, 3)} Y{number(y, 3)}{self._travel}",
            f"G1 E{number(e_mm, 5)} F{_feed(speed_mm_s)}",
        ]
        self._leave()

    def _leave(self) -> None:
        self._filament(-self._printer.retraction_mm)
        self.lines.append(f"G1 Z{number(self._clear_mm, 3)}{self._z_feed}")

    def _filament(self, length_mm: float) -> None:
        if abs(length_mm) >= 5e-6:
            feed = _feed(self._printer.retraction_speed_mm_s)
            self.lines.append(f"G1 E{number(length_mm, 5)} F{feed}")

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
        self.lines.append(
            f"M106 S{round(255 * state.fan_ratio)}" if state.fan_ratio > 0 else "M107"
        )
        self.lines.append(f"G92 E{number(state.e_mm, 5)}")
        if state.feed_mm_s > 0:
            self.lines.append(f"G1 F{number(mm_min_from_mm_s(state.feed_mm_s), 1)}")
        if not state.absolute_xyz:
            self.lines.append("G91")
        self.lines.append("M82" if state.absolute_e else "M83")  # after G90 and G91, always
        if not state.units_mm:
            self.lines.append("G20")


def _feed(speed_mm_s: float) -> str:
    return number(max(1.0, mm_min_from_mm_s(speed_mm_s)), 0)
