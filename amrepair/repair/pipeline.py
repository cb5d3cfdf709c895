"""The offline algorithm: from a scan to a checked program, with one call for each stage."""

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
    heights_beside,
    lines_beside,
    standing_in_job,
    with_others,
    with_what_stands_out,
)
from amrepair.deficit.options import DeficitOptions
from amrepair.frames import Transform, box_corners, box_of
from amrepair.observe.rays import RangeImage, range_images
from amrepair.regions import AnomalyMap, Region
from amrepair.regions.bed import by_beds, of_bed
from amrepair.regions.error_calibration import NORMAL_NOISE, of_touches
from amrepair.regions.inspected import tolerances
from amrepair.regions.options import RegionOptions
from amrepair.regions.systematic import PoseKnown
from amrepair.repair import scan_scope
from amrepair.repair.filling import fillable, lines_of
from amrepair.repair.other_part import refuse_other_part
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
from gcode.profiles.own_settings import printer_line
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
        In any frame. A scan in the frame of the printer's own probe needs no alignment.
    site
        What the scan is held against: template, printer, place on the bed, options.
    title
        The first line of the program.
    guess
        A pose that is known beforehand, template from the scan's frame; None searches all poses.
    interruption
        The machine's state, where a running job is interrupted for the repair; None makes a
        program that stands alone, for a finished part.
    strict
        Whether to raise where the checker refuses the program. If not, the plan comes back without
        a program and says why: a running job must not die of a patch that is never sent.
    wanted
        Says of each missing region whether the program is to fill it.
    rng
        For the search of a pose.
    watch
        Measures the time of each stage.

    Raises
    ------
    AlignmentError
        If the scan cannot be aligned, equally good poses lead to different repairs, or a finished
        part would stand in the bed, in the air or beyond the printer, or what is scanned has its
        walls elsewhere.
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
    if site.printed_z_mm is None and not site.part_is_known:
        refuse_other_part(anomaly, site.template, scan.source)
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
        elif scan.frame == "build" and not site.on_fixture:
            as_built = _among_others(as_built, laid, anomaly, missing, site)
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
    """A scan that has been aligned to its template.

    Attributes
    ----------
    registration
        Template from scan.
    placed
        Build from template.
    whole, judged
        The scan in the template's frame: all of it, and only what is compared with the template.
    images
        Its range images, in the template's frame; None where a planned template ends in mid-air.
    pose
        How well the pose is known: `told` by the printer's own probe; `stands` for a part that
        stands on the bed, scanned in the printer's frame; `free` where the scan alone tells it.
    """

    registration: Registration
    placed: Transform
    whole: Scan
    judged: Scan
    images: tuple[RangeImage, ...] | None
    pose: PoseKnown

    def by(self, other: Registration) -> _Laid:
        """The same scan under another registration, of a symmetric part that fits in several."""
        motion = other.template_from_scan @ self.registration.template_from_scan.inverse()
        return replace(
            self,
            registration=other,
            whole=self.whole.moved(motion),
            judged=self.judged.moved(motion),
            images=None if self.images is None else tuple(i.moved(motion) for i in self.images),
        )

    def plan(self, anomaly: AnomalyMap, deficit: Deficit, site: Site) -> RepairPlan:
        """The plan so far: what was found, without a patch or a program."""
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
    """Align the scan to the template, and refuse a pose in which the part cannot stand."""
    with ThreadPoolExecutor(1) as beside:
        # range images and the pose do not need each other, so they are made side by side; where
        # only the last layers are judged, the detector makes the images of that part of the scan
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
                options=scan_scope.align_options(site, scan),
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
        "told" if known is not None else "stands" if _stands(scan, site, said) else "free",
    )


def _stands(scan: Scan, site: Site, said: bool) -> bool:
    """Whether the scan is in the printer's frame, and the part where the bed or a word puts it."""
    return scan.frame == "build" and (said or not site.on_fixture)


