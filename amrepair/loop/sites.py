"""What is expected at each stop of a job: the finished part, or what is printed so far."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from scipy import ndimage

from amrepair.arrays import Mask, Points
from amrepair.frames import Transform
from amrepair.loop.locate import (
    BESIDE_THE_PART,
    MOVED_MM,
    TOWERS,
    first_layer,
    foot_mm,
    half_widths_mm,
    of_roles,
    tops_of,
    walls_moved_mm,
)
from amrepair.loop.looks import Stop
from amrepair.loop.sequential_objects import finished_at, refuse_own_hits, template_of
from amrepair.regions import detect
from amrepair.regions.error_calibration import NORMAL_NOISE
from amrepair.regions.options import RegionOptions
from amrepair.regions.planned_beads import PlannedBeads
from amrepair.repair import Detector, Site
from amrepair.repair.options import DEFAULT_REPAIR
from amrepair.repair.site import Finished, Raft
from amrepair.template import CutTemplate, KeptFills, LaidBeads, PlannedSdf
from amrepair.template.port import Template
from gcode.check import JobBridges
from gcode.profiles import PrintSetup
from gcode.profiles.own_settings import setup_for_head
from gcode.reader import Beads, Job, Turn
from gcode.slicing.job_lines import JobLines
from gcode.slicing.layers import LayerGrid
from gcode.surfaces import HeightField
from gcode.surfaces.lines import columns_around, heights_by_lines

BESIDE_CELL_MM = 0.25
# Lower than the drawing by more, a place is open: slopes and rounding make one.
LEFT_OPEN_LAYERS = 2.0
RIMS = ("perimeter", "wall")  # what slicers call it
# Of the nozzle's bore: the narrowest gap that slicers fill; what is ironed is given less, a tenth
# of a line whose neighbour lies a tenth of a millimetre off.
IRONS_BORES = 0.2


@dataclass(frozen=True, slots=True)
class Expected:
    """What is expected at a stop of a job (`sites`), and how it is judged."""

    template: Template
    build_from_template: Transform
    setup: PrintSetup
    by_beads: bool
    detector: Detector
    _at: Callable[[Stop], Site]
    _ends_otherwise: Callable[[Turn], bool]

    def __call__(self, stop: Stop) -> Site:
        """At one stop."""
        return self._at(stop)

    def of(self, job: Job) -> Expected:
        """The same of another job: what is left of it, say."""
        return _expected(
            job, self.template, self.build_from_template, self.setup, self.by_beads, self.detector,
            self._ends_otherwise,
        )  # fmt: skip


def sites(
    job: Job,
    template: Template,
    build_from_template: Transform,
    setup: PrintSetup,
    *,
    by_beads: bool = True,
    detector: Detector = detect,
) -> Expected:
    """What is expected at a stop, for `run_loop`.

    A finished part is judged by its template. A layer is, too, where `by_beads` is false (all of
    it is planned to be solid); else by the beads that the job planned, so that open infill is
    none of the defects; so is a finished part that the job leaves open at its top, as a vase, or
    whose walls it moves ('XY compensation', 'horizontal expansion').

    Of objects that are printed one after another it is the one under way: what has come to its end
    is judged there, and stands beside the others from then on (`Site.finished`).

    Raises
    ------
    InputError
        If the job itself leads the head through what it has finished.
    """
    refuse_own_hits(job, setup)

    @functools.cache
    def ends_otherwise(turn: Turn) -> bool:
        own, part = job.of_turn(turn), template_of(template, build_from_template, job, turn)
        return by_beads and (
            _left_open(own, part, build_from_template)
            or walls_moved_mm(own, part, build_from_template) > MOVED_MM
        )

    return _expected(job, template, build_from_template, setup, by_beads, detector, ends_otherwise)


def _expected(
    job: Job,
    template: Template,
    build_from_template: Transform,
    setup: PrintSetup,
    by_beads: bool,
    detector: Detector,
    ends_otherwise: Callable[[Turn], bool],
) -> Expected:
    """As `sites`; what the whole job ends with is asked once, whatever is left of it later."""
    kept = KeptFills()

    @functools.cache
    def of(turn: Turn) -> _Part:
        return _Part.of(job, turn, template, build_from_template, setup, kept)

    def at(stop: Stop) -> Site:
        part = of(job.turn_at(stop.line))
        by_template = stop.layer_index is None and not ends_otherwise(part.turn)
        site = part.finished_site() if by_template else part.site_at(stop, by_beads=by_beads)
        # a repair is laid by the head, or the filament, that is there: as its material asks
        own = setup_for_head(site.setup, job.program.text, int(job.tools[stop.line]))
        return replace(site, setup=own, detector=detector)

    return Expected(template, build_from_template, setup, by_beads, detector, at, ends_otherwise)


@dataclass(frozen=True, slots=True)
class _Part:
    """What one turn of a job prints: all of it, or one of the objects that it prints in turn.

    Attributes
    ----------
    own
        The job as if it printed nothing else.
    job
        All of it.
    """

    turn: Turn
    own: Job
    job: Job
    template: Template
    build_from_template: Transform
    setup: PrintSetup
    grid: LayerGrid
    raft: Raft | None
    finished: Finished | None
    kept: KeptFills

    @classmethod
    def of(
        cls,
        job: Job,
        turn: Turn,
        template: Template,
        placed: Transform,
        setup: PrintSetup,
        kept: KeptFills,
    ) -> _Part:
        own, part = job.of_turn(turn), template_of(template, placed, job, turn)
        tops_mm = tops_of(job)[turn.first_layer : turn.end_layer]
        grid = LayerGrid.from_tops(tops_mm, layer_height_mm=setup.process.layer_height_mm)
        return cls(
            turn, own, job, part, placed, setup, grid, _raft(own, part, placed.inverse()),
            finished_at(job, turn, setup), kept,
        )  # fmt: skip

    def _beside(self, line: int, judged: Mask) -> HeightField | None:
        """What is laid beside the part before a line, but for what of its own is judged."""
        beads = self.job.beads
        which = (beads.line < line) & (beads.layer >= 0)
        which[self.job.laid_in(self.turn)] &= ~judged
        return _beside(self.job, which)

    def finished_site(self) -> Site:
        """Judged by its template."""
        every = self.own.beads.layer >= 0
        drawn = every & ~irons(self.own.beads, self.setup)
        return Site(
            self.template,
            self.setup,
            self.grid,
            self.build_from_template,
            calibration=NORMAL_NOISE,
            lines=lines_of_job(self.own, drawn, self.setup),
            beside=self._beside(self.job.end_of(self.turn), np.zeros_like(every)),
            raft=self.raft,
            finished=self.finished,
            laid=_laid(self.own, every, self.kept),
        )

    def site_at(self, stop: Stop, *, by_beads: bool) -> Site:
        """Judged by what is printed so far."""
        template_from_build, beads = self.build_from_template.inverse(), self.own.beads
        z_mm = float(template_from_build.apply(np.array([[0.0, 0.0, stop.z_mm]]))[0, 2])
        done = (beads.line < stop.line) & (beads.layer >= 0)
        # a tower stands as it does: nothing of it is to be mended
        drawn = done & ~irons(beads, self.setup)
        judged = drawn & (beads.layer >= first_layer(self.own)) & ~of_roles(beads, TOWERS)
        start, end = (
            template_from_build.apply(place[judged]) for place in (beads.start_mm, beads.end_mm)
        )
        section, height = beads.section_mm2[judged], beads.height_mm[judged]
        support = of_roles(beads, BESIDE_THE_PART)
        ours = ~support[judged]
        level_mm = _highest_mm(start, end, ours)
        planned = (
            PlannedSdf.from_beads(start, end, section, height, level_mm=level_mm)
            if by_beads
            else None
        )
        below = CutTemplate(self.template, z_mm)
        return Site(
            below,
            self.setup,
            self.grid,
            self.build_from_template,
            stop.z_mm,
            calibration=NORMAL_NOISE,
            planned=planned,
            beads=PlannedBeads.recent(start, end, section, height, ~ours),
            lines=lines_of_job(self.own, drawn, self.setup),
            surface=(planned or below).surface_points(RegionOptions().spacing_mm),
            beside=self._beside(stop.line, judged if by_beads else np.zeros_like(judged)),
            strands=_beside(self.own, judged & support) if by_beads else None,
            raft=self.raft,
            finished=self.finished,
            laid=_laid(self.own, done, self.kept),
        )


def irons(beads: Beads, setup: PrintSetup) -> Mask:
    """Which lines only smooth what lies there: they are given less plastic than any line is."""
    width_mm = beads.section_mm2 / np.maximum(beads.height_mm, 1e-6)
    return np.asarray(width_mm < IRONS_BORES * setup.printer.nozzle_diameter_mm)


def _highest_mm(start: Points, end: Points, pick: Mask) -> float | None:
    """How high some beads come; None where there are none."""
    tops_mm = np.maximum(start[pick, 2], end[pick, 2])
    return float(tops_mm.max()) if len(tops_mm) else None


def _laid(job: Job, which: Mask, kept: KeptFills) -> LaidBeads | None:
    """Some of a job's beads, by layer, without what it lays beside the part."""
    beads = job.beads
    pick = which & ~of_roles(beads, BESIDE_THE_PART)
    if not pick.any():
        return None
    return LaidBeads.from_beads(
        beads.start_mm[pick],
        beads.end_mm[pick],
        beads.section_mm2[pick],
        beads.height_mm[pick],
        beads.layer[pick],
        kept=kept,
    )


