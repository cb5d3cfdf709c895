"""A job moved up to stand on a part that stands on the bed already.

Every height of the job is raised by what stands under its first layer; X and Y stay. Z is not
homed; the beginning is as in `resume_at`, and the checker judges all of it with the part.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from gcode.dialects import command_of, number
from gcode.errors import InputError
from gcode.moves import Program
from gcode.profiles import PrintSetup
from gcode.progress import Progress, silent
from gcode.reader import Job, job_for
from gcode.resumption.head import Continued, continued
from gcode.resumption.standing import over_reach
from gcode.stretches import places_along
from gcode.surfaces import HeightField

ONTO_STEP_MM = 0.5  # along the first layer's beads
UNEVEN_RATIO = 0.5  # of a layer: what the first one bridges or is pressed into
HELD_RATIO = 0.98  # of the first layer that must lie on something
TOP_PERCENT = 95.0  # what is higher are single points of a scan's noise
_Z = re.compile(r"([Zz])\s*([-+]?(?:\d+\.?\d*|\.\d+))")


@dataclass(frozen=True, slots=True)
class Stacked(Continued):
    """A checked program that prints a job onto a part.

    Attributes
    ----------
    raised_mm
        How much higher it prints.
    uneven_mm
        How far what is under its first layer lies below that height, at most where it is held.
    """

    raised_mm: float
    uneven_mm: float


def print_onto(
    program: Program,
    setup: PrintSetup,
    standing: HeightField,
    *,
    title: str = "a job",
    about_printer: Sequence[str] = (),
    progress: Progress = silent,
) -> Stacked:
    """Move a job up onto what stands there.

    Parameters
    ----------
    program
        The whole job, of any slicer, placed in X and Y where it is to stand on the part.
    standing
        What stands on the bed, build frame.
    about_printer
        Comment lines of the program that tell for which printer it is.

    Raises
    ------
    InputError
        If nothing stands under the job's first layer, it is not flat, or there is no room above.
    CheckRefusedError
        If the checker refuses what comes out.
    """
    job = job_for(program, setup.printer, progress)
    raised_mm, uneven_mm = _height_under(job, standing)
    line = job.layers[0].first_line
    state = job.state_after(line)
    x, y, z = state.position_mm
    lines = program.text.rstrip().split("\n")[line:]
    made = continued(
        job, line, _raised(lines, raised_mm, absolute=state.absolute_xyz, first=line), setup,
        state=replace(state, position_mm=(x, y, z + raised_mm)),
        standing=standing, reach=over_reach(standing, setup.printer),
        about=[f"{title}, raised by {raised_mm:g} mm onto what stands there"],
        about_printer=about_printer, progress=progress,
    )  # fmt: skip
    return Stacked(made.checked, made.hotend_c, made.bed_c, made.primed, raised_mm, uneven_mm)


def _height_under(job: Job, standing: HeightField) -> tuple[float, float]:
    """How high the first layer is to be raised, and how uneven what is under it is."""
    beads = job.beads
    own = beads.layer == 0
    places, _ = places_along(beads.start_mm[own], beads.end_mm[own], ONTO_STEP_MM)
    under_mm = standing.sample(places[:, :2])
    top_mm = float(np.percentile(under_mm, TOP_PERCENT))
    layer_mm = max(job.layers[0].height_mm, 0.05)
    if top_mm < layer_mm:
        raise InputError(
            f"Nothing stands under the job's first layer (the highest is {top_mm:.2f} mm); place "
            "the job in X and Y where the part stands, in the slicer."
        )
    low_mm = top_mm - UNEVEN_RATIO * layer_mm
    held = under_mm >= low_mm
    share = float(held.mean())
    if share < HELD_RATIO:
        raise InputError(
            f"{1 - share:.0%} of the job's first layer would hang in the air: what stands under it "
            f"is {under_mm.min():.2f} to {top_mm:.2f} mm high, half a layer "
            f"({UNEVEN_RATIO * layer_mm:.2f} mm) may be uneven; slice it without skirt and brim, "
            "or move it onto a flat."
        )
    return round(top_mm, 3), round(top_mm - float(under_mm[held].min()), 3)


def _raised(lines: list[str], by_mm: float, *, absolute: bool, first: int) -> list[str]:
    """Lines with their absolute heights raised."""
    out = []
    for number_, line in enumerate(lines, first + 1):
        code, mark, comment = line.partition(";")
        name, rest = command_of(code)
        if name in ("G90", "G91"):
            absolute = name == "G90"
        shifts = name == "G92" and "Z" in rest
        homes_z = name == "G28" and ("Z" in rest or not {"X", "Y"} & set(rest))
        if shifts or homes_z or name == "G20":
            raise InputError(
                f"Line {number_} ({code.strip()!r}) changes what a height means, and cannot be "
                "raised; slice the job without it."
            )
        if absolute and name in ("G0", "G1", "G2", "G3"):
            code = _Z.sub(lambda m: f"{m.group(1)}{number(float(m.group(2)) + by_mm, 5)}", code)
        out.append(f"{code}{mark}{comment}")
    return out
