"""Detection: from an aligned scan to labels, thresholds and regions.

The threshold adds what is systematic (process allowance, registration, template bias) to what
noise can do at a stated false-alarm rate; averages over cells and bead-sized windows find what
is thinner than one point's noise, and hysteresis follows it to its rim.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.stats import norm

from amrepair.detect.anomaly import AnomalyMap, Label
from amrepair.detect.evidence import Evidence, gather, with_stubs
from amrepair.detect.faces import PLANE_POINTS
from amrepair.detect.holes import UPRIGHT
from amrepair.detect.near import nearest_within
from amrepair.detect.normal_variation import forgiven
from amrepair.detect.rays import RangeImage, range_images
from amrepair.detect.regions import find_regions
from amrepair.detect.strands import on_strands
from amrepair.detect.surfels import Surfels, make_surfels
from amrepair.errors import InputError
from amrepair.scans import Scan
from amrepair.template.port import Template
from gcode.progress import Progress, silent

# Of places in the template's frame and their deviations: a length for each.
RoundedUp = Callable[[Float[np.ndarray, "s 3"], Float[np.ndarray, " s"]], Float[np.ndarray, " s"]]
# Half a 0.2 mm layer: what section-at-mid-layer leaves on slopes and rounds off at tops.
DEFAULT_ALLOWANCE_MM = 0.1
# A layer's own top lies where the job's G-code puts it: a quarter of a layer is left to the beads.
TOP_ALLOWANCE_MM = 0.05
DEFAULT_REGISTRATION_SIGMA_MM = 0.03
# Of a layer that lacks as a whole: windows of many beads, a quarter of them seen, told to half of
# what a bead's own window is; in 87 looks at clean layers of six parts none was more than 0.07 low.
LEVEL_WINDOW_MM, LEVEL_SEEN, LEVEL_LIMIT_MM, LEVEL_MOST_MM = 6.0, 0.25, 0.08, 0.15
# The template's distance is the height under a plane: to rounding.
ON_PLANE_MM = 1e-4
WELL_SEEN_POINTS = 27  # three each way
FALSE_ALARMS_PER_SCAN = 1e-3
# Excess farther out than this is not part of the print (clutter, the bed's rim).
MAX_EXCESS_MM = 12.0
# Bed, skirt and first-layer ooze: one thick layer above the lowest plane of the part.
BED_BAND_MM = 0.35
# So much of the underside seen, so far from its rim: nothing lies under the part, there is no bed.
SEEN_UNDERSIDE, RIM_MM, FOOT_CELL_MM, MOST_FOOT = 0.3, 0.15, 1.0, 20_000
# Fewer cells than this over the threshold are an outlier, not a surface.
MIN_CORE_CELLS = 3
SURFACE_SPACING_MM = 0.6
# So many tell a scan's size, to the factor between two units.
SIZE_POINTS = 20_000


@dataclass(frozen=True, slots=True)
class Threshold:
    """Limits on a cell's mean deviation.

    Attributes
    ----------
    systematic_mm
        Allowance, registration and bias: what averaging does not remove.
    sigma_mm
        Noise of one point.
    quantile
        Standard normal quantile of the false-alarm rate.
    """

    systematic_mm: float
    sigma_mm: float
    quantile: float

    def high_mm(self, count: Int[np.ndarray, " s"]) -> Float[np.ndarray, " s"]:
        """(s,) limit for a mean of `count` points to start a region."""
        return self.systematic_mm + self.quantile * self.sigma_mm / np.sqrt(np.maximum(count, 1))

    def low_mm(self, count: Int[np.ndarray, " s"]) -> Float[np.ndarray, " s"]:
        """(s,) limit for a mean of `count` points to go on with one."""
        return self.systematic_mm / 2 + 2 * self.sigma_mm / np.sqrt(np.maximum(count, 1))

    @property
    def well_seen_mm(self) -> float:
        """Limit where there are points enough to start a region."""
        return float(self.high_mm(np.array([WELL_SEEN_POINTS]))[0])


def detect(
    scan: Scan,
    template: Template,
    *,
    threshold_mm: float | None = None,
    allowance_mm: float = DEFAULT_ALLOWANCE_MM,
    top_z_mm: float | None = None,
    registration_sigma_mm: float = DEFAULT_REGISTRATION_SIGMA_MM,
    false_alarms: float = FALSE_ALARMS_PER_SCAN,
    top_k: int = 1000,
    images: tuple[RangeImage, ...] | None = None,
    surface: tuple[Float[np.ndarray, "m 3"], Float[np.ndarray, "m 3"]] | None = None,
    rounded_up: RoundedUp | None = None,
    up: Float[np.ndarray, " 3"] = UPRIGHT,
    progress: Progress = silent,
) -> AnomalyMap:
    """Score and label a scan against its template.

    Parameters
    ----------
    scan
        In the template's frame.
    threshold_mm
        Systematic part of the limit; None adds up allowance, registration and template bias.
    allowance_mm
        What the process may leave (staircase, top rounding): half a layer by default.
    top_z_mm
        Height of the layer just printed, where the template ends there: what is missing under
        that plane is judged with `TOP_ALLOWANCE_MM`, since the job says exactly where it lies.
    registration_sigma_mm
        Standard deviation of the alignment at the surface.
    false_alarms
        Expected number of regions per scan that noise alone makes.
    top_k
        How many of the highest scores make the object score (PASDF: 1000).
    images
        What the scan's rays saw (`range_images`), where it is known already.
    surface
        The template's surface points, `SURFACE_SPACING_MM` apart, and normals, where they are.
    rounded_up
        Of places and their deviations: how far out of the template the process itself was told to
        go there. So much is not excess.
    up
        Unit vector away from what the part stands on, template frame.

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
    if scan.frame != "template":
        raise InputError(
            f"the scan {scan.source} is in frame '{scan.frame}'; align it to the template first"
        )
    _refuse_wrong_scale(scan, template)
    progress("detect", 0.0, 4.0)
    with ThreadPoolExecutor(1) as beside:  # what rays saw needs no distances, nor they it
        asked = None if images is not None else beside.submit(range_images, scan)
        f_mm = template.distance(scan.points_mm)
        surface = surface or template.surface_points(SURFACE_SPACING_MM)
        keep = ~_background(scan, template, f_mm, surface[0])
        if not keep.any():
            raise InputError(
                f"no point of the scan {scan.source} lies within {MAX_EXCESS_MM:g} mm of the "
                "template; check its frame, its unit and that it shows this part"
            )
        surfels = make_surfels(scan.points_mm, f_mm, keep)
        seen = images or () if asked is None else asked.result()
    limit, source = _threshold(
        scan, template, surfels, threshold_mm, allowance_mm, registration_sigma_mm, false_alarms
    )
    progress("detect", 1.0, 4.0)
    top_allowance_mm = min(allowance_mm, TOP_ALLOWANCE_MM)
    top_limit = replace(limit, systematic_mm=limit.systematic_mm - allowance_mm + top_allowance_mm)
    top = _under_plane(surfels, None if threshold_mm is not None else top_z_mm)
    judged = higher = forgiven(surfels, template)
    if rounded_up is not None:
        over_mm = rounded_up(judged.place_mm, judged.deviation_mm)
        higher = judged.judged_by(lambda deviation_mm: deviation_mm - over_mm)
    missing, excess = _label_surfels(judged, higher, template, limit, top_limit, top)
    evidence = gather(
        scan,
        template,
        surfels,
        missing | excess,
        seen,
        threshold_mm=float(limit.low_mm(np.array([PLANE_POINTS]))[0]),
        up=up,
    )
    progress("detect", 2.0, 4.0)
    label = np.zeros(len(scan), np.int64)
    has_cell = surfels.of_point >= 0
    cell = surfels.of_point[has_cell]
    label[has_cell] = np.where(
        missing[cell], int(Label.MISSING), np.where(excess[cell], int(Label.EXCESS), 0)
    )
    if surfels.spacing_mm > SURFACE_SPACING_MM:
        surface = template.surface_points(surfels.spacing_mm)
    surface_mm, normals = surface
    surface_label = _label_surface(surface_mm, normals, template, evidence, missing, limit)
    gone_mm = surface_mm[surface_label == int(Label.MISSING)]
    evidence = with_stubs(evidence, scan, gone_mm, missing | excess)
    progress("detect", 3.0, 4.0)
    score = np.abs(f_mm)
    kept_scores = score[keep]
    k = min(top_k, len(kept_scores))
    object_score = float(np.partition(kept_scores, len(kept_scores) - k)[-k:].mean())
    regions = find_regions(evidence, missing, excess, surface_mm, surface_label, template)
    progress("detect", 4.0, 4.0)
    return AnomalyMap(
        points_mm=scan.points_mm,
        deviation_mm=f_mm,
        score=score,
        label=label,
        template_points_mm=surface_mm,
        template_label=surface_label,
        threshold_mm=limit.well_seen_mm,
        threshold_source=source,
        object_score=object_score,
        regions=regions,
        top_z_mm=top_z_mm if threshold_mm is None else None,
        top_threshold_mm=top_limit.well_seen_mm,
        evidence=evidence,
        surfel_label=np.where(missing, int(Label.MISSING), np.where(excess, int(Label.EXCESS), 0)),
        surfel_higher_mm=surfels.deviation_mm - higher.deviation_mm,
    )


