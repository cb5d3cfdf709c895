"""Types of defects with a confidence, from geometry and from the job's own beads.

What went wrong with the whole print comes first (it came off, layers are shifted, it curls up):
then every region is of that. Then what went wrong with the flow, told from the last layer's beads
in the order they were printed: too little from some bead on is a clog, where that tells more of
them right than a region would, whichever lie beside one another, and than one level of the whole
layer does; too little everywhere is under-extrusion. What is left has a place, and is told by its
shape.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import manifold3d
import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial import cKDTree

from amrepair.arrays import Box, Mask, PlanePoints, Values
from amrepair.deficit.heights import has_others_beside
from amrepair.frames import Transform, cells_of, turned_rad
from amrepair.loop.findings import matching
from amrepair.loop.kind_options import DEFAULT_KINDS, KindOptions
from amrepair.loop.layer_shift import ShiftOptions, Walls, layer_shift
from amrepair.loop.shapes import bead_way, last_beads, over_last_beads, spread, tall_mm
from amrepair.loop.shapes import chain as chain_of
from amrepair.regions import Label, Region
from amrepair.regions.anomaly import DefectType
from amrepair.repair import RepairPlan, Site
from amrepair.scans.facing import facing
from amrepair.template.port import Template
from gcode.meshes import box_of_solid
from gcode.reader import Job


@dataclass(frozen=True, slots=True)
class _Surface:
    """Points of the scan, build frame, with their deviations and outward directions.

    `noise_mm` is that of one point; heights are above the bed as the scan itself shows it.
    """

    place_mm: Float[np.ndarray, "s 3"]
    deviation_mm: Float[np.ndarray, " s"]
    outward: Float[np.ndarray, "s 3"]
    noise_mm: float

    def part(self, pick: Bool[np.ndarray, " s"], most: int) -> _Surface:
        """Some of the points, evenly thinned where they are many."""
        which = np.flatnonzero(pick)
        which = which[:: max(1, -(-len(which) // most))]
        return _Surface(
            self.place_mm[which], self.deviation_mm[which], self.outward[which], self.noise_mm
        )

    def __len__(self) -> int:
        return len(self.place_mm)


@dataclass(frozen=True, slots=True)
class TypeGuess:
    """A type, how sure it is, and what else is known of it, for people.

    `layer` is the job's first one that it concerns; None where that is not told.
    """

    type: DefectType
    confidence: float
    told: str = ""
    layer: int | None = None


def typed(
    plan: RepairPlan,
    job: Job,
    site: Site,
    line: int,
    build_from_scanner: Transform,
    *,
    repaired: bool = False,
    mended: manifold3d.Manifold | None = None,
    options: KindOptions = DEFAULT_KINDS,
) -> RepairPlan:
    """The plan with every region typed.

    Parameters
    ----------
    line
        The job's first line that is not yet printed.
    build_from_scanner
        Where the scanner's calibration says that the scan lies.
    repaired
        A patch lies on the layer by now: its beads no longer tell, in the order in which the job
        laid them, how much came out.
    mended
        What was missing at the stop before and was filled there, build frame.
    """
    layer_mm = plan.layer_height_mm
    seen = _surfaces(plan, site.planned or site.template, options)
    found, flow = [_came_off(plan, build_from_scanner, options)], None
    if seen is not None:
        # a scan that was laid over the upper layers lies aside of its place, as the lower ones do
        found += [_aside(plan, job, line, seen, options), _warped(seen[0], layer_mm, options)]
    whole = max((k for k in found if k is not None), key=lambda k: k.confidence, default=None)
    if whole is None and seen is not None and plan.deficit.regions and not repaired:
        flow = _flow(_laid(plan, job, line, seen[2], options), job, line, layer_mm, options)
    pieces = {
        Label.MISSING: plan.deficit.missing.decompose(),
        Label.EXCESS: plan.deficit.excess.decompose(),
    }
    regions = []
    for region in plan.deficit.regions:
        # of a line that is gone many looks have told, not its depth
        there = 1.0 if region.skipped else _there(region.depth_mm, plan.deficit.tolerance_mm)
        mine, box_mm = pieces[region.label], np.asarray(region.box_mm)
        excess = region.label is Label.EXCESS
        kind = whole or _of_region(
            region,
            mine,
            flow,
            job,
            line,
            at_rim=not excess and _at_rim(plan, site, box_mm, options),
            hangs=excess and _hangs(matching(mine, box_mm), plan, site, options),
            mended=mended,
            layer_mm=layer_mm,
            options=options,
        )
        regions.append(
            replace(region, type=kind.type, told=kind.told,
                    confidence=min(kind.confidence, there) if whole is None else kind.confidence)
        )  # fmt: skip
    if whole is not None and not any(r.volume_mm3 >= 1.0 for r in regions):
        regions.append(_everywhere(plan, site, whole))
    return replace(
        plan,
        deficit=replace(plan.deficit, regions=tuple(regions)),
        shifted_from=None if whole is None else whole.layer,
    )


def shifted(
    plan: RepairPlan, job: Job, template: Template, options: KindOptions = DEFAULT_KINDS
) -> TypeGuess | None:
    """Whether layers of a finished part lie aside of those below; None where none are told."""
    seen = _surfaces(plan, template, options)
    end = job.layers[-1].end_line
    return None if seen is None else _aside(plan, job, end, seen, options, from_above=False)


def _there(depth_mm: float, tolerance_mm: float) -> float:
    """That a region is there at all: a half at half the tolerance, 15 in 16 at twice."""
    return float(1.0 - 0.25 ** (depth_mm / max(tolerance_mm, 1e-6)))


def _sure(value: float, limit: float) -> float:
    """Confidence of a measure against its limit: a half there, 0.9 at twice."""
    return float(1.0 - 0.5 ** ((value / max(limit, 1e-9)) ** 1.7))


def _surfaces(
    plan: RepairPlan, expected: Template, options: KindOptions
) -> tuple[_Surface, _Surface, float] | None:
    """What was seen of the top, and of the walls, and how high the bed seems to lie.

    None where no evidence says how noisy it is.
    """
    evidence = plan.anomaly.evidence
    if evidence is None or len(evidence.surfels) == 0:
        return None
    every = max(1, len(plan.anomaly.points_mm) // (12 * options.most_points))
    points, deviation = plan.anomaly.points_mm[::every], plan.anomaly.deviation_mm[::every]
    placed = plan.build_from_template
    height = placed.apply(points)[:, 2]
    beside = np.flatnonzero((deviation > options.beside_layer_mm) & (np.abs(height) < 0.5))
    bed_mm = float(np.median(height[beside])) if len(beside) >= options.least_points else 0.0
    near = np.flatnonzero((np.abs(deviation) < 3.0) & (height > options.low_wall_mm))
    near = near[:: max(1, -(-len(near) // (4 * options.most_points)))]
    every_mm, apart_mm = plan.anomaly.points_mm, evidence.surfels.spacing_mm
    near = near[has_others_beside(points[near], every_mm, apart_mm)]
    gradient = expected.distance_and_gradient(points[near])[1]
    length = np.linalg.norm(gradient, axis=1, keepdims=True)
    outward = placed.rotate(gradient / np.maximum(length, 1e-9))
    place = placed.apply(points[near])
    corrected = deviation[near] - bed_mm * np.maximum(outward[:, 2], 0.0)
    noise_mm = max(float(evidence.surfels.spread_mm), plan.scan.sigma_mm)
    seen = _Surface(place, corrected, outward, noise_mm)
    level_mm = float(placed.apply(expected.bounds_mm)[:, 2].max())
    high = place[:, 2] > level_mm - options.top_rim_mm
    low = place[:, 2] < level_mm - options.high_wall_mm
    top = seen.part((outward[:, 2] > options.top_cosine) & high, options.most_points)
    walls = (np.abs(outward[:, 2]) < options.wall_cosine) & low
    return top, seen.part(walls, options.most_points), bed_mm


def _laid(plan: RepairPlan, job: Job, line: int, bed_mm: float, options: KindOptions) -> _Surface:
    """What was seen over the last layer's beads, by how far it lies above or below their path.

    Not by how far from what is planned: where a bead over open infill is low or gone, what is seen
    there is the top of a lower one, which is where it should be. What a bead lacks is no more than
    its height.
    """
    assert plan.anomaly.evidence is not None
    placed, scan, most_mm = plan.build_from_template, plan.scan, plan.layer_height_mm
    some = np.arange(0, len(scan), max(1, len(scan) // (4 * options.most_points)))
    place = placed.apply(scan.points_mm[some])
    over, above_mm = over_last_beads(place, job, line, share=options.over_bead)
    faced = placed.rotate(facing(scan, some[over], neighbours=options.faced_by))
    upward = faced[:, 2] if scan.normals is not None else np.abs(faced[:, 2])
    up = upward > options.top_cosine  # noise spreads walls over their beads; undersides are none
    over, above_mm = over[up], above_mm[up]
    noise_mm = max(float(plan.anomaly.evidence.surfels.spread_mm), plan.scan.sigma_mm)
    seen = _Surface(place[over], np.clip(above_mm - bed_mm, -most_mm, most_mm), faced[up], noise_mm)
    return seen.part(np.ones(len(over), bool), options.most_points)


def _aside(
    plan: RepairPlan,
    job: Job,
    line: int,
    seen: tuple[_Surface, _Surface, float],
    options: KindOptions,
    *,
    from_above: bool = True,
) -> TypeGuess | None:
    """Whether layers lie aside of those below.

    What is not seen `from_above` has floors of hollows, too, which are no tops of beads.

    It is no surer than the shift is large: what it does to the print is a matter of its size.
    """
    (_, walls, bed_mm), scan = seen, plan.scan
    most = options.shift.points_per_up * options.shift.most_points
    some = np.arange(0, len(scan), max(1, -(-len(scan) // most)))
    normals = plan.build_from_template.rotate(facing(scan, some, neighbours=options.faced_by))
    upward = normals[:, 2] if scan.normals is not None else np.abs(normals[:, 2])
    place_mm = plan.build_from_template.apply(scan.points_mm[some[upward > options.top_cosine]])
    if not from_above:
        every_mm = plan.build_from_template.apply(scan.points_mm)
        place_mm = place_mm[~_under_roof(place_mm, every_mm, options.shift)]
    beads_mm = options.short_layers * plan.layer_height_mm
    found = layer_shift(
        place_mm - np.array([0.0, 0.0, bed_mm]),
        Walls(
            walls.place_mm, walls.deviation_mm, walls.outward[:, :2],
            float(np.hypot(walls.noise_mm, options.shift.lateral_mm)),
        ),
        float(np.hypot(walls.noise_mm, beads_mm)), job, line, options.shift,
        regions=bool(plan.deficit.regions), between_views_mm=_between_views_mm(plan),
    )  # fmt: skip
    if found is None:
        return None
    spoils = _sure(found.size_mm, options.shift_layers * plan.layer_height_mm)
    return TypeGuess(
        DefectType.LAYER_SHIFT, min(spoils, found.confidence), found.told(), found.layer
    )


def _under_roof(
    place_mm: Float[np.ndarray, "p 3"], scan_mm: Float[np.ndarray, "s 3"], options: ShiftOptions
) -> Bool[np.ndarray, " p"]:
    """Which points lie under a point of the scan that is higher by more than a roof is thick."""
    cell = cells_of(scan_mm[:, :2], scan_mm[:, :2].min(axis=0), options.column_mm)
    top_mm = np.full(tuple(cell.max(axis=0) + 1), -np.inf)
    np.maximum.at(top_mm, tuple(cell.T), scan_mm[:, 2])
    own = cells_of(place_mm[:, :2], scan_mm[:, :2].min(axis=0), options.column_mm)
    return np.asarray(top_mm[tuple(own.T)] > place_mm[:, 2] + options.roof_mm)


def _between_views_mm(plan: RepairPlan) -> float:
    noise = plan.anomaly.noise
    return 0.0 if noise is None else noise.view_disagreement_mm or 0.0


def _came_off(
    plan: RepairPlan, build_from_scanner: Transform, options: KindOptions
) -> TypeGuess | None:
    """Whether the part lies somewhere else than where the calibration and the job have it."""
    moved = plan.build_from_scan @ build_from_scanner.inverse()
    placed = plan.build_from_template
    points = plan.scan.points_mm
    some = points[:: max(1, len(points) // options.most_points)]
    centre = placed.apply(some).mean(axis=0, keepdims=True)
    off_mm = float(np.linalg.norm(moved.apply(centre) - centre))
    turned_deg = float(np.rad2deg(turned_rad(moved.rotation)))
    share = max(off_mm / options.moved_mm, turned_deg / options.moved_deg)
    return TypeGuess(DefectType.DETACHED, _sure(share, 1.0)) if share > 1.0 else None


def _moved_so(told_mm: Values, seen_mm: Values, options: KindOptions) -> bool:
    """Whether surface stands off wherever a motion of all of it has it do so, band by band.

    Of what broke off, or lies on it, the rest is where it was. Bands begin at shares of the
    farthest.
    """
    bands = options.warp_bands
    band = np.digitize(told_mm / told_mm.max(), bands)
    seen = (seen_mm[band == k] / told_mm[band == k] for k in range(1, len(bands) + 1))
    return all(np.median(one) > options.moved_share for one in seen if len(one))


def _warped(top: _Surface, layer_mm: float, options: KindOptions) -> TypeGuess | None:
    """The top bends up at its rim: a parabola explains what flow and place do not."""
    if len(top) < options.least_points:
        return None
    xy, dev = top.place_mm[:, :2], top.deviation_mm
    centre, half = 0.5 * (xy.min(axis=0) + xy.max(axis=0)), 0.5 * np.ptp(xy, axis=0)
    x, y = ((xy - centre) / np.maximum(half, 1.0)).T
    design = np.column_stack([np.ones(len(x)), x, y, x * x, x * y, y * y])
    found, *_ = np.linalg.lstsq(design, dev, rcond=None)
    fitted = design @ found
    flat = float(((dev - dev.mean()) ** 2).sum())
    gained = flat - float(((dev - fitted) ** 2).sum())
    share = gained / max(flat - len(top) * top.noise_mm**2, 0.2 * flat, 1e-9)
    middle = np.hypot(x, y) < 0.4
    rim = np.hypot(x, y) > 1.0
    if not middle.any() or not rim.any():
        return None
    high_mm = float(np.percentile(fitted[rim], 90))
    lifted_mm = high_mm - float(fitted[middle].mean())
    # what sinks in the middle is no curl
    up = high_mm > options.lifted_layers * layer_mm
    # layers that contract by a strain more than those below bend a part so far, and no farther
    most_mm = options.most_strain * float((half**2).sum()) / float(np.median(top.place_mm[:, 2]))
    bent = up and lifted_mm < most_mm and _moved_so(fitted, dev, options)
    if bent and lifted_mm > options.warp_layers * layer_mm and share > options.warp_share:
        sure = _sure(lifted_mm, options.warp_layers * layer_mm)
        return TypeGuess(DefectType.WARP, sure * min(1.0, share / (1.5 * options.warp_share)))
    return None


def _flow(
    top: _Surface, job: Job, line: int, layer_mm: float, options: KindOptions
) -> TypeGuess | None:
    """What the last layer's beads carry, in the order they were printed."""
    points = last_beads(job, line)
    if len(points) < 30 or len(top) < options.least_points:
        return None
    window = max(4, round(6 * (top.noise_mm / layer_mm) ** 2 / 0.3**2))  # noise well below a third
    distance, nearest = cKDTree(top.place_mm[:, :2]).query(points[:, :2], k=min(window, 60))
    seen = distance[:, 0] < 1.0
    if seen.sum() < 30:
        return None
    low = -top.deviation_mm[nearest[seen]].mean(axis=1) / layer_mm
    short = low > options.short_layers
    if np.mean(low < -options.short_layers) > options.layer_share:
        return TypeGuess(DefectType.OVER_EXTRUSION, float(np.mean(low < -options.short_layers)))
    if not short.any():
        return None
    at, wrong = _since(short)
    share = 1.0 - at / len(short)
    if (
        options.clog_least < share < options.clog_most
        and _lasts(short[at:]) >= options.clog_lasts
        and wrong <= _apart(points[seen, :2], short, distance[seen, -1], options)
        and _left_by_clog(low, at) < float(((low - low.mean()) ** 2).sum())
    ):
        return TypeGuess(DefectType.CLOG, 1.0 - wrong)
    if short.mean() > options.layer_share:
        return TypeGuess(DefectType.UNDER_EXTRUSION, float(short.mean()))
    return None


