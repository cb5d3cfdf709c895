"""What is expected at each stop of a job: the finished part, or what is printed so far."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from jaxtyping import Bool

from amrepair.detect.detection import SURFACE_SPACING_MM
from amrepair.detect.skipped import PlannedBeads
from amrepair.frames import Transform
from amrepair.loop.looks import Stop
from amrepair.repair import Site
from amrepair.template import PlannedSdf
from amrepair.template.port import Template
from gcode.profiles import PrintSetup
from gcode.reader import Job
from gcode.slicing.job_lines import JobLines
from gcode.slicing.layers import LayerGrid

RIMS = ("perimeter", "wall")  # what slicers call it


def sites(
    job: Job,
    template: Template,
    build_from_template: Transform,
    setup: PrintSetup,
    *,
    by_beads: bool = True,
) -> Callable[[Stop], Site]:
    """What is expected at a stop, for `run_loop`.

    A finished part is judged by its template. A layer is, too, where `by_beads` is false (all of
    it is planned to be solid); else by the beads that the job planned, so that open infill is
    none of the defects.
    """
    grid = LayerGrid.from_tops(
        [layer.z_mm for layer in job.layers], layer_height_mm=setup.process.layer_height_mm
    )
    template_from_build = build_from_template.inverse()

    def at(stop: Stop) -> Site:
        if stop.layer_index is None:
            whole = _lines(job, job.beads.layer >= 0)
            return Site(template, setup, grid, build_from_template, lines=whole)
        z_mm = float(template_from_build.apply(np.array([[0.0, 0.0, stop.z_mm]]))[0, 2])
        beads = job.beads
        done = (beads.line < stop.line) & (beads.layer >= 0)
        start, end = (
            template_from_build.apply(place[done]) for place in (beads.start_mm, beads.end_mm)
        )
        section, height = beads.section_mm2[done], beads.height_mm[done]
        planned = PlannedSdf.from_beads(start, end, section, height) if by_beads else None
        recent = PlannedBeads.recent(start, end, section, height)
        below = template.below_z(z_mm)
        return Site(
            below,
            setup,
            grid,
            build_from_template,
            stop.z_mm,
            planned=planned,
            beads=recent,
            lines=_lines(job, done),
            surface=(planned or below).surface_points(SURFACE_SPACING_MM),
        )

    return at


def _lines(job: Job, which: Bool[np.ndarray, " n"]) -> JobLines:
    """Some of a job's beads as lines that a patch may follow."""
    beads = job.beads
    rim = np.array([any(word in role.lower() for word in RIMS) for role in beads.roles])
    return JobLines(
        beads.start_mm[which],
        beads.end_mm[which],
        beads.section_mm2[which],
        beads.height_mm[which],
        rim[beads.role[which]],
    )
