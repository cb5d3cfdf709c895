"""The deficit: template minus as-built, with a tolerance, as solids in the build frame.

Template minus scan leaves a thin connected shell of noise. So the distance field of the template
is eroded by τ, the as-built part is subtracted, and what is left is grown back and clipped to
template minus as-built. What is thinner than τ counts only where detection's
averages say so. Empty space counts only where a ray crossed it or scanned surface bounds it.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Any

import manifold3d
import numpy as np
from jaxtyping import Bool, Float
from scipy import ndimage

from amrepair.deficit.boxes import boxes_of
from amrepair.deficit.heights import as_built_heights, standing_heights, with_what_stands_out
from amrepair.deficit.voxels import VoxelBox, solid_from_field
from amrepair.deficit.walls import (
    with_even_crests,
    with_rising_rims,
    with_sharp_walls,
    with_whole_rims,
)
from amrepair.errors import DeficitError
from amrepair.field.as_built import Evidence, with_stubs
from amrepair.frames import Transform, in_box
from amrepair.observe.background import ON_PLANE_MM
from amrepair.regions import AnomalyMap, Label, Region, detect
from amrepair.regions.regions import classify
from amrepair.regions.skipped import PlannedBeads, skipped
from amrepair.scans import Scan
from amrepair.template.port import Template
from gcode.progress import Progress, silent
from gcode.surfaces import HeightField

# A corner of a cube of side τ lies √3 τ from the eroded template.
GROW_FACTOR = 3**0.5
# Under a layer's top, of the limit: what the surfel nearest to it is labelled for is missing.
THIN_RATIO = 0.25
# One bead of 0.45 × 0.2 mm as long as two nozzle widths: less cannot be placed.
BEAD_MM3 = 0.08
# Pieces below this share of a bead are what marching cubes makes of noise at a rim.
CRUMB_MM3 = 0.02
# From so much on heights will be asked for: what a clean layer's crumbs never are.
EARLY_MM3 = 0.5


class Standing:
    """Heights that are made when they are first asked for: a clean layer needs none.

    Parameters
    ----------
    make
        Makes them; let go of once it has.
    """

    def __init__(self, make: Callable[[], HeightField]) -> None:
        self._make: Callable[[], HeightField] | None = make
        self._made: HeightField | None = None

    def __call__(self) -> HeightField:
        """The heights."""
        if self._made is None:
            assert self._make is not None
            self._made, self._make = self._make(), None
        return self._made


@dataclass(frozen=True, slots=True)
class Deficit:
    """What is missing and what is too much, build frame.

    Attributes
    ----------
    missing, excess
        Watertight `manifold3d.Manifold`s, possibly empty.
    regions
        One per defect, boxes in the build frame, missing first, largest first. Those below what
        one bead can fix are in the list (`below_bead`) and in the solids.
    tolerance_mm
        τ: the erosion that was used.
    unseen_area_mm2
        Template surface that nothing is known of.
    stands
        Makes `as_built`, when that is first asked for.
    gone
        Stretches of planned lines that are not there, template frame.
    """

    missing: manifold3d.Manifold
    excess: manifold3d.Manifold
    regions: tuple[Region, ...]
    tolerance_mm: float
    unseen_area_mm2: float
    stands: Standing
    gone: PlannedBeads | None = None

    @property
    def as_built(self) -> HeightField:
        """What stands on the bed; unseen cells are solid as `as_built_heights` says."""
        return self.stands()

    @property
    def missing_mm3(self) -> float:
        """Volume missing."""
        return float(self.missing.volume())

    @property
    def excess_mm3(self) -> float:
        """Volume in excess."""
        return float(self.excess.volume())


def compute_deficit(
    scan: Scan,
    template: Template,
    anomaly: AnomalyMap | None = None,
    *,
    build_from_template: Transform,
    tolerance_mm: float | None = None,
    printed_z_mm: float | None = None,
    cell_mm: float = 0.25,
    as_built: Callable[[], HeightField] | None = None,
    beads: PlannedBeads | None = None,
    progress: Progress = silent,
) -> Deficit:
    """Solids of what is missing and in excess.

    Parameters
    ----------
    scan
        In the template's frame.
    anomaly
        What `detect` said about this scan; None runs it with its defaults.
    build_from_template
        Where the part stands on the bed.
    tolerance_mm
        τ; None takes the detection's threshold.
    printed_z_mm
        Height printed so far, build frame; None is the template's own top.
    cell_mm
        Cell of what the scan alone says of heights.
    as_built
        Makes what stands on the bed, where the caller knows; None has it made of scan and solids.
    beads
        What the job has laid there, template frame: lines of it that rays went through are missing,
        however near to the template's surface they lie.

    Raises
    ------
    DeficitError
        If a defect's surface cannot be made a valid solid.
    """
    if anomaly is None or anomaly.evidence is None or anomaly.surfel_label is None:
        anomaly = detect(scan, template)
    if tolerance_mm is not None and not tolerance_mm >= 0:
        raise DeficitError(f"the tolerance is {tolerance_mm} mm; it must be ≥ 0")
    tau_mm = anomaly.threshold_mm if tolerance_mm is None else tolerance_mm
    evidence = anomaly.evidence
    if evidence is None:
        raise DeficitError("the anomaly map carries no evidence; run detect on the scan first")
    lines = None if beads is None else skipped(beads, evidence, template)
    if lines is not None and len(lines.width_mm):
        labelled = np.asarray(anomaly.surfel_label) != int(Label.OK)
        evidence = with_stubs(evidence, scan, lines.samples_mm(), labelled)

    def seen_heights() -> HeightField:
        return as_built_heights(
            scan,
            template,
            evidence.spacing_mm,
            build_from_template=build_from_template,
            printed_z_mm=printed_z_mm,
            cell_mm=cell_mm,
            images=evidence.images,
        )

    look = as_built or seen_heights
    solids: dict[Label, list[manifold3d.Manifold]] = {}
    regions: list[Region] = []
    with ThreadPoolExecutor(1) as beside:  # heights of the scan wait for no solid
        early = beside.submit(look) if _roughly_missing(anomaly, evidence) > EARLY_MM3 else None
        for label in (Label.MISSING, Label.EXCESS):
            gone = lines if label is Label.MISSING else None
            solids[label] = _pieces(template, evidence, anomaly, label, tau_mm, gone, progress)
            regions += [
                _region(piece, label, template, build_from_template, gone)
                for piece in solids[label]
            ]
    matrix = build_from_template.matrix[:3]
    missing, excess = (
        manifold3d.Manifold.batch_boolean(found, manifold3d.OpType.Add).transform(matrix)
        if found
        else manifold3d.Manifold()
        for found in solids.values()
    )
    unseen = anomaly.template_label == int(Label.UNSEEN)

    def stands() -> HeightField:
        seen = look() if early is None else early.result()
        if as_built is not None:
            return seen
        expected: Any = template.solid()
        solid, lost_mm, designed_mm = standing_heights(
            seen, expected.transform(matrix), missing, excess
        )
        gone = lost_mm > 0
        points_mm = build_from_template.apply(scan.points_mm)
        sharp = with_sharp_walls(solid, gone, points_mm, scan.sigma_mm)
        known = with_what_stands_out(sharp, points_mm, scan.sigma_mm, evidence.spacing_mm)
        even = with_even_crests(known, lost_mm, designed_mm)
        rising = with_rising_rims(even, lost_mm, designed_mm, evidence.spacing_mm)
        return with_whole_rims(rising, lost_mm, designed_mm)

    return Deficit(
        missing=missing,
        excess=excess,
        regions=tuple(sorted(regions, key=lambda r: (int(r.label), -r.volume_mm3))),
        tolerance_mm=tau_mm,
        unseen_area_mm2=_unseen_area(anomaly, int(unseen.sum())),
        stands=Standing(stands),
        gone=lines,
    )


def measured_regions(anomaly: AnomalyMap, deficit: Deficit) -> tuple[Region, ...]:
    """What `detect` found, measured by solids; the largest first, boxes in the template frame.

    A surface alone tells little of how much is missing over it: of a deep notch 0.7. Depths stay
    the largest deviation; what no solid was made of stays as its surface has it.

    Parameters
    ----------
    deficit
        Of the same anomaly, with a build frame that is the template's.
    """

    def touch(a: Region, b: Region) -> bool:
        return a.label is b.label and bool(
            (a.box_mm[0] <= b.box_mm[1]).all() and (b.box_mm[0] <= a.box_mm[1]).all()
        )

    pieces: dict[int, list[Region]] = {k: [] for k in range(-1, len(anomaly.regions))}
    for piece in deficit.regions:
        near = [k for k, region in enumerate(anomaly.regions) if touch(region, piece)]
        off_mm = [np.abs(anomaly.regions[k].box_mm - piece.box_mm).max() for k in near]
        pieces[near[int(np.argmin(off_mm))] if near else -1].append(piece)
    found = pieces[-1]
    for k, region in enumerate(anomaly.regions):
        own = pieces[k]
        if not own:
            found.append(region)
            continue
        boxes = np.array([piece.box_mm for piece in own])
        found.append(
            replace(
                own[0],
                volume_mm3=sum(piece.volume_mm3 for piece in own),
                area_mm2=sum(piece.area_mm2 for piece in own),
                box_mm=np.stack([boxes[:, 0].min(axis=0), boxes[:, 1].max(axis=0)]),
                depth_mm=region.depth_mm,
                p_value=region.p_value,
            )
        )
    return tuple(sorted(found, key=lambda r: -r.volume_mm3))


def _roughly_missing(anomaly: AnomalyMap, evidence: Evidence) -> float:
    """Volume under the surfels that are labelled missing, mm³."""
    s = evidence.surfels
    mine = np.asarray(anomaly.surfel_label) == int(Label.MISSING)
    return float(np.abs(s.deviation_mm[mine]).sum()) * s.cell_mm**2


def _pieces(
    template: Template,
    evidence: Evidence,
    anomaly: AnomalyMap,
    label: Label,
    tau_mm: float,
    gone: PlannedBeads | None,
    progress: Progress,
) -> list[manifold3d.Manifold]:
    """Solids of one label, each in one piece, template frame."""
    boxes = boxes_of(anomaly, evidence, template, label, gone)
    finest_mm = 2 * float(getattr(template, "voxel_mm", np.inf))  # of beads: two layers
    found: list[manifold3d.Manifold] = []
    for i, (low, high, depth) in enumerate(boxes):
        progress(f"deficit: {label.name.lower()}", float(i), float(len(boxes)))
        solid = _solid_in_box(
            template,
            evidence,
            anomaly,
            label,
            low,
            high,
            depth_mm=min(depth, finest_mm),
            tau_mm=tau_mm,
            gone=gone,
        )
        found += [piece for piece in solid.decompose() if piece.volume() >= CRUMB_MM3]
    return found


def _solid_in_box(
    template: Template,
    evidence: Evidence,
    anomaly: AnomalyMap,
    label: Label,
    low_mm: Float[np.ndarray, " 3"],
    high_mm: Float[np.ndarray, " 3"],
    *,
    depth_mm: float,
    tau_mm: float,
    gone: PlannedBeads | None,
) -> manifold3d.Manifold:
    """Erode, subtract, grow back, clip: all on one grid of signed distances."""
    s = evidence.surfels
    labels = np.asarray(anomaly.surfel_label)
    inside = in_box(s.place_mm, low_mm, high_mm) & (labels == int(label))
    across = int(np.argmax(np.abs(evidence.normal[inside]).sum(axis=0))) if inside.any() else 2
    box = VoxelBox.around(low_mm, high_mm, thickness_mm=depth_mm, across=across)
    samples = box.samples_mm()
    f = template.distance(samples)
    sign = -1.0 if label is Label.MISSING else 1.0
    # only where the template says it can be: the rest of the box needs no look at the scan
    beyond_mm = 2 * float(box.step_mm.max())
    can_be = sign * f > -beyond_mm
    if label is Label.EXCESS and inside.any():
        can_be &= f < float(s.deviation_mm[inside].max()) + beyond_mm
        can_be &= samples[:, 2] > float(template.bounds_mm[0, 2])  # nothing stands in the bed
    near = np.flatnonzero(can_be)
    best = np.full(len(samples), -10.0 if label is Label.MISSING else 10.0)
    cautious = best.copy()
    if label is Label.MISSING:
        best[near], cautious[near] = evidence.clearance(samples[near], f[near])
    else:
        best[near] = evidence.surface_clearance(samples[near], f[near])
        # SOLID means "nobody knows": for excess the cautious answer is that nothing is there
        best[near] = np.where(best[near] <= -4.999, 10.0, best[near])
        if evidence.has_rays:
            # a slanting plane goes on beyond its points; what rays crossed is empty all the same
            crossed = evidence.cautious(samples[near], f[near])
            best[near] = np.maximum(best[near], crossed)
        cautious = best
    # solid = both negative: inside the template and outside the as-built part (or the reverse)
    clip = np.maximum(-sign * f, -best if label is Label.MISSING else best)
    beyond = -sign * cautious  # missing: how empty; excess: how solid
    limit_mm, thin_mm = _limits(anomaly, label, samples, f, tau_mm, depth_mm)
    away_mm = sign * f  # from the template, of which so much is no defect
    away_mm[near] -= _allowed(anomaly, label, samples[near], away_mm[near] - thin_mm[near])
    core = (away_mm > limit_mm) & (beyond > limit_mm / 2)
    if label is Label.MISSING and evidence.has_rays:
        # a planned bead is thinner than 2 τ: nothing of it would be left of an eroded template,
        # but rays that went through it count as well
        core |= (away_mm > limit_mm / 4) & (beyond > limit_mm)
    ask = np.flatnonzero(can_be & ~core & (away_mm > thin_mm) & (clip < 0))
    nearest = evidence.surfels.tree.query(samples[ask], workers=2)[1]
    core[ask[labels[nearest] == int(label)]] = True
    if gone is not None and len(gone.width_mm):
        maybe = np.flatnonzero(clip < 0)
        core[maybe[gone.holds(samples[maybe])]] = True
    if label is Label.EXCESS:
        # one reflection in mid-air is a plane, too, but none that stands out by its label
        found = np.flatnonzero(core)
        nearest = evidence.surfels.tree.query(samples[found], workers=2)[1]
        core[found[labels[nearest] != int(label)]] = False
    else:
        said = [s.place_mm[inside], anomaly.template_points_mm[anomaly.template_label == label]]
        if gone is not None:
            said.append(gone.samples_mm())
        core = _of_a_region(core, box, np.concatenate(said), s.cell_mm)
    grow_mm = GROW_FACTOR * tau_mm + float(box.step_mm.max())
    reach = box.distance_to(core.reshape(box.shape)) - grow_mm
    shaped = clip.reshape(box.shape)
    field = np.maximum(shaped, np.minimum(reach, 10.0))
    if label is Label.MISSING:
        field = np.where(
            _hangs_free(f.reshape(box.shape) < 0, shaped < 0, field < 0), shaped, field
        )
    return solid_from_field(box, field)


def _of_a_region(
    core: Bool[np.ndarray, " v"],
    box: VoxelBox,
    labelled_mm: Float[np.ndarray, "p 3"],
    reach_mm: float,
) -> Bool[np.ndarray, " v"]:
    """(v,) what of the samples hangs together with a place that the test found: noise does not."""
    high_mm = box.low_mm + box.step_mm * (np.array(box.shape) - 1)
    near = in_box(labelled_mm, box.low_mm, high_mm)
    index = np.round((labelled_mm[near] - box.low_mm) / box.step_mm).astype(np.int64)
    told = np.zeros(box.shape, bool)
    told[tuple(index.T)] = True
    shaped = core.reshape(box.shape)
    groups, count = ndimage.label(shaped, structure=np.ones((3, 3, 3), bool))
    kept = np.zeros(count + 1, bool)
    kept[groups[shaped & (box.distance_to(told) <= reach_mm)]] = True
    return np.asarray(kept[groups].ravel())


def _hangs_free(
    wanted: Bool[np.ndarray, "x y z"],
    may_be_gone: Bool[np.ndarray, "x y z"],
    gone: Bool[np.ndarray, "x y z"],
) -> Bool[np.ndarray, "x y z"]:
    """What is left between what is gone and the air, with nothing that was seen to hold it.

    The roof of a hollow, an edge: thinner than what the erosion leaves, so no growing gets there.
    """
    groups, count = ndimage.label(wanted & ~gone)
    if count == 0:
        return np.zeros_like(gone)
    held = np.bincount(groups[~may_be_gone], minlength=count + 1) > 0
    beside = np.bincount(groups[ndimage.binary_dilation(gone)], minlength=count + 1) > 0
    for axis in range(3):
        for end in (0, -1):
            held[np.unique(groups.take(end, axis=axis))] = True  # it goes on beyond the box
    loose = beside & ~held
    loose[0] = False
    return np.asarray(loose[groups])


def _allowed(
    anomaly: AnomalyMap,
    label: Label,
    samples_mm: Float[np.ndarray, "v 3"],
    over_mm: Float[np.ndarray, " v"],
) -> Float[np.ndarray, " v"]:
    """(v,) how far out of the template nothing is too much, by the nearest surfel; 0 if missing.

    Asked for where `over_mm` is positive alone.
    """
    allowed_mm = np.zeros(len(samples_mm))
    higher_mm = anomaly.surfel_higher_mm
    if label is Label.EXCESS and higher_mm is not None and (higher_mm > 0).any():
        assert anomaly.evidence is not None
        ask = np.flatnonzero(over_mm > 0)
        nearest = anomaly.evidence.surfels.tree.query(samples_mm[ask], workers=2)[1]
        allowed_mm[ask] = np.maximum(higher_mm[nearest], 0.0)
    return allowed_mm


def _limits(
    anomaly: AnomalyMap,
    label: Label,
    samples_mm: Float[np.ndarray, "v 3"],
    f_mm: Float[np.ndarray, " v"],
    tau_mm: float,
    depth_mm: float,
) -> tuple[Float[np.ndarray, " v"], Float[np.ndarray, " v"]]:
    """(v,) τ, and the depth from which on a label counts.

    Under the plane of the layer just printed both are smaller: detection used a smaller limit,
    and no wall is near whose noise could be taken for depth.
    """
    limit_mm = np.full(len(samples_mm), tau_mm)
    thin_mm = np.full(len(samples_mm), min(tau_mm, depth_mm / 2))
    if anomaly.top_z_mm is not None and label is Label.MISSING:
        under = np.abs(f_mm - (samples_mm[:, 2] - anomaly.top_z_mm)) < ON_PLANE_MM
        limit_mm[under] = min(tau_mm, anomaly.top_threshold_mm)
        thin_mm[under] = np.minimum(thin_mm[under], THIN_RATIO * limit_mm[under])
    return limit_mm, thin_mm


def _region(
    piece: manifold3d.Manifold,
    label: Label,
    template: Template,
    build_from_template: Transform,
    gone: PlannedBeads | None,
) -> Region:
    """Measures of one piece; its box in the build frame."""
    bounds = np.asarray(piece.bounding_box()).reshape(2, 3)
    volume = float(piece.volume())
    area = float(piece.surface_area()) / 2
    depth = min(float(np.ptp(bounds, axis=0).min()), 2 * volume / max(area, 1e-9))
    kind = classify(label, depth_mm=depth, area_mm2=area, box_mm=bounds, template=template)
    moved = piece.transform(build_from_template.matrix[:3])
    return Region(
        label=label,
        type=kind,
        volume_mm3=volume,
        area_mm2=area,
        depth_mm=depth,
        box_mm=np.asarray(moved.bounding_box()).reshape(2, 3),
        below_bead=volume < BEAD_MM3,
        skipped=_is_skipped(piece, gone),
    )


def _is_skipped(piece: manifold3d.Manifold, gone: PlannedBeads | None) -> bool:
    """Whether the middle of a line that is gone lies in a piece's box, template frame."""
    if gone is None:
        return False
    box = np.asarray(piece.bounding_box()).reshape(2, 3)
    middle = 0.5 * (gone.start_mm + gone.end_mm)
    middle[:, 2] -= 0.5 * gone.height_mm
    return bool(in_box(middle, box[0], box[1]).any())


def _unseen_area(anomaly: AnomalyMap, count: int) -> float:
    """Area of the unseen template points, from their mean spacing."""
    from amrepair.field.groups import area_per_point

    return count * area_per_point(anomaly.template_points_mm)