def _since(short: Mask) -> tuple[int, float]:
    """From which place along the path too little came out, and the share that this tells wrong.

    All that was printed before it is taken to be whole, all after it to be short.
    """
    wrong = np.cumsum(np.concatenate([[np.sum(~short)], np.where(short, 1, -1)]))
    at = int(np.argmin(wrong))
    return at, float(wrong[at]) / len(short)


def _left_by_clog(low: Values, at: int) -> float:
    """Sum of squares that a clog leaves: whole up to a place along the path, one level from there.

    What one level of the whole layer leaves is to be held against it: a layer that lacks as a whole
    lacks before that place, too.
    """
    before, after = low[:at], low[at:]
    return float((before**2).sum() + ((after - after.mean()) ** 2).sum())


def _lasts(short: Mask) -> float:
    """Share of places, from the first on, up to where they are best taken to be whole again."""
    return float(np.argmax(np.cumsum(np.where(short, 1, -1))) + 1) / len(short)


def _apart(xy_mm: PlanePoints, short: Mask, blur_mm: Values, options: KindOptions) -> float:
    """Share of places that are not as most of those around them: what a region tells wrong.

    `blur_mm` is how far away the points lie that a place's height is the mean of: nearer than
    twice as far two places share them, and their noise.
    """
    distance, near = cKDTree(xy_mm).query(xy_mm, k=min(options.around_of, len(xy_mm)))
    other = distance > np.maximum(2.0 * blur_mm, 1e-9)[:, None]
    other &= np.cumsum(other, axis=1) <= options.around
    votes = np.where(other, np.where(short[near], 1, -1), 0).sum(axis=1)
    told = other.any(axis=1)
    return float(np.mean((votes[told] > 0) != short[told])) if told.any() else 1.0