def _left_open(job: Job, template: Template, build_from_template: Transform) -> bool:
    """Whether a job leaves holes of two beads' width in the part, open to above: no top, a vase."""
    beads = job.beads
    part = HeightField.from_manifold(
        build_from_template.solid(template.solid()),
        BESIDE_CELL_MM,
        margin_mm=DEFAULT_REPAIR.stray_mm,
    )
    pick = (beads.layer >= 0) & ~of_roles(beads, BESIDE_THE_PART)
    half_mm = half_widths_mm(beads, pick)
    laid_mm = _heights_mm(beads, pick, half_mm, part.origin_mm, part.z_mm.shape)
    least_mm = LEFT_OPEN_LAYERS * np.median(beads.height_mm[pick])
    lower = (part.z_mm > 0.0) & (part.z_mm - laid_mm > least_mm)
    room_mm = (ndimage.distance_transform_edt(lower) - 0.5) * BESIDE_CELL_MM
    return bool(room_mm.max() > 2.0 * np.median(half_mm))


def _raft(job: Job, template: Template, template_from_build: Transform) -> Raft | None:
    """What the job lays before its first layer of the part; None where that is on the bed."""
    beads = job.beads
    under = (beads.layer >= 0) & (beads.layer < first_layer(job))
    if not under.any():
        return None
    ends = np.concatenate([beads.start_mm[under], beads.end_mm[under]])
    far_mm = template.distance(template_from_build.apply(ends)).max()
    return Raft(foot_mm(job), float(far_mm + beads.width_mm[under].max()))