def _refuse_wrong_scale(scan: Scan, template: Template) -> None:
    """Metres or inches read as millimetres: the sizes differ by the factor between the units."""
    some = scan.points_mm[:: max(1, len(scan) // SIZE_POINTS)]
    scan_mm = float(np.linalg.norm(np.ptp(some, axis=0)))
    part_mm = float(np.linalg.norm(np.ptp(template.bounds_mm, axis=0)))
    if 0 < scan_mm * 200 < part_mm:
        raise InputError(
            f"the scan {scan.source} spans {scan_mm:.3g} mm and the template {part_mm:.3g} mm: "
            f"the scan looks like metres; multiply it by 1000"
        )
    if scan_mm > 200 * part_mm:
        raise InputError(
            f"the scan {scan.source} spans {scan_mm:.3g} mm and the template {part_mm:.3g} mm: "
            f"the scan looks like micrometres, or the template like metres; convert one to mm"
        )


def _background(
    scan: Scan,
    template: Template,
    f_mm: Float[np.ndarray, " n"],
    surface_mm: Float[np.ndarray, "m 3"],
) -> Bool[np.ndarray, " n"]:
    """Bed, skirt and far clutter: outside the part, near its lowest plane or far away."""
    low_z = float(template.bounds_mm[0, 2])
    if _shows_underside(scan, template, f_mm, surface_mm):
        # what lies beside the part in its lowest plane is where it stood when seen from above
        rim_mm = _rim_mm(scan)
        in_plane = np.abs(scan.points_mm[:, 2] - low_z) < rim_mm
        beside = in_plane & (f_mm > max(rim_mm, BED_BAND_MM / 2))
        return np.asarray((f_mm > MAX_EXCESS_MM) | beside)
    bed = (scan.points_mm[:, 2] < low_z + BED_BAND_MM) & (f_mm > 0.02)
    inside_band = scan.points_mm[:, 2] > low_z - BED_BAND_MM
    # below the part there is no print; a whole-part scan has its own underside at f ≈ 0
    return (bed & (f_mm > BED_BAND_MM / 2)) | (f_mm > MAX_EXCESS_MM) | (~inside_band & (f_mm > 1.0))


def _rim_mm(scan: Scan) -> float:
    """How far from the lowest plane a point may lie that is on it."""
    return max(RIM_MM, 4.0 * scan.sigma_mm)


def _shows_underside(
    scan: Scan,
    template: Template,
    f_mm: Float[np.ndarray, " n"],
    surface_mm: Float[np.ndarray, "m 3"],
) -> bool:
    """Whether the part was seen from below: then what bulges there is no bed."""
    low_z = float(template.bounds_mm[0, 2])
    rim_mm = _rim_mm(scan)
    near = np.flatnonzero((np.abs(f_mm) < rim_mm) & (scan.points_mm[:, 2] < low_z + rim_mm))

    def cells_within(points_mm: Float[np.ndarray, "k 3"]) -> set[tuple[int, int]]:
        above = points_mm.copy()
        above[:, 2] = low_z + rim_mm + RIM_MM
        under = above[template.distance(above) < -rim_mm, :2] if len(above) else above[:, :2]
        index = np.unique(np.floor(under / FOOT_CELL_MM).astype(np.int64), axis=0)
        return {(int(x), int(y)) for x, y in index}

    seen = cells_within(scan.points_mm[near[:: len(near) // MOST_FOOT + 1]])
    if not seen:
        return False
    foot = cells_within(surface_mm[surface_mm[:, 2] < low_z + ON_PLANE_MM])
    return len(seen & foot) > SEEN_UNDERSIDE * max(len(foot), 1)


def _threshold(
    scan: Scan,
    template: Template,
    surfels: Surfels,
    threshold_mm: float | None,
    allowance_mm: float,
    registration_sigma_mm: float,
    false_alarms: float,
) -> tuple[Threshold, str]:
    """The limit, and how it was set."""
    sigma_mm = max(scan.sigma_mm, surfels.spread_mm)
    rate = false_alarms / max(len(surfels), 1)
    quantile = float(norm.isf(rate))
    if threshold_mm is not None:
        return (
            Threshold(threshold_mm, sigma_mm, quantile),
            f"given: {threshold_mm:g} mm plus noise {sigma_mm:.3f} mm per point",
        )
    systematic = allowance_mm + float(np.hypot(2 * registration_sigma_mm, template.bias_mm))
    return (
        Threshold(systematic, sigma_mm, quantile),
        f"systematic {systematic:.3f} mm (allowance {allowance_mm:g}, registration "
        f"{registration_sigma_mm:g}, template bias {template.bias_mm:.3f}) plus {quantile:.1f} "
        f"sigma of noise {sigma_mm:.3f} mm on averages: at most {false_alarms:g} false regions "
        "expected per scan",
    )


def _under_plane(surfels: Surfels, top_z_mm: float | None) -> Bool[np.ndarray, " s"]:
    """Surfels whose deviation is their height under the plane of the layer just printed."""
    if top_z_mm is None:
        return np.zeros(len(surfels), bool)
    return np.abs(surfels.deviation_mm - (surfels.place_mm[:, 2] - top_z_mm)) < ON_PLANE_MM


def _label_surfels(
    surfels: Surfels,
    higher: Surfels,
    template: Template,
    limit: Threshold,
    top_limit: Threshold,
    top: Bool[np.ndarray, " s"],
) -> tuple[Bool[np.ndarray, " s"], Bool[np.ndarray, " s"]]:
    """Missing and excess by two scales and hysteresis; missing under the top by its own limits.

    `higher` has the deviations that excess is told by.
    """
    labels = []
    wide_top = top.copy()
    around = surfels.table[top]
    wide_top[top] = (top[around] | (around < 0)).all(axis=1)
    for sign in (-1.0, 1.0):
        own, own_wide = (top, wide_top) if sign < 0 else (np.zeros_like(top),) * 2
        judged = surfels if sign < 0 else higher
        cell = sign * judged.deviation_mm
        wide = sign * judged.wide_deviation_mm
        high = np.where(own, top_limit.high_mm(surfels.count), limit.high_mm(surfels.count))
        count = surfels.wide_count
        high_wide = np.where(own_wide, top_limit.high_mm(count), limit.high_mm(count))
        low = np.where(own, top_limit.low_mm(surfels.count), limit.low_mm(surfels.count))
        core = (cell > high) & (surfels.count >= 2)
        core |= (wide > high_wide) & (count >= 6)
        through = cell > low
        if sign < 0:
            core |= _low_level(surfels, own_wide)
        core &= through
        if sign > 0:
            strands = on_strands(
                judged,
                template,
                (wide > limit.low_mm(count)) & ~core,
                systematic_mm=limit.systematic_mm,
                noise_mm=limit.quantile * limit.sigma_mm,
            )
            core, through = core | strands, through | strands
        grown = surfels.grow(core, through)
        labels.append(_drop_specks(surfels, grown, core))
    missing, excess = labels
    return missing, excess & ~missing


def _low_level(surfels: Surfels, top: Bool[np.ndarray, " s"]) -> Bool[np.ndarray, " s"]:
    """Cells of the layer just printed around which it lies too low as a whole.

    On a small island, and in a thin wall, the layer's level counts, and the bead's own window.
    """
    level_mm = surfels.level_deviation(
        top, window_mm=LEVEL_WINDOW_MM, least=LEVEL_SEEN, most_mm=LEVEL_MOST_MM
    )
    around = np.isfinite(level_mm)
    if not around.any():
        return around
    alone = top & ~around & (surfels.wide_deviation_mm < -LEVEL_LIMIT_MM)
    level_mm[alone] = level_mm[around].mean()
    return np.asarray(around | alone) & (level_mm < -LEVEL_LIMIT_MM)


def _drop_specks(
    surfels: Surfels, grown: Bool[np.ndarray, " s"], core: Bool[np.ndarray, " s"]
) -> Bool[np.ndarray, " s"]:
    """Without the connected groups that hold fewer than MIN_CORE_CELLS core cells."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    which = np.flatnonzero(grown)
    if len(which) == 0:
        return grown
    number = np.full(len(surfels) + 1, -1, np.int64)
    number[which] = np.arange(len(which))
    near = number[surfels.table[which]]  # −1 looks up the last entry, which is −1
    row = np.repeat(np.arange(len(which)), 27)
    ok = near.ravel() >= 0
    graph = coo_matrix(
        (np.ones(int(ok.sum()), bool), (row[ok], near.ravel()[ok])), (len(which), len(which))
    )
    groups, group = connected_components(graph, directed=False)
    cores = np.bincount(group, weights=core[which], minlength=groups)
    kept = np.zeros_like(grown)
    kept[which] = cores[group] >= MIN_CORE_CELLS
    return kept


def _label_surface(
    surface_mm: Float[np.ndarray, "m 3"],
    normals: Float[np.ndarray, "m 3"],
    template: Template,
    evidence: Evidence,
    missing: Bool[np.ndarray, " s"],
    limit: Threshold,
) -> Int[np.ndarray, " m"]:
    """Present where scanned surface lies on it, missing where seen to be gone, else unseen."""
    surfels = evidence.surfels
    reach_mm = 1.8 * surfels.cell_mm + limit.systematic_mm
    nearest = nearest_within(surface_mm, surfels.place_mm, reach_mm)
    present = (nearest >= 0) & ~missing[nearest]
    label = np.where(present, int(Label.OK), int(Label.UNSEEN))
    if evidence.has_rays:
        label[_seen_through(surface_mm, normals, template, evidence, limit)] = int(Label.MISSING)
    elif missing.any():
        open_ = np.flatnonzero(~present)
        # just inside the surface, as deep as the limit: empty there is more than noise
        depth_mm = limit.well_seen_mm
        inside = surface_mm[open_] - depth_mm * normals[open_]
        f_mm = template.distance(inside)
        gone = (evidence.cautious(inside, f_mm) > depth_mm / 2) & (f_mm < -depth_mm / 2)
        label[open_[gone]] = int(Label.MISSING)
    return label


def _seen_through(
    surface_mm: Float[np.ndarray, "m 3"],
    normals: Float[np.ndarray, "m 3"],
    template: Template,
    evidence: Evidence,
    limit: Threshold,
) -> Bool[np.ndarray, " m"]:
    """Points that rays passed by more than noise can be, in whatever is thin.

    A wall one bead wide that is gone leaves points of what stood below it, less than a
    millimetre off and, in a wall so thin, within every limit; a layer over a cell leaves none.
    """
    depth_mm = limit.well_seen_mm
    inside = surface_mm - 0.5 * depth_mm * normals
    f_mm = template.distance(inside)
    return (evidence.cautious(inside, f_mm) > depth_mm) & (f_mm < -depth_mm / 4)
