"""A job from a layer on, for a part that already stands there up to that layer.

Z is never homed: it must still be true. The head is lifted above everything first, homes X and Y
there, is heated and primed beside the part, travels above everything and comes straight down to
where the job's nozzle was; modes, extruder, fan, limits are the job's, and so is every line from
there on, unchanged. The result is judged by the checker with what stands there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

from gcode.errors import InputError
from gcode.moves import Program
from gcode.profiles import PrintSetup
from gcode.progress import Progress, silent
from gcode.reader import Job, job_for
from gcode.reader.job import JobLayer
from gcode.resumption.head import Continued, continued
from gcode.resumption.leaving_out import lines_without
from gcode.resumption.standing import standing_field
from gcode.surfaces import HeightField

SAME_LAYER = 0.5
"""A measured height means the nearest layer: parts shrink, and bend."""


@dataclass(frozen=True, slots=True)
class Resumption(Continued):
    """A checked program that goes on with a job from a layer on.

    Attributes
    ----------
    layer
        The first layer that is printed.
    first_line
        The job's line that the program goes on with, from 0.
    standing
        What must stand on the bed already.
    """

    standing: HeightField
    layer: JobLayer
    first_line: int


def resume_at(
    program: Program,
    setup: PrintSetup,
    *,
    z_mm: float | None = None,
    layer: int | None = None,
    without: str | None = None,
    title: str = "a job",
    about_printer: Sequence[str] = (),
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
    without
        An object of the job of which nothing more is printed; what stands of it stays.
    about_printer
        Comment lines of the program that tell for which printer it is.

    Raises
    ------
    InputError
        If there is no such layer, or no room to lift, home or prime.
    ReadError, CheckRefusedError
        If the job cannot be understood, or what would be printed is refused.
    """
    job = job_for(program, setup.printer, progress)
    progress("what stands", 0.0, 1.0)
    first = first_layer(job, z_mm, layer)
    line = first.first_line
    field = standing_field(job.beads, line, setup.printer)
    progress("what stands", 1.0, 1.0)
    body: Sequence[str] = program.text.rstrip().split("\n")[line:]
    if without is not None:
        body = lines_without(job, line, without, setup.printer)
    made = continued(
        job, line, body, setup, state=job.state_after(line), standing=field, reach=field,
        about=[
            f"{title}, from layer {first.index} on, whose top is at {first.z_mm:g} mm",
            f"up to {field.top_mm:g} mm the part stands there already",
        ],
        about_printer=about_printer, progress=progress,
    )  # fmt: skip
    return Resumption(made.checked, made.hotend_c, made.bed_c, made.primed, field, first, line)


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