def _by_the_bed(laid: _Laid, site: Site) -> Site:
    """The site with the scanner's errors as the bed beside the part shows them.

    Only where no calibration is known, so that normal noise would be assumed. The bed in earlier
    looks of the same run counts too.
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
    """Find the regions that deviate, and make solids of them."""
    with watch("detect"):
        anomaly = _detect(laid, site, progress)
    with watch("deficit"):
        return anomaly, _deficit(laid, anomaly, site, progress)


def _detect(laid: _Laid, site: Site, progress: Progress) -> AnomalyMap:
    """Compare the scan with what is expected, and find the regions that deviate."""
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
    """The options of the test, with the allowances of the site's process."""
    return replace(
        site.options.regions,
        allowance_mm=site.allowance_mm,
        process_sigma_mm=site.process_sigma_mm,
    )


def _deficit(laid: _Laid, anomaly: AnomalyMap, site: Site, progress: Progress) -> Deficit:
    """Make solids of what is missing and of what is too much, build frame."""
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
    """How the heights of what stands on the bed are made for a print with open infill.

    The scan's own heights count everywhere there, down to the floors of open cells.
    """
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
    """The deficit's options; what a job has just printed limits how high unseen places stand."""
    options = site.options.deficit
    if site.laid is None and site.planned is None:
        return options
    margin_mm = site.options.just_printed_margin_mm
    return replace(options, heights=replace(options.heights, unseen_margin_mm=margin_mm))


def _among_finished(
    as_built: HeightField, laid: _Laid, anomaly: AnomalyMap, finished: Finished, site: Site
) -> HeightField:
    """The heights of the part joined with those of the job's finished objects beside it.

    Those stand as they were printed, and as high as this scan shows them. The field covers all of
    the job, since the nozzle comes from beside it and goes back there.
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


def _among_others(
    as_built: HeightField,
    laid: _Laid,
    anomaly: AnomalyMap,
    missing: manifold3d.Manifold,
    site: Site,
) -> HeightField:
    """The heights of the part joined with those of what else stands on the bed.

    The field itself is as wide as the nozzle's cone. What stands farther off must be known where
    wider parts of the head would touch it, or the nozzle on its way to the part: in a running job,
    where the head is parked over the bed, from the job's own lines, else from the scan.
    """
    assert anomaly.evidence is not None
    printer, options = site.setup.printer, site.options.deficit.heights
    wider_mm = [s.z_from_mm for s in printer.head if s.reach_mm > options.beside_part_mm]
    lowest_mm = float(missing.bounding_box()[2]) + min(wider_mm, default=np.inf)
    over_mm = min(lowest_mm, as_built.top_mm + options.trust_mm)
    if site.laid is not None and site.lines is not None:
        others = lines_beside(as_built, site.lines, over_mm=over_mm, options=options)
    else:
        others = heights_beside(
            as_built,
            laid.placed.apply(laid.whole.points_mm),
            anomaly.evidence.spacing_mm,
            over_mm=over_mm,
            within_mm=printer.bed_box_mm,
            options=options,
        )
    return as_built if others is None else with_others(as_built, others)


def _slice(
    missing: manifold3d.Manifold,
    as_built: HeightField,
    site: Site,
    interruption: ModalState | None,
    lines: JobLines | None,
    progress: Progress,
) -> PatchPlan:
    """Slice the missing solids to beads, laid onto what stands there."""
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
    """The plan with its program, written and checked; or with the checker's refusal."""
    assert plan.patch is not None
    as_built, printer = plan.deficit.as_built, site.setup.printer
    if interruption is None:  # a program that stands alone says for which printer
        title = f"{title}\n{printer_line(printer)}"
    program = write(
        plan.patch.toolpath, site.setup, title=title, resume=interruption, restore=False
    )
    # the checker allows the job's own bridges only if it has followed the job itself
    bridges = lines.bridges if lines is not None else None
    patch = bridges if isinstance(bridges, JobBridges) else True
    try:
        checked = check(program, site.setup, as_built=as_built, initial=interruption, patch=patch)
    except CheckRefusedError as error:
        if strict:
            raise
        return replace(plan, refused=str(error))
    return replace(plan, checked=checked, estimate=estimate(program, printer))
