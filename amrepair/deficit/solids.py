"""Solids of one label, one by one: erode, subtract, grow back, clip, on grids of distances."""

from __future__ import annotations

import manifold3d
import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import ndimage

from amrepair.deficit.boxes import boxes_of
from amrepair.deficit.options import DeficitOptions
from amrepair.deficit.voxels import VoxelBox, solid_from_field
from amrepair.field.as_built import Evidence
from amrepair.frames import in_box
from amrepair.observe.background import ON_PLANE_MM
from amrepair.regions import AnomalyMap, Label
from amrepair.regions.skipped import PlannedBeads
from amrepair.template.port import Template
from gcode.progress import Progress

# A corner of a cube of side τ lies √3 τ from the eroded template.
GROW_FACTOR = 3**0.5


def pieces_of(
    template: Template,
    evidence: Evidence,
    anomaly: AnomalyMap,
    label: Label,
    tau_mm: float,
    gone: PlannedBeads | None,
    options: DeficitOptions,
    progress: Progress,
) -> list[manifold3d.Manifold]:
    """Solids of one label, each in one piece, template frame."""
    boxes = boxes_of(anomaly, evidence, template, label, gone, options.voxels)
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
            options=options,
        )
        found += [
            piece for piece in solid.decompose() if piece.volume() >= options.solids.crumb_mm3
        ]
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
    options: DeficitOptions,
) -> manifold3d.Manifold:
    """Erode, subtract, grow back, clip: all on one grid of signed distances."""
    s = evidence.surfels
    labels = np.asarray(anomaly.surfel_label)
    inside = in_box(s.place_mm, low_mm, high_mm) & (labels == int(label))
    across = int(np.argmax(np.abs(evidence.normal[inside]).sum(axis=0))) if inside.any() else 2
    voxels = options.voxels
    box = VoxelBox.around(low_mm, high_mm, thickness_mm=depth_mm, across=across, options=voxels)
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
    best, cautious = _clearances(evidence, label, samples, f, near)
    held = _where_lines_hung(template, samples, near[best[near] < 0], gone)
    best[held] = np.maximum(best[held], evidence.rays_say(samples[held]))
    # solid = both negative: inside the template and outside the as-built part (or the reverse)
    clip = np.maximum(-sign * f, -best if label is Label.MISSING else best)
    beyond = -sign * cautious  # missing: how empty; excess: how solid
    limit_mm, thin_mm = _limits(anomaly, label, samples, f, tau_mm, depth_mm, options)
    away_mm = sign * f  # from the template, of which so much is no defect
    away_mm[near] -= _allowed(anomaly, label, samples[near], away_mm[near] - thin_mm[near])
    core = (away_mm > limit_mm) & (beyond > limit_mm / 2)
    if label is Label.MISSING:
        # a planned bead or a thin wall is thinner than 2 τ: nothing of it would be left of an
        # eroded template, but what is known to be empty that far around counts as well
        core |= (away_mm > limit_mm / 4) & (beyond > limit_mm)
    ask = np.flatnonzero(can_be & ~core & (away_mm > thin_mm) & (clip < 0))
    nearest = s.tree.query(samples[ask], workers=2)[1]
    core[ask[labels[nearest] == int(label)]] = True
    if gone is not None and len(gone.width_mm):
        maybe = np.flatnonzero(clip < 0)
        core[maybe[gone.holds(samples[maybe])]] = True
    if label is Label.EXCESS:
        # one reflection in mid-air is a plane, too, but none that stands out by its label
        found = np.flatnonzero(core)
        nearest = s.tree.query(samples[found], workers=2)[1]
        core[found[labels[nearest] != int(label)]] = False
    else:
        said = [s.place_mm[inside], anomaly.template_points_mm[anomaly.template_label == label]]
        if gone is not None:
            said.append(gone.samples_mm(options.skipped.look_step_mm))
        core = _of_a_region(core, box, np.concatenate(said), s.cell_mm)
    return _grown_back(box, core, clip, f, label, tau_mm)


def _clearances(
    evidence: Evidence,
    label: Label,
    samples_mm: Float[np.ndarray, "v 3"],
    f_mm: Float[np.ndarray, " v"],
    near: Int[np.ndarray, " k"],
) -> tuple[Float[np.ndarray, " v"], Float[np.ndarray, " v"]]:
    """(v,) how far samples lie out of what stands there, best known and cautiously said.

    Asked for `near` alone; elsewhere nothing of that label can be.
    """
    best = np.full(len(samples_mm), -10.0 if label is Label.MISSING else 10.0)
    cautious = best.copy()
    if label is Label.MISSING:
        best[near], cautious[near] = evidence.clearance(samples_mm[near], f_mm[near])
        return best, cautious
    best[near] = evidence.surface_clearance(samples_mm[near], f_mm[near])
    # SOLID means "nobody knows": for excess the cautious answer is that nothing is there
    best[near] = np.where(best[near] <= -4.999, 10.0, best[near])
    if evidence.has_rays:
        # a slanting plane goes on beyond its points; what rays crossed is empty all the same
        crossed = evidence.cautious(samples_mm[near], f_mm[near])
        best[near] = np.maximum(best[near], crossed)
    return best, best


def _where_lines_hung(
    template: Template,
    samples_mm: Float[np.ndarray, "v 3"],
    near: Int[np.ndarray, " k"],
    gone: PlannedBeads | None,
) -> Int[np.ndarray, " h"]:
    """Those of some samples that lie in lines which are gone and hung over a floor.

    The floor under such a line is as designed, and says nothing of the line.
    """
    if gone is None or not len(gone.width_mm):
        return near[:0]
    held = near[gone.holds(samples_mm[near])]
    below_mm = samples_mm[held] - np.array([0.0, 0.0, float(np.median(gone.height_mm))])
    return held[template.distance(below_mm) > 0]


def _grown_back(
    box: VoxelBox,
    core: Bool[np.ndarray, " v"],
    clip: Float[np.ndarray, " v"],
    f_mm: Float[np.ndarray, " v"],
    label: Label,
    tau_mm: float,
) -> manifold3d.Manifold:
    """The core, grown by what the erosion took and clipped to template minus as-built."""
    grow_mm = GROW_FACTOR * tau_mm + float(box.step_mm.max())
    reach = box.distance_to(core.reshape(box.shape)) - grow_mm
    shaped = clip.reshape(box.shape)
    field = np.maximum(shaped, np.minimum(reach, 10.0))
    if label is Label.MISSING:
        wanted = f_mm.reshape(box.shape) < 0
        field = np.where(_hangs_free(wanted, shaped < 0, field < 0), shaped, field)
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
    options: DeficitOptions,
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
        thin_mm[under] = np.minimum(thin_mm[under], options.solids.sliver_ratio * limit_mm[under])
    return limit_mm, thin_mm