def _of_region(
    region: Region,
    pieces: list[manifold3d.Manifold],
    flow: TypeGuess | None,
    job: Job,
    line: int,
    *,
    at_rim: bool,
    hangs: bool,
    mended: manifold3d.Manifold | None,
    layer_mm: float,
    options: KindOptions,
) -> TypeGuess:
    """The type of one region, its place and shape considered."""
    piece = matching(pieces, np.asarray(region.box_mm))
    if region.label is Label.EXCESS:
        if flow is not None and flow.type is DefectType.OVER_EXTRUSION:
            return flow
        if hangs:
            return TypeGuess(DefectType.SAG, 0.95)
        chain = chain_of(piece, pieces)
        long_mm, wide_mm, _ = spread(chain)
        lies = tall_mm(chain) < options.string_tall * long_mm  # what climbs a wall is its seam
        if lies and long_mm > options.string_aspect * wide_mm and wide_mm < options.string_width_mm:
            return TypeGuess(DefectType.STRING, _sure(long_mm / wide_mm, options.string_aspect))
        return TypeGuess(DefectType.BLOB, 0.95)
    layers = 0.0 if piece is None else piece.volume() / layer_mm / float(piece.project().area())
    if flow is not None and (
        flow.type is DefectType.UNDER_EXTRUSION
        # what is gone of the layers below, or was until it was filled there, has a place
        or (
            flow.type is DefectType.CLOG
            and layers <= options.clog_layers
            and (piece is None or not _is_over(piece, mended, layer_mm))
        )
    ):
        return flow
    long_mm, wide_mm, along = spread([piece] if piece is not None else [])
    if long_mm > options.skipped_aspect * wide_mm and not at_rim:
        way = bead_way(job, line, np.asarray(region.box_mm))
        if way is not None and abs(float(way @ along)) > options.along_cosine:
            return TypeGuess(
                DefectType.MISSING_BEADS, _sure(long_mm / wide_mm, options.skipped_aspect)
            )
    if layers > options.whole_layers or region.type in (DefectType.VOID, DefectType.CHIP):
        return TypeGuess(DefectType.CHIP if at_rim else DefectType.VOID, 0.95)
    return TypeGuess(region.type, 0.95)


