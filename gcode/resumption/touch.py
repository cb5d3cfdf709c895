"""Z found anew on a standing part by touching a flat of it that its job knows.

Nobody knows Z after a power loss, and homing it would drive the nozzle into the part. The job tells
where the last layer is solid, and how high; there the nozzle itself feels for it, never deeper
than planned. It makes the programs; `hosts.touching` carries them out.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from scipy import ndimage

from gcode.check import CheckedProgram, Touch, check
from gcode.check.touches import TOUCH_COMMANDS
from gcode.dialects import dialect_of, number
from gcode.errors import InputError
from gcode.moves import Program
from gcode.profiles import PrinterProfile, PrintSetup, ProbeProfile
from gcode.progress import Progress, silent
from gcode.reader import job_for
from gcode.reader.job import Beads, JobLayer
from gcode.resumption.head import RESUME_LIFT_MM, feed, height_over
from gcode.resumption.resume_at import first_layer
from gcode.resumption.settings import settings_before
from gcode.resumption.standing import standing_field
from gcode.stretches import places_to_ends
from gcode.surfaces import HeightField

FLAT_CELL_MM = 0.2
FLAT_SLACK_MM = 0.01
"""Beads of one layer lie at one height, within the digits of the text; a spiral's do not."""


@dataclass(frozen=True, slots=True)
class TouchOptions:
    """Physical sizes of a touch.

    Attributes
    ----------
    doubt_mm
        How well a nozzle's height is told by eye and a ruler.
    over_mm
        How far below that a first touch goes on before it is given up.
    fine_mm
        The same of touches after the first, when the height is known.
    flat_mm
        Least diameter of a flat: the end of a nozzle (1 mm) and a millimetre on each side, for
        where X and Y are homed to.
    agree_mm
        Most by which two touches may differ: what they feel is no flat, or something gives way.
    coverage
        The stated uncertainty is so many standard deviations.
    """

    doubt_mm: float = 1.0
    over_mm: float = 0.5
    fine_mm: float = 0.3
    flat_mm: float = 3.0
    agree_mm: float = 0.1
    coverage: float = 2.0


@dataclass(frozen=True, slots=True)
class Touching:
    """What to touch, and the programs that do.

    Attributes
    ----------
    layer
        The last complete layer, whose top is felt.
    places_mm
        (2, 2) XY of the two touches, build frame; the first of all is at the first.
    flat_mm
        Diameter of the largest disc that is solid there.
    coarse
        One touch, when the height is known by eye.
    fine
        Both touches, when it is known by the first.
    standing
        What stands there.
    probe
        What feels it.
    """

    layer: JobLayer
    places_mm: Float[np.ndarray, "2 2"]
    flat_mm: float
    coarse: CheckedProgram
    fine: CheckedProgram
    standing: HeightField
    probe: ProbeProfile
    options: TouchOptions


def plan_touch(
    program: Program,
    setup: PrintSetup,
    *,
    above_mm: float,
    z_mm: float | None = None,
    layer: int | None = None,
    progress: Progress = silent,
) -> Touching:
    """Plan how Z is found anew on what stands of a job.

    Parameters
    ----------
    above_mm
        How high the nozzle stands above the part's top now, by eye, within `TouchOptions.doubt_mm`.
    z_mm, layer
        As for `resume_at`: height of what stands there, or the first layer to be printed.

    Raises
    ------
    InputError
        If the firmware has no such touch, the nozzle is too low or too high, the job has no such
        layer or it no flat.
    CheckRefusedError
        If the checker refuses the touches.
    """
    printer, options = setup.printer, TouchOptions()
    _refuse_impossible(printer, above_mm, options)
    job = job_for(program, printer, progress)
    first = first_layer(job, z_mm, layer)
    last = job.layers[first.index - 1]
    places_mm, across_mm = _flat(job.beads, last, options)
    field = standing_field(job.beads, first.first_line, printer)
    levelled = settings_before(job, first.first_line).levelled  # and the job goes on with the mesh
    mesh_again = dialect_of(printer.dialect).mesh_again if levelled else ""
    high_mm = height_over(field.top_mm, job.state_after(first.first_line), printer)

    def made(where: Float[np.ndarray, "k 2"], below_mm: float) -> CheckedProgram:
        touches = tuple(
            Touch(float(x), float(y), last.z_mm, last.z_mm - below_mm) for x, y in where
        )
        text = _text(touches, setup, high_mm, mesh_again)
        whole = Program(text, program.dialect)
        return check(whole, setup, as_built=field, touches=touches, progress=progress)

    return Touching(
        layer=last,
        places_mm=places_mm,
        flat_mm=across_mm,
        coarse=made(places_mm[:1], options.doubt_mm + options.over_mm),
        fine=made(places_mm, options.fine_mm),
        standing=field,
        probe=printer.feeler,
        options=options,
    )