def _beside(job: Job, which: Mask) -> HeightField | None:
    """How high skirts, brims, supports and towers stand, build frame; None where there are none."""
    beads = job.beads
    pick = which & of_roles(beads, BESIDE_THE_PART)
    if not pick.any():
        return None
    within_mm = half_widths_mm(beads, pick) + DEFAULT_REPAIR.stray_mm
    low, shape = columns_around(
        beads.start_mm[pick], beads.end_mm[pick], float(within_mm.max()), BESIDE_CELL_MM
    )
    z_mm = _heights_mm(beads, pick, within_mm, low, shape)
    return HeightField(low, BESIDE_CELL_MM, z_mm, np.isfinite(z_mm))


def _heights_mm(
    beads: Beads, pick: Mask, within_mm: Float[np.ndarray, " k"], low_mm: Float[np.ndarray, " 2"],
    shape: tuple[int, int],
) -> Float[np.ndarray, "ny nx"]:  # fmt: skip
    """How high some beads stand over columns so near to them; −inf over the others."""
    start, end = beads.start_mm[pick], beads.end_mm[pick]
    return heights_by_lines(
        start, end, within_mm, np.maximum(start[:, 2], end[:, 2]),
        low_mm=low_mm, cell_mm=BESIDE_CELL_MM, shape=shape,
    )  # fmt: skip


def lines_of_job(job: Job, which: Mask, setup: PrintSetup) -> JobLines:
    """Some of a job's beads as lines that a patch may follow, and what they bridge."""
    beads = job.beads
    start, end, section = (
        each[which] for each in (beads.start_mm, beads.end_mm, beads.section_mm2)
    )
    rim = np.array([any(word in role.lower() for word in RIMS) for role in beads.roles])
    return JobLines(
        start,
        end,
        section,
        beads.height_mm[which],
        rim[beads.role[which]],
        bridges=JobBridges(start, end, section, setup.printer.nozzle_diameter_mm),
    )