def _hangs(
    piece: manifold3d.Manifold | None, plan: RepairPlan, site: Site, options: KindOptions
) -> bool:
    """Whether most of what is too much lies close below what the job printed with no support.

    By its upper half: what hangs may reach down to the bed, or nobody saw where it ends.
    """
    if piece is None:
        return False
    place_mm = np.asarray(piece.to_mesh64().vert_properties)[:, :3]
    place_mm = place_mm[place_mm[:, 2] >= box_of_solid(piece)[:, 2].mean()]
    levels_mm = np.linspace(0.0, options.sag_mm, options.sag_levels + 1)[1:]
    above = place_mm[:, None] + levels_mm[:, None] * np.array([0.0, 0.0, 1.0])
    inside = site.template.distance(
        plan.build_from_template.inverse().apply(above.reshape(-1, 3))
    ).reshape(above.shape[:2])
    printed_mm = np.inf if site.printed_z_mm is None else site.printed_z_mm
    under = ((inside < 0.0) & (above[..., 2] < printed_mm)).any(axis=1)
    if site.strands is not None:
        under &= ~np.isfinite(site.strands.sample(place_mm[:, :2], outside_mm=-np.inf))
    return float(under.mean()) > 0.5


def _is_over(
    piece: manifold3d.Manifold, mended: manifold3d.Manifold | None, layer_mm: float
) -> bool:
    """Whether most of a piece lies over what was filled in the layer below it."""
    if mended is None:
        return False
    over, low_mm = piece.project(), float(box_of_solid(piece)[0, 2])
    below = over.extrude(1.5 * layer_mm).translate((0.0, 0.0, low_mm - layer_mm)) ^ mended
    return float(below.project().area()) > 0.5 * float(over.area())


