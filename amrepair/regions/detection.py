"""Detection: from an aligned scan to regions, each with its significance. Begin reading here."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.special import ndtr

from amrepair.arrays import Mask, Numbers, Points
from amrepair.field.as_built import Evidence, gather, with_stubs
from amrepair.field.groups import group_points, touching_mm
from amrepair.observe.rays import RangeImage
from amrepair.regions.anomaly import AnomalyMap, Label
from amrepair.regions.error_calibration import NORMAL_NOISE, Calibration
from amrepair.regions.error_calibration_fit import Sound, sound_scales
from amrepair.regions.inspected import Inspected, OffByJob, inspected_of, tolerances
from amrepair.regions.labels import grown
from amrepair.regions.noise import Noise, noise_of
from amrepair.regions.observation import Observed, observed
from amrepair.regions.options import RegionOptions
from amrepair.regions.regions import Tested, find_regions
from amrepair.regions.significance import LEAST_PEAKS, Level, as_student, tested
from amrepair.regions.strands import on_strands
from amrepair.regions.systematic import PoseKnown, without_systematic_errors
from amrepair.scans import Scan
from amrepair.template.port import Template
from gcode.progress import Progress, silent


def detect(
    scan: Scan,
    template: Template,
    *,
    options: RegionOptions | None = None,
    calibration: Calibration | None = None,
    top_z_mm: float | None = None,
    images: tuple[RangeImage, ...] | None = None,
    surface: tuple[Points, Points] | None = None,
    off_by_job: OffByJob | None = None,
    pose: PoseKnown = "free",
    progress: Progress = silent,
) -> AnomalyMap:
    """Score and label a scan against its template.

    Parameters
    ----------
    scan
        In the template's frame.
    template
        The expected shape.
    options
        Settings of the test; None takes the defaults.
    calibration
        The errors of this scanner on sound parts. None estimates them from the scan itself; so does
        `NORMAL_NOISE` where the scan contradicts it.
    top_z_mm
        Height of the layer just printed, where the template ends there. What is missing under that
        plane is judged with the smaller `top_allowance_mm`, since the job says exactly where the
        plane lies.
    images, surface
        The scan's range images, and points (`spacing_mm` apart) and normals of the template's
        surface, where the caller has them already.
    off_by_job
        A function of places and their deviations: how far off the template the job's own path may
        put the surface there, on that side. So much is neither excess nor missing.
    pose
        How well the scan's pose is known. `free`: residual pose, scale and bow are estimated and
        taken out. `stands`, of a part on its bed: scale and bow, but no shift of the whole top up
        or down. `told`, as always with `top_z_mm`: nothing is taken out.
    progress
        Told how far detection is.

    Raises
    ------
    InputError
        If the scan is not in the template's frame, or its size contradicts the template's.

    Examples
    --------
    >>> from pathlib import Path
    >>> from amrepair import align_scan, detect_defects, open_template, read_scan
    >>> template = open_template(Path("part.safetensors"))
    >>> scan = read_scan(Path("scan.ply"), frame="build")
    >>> pose = align_scan(scan, template).template_from_scan
    >>> anomaly = detect_defects(scan.moved(pose), template)
    >>> [(r.label.name, 1.4 < r.depth_mm < 1.8) for r in anomaly.regions if r.volume_mm3 > 2.0]
    [('MISSING', True)]
    """
    options = options or RegionOptions()
    progress("detect", 0.0, 4.0)

    def observe(without: tuple[int, ...]) -> tuple[Observed, Inspected]:
        seen = observed(scan, template, options, images, surface, without)
        return seen, inspected_of(seen, options, top_z_mm, off_by_job)

    # if a whole layer is too low, that must not be taken for an error of the pose: the job says
    # how high the top lies
    held = "told" if top_z_mm is not None else pose
    seen, inspected, nuisance, contradicting = without_systematic_errors(observe, held, options)
    progress("detect", 1.0, 4.0)
    test = _tested(seen, inspected, options, calibration)
    progress("detect", 2.0, 4.0)
    evidence, surface_label = _bounded(seen, test, options)
    progress("detect", 3.0, 4.0)
    regions = find_regions(seen, test, surface_label)
    score = np.abs(seen.f_mm)
    k = min(options.top_k, int(seen.keep.sum()))
    surfel_label = np.where(test.missing, int(Label.MISSING), test.excess * int(Label.EXCESS))
    allowed_mm = inspected.tolerance_mm[1] - inspected.tolerance_mm[0]
    progress("detect", 4.0, 4.0)
    return AnomalyMap(
        points_mm=scan.points_mm,
        deviation_mm=seen.f_mm,
        score=score,
        label=np.append(surfel_label, 0)[seen.surfels.of_point],
        template_points_mm=seen.surface_mm,
        each_mm2=seen.each_mm2,
        template_label=surface_label,
        threshold_mm=test.limit_mm,
        threshold_source=_source(options, template, test.noise),
        object_score=float(np.partition(score[seen.keep], -k)[-k:].mean()),
        regions=regions,
        top_z_mm=top_z_mm if options.tolerance_mm is None else None,
        top_threshold_mm=test.top_mm,
        evidence=evidence,
        surfel_label=surfel_label,
        surfel_higher_mm=np.maximum(allowed_mm[: len(seen.surfels)], 0.0),
        inspected=inspected,
        noise=test.noise,
        nuisance=nuisance,
        contradicting=contradicting,
        calibration=test.calibration,
        options=options,
        chance_mm=_chance_mm(test),
    )


def _tested(
    seen: Observed, inspected: Inspected, options: RegionOptions, calibration: Calibration | None
) -> Tested:
    """Test local means at every scale, and grow regions from the significant places."""
    cells, gone_to = len(seen.surfels), len(seen.surfels) + len(seen.crossed.which)
    # a scan alone does not tell its own errors from what the process left
    alone = replace(options, process_sigma_mm=0.0)
    levels = tested(inspected, alone if calibration is None else options, calibration)
    if calibration == NORMAL_NOISE and _erratic(levels, options):  # the scan itself contradicts
        levels, calibration = tested(inspected, alone, None), None
    # neither a scan nor a calibration tells what errors look like in narrow strips, so strands are
    # looked for only where errors are known to be normal
    strands = np.zeros(len(seen.surfels), bool)
    if calibration is not None and calibration.is_normal:
        strands = _strands(seen, inspected, levels, options)
    tolerances_mm = tolerances(options, seen.template)
    labels, log_p = grown(
        levels, inspected.tolerance_mm, options, anywhere_mm=tolerances_mm[0], strands=strands
    )
    gone = np.zeros(len(seen.surface_mm), bool)
    gone[seen.crossed.which] = labels[0, cells:gone_to]
    gone_p_value = np.ones(len(seen.surface_mm))
    gone_p_value[seen.crossed.which] = np.exp(log_p[0, cells:gone_to])
    # the label of a wall's end goes to the cell that its points belong to
    ended = seen.ends.surfel[labels[0, gone_to:]]
    labels[0, ended], labels[1, ended] = True, False
    np.minimum.at(log_p[0], seen.ends.surfel, log_p[0, gone_to:])
    errors = as_student(levels[1].quantile, levels[1].freedom)
    noise_mm = float(np.median(errors * levels[1].error_mm))
    return Tested(
        levels,
        calibration,
        noise=noise_of(levels, seen.shares, seen.scan, options),
        missing=labels[0, :cells],
        excess=labels[1, :cells],
        gone=gone,
        gone_p_value=gone_p_value,
        log_p=log_p,
        limit_mm=tolerances_mm[0] + noise_mm,
        top_mm=tolerances_mm[1] + noise_mm,
    )


def _erratic(levels: tuple[Level, ...], options: RegionOptions) -> bool:
    """Whether the scan has more outliers than normal noise, on both sides of the template.

    A defect of a print lies to one side, missing or excess, while a scanner's errors lie on both.
    An outlier is a place beyond the tolerance by `grow_sigmas`, of which normal noise leaves hardly
    any.
    """
    low, high = (int((peaks > options.grow_sigmas).sum()) for peaks in levels[0].peaks)
    return min(low, high) > 0 and low + high >= LEAST_PEAKS


def _chance_mm(test: Tested) -> tuple[tuple[float, float], ...]:
    """How low sound places may seem to lie by chance, for windows of rising width.

    Wider windows than the narrowest use the calibration's outliers, where there is a calibration.
    """
    told: list[tuple[float, float]] = []
    for level in test.levels[1:]:
        calibrated = bool(told) and test.calibration is not None
        off_mm = level.far_off_mm[0] if calibrated else np.median(level.chance_mm)
        told.append((level.scale.width_mm, float(off_mm)))
    return tuple(told)


def _bounded(seen: Observed, test: Tested, options: RegionOptions) -> tuple[Evidence, Numbers]:
    """What is known of the space around the regions, and the label of each template point."""
    labelled = test.missing | test.excess
    evidence = gather(
        seen.scan,
        seen.template,
        seen.surfels,
        labelled,
        seen.images,
        threshold_mm=min(_stray_limit_mm(test, options), test.limit_mm),
        options=options.evidence,
    )
    surface_label = _label_surface(seen, evidence, test)
    return with_stubs(evidence, seen.surface_mm[test.gone], labelled), surface_label


def judged_scales(anomaly: AnomalyMap) -> Sound:
    """The errors that a scan of a sound part shows, from which a calibration is made.

    The scan is tested again without any calibration, whatever it was judged by.
    """
    assert anomaly.inspected is not None
    assert anomaly.options is not None
    return sound_scales(tested(anomaly.inspected, anomaly.options, None), anomaly.options)


def _strands(
    seen: Observed, inspected: Inspected, levels: tuple[Level, ...], options: RegionOptions
) -> Mask:
    """(n,) cells of strips that stand out along their length, but are narrower than any window.

    Each cell's own tolerance counts, since what the job lays itself, as supports, stands out too.
    """
    surfels = seen.surfels
    first = levels[1]
    cells = slice(len(surfels))
    usual_mm = float(np.median(first.tolerance_mm[1]))
    higher_mm = inspected.value_mm[cells] - inspected.tolerance_mm[1, cells] + usual_mm
    per_point_mm = float(np.median(first.scale.noise_mm) * np.sqrt(np.median(surfels.count)))
    # of what is as narrow as a few cells, errors have a tail as long as that of those cells
    critical = float(max(first.critical[1], levels[0].critical[1]))
    return on_strands(
        surfels,
        seen.template,
        higher_mm,
        # a mean: a median tells nothing of a strip
        surfels.wide_mean(higher_mm) > options.grow_share * usual_mm,
        systematic_mm=float(np.median(first.tolerance_mm[1] + critical * first.errors.common_mm)),
        noise_mm=critical * per_point_mm,
    )


def _stray_limit_mm(test: Tested, options: RegionOptions) -> float:
    """From which distance to the template on a cell counts as broken surface.

    A share of the tolerance, and beyond it what cells stray from their neighbours by noise: the
    same quantile of the scan's own strays as `grow_sigmas` is of normal noise, so that the long
    tail of a real scanner's errors counts.
    """
    level = test.levels[0]
    tolerance_mm = options.grow_share * float(np.median(level.tolerance_mm[0]))
    if test.calibration is not None:
        return tolerance_mm + options.grow_sigmas * float(np.median(level.error_mm))
    stray_mm = np.abs(level.scale.value_mm - level.scale.median_mm)
    share = 1.0 - 2.0 * float(ndtr(-options.grow_sigmas))
    return tolerance_mm + float(np.quantile(stray_mm, share))


def _source(options: RegionOptions, template: Template, noise: Noise) -> str:
    """How the threshold came about, in a sentence."""
    if options.tolerance_mm is not None:
        tolerance = f"given tolerance {options.tolerance_mm:g} mm"
    else:
        tolerance = (
            f"tolerance from allowance {options.allowance_mm:g} mm, registration "
            f"{options.registration_sigma_mm:g} mm and template bias {template.bias_mm:.3f} mm"
        )
    return (
        f"{tolerance}; noise {noise.sigma_mm:.3f} mm a point ({noise.source}): "
        f"{options.false_regions:g} false regions expected per scan"
    )


def _label_surface(seen: Observed, evidence: Evidence, test: Tested) -> Numbers:
    """Labels of template points: OK where scanned surface lies, MISSING where gone, else UNSEEN."""
    surfels, surface_mm = evidence.surfels, seen.surface_mm
    missing, limit_mm = test.missing, test.limit_mm
    present = (seen.nearest >= 0) & ~missing[seen.nearest]
    label = np.where(present, int(Label.OK), int(Label.UNSEEN))
    if evidence.has_rays:
        label[test.gone] = int(Label.MISSING)
    if missing.any() and (evidence.unmet is not None or not evidence.has_rays):
        open_ = np.flatnonzero(label == Label.UNSEEN)
        # just inside the surface, as deep as the limit: empty there is more than noise
        inside = surface_mm[open_] - limit_mm * seen.normals[open_]
        f_mm = seen.template.distance(inside)
        empty = (evidence.cautious(inside, f_mm, limit_mm) > limit_mm / 2) & (f_mm < -limit_mm / 2)
        # what nobody saw is missing only as part of what was seen to be
        places_mm = np.concatenate([surfels.place_mm[missing], surface_mm[open_[empty]]])
        group = group_points(places_mm, reach_mm=touching_mm(surfels.cell_mm))
        told = int(missing.sum())
        with_cells = np.isin(group[told:], group[:told])
        label[open_[empty][with_cells]] = int(Label.MISSING)
    return label