def _refuse_impossible(printer: PrinterProfile, above_mm: float, options: TouchOptions) -> None:
    """Raise where no nozzle feels by such a touch, or it stands too low or too high."""
    if printer.dialect not in TOUCH_COMMANDS:
        raise InputError(
            f"{printer.id} speaks {printer.dialect}, whose probing goes as deep as its own "
            f"configuration says: nothing could stop it above the part; set Z by hand, with paper "
            f"between nozzle and part, or use a printer whose touches can be told how deep "
            f"(Marlin, RepRapFirmware, Klipper)."
        )
    if printer.feeler.kind != "nozzle":
        raise InputError(
            f"{printer.name} feels with a {printer.feeler.kind} beside its nozzle, whose own "
            f"height that does not tell to a few hundredths of a millimetre; set Z by hand, with "
            f"paper below the nozzle."
        )
    if not 2 * options.doubt_mm <= above_mm <= RESUME_LIFT_MM:
        raise InputError(
            f"--above-mm is {above_mm:g}; turn Z by hand until the nozzle stands "
            f"{2 * options.doubt_mm:g} to {RESUME_LIFT_MM:g} mm above the part's top."
        )


def _text(touches: tuple[Touch, ...], setup: PrintSetup, high_mm: float, mesh_again: str) -> str:
    """Above everything, X and Y homed; over each place, down to it, and up again."""
    z_feed = f" F{feed(setup.printer.z_speed_mm_s)}"
    travel = f" F{feed(setup.printer.travel_speed_mm_s)}"
    up = f"G1 Z{number(high_mm, 3)}{z_feed}"
    lines = ["; Z found anew: heaters off, never deeper than planned", "G21", "G90", "M83", up]
    lines += ["G28 X Y", mesh_again] if mesh_again else ["G28 X Y"]
    for touch in touches:
        lines += [
            f"G1 X{number(touch.x_mm, 3)} Y{number(touch.y_mm, 3)}{travel}",
            touch_line(setup.printer, from_mm=high_mm, lowest_mm=touch.lowest_mm),
            up,
        ]
    return "\n".join(lines) + "\n"


def touch_line(printer: PrinterProfile, *, from_mm: float, lowest_mm: float) -> str:
    """The line that feels straight down from one height, to another at the deepest."""
    probe = printer.feeler
    if TOUCH_COMMANDS[printer.dialect] == "AMREPAIR_TOUCH":
        depth = number(from_mm - lowest_mm, 3)
        return f"AMREPAIR_TOUCH DEPTH={depth} SPEED={number(probe.speed_mm_s, 3)}"
    return f"G38.2 Z{number(lowest_mm, 3)} F{feed(probe.speed_mm_s)}"


def _flat(
    beads: Beads, layer: JobLayer, options: TouchOptions
) -> tuple[Float[np.ndarray, "2 2"], float]:
    """Two places on the largest flat of a layer, and how wide it is there, mm."""
    origin, solid = _solid(beads, layer)
    inside_mm = (
        FLAT_CELL_MM * ndimage.distance_transform_edt(solid) if solid.size else np.zeros((1, 1))
    )
    row, column = np.unravel_index(int(inside_mm.argmax()), inside_mm.shape)
    across_mm = 2.0 * float(inside_mm[row, column])
    if across_mm < options.flat_mm:
        raise InputError(
            f"The last layer that stands there (top at {layer.z_mm:g} mm) is solid over "
            f"{across_mm:.1f} mm at most, and a touch needs a flat of {options.flat_mm:g} mm; set "
            f"Z by hand, with paper between nozzle and part."
        )
    islands, _ = ndimage.label(inside_mm >= 0.5 * options.flat_mm)
    rows, columns = np.nonzero(islands == islands[row, column])
    away = np.hypot(rows - row, columns - column)
    other = int(away.argmax())
    cells = np.array([[column, row], [columns[other], rows[other]]], dtype=float)
    return origin + (cells + 0.5) * FLAT_CELL_MM, across_mm


def _solid(
    beads: Beads, layer: JobLayer
) -> tuple[Float[np.ndarray, " 2"], Bool[np.ndarray, "ny nx"]]:
    """Where a layer's beads lie side by side at its height: origin, mm, and cells."""
    pick = (beads.layer == layer.index) & (np.abs(beads.end_mm[:, 2] - layer.z_mm) <= FLAT_SLACK_MM)
    start, end = beads.start_mm[pick][:, :2], beads.end_mm[pick][:, :2]
    if not len(start):
        return np.zeros(2), np.zeros((0, 0), dtype=bool)
    half_mm = 0.5 * float(np.median(beads.width_mm[pick]))
    points, _ = places_to_ends(start, end, 0.5 * FLAT_CELL_MM)
    rim = 2 * math.ceil(half_mm / FLAT_CELL_MM) + 1
    origin = np.floor(points.min(axis=0) / FLAT_CELL_MM) * FLAT_CELL_MM - rim * FLAT_CELL_MM
    cells = ((points - origin) / FLAT_CELL_MM).astype(np.int64)
    free = np.ones(cells.max(axis=0)[::-1] + 1 + rim, dtype=bool)
    free[cells[:, 1], cells[:, 0]] = False
    return origin, FLAT_CELL_MM * ndimage.distance_transform_edt(free) <= half_mm
