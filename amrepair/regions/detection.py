"""Detection: from an aligned scan to regions, each with how sure it is."""

from __future__ import annotations

import numpy as np
from scipy.special import ndtr

from amrepair.arrays import Mask, Numbers, Points
from amrepair.field.as_built import Evidence, gather, with_stubs
from amrepair.field.groups import group_points, touching_mm
from amrepair.observe.rays import RangeImage
from amrepair.regions.anomaly import AnomalyMap, Label
from amrepair.regions.calibrating import Sound, sound_scales
from amrepair.regions.calibration import NORMAL_NOISE, Calibration
from amrepair.regions.labels import grown
from amrepair.regions.noise import Noise, noise_of
from amrepair.regions.options import RegionOptions
from amrepair.regions.regions import Tested, find_regions
from amrepair.regions.significance import LEAST_PEAKS, Level, as_student, tested
from amrepair.regions.sites import (
    Observed,
    OffByJob,
    PoseKnown,
    Sites,
    agreed,
    observed,
    sites_of,
    tolerances,
)
from amrepair.regions.strands import on_strands
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
    options
        What the test is set to; None takes the defaults.
    calibration
        What sound parts look like to this scanner; None: as the scan itself tells, and so, too,
        where normal noise is given and the scan itself contradicts.
    top_z_mm
        Height of the layer just printed, where the template ends there: what is missing under
        that plane is judged with `top_allowance_mm`, since the job says exactly where it lies.
    images
        What the scan's rays saw (`range_images`), where it is known already.
    surface
        The template's surface points, `spacing_mm` apart, and normals, where they are.
    off_by_job
        Of places and their deviations: how far off the template, on that side, the job's own path
        may put the surface there. So much is not excess, and not missing.
    pose
        How well the scan's pose is known. Of a part that stands on its bed a bow and what it has
        shrunk by are told and taken out, but no top that lies higher or lower as a whole. Where the
        pose is told, as under `top_z_mm`, nothing is.

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

    def observe(without: tuple[int, ...]) -> tuple[Observed, Sites]:
        seen = observed(scan, template, options, images, surface, without)
        return seen, sites_of(seen, options, top_z_mm, off_by_job)

    # a layer that lacks as a whole is no pose: how high its top lies the job has said
    held = "told" if top_z_mm is not None else pose
    seen, sites, nuisance, contradicting = agreed(observe, held, options)
    progress("detect", 1.0, 4.0)
    test = _tested(seen, sites, options, calibration)
    progress("detect", 2.0, 4.0)
    evidence, surface_label = _bounded(seen, test, options)
    progress("detect", 3.0, 4.0)
    regions = find_regions(evidence, test, seen.surface_mm, surface_label, seen.template)
    score = np.abs(seen.f_mm)
    k = min(options.top_k, int(seen.keep.sum()))
    surfel_label = np.where(test.missing, int(Label.MISSING), test.excess * int(Label.EXCESS))
    allowed_mm = sites.tolerance_mm[1] - sites.tolerance_mm[0]
    progress("detect", 4.0, 4.0)
    return AnomalyMap(
        points_mm=scan.points_mm,
        deviation_mm=seen.f_mm,
        score=score,
        label=np.append(surfel_label, 0)[seen.surfels.of_point],
        template_points_mm=seen.surface_mm,
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
        sites=sites,
        noise=test.noise,
        nuisance=nuisance,
        contradicting=contradicting,
        calibration=test.calibration,
        options=options,
        chance_mm=_chance_mm(test),
    )