def _at_rim(plan: RepairPlan, site: Site, box_mm: Box, options: KindOptions) -> bool:
    """Whether a region reaches the part's outline seen from above, a little below its floor."""
    placed = plan.build_from_template
    z = max(float(box_mm[0, 2]) - options.below_layer_mm, 0.5 * float(box_mm[0, 2]))
    around = np.array([[box_mm[i, 0], box_mm[j, 1], z] for i in (0, 1) for j in (0, 1)])
    inside = site.template.distance(placed.inverse().apply(around))
    foot_mm = float(placed.apply(site.template.bounds_mm)[:, 2].min())
    # near the bed the foot is nearer than any rim
    return bool((inside > -min(options.layer_rim_mm, 0.8 * (z - foot_mm))).any())


def _everywhere(plan: RepairPlan, site: Site, whole: TypeGuess) -> Region:
    """A region of no volume that stands for the whole part."""
    placed = plan.build_from_template
    box = placed.apply(site.template.bounds_mm)
    return Region(
        label=Label.EXCESS,
        type=whole.type,
        volume_mm3=0.0,
        area_mm2=0.0,
        depth_mm=0.0,
        box_mm=np.stack([box.min(axis=0), box.max(axis=0)]),
        confidence=whole.confidence,
        told=whole.told,
    )
