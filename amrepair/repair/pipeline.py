"""From a scan to a checked program, a call per stage."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial

import manifold3d
import numpy as np

from amrepair.align import align
from amrepair.align.registration import Registration
from amrepair.align.standing import refuse_impossible
from amrepair.deficit import (
    AsBuilt,
    Deficit,
    Standing,
    as_built_heights,
    compute_deficit,
    standing_in_job,
    with_others,
    with_what_stands_out,
)
from amrepair.deficit.options import DeficitOptions
from amrepair.frames import Transform, box_corners, box_of
from amrepair.observe.rays import RangeImage, range_images
from amrepair.regions import AnomalyMap, Region
from amrepair.regions.bed import by_beds, of_bed
from amrepair.regions.calibration import NORMAL_NOISE, of_touches
from amrepair.regions.inspected import tolerances
from amrepair.regions.options import RegionOptions
from amrepair.regions.systematic import PoseKnown
from amrepair.repair import scan_scope
from amrepair.repair.filling import fillable, lines_of
from amrepair.repair.path_offsets import off_by_job
from amrepair.repair.plan import RepairPlan
from amrepair.repair.site import Finished, Site
from amrepair.repair.stopwatch import Stopwatch
from amrepair.repair.symmetry import registration_of_damage
from amrepair.scans import PROBE, Scan
from gcode.check import JobBridges, check
from gcode.errors import CheckRefusedError
from gcode.estimate import estimate
from gcode.moves import ModalState
from gcode.progress import Progress, silent
from gcode.slicing.job_lines import JobLines
from gcode.slicing.patch import PatchPlan, slice_patch
from gcode.surfaces import HeightField
from gcode.writer import write


def plan_repair(
    scan: Scan,
    site: Site,
    *,
    title: str,
    guess: Transform | None = None,
    interruption: ModalState | None = None,
    strict: bool = True,
    wanted: Callable[[Region], bool] = lambda region: True,
    rng: np.random.Generator | None = None,
    watch: Stopwatch | None = None,
    progress: Progress = silent,
) -> RepairPlan:
    """Align, detect, make the deficit, slice it, write and check it.

    Parameters
    ----------
    scan
        In whatever frame its sensor has; in that of the printer's probe no pose is looked for.
    guess
        A pose (template from the scan's frame) known beforehand; None searches from any pose.
    interruption
        The state of the machine in mid-job; None makes a whole program for a standing part.
    strict
        Raise where the checker refuses the program; else return a plan without one, that says so:
        a job must not die of a patch that is never sent.
    wanted
        Which of the missing regions the program is to fill.

    Raises
    ------
    AlignmentError
        If the scan cannot be aligned, equally good poses lead to different repairs, or a finished
        part would stand in the bed, in the air or beyond the printer.
    DeficitError
        If the deficit is no valid solid.
    gcode.errors.GcodeError
        If the deficit cannot be sliced or the checker refuses the program.

    Examples
    --------
    >>> from pathlib import Path
    >>> import gcode
    >>> from amrepair import Site, open_template, plan_repair, read_scan
    >>> site = Site.of_part(open_template(Path("part.safetensors")), gcode.load_setup())
    >>> plan = plan_repair(read_scan(Path("scan.ply"), frame="build"), site, title="repair")
    >>> "G28 X Y" in plan.checked.program.text  # Z is never homed onto a part
    True
    """
    watch = watch or Stopwatch()
    if scan.frame == PROBE:  # it measures its noise itself
        site = replace(site, calibration=of_touches(scan.sigma_mm, site.process_sigma_mm))
    with watch("align"):
        laid = _align(scan, site, guess, rng, progress)
    with watch("detect"):
        site = _by_the_bed(laid, site)
    anomaly, deficit = _judge(laid, site, watch, progress)
    chosen = registration_of_damage(scan, site, laid.registration, deficit)
    if chosen is not laid.registration:
        laid = laid.by(chosen)
        anomaly, deficit = _judge(laid, site, watch, progress)
    missing = fillable(deficit, wanted, site.policy)
    plan = laid.plan(anomaly, deficit, site)
    if missing.is_empty():
        return plan
    with watch("deficit"):
        as_built = deficit.as_built  # made where it is needed: a clean layer has no use for it
        if site.finished is not None:
            as_built = _among_finished(as_built, laid, anomaly, site.finished, site)
            plan = replace(plan, deficit=replace(deficit, stands=Standing(lambda: as_built)))
    with watch("slice"):
        lines = lines_of(site, deficit, laid.placed)
        patch = _slice(missing, as_built, site, interruption, lines, progress)
    plan = replace(plan, patch=patch)
    if not patch.toolpath.extrusions:
        return plan
    with watch("check"):
        return _checked(plan, site, lines, title=title, interruption=interruption, strict=strict)


@dataclass(frozen=True, slots=True)
class _Laid:
    """A scan laid into its template.

    Attributes
    ----------
    placed
        Build from template.
    whole, judged
        The scan in the template's frame: all of it, and what is held against the template.
    images
        What rays saw, in the template's frame; None where what is expected ends in mid-air.
    pose
        How well it is known: told, as that of the printer's own probe; of a part that stands where
        it was printed, in a scan in the printer's frame; or as the scan alone tells.
    """

    registration: Registration
    placed: Transform
    whole: Scan
    judged: Scan
    images: tuple[RangeImage, ...] | None
    pose: PoseKnown

    def by(self, other: Registration) -> _Laid:
        """The same scan in another pose of the part that it fits as well."""
        motion = other.template_from_scan @ self.registration.template_from_scan.inverse()
        return replace(
            self,
            registration=other,
            whole=self.whole.moved(motion),
            judged=self.judged.moved(motion),
            images=None if self.images is None else tuple(i.moved(motion) for i in self.images),
        )

    def plan(self, anomaly: AnomalyMap, deficit: Deficit, site: Site) -> RepairPlan:
        """The verdict, as yet without a program."""
        return RepairPlan(
            self.registration,
            anomaly,
            deficit,
            self.placed @ self.registration.template_from_scan,
            site.setup.process.layer_height_mm,
            self.judged,
            site.policy,
            beds=site.beds,
        )


def _align(
    scan: Scan,
    site: Site,
    guess: Transform | None,
    rng: np.random.Generator | None,
    progress: Progress,
) -> _Laid:
    """Lay the scan into the template; a pose in which a part cannot stand is refused."""
    with ThreadPoolExecutor(1) as beside:
        # what rays saw needs no pose, nor it them; a part of the scan has images of its own
        seen = None if scan_scope.ends_in_air(site) else beside.submit(range_images, scan)
        known = guess if scan.frame == PROBE else None
        if known is not None:
            registration = Registration.known(known)
        else:
            registration = align(
                scan if guess is None else scan_scope.without_finished_objects(scan, site, guess),
                site.template,
                guess=guess,
                part_is_known=site.part_is_known,
                so_far=scan_scope.planned_so_far(site),
                aside=scan_scope.beside_part(site),
                options=scan_scope.align_options(site),
                rng=rng,
                progress=progress,
            )
    placed = site.stands_at(scan, registration)
    said = site.build_from_template is not None or guess is not None
    if site.printed_z_mm is None:
        printer, raised = site.setup.printer, site.on_fixture
        refuse_impossible(site.template, placed, printer, said=said, raised=raised)
    moved = registration.template_from_scan
    whole = scan.moved(moved)
    own = scan_scope.without_finished_objects(
        whole, site, Transform.identity("template", "template")
    )
    return _Laid(
        registration,
        placed,
        whole,
        scan_scope.within_planned(scan_scope.without_beside(own, site), site),
        None if seen is None else tuple(image.moved(moved) for image in seen.result()),
        "told" if known is not None else "stands" if scan.frame == "build" and said else "free",
    )


def _by_the_bed(laid: _Laid, site: Site) -> Site:
    """Where nobody has told of the scanner's errors, the bed that is scanned with a part does.

    And what it showed in the looks before.
    """
    if site.calibration != NORMAL_NOISE:
        return site
    options = _region_options(site)
    seen = of_bed(
        laid.whole.moved(laid.placed),
        box_of(laid.placed.apply(box_corners(site.template.bounds_mm))),
        tolerances(options, site.expected)[0],
        options,
    )
    beds = site.beds if seen is None else (*site.beds, seen)
    return replace(site, beds=beds, calibration=by_beds(beds, options)) if beds else site


def _judge(
    laid: _Laid, site: Site, watch: Stopwatch, progress: Progress
) -> tuple[AnomalyMap, Deficit]:
    """Find the regions, and make solids of them."""
    with watch("detect"):
        anomaly = _detect(laid, site, progress)
    with watch("deficit"):
        return anomaly, _deficit(laid, anomaly, site, progress)


def _detect(laid: _Laid, site: Site, progress: Progress) -> AnomalyMap:
    """Hold the scan against what is expected."""
    return site.detector(
        laid.judged,
        site.expected,
        options=_region_options(site),
        calibration=site.calibration,
        top_z_mm=scan_scope.layer_top_mm(site),
        images=laid.images,
        surface=site.surface,
        pose=laid.pose,
        off_by_job=off_by_job(site, laid.placed),
        progress=progress,
    )


def _region_options(site: Site) -> RegionOptions:
    """What regions are tested by here."""
    return replace(
        site.options.regions,
        allowance_mm=site.allowance_mm,
        process_sigma_mm=site.process_sigma_mm,
    )


def _deficit(laid: _Laid, anomaly: AnomalyMap, site: Site, progress: Progress) -> Deficit:
    """Solids of what is missing and of what is too much, build frame."""
    return compute_deficit(
        laid.judged,
        site.expected,
        anomaly,
        build_from_template=laid.placed,
        printed_z_mm=site.printed_z_mm,
        as_built=None if site.planned is None else _as_built(laid, anomaly, site),
        options=_deficit_options(site),
        beads=site.beads,
        progress=progress,
    )


def _as_built(laid: _Laid, anomaly: AnomalyMap, site: Site) -> AsBuilt:
    """What stands there is all that was seen, the bottoms of open cells too."""
    evidence = anomaly.evidence
    assert evidence is not None
    spacing_mm, images, options = (
        evidence.spacing_mm,
        evidence.images,
        _deficit_options(site).heights,
    )

    def standing(seen: HeightField, missing: manifold3d.Manifold) -> HeightField:
        scan = laid.whole.moved(laid.placed)
        return standing_in_job(seen, site.lines, missing, scan, spacing_mm, options)

    seen = partial(
        as_built_heights, laid.whole, site.template, spacing_mm, images=images, options=options,
        build_from_template=laid.placed, printed_z_mm=site.printed_z_mm,
    )  # fmt: skip
    return AsBuilt(seen, standing)


def _deficit_options(site: Site) -> DeficitOptions:
    """What nobody saw stands no higher than the job, where one has just been printed there."""
    options = site.options.deficit
    if site.laid is None and site.planned is None:
        return options
    margin_mm = site.options.just_printed_margin_mm
    return replace(options, heights=replace(options.heights, unseen_margin_mm=margin_mm))


def _among_finished(
    as_built: HeightField, laid: _Laid, anomaly: AnomalyMap, finished: Finished, site: Site
) -> HeightField:
    """What stands on the bed, and what else of the job does: as it was printed, and as it is seen.

    Over all of it: the nozzle comes from beside the job, and goes back there.
    """
    assert anomaly.evidence is not None
    points_mm = laid.placed.apply(laid.whole.points_mm)
    others = with_what_stands_out(
        finished.standing,
        points_mm[finished.own(points_mm[:, :2])],
        laid.whole.sigma_mm,
        anomaly.evidence.spacing_mm,
        site.options.deficit.heights,
    )
    return with_others(as_built, others)


def _slice(
    missing: manifold3d.Manifold,
    as_built: HeightField,
    site: Site,
    interruption: ModalState | None,
    lines: JobLines | None,
    progress: Progress,
) -> PatchPlan:
    """Toolpaths that fill what is missing, onto what stands there."""
    x_mm = y_mm = z_mm = 0.0
    if interruption is not None:
        x_mm, y_mm, z_mm = (float(axis) for axis in interruption.position_mm)
    return slice_patch(
        missing,
        site.setup,
        as_built=as_built,
        grid=site.grid,
        standalone=interruption is None,
        start_mm=None if interruption is None else (x_mm, y_mm, z_mm),
        hotend_c=None if interruption is None else interruption.hotend_c,
        lines=lines,
        options=site.options.patch,
        progress=progress,
    )


def _checked(
    plan: RepairPlan,
    site: Site,
    lines: JobLines | None,
    *,
    title: str,
    interruption: ModalState | None,
    strict: bool,
) -> RepairPlan:
    """The plan with its program, written and checked, or with the reason why it has none."""
    assert plan.patch is not None
    as_built, printer = plan.deficit.as_built, site.setup.printer
    program = write(
        plan.patch.toolpath, site.setup, title=title, resume=interruption, restore=False
    )
    # what the job bridges counts where the checker has followed it itself
    bridges = lines.bridges if lines is not None else None
    patch = bridges if isinstance(bridges, JobBridges) else True
    try:
        checked = check(program, site.setup, as_built=as_built, initial=interruption, patch=patch)
    except CheckRefusedError as error:
        if strict:
            raise
        return replace(plan, refused=str(error))
    return replace(plan, checked=checked, estimate=estimate(program, printer))