def _tested(
    seen: Observed, sites: Sites, options: RegionOptions, calibration: Calibration | None
) -> Tested:
    """Test every scale, and grow regions from where it is significant."""
    cells, gone_to = len(seen.surfels), len(seen.surfels) + len(seen.crossed.which)
    levels = tested(sites, options, calibration)
    if calibration == NORMAL_NOISE and _erratic(levels, options):  # the scan itself contradicts
        levels, calibration = tested(sites, options, None), None
    # what errors leave in strips neither a scan nor a calibration tells: only where they are known
    # to be normal is there any
    strands = np.zeros(len(seen.surfels), bool)
    if calibration is not None and calibration.is_normal:
        strands = _strands(seen, sites, levels, options)
    tolerances_mm = tolerances(options, seen.template)
    labels, log_p = grown(
        levels, sites.tolerance_mm, options, anywhere_mm=tolerances_mm[0], strands=strands
    )
    gone = np.zeros(len(seen.surface_mm), bool)
    gone[seen.crossed.which] = labels[0, cells:gone_to]
    gone_p_value = np.ones(len(seen.surface_mm))
    gone_p_value[seen.crossed.which] = np.exp(log_p[0, cells:gone_to])
    # an end speaks for the cell that its points are part of
    ended = seen.ends.surfel[labels[0, gone_to:]]
    labels[0, ended], labels[1, ended] = True, False
    np.minimum.at(log_p[0], seen.ends.surfel, log_p[0, gone_to:])
    errors = as_student(levels[1].quantile, levels[1].freedom)
    noise_mm = float(np.median(errors * levels[1].error_mm))
    return Tested(
        levels,
        calibration,
        noise=noise_of(levels, seen.shares, seen.scan.sigma_mm, options),
        missing=labels[0, :cells],
        excess=labels[1, :cells],
        gone=gone,
        gone_p_value=gone_p_value,
        log_p=log_p,
        limit_mm=tolerances_mm[0] + noise_mm,
        top_mm=tolerances_mm[1] + noise_mm,
    )


def _erratic(levels: tuple[Level, ...], options: RegionOptions) -> bool:
    """Whether so many places stand out as tell a tail, and not all of them to one side.

    What went wrong with a print is too much or too little; a scanner's errors are both. Places
    beyond what is allowed by `grow_sigmas`: normal noise alone leaves hardly one.
    """
    low, high = (int((peaks > options.grow_sigmas).sum()) for peaks in levels[0].peaks)
    return min(low, high) > 0 and low + high >= LEAST_PEAKS


def _chance_mm(test: Tested) -> tuple[tuple[float, float], ...]:
    """By rising width of windows, how low sound places may seem to lie by chance.

    In wider windows than the narrowest, what lies far off, where a calibration knows that.
    """
    told: list[tuple[float, float]] = []
    for level in test.levels[1:]:
        calibrated = bool(told) and test.calibration is not None
        off_mm = level.far_off_mm[0] if calibrated else np.median(level.chance_mm)
        told.append((level.scale.width_mm, float(off_mm)))
    return tuple(told)


def _bounded(seen: Observed, test: Tested, options: RegionOptions) -> tuple[Evidence, Numbers]:
    """What is known of the space around regions, and of each place of the template's surface."""
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
    """What a scan of a sound part shows of its errors, for a calibration to learn from.

    As the scan itself tells, whatever calibration it was judged by.
    """
    assert anomaly.sites is not None
    assert anomaly.options is not None
    return sound_scales(tested(anomaly.sites, anomaly.options, None), anomaly.options)


def _strands(
    seen: Observed, sites: Sites, levels: tuple[Level, ...], options: RegionOptions
) -> Mask:
    """(n,) cells of strips narrower than any window that stand out along their length.

    By how much more than each cell may: what the job itself lays, as supports, stands out too.
    """
    surfels = seen.surfels
    first = levels[1]
    cells = slice(len(surfels))
    usual_mm = float(np.median(first.tolerance_mm[1]))
    higher_mm = sites.value_mm[cells] - sites.tolerance_mm[1, cells] + usual_mm
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
    """How far from the template a cell is broken off: beyond δ's share, and how cells stray.

    Of all cells as many stray farther from their neighbours as of normal noise lie beyond
    `grow_sigmas`: the tail of a real scanner's errors counts.
    """
    level = test.levels[0]
    tolerance_mm = options.grow_share * float(np.median(level.tolerance_mm[0]))
    if test.calibration is not None:
        return tolerance_mm + options.grow_sigmas * float(np.median(level.error_mm))
    stray_mm = np.abs(level.scale.value_mm - level.scale.median_mm)
    share = 1.0 - 2.0 * float(ndtr(-options.grow_sigmas))
    return tolerance_mm + float(np.quantile(stray_mm, share))


def _source(options: RegionOptions, template: Template, noise: Noise) -> str:
    """How the limit came about, in a sentence."""
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
    """Present where scanned surface lies on it, missing where seen to be gone, else unseen."""
    surfels, surface_mm = evidence.surfels, seen.surface_mm
    missing, limit_mm = test.missing, test.limit_mm
    present = (seen.nearest >= 0) & ~missing[seen.nearest]
    label = np.where(present, int(Label.OK), int(Label.UNSEEN))
    if evidence.has_rays:
        label[test.gone] = int(Label.MISSING)
    elif missing.any():
        open_ = np.flatnonzero(~present)
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
