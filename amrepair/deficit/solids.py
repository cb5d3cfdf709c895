"""Solids of one label, one by one: erode, subtract, grow back, clip, on grids of distances."""

from __future__ import annotations

import manifold3d
import numpy as np
from jaxtyping import Float
from scipy import ndimage

from amrepair.arrays import Mask, Points, Values, VoxelMask, Voxels
from amrepair.deficit.boxes import Box, Sought, boxes_of
from amrepair.deficit.voxels import VoxelBox, solids_from_field
from amrepair.field.as_built import SOLID_MM
from amrepair.field.near import has_near
from amrepair.field.places import PlaceTree
from amrepair.frames import in_box
from amrepair.observe.background import ON_PLANE_MM
from gcode.progress import Progress

# A corner of a cube of side τ lies √3 τ from the eroded template.
GROW_FACTOR = 3**0.5
# So that none of its cubes' corners on the template's surface is left out, at √3 samples at most.
SAMPLES_BEYOND = 2.0
# Farther than anything that is asked for.
FAR_MM = 10.0


def pieces_of(sought: Sought, progress: Progress) -> list[manifold3d.Manifold]:
    """Solids of one label, each in one piece, template frame."""
    boxes = boxes_of(sought)
    found: list[manifold3d.Manifold] = []
    for i, box in enumerate(boxes):
        progress(f"deficit: {sought.label.name.lower()}", float(i), float(len(boxes)))
        found += _solids_in_box(sought, box)
    return found


def _solids_in_box(sought: Sought, place: Box) -> list[manifold3d.Manifold]:
    """Erode, subtract, grow back, clip: all on one grid of signed distances."""
    s, template = sought.evidence.surfels, sought.template
    inside = in_box(s.place_mm, *place.corners_mm) & sought.labelled
    ways = np.abs(sought.evidence.normal[inside]).sum(axis=0)
    finest_mm = 2 * float(getattr(template, "voxel_mm", np.inf))  # of beads: two layers
    depth_mm = min(place.depth_mm, finest_mm)
    box = VoxelBox.around(
        *place.corners_mm, thickness_mm=depth_mm,
        across=int(np.argmax(ways)) if inside.any() else 2,
        is_film=place.is_film, options=sought.options.voxels,
    )  # fmt: skip
    samples = box.samples_mm()
    f = template.distance(samples)
    deep_mm = sought.sign * f  # in the template where something is missing, outside for excess
    # only where the template says it can be: the rest of the box needs no look at the scan
    beyond_mm = 2 * float(box.step_mm.max())
    can_be = deep_mm > -beyond_mm
    if sought.is_excess and inside.any():
        most_off_mm = float(s.deviation_mm[inside].max()) + beyond_mm
        can_be &= f < most_off_mm
        # straight out of the template its surface comes no later than where it is farthest out:
        # behind a face that hangs from an overhang, where nobody saw, its plane would go on
        asked = np.flatnonzero(can_be & (f > 0))
        away_mm = PlaceTree.of(s.place_mm[inside]).nearest(samples[asked], 1)[0][:, 0]
        can_be[asked] = away_mm < most_off_mm - f[asked] + s.cell_mm
        can_be &= samples[:, 2] > float(template.bounds_mm[0, 2])  # nothing stands in the bed
    near = np.flatnonzero(can_be)
    best, cautious = (np.full(len(f), -FAR_MM) for _ in range(2))  # how surely it is so
    # farther off no sample shapes a surface, nor is it thinner than what is eroded
    most_mm = max(box.surface_mm, 2 * sought.tau_mm)
    best[near], cautious[near] = _shown(sought, samples[near], f[near], most_mm)
    # both have to be: inside the template and outside the as-built part, or the reverse
    clip = -np.minimum(deep_mm, best)
    limit_mm, thin_mm = _limits(sought, samples, f, depth_mm)
    deep_mm[near] -= sought.allowed_mm(samples[near], deep_mm[near] > thin_mm[near])
    core = (deep_mm > limit_mm) & (cautious > limit_mm / 2)
    if not sought.is_excess:
        # a planned bead or a thin wall is thinner than 2 τ: nothing of it would be left of an
        # eroded template, but what is known to be empty that far around counts as well
        core |= (deep_mm > limit_mm / 4) & (cautious > limit_mm)
    ask = np.flatnonzero(can_be & ~core & (deep_mm > thin_mm) & (clip < 0))
    core[ask] = sought.nearest_is_labelled(samples[ask])
    line = np.zeros_like(core)
    if sought.gone is not None:
        maybe = np.flatnonzero((clip < 0) & ~core)
        line[maybe] = sought.gone.holds(samples[maybe])
        core |= line
    if sought.is_excess:
        # one reflection in mid-air is a plane, too, but none that stands out by its label
        found = np.flatnonzero(core)
        core[found] = sought.nearest_is_labelled(samples[found])
    else:
        core = _of_a_region(core, box, sought.told_mm(inside), s.cell_mm)
    field = _grown_back(sought, box, core & ~line, core & line, clip, f)
    sure = (cautious > limit_mm / 2).reshape(box.shape)
    return _cut_out(sought, box, field, f, sure, by_mesh=not np.isfinite(finest_mm))


def _cut_out(
    sought: Sought, box: VoxelBox, field: Voxels, f_mm: Values, sure: VoxelMask, *, by_mesh: bool
) -> list[manifold3d.Manifold]:
    """Where the field is negative, as far as the template's surface.

    Of what is missing of a part that a mesh tells, and where samples lie far apart, the template's
    own solid cuts it there.
    """
    options = sought.options.voxels
    breaks, coarse = by_mesh and not sought.is_excess, box.step_mm.max() > options.coarsest_mm
    if breaks:
        field = _by_broken_planes(sought, box, field, f_mm, sure & (field < 0))
    if coarse:
        field = _beyond_the_surface(field, (sought.sign * f_mm > 0).reshape(box.shape), sure)
    pieces = solids_from_field(box, field, options.crumb_mm3)
    return cut_to_design(sought, pieces) if breaks or coarse else pieces


def _shown(
    sought: Sought, samples_mm: Points, f_mm: Values, most_mm: float
) -> tuple[Values, Values]:
    """(k,) how far samples lie in what is sought, empty or solid, best known and cautiously.

    Exact up to `most_mm`.
    """
    evidence = sought.evidence
    if not sought.is_excess:
        best, cautious = evidence.clearance(samples_mm, f_mm, most_mm)
        if sought.gone is not None:
            best, held = best.copy(), np.flatnonzero(best < 0)
            held = held[sought.gone.holds(samples_mm[held])]
            best[held] = np.maximum(best[held], evidence.rays_say(samples_mm[held]))
        return best, cautious
    out_mm = evidence.surface_clearance(samples_mm, f_mm)
    # "nobody knows": for excess the cautious answer is that nothing is there
    out_mm = np.where(out_mm <= SOLID_MM, FAR_MM, out_mm)
    if evidence.has_rays:
        # a slanting plane goes on beyond its points; what rays crossed is empty all the same
        out_mm = np.maximum(out_mm, evidence.cautious(samples_mm, f_mm))
    return -out_mm, -out_mm


def _limits(
    sought: Sought, samples_mm: Points, f_mm: Values, depth_mm: float
) -> tuple[Values, Values]:
    """(v,) τ, and the depth from which on a label counts.

    Under the plane of the layer just printed both are smaller: detection used a smaller limit,
    and no wall is near whose noise could be taken for depth.
    """
    anomaly, tau_mm = sought.anomaly, sought.tau_mm
    limit_mm = np.full(len(f_mm), tau_mm)
    thin_mm = np.full(len(f_mm), min(tau_mm, depth_mm / 2))
    if anomaly.top_z_mm is not None and not sought.is_excess:
        under = np.abs(f_mm - (samples_mm[:, 2] - anomaly.top_z_mm)) < ON_PLANE_MM
        limit_mm[under] = min(tau_mm, anomaly.top_threshold_mm)
        sliver_mm = sought.options.voxels.sliver_ratio * limit_mm[under]
        thin_mm[under] = np.minimum(thin_mm[under], sliver_mm)
    return limit_mm, thin_mm


def _grown_back(
    sought: Sought, box: VoxelBox, core: Mask, line: Mask, clip: Values, f_mm: Values
) -> Voxels:
    """The core, grown by what the erosion took and clipped to template minus as-built.

    Nothing was taken of a line of the job that is gone: it is as wide as it was planned.
    """
    sample_mm = float(box.step_mm.max())
    grow_mm = GROW_FACTOR * sought.tau_mm + sample_mm
    reach = np.minimum(
        box.distance_to(core.reshape(box.shape)) - grow_mm,
        box.distance_to(line.reshape(box.shape)) - sample_mm,
    )
    shaped = clip.reshape(box.shape)
    field = np.maximum(shaped, np.minimum(reach, FAR_MM))
    if not sought.is_excess:
        wanted = f_mm.reshape(box.shape) < 0
        field = np.where(_hangs_free(wanted, shaped < 0, field < 0), shaped, field)
    # what is enclosed in mid-air is nothing that stands: there it is as designed
    enclosed = ndimage.binary_fill_holes(field < 0) & (field >= 0)
    return np.where(enclosed, sought.sign * -f_mm.reshape(box.shape), field)


def _by_broken_planes(
    sought: Sought, box: VoxelBox, field: Voxels, f_mm: Values, sure: VoxelMask
) -> Voxels:
    """Around what surely differs: how far samples lie from the broken surface alone.

    Distances that end at the template's surface as well round off where a break runs out, and where
    it does so at an acute angle a fin that is not there is left of the part. The broken surface's
    planes go on beyond the template's, whose own solid then cuts them.
    """
    if not sure.any():
        return field
    near = ndimage.distance_transform_edt(~sure) <= SAMPLES_BEYOND
    near &= np.abs(f_mm).reshape(box.shape) <= SAMPLES_BEYOND * float(box.step_mm.max())
    asked = np.flatnonzero(near)
    told = -sought.evidence.broken_clearance(box.samples_mm()[asked], f_mm[asked])
    flat, own = field.ravel().copy(), f_mm[asked] < 0
    known = np.isfinite(told) & (~own | (told * flat[asked] > 0))
    flat[asked[known]] = told[known]
    return flat.reshape(box.shape)


def _beyond_the_surface(field: Voxels, own: VoxelMask, sure: VoxelMask) -> Voxels:
    """Of a coarse grid: what surely differs, two samples on beyond the template's surface.

    Between such samples a thin wall would be lost, and every edge rounded. The template's solid
    cuts it instead.

    Parameters
    ----------
    own, sure
        On which side of the template's surface something can differ, and where it surely does.
    """
    if not own.any():
        return field
    away, nearest = ndimage.distance_transform_edt(~own, return_indices=True)
    differs = sure & (field < 0)
    beyond = ~own & (away <= SAMPLES_BEYOND) & differs[tuple(nearest)]
    return np.where(beyond, -np.abs(field), field)


def cut_to_design(sought: Sought, pieces: list[manifold3d.Manifold]) -> list[manifold3d.Manifold]:
    """Of pieces what lies in the template where something is missing, else what lies outside."""
    if not pieces:
        return pieces
    whole = manifold3d.Manifold.batch_boolean(pieces, manifold3d.OpType.Add)
    design = sought.template.solid()
    cut = whole - design if sought.is_excess else whole ^ design
    least_mm3 = sought.options.voxels.crumb_mm3
    shells = cut.decompose()
    pieces = [shell for shell in shells if shell.volume() >= least_mm3]
    # a hollow's shell is one of its own, and its piece comes without it
    hollow = any(shell.volume() < -least_mm3 for shell in shells)
    return [piece ^ cut for piece in pieces] if hollow else pieces


def _of_a_region(
    core: Mask, box: VoxelBox, labelled_mm: Float[np.ndarray, "p 3"], reach_mm: float
) -> Mask:
    """(v,) what of the samples hangs together with a place that the test found: noise does not."""
    high_mm = box.low_mm + box.step_mm * (np.array(box.shape) - 1)
    near = in_box(labelled_mm, box.low_mm, high_mm)
    index = np.round((labelled_mm[near] - box.low_mm) / box.step_mm).astype(np.int64)
    shaped = core.reshape(box.shape)
    groups, count = ndimage.label(shaped, structure=np.ones((3, 3, 3), bool))
    which = np.argwhere(shaped)
    told = has_near(which * box.step_mm, index * box.step_mm, reach_mm)
    kept = np.zeros(count + 1, bool)
    kept[groups[tuple(which[told].T)]] = True
    return np.asarray(kept[groups].ravel())


def _hangs_free(wanted: VoxelMask, may_be_gone: VoxelMask, gone: VoxelMask) -> VoxelMask:
    """What is left between what is gone and the air, with nothing that was seen to hold it.

    The roof of a hollow, an edge: thinner than what the erosion leaves, so no growing gets there.
    """
    groups, count = ndimage.label(wanted & ~gone)
    held = np.bincount(groups[~may_be_gone], minlength=count + 1) > 0
    beside = np.bincount(groups[ndimage.binary_dilation(gone)], minlength=count + 1) > 0
    for axis in range(3):
        for end in (0, -1):
            held[np.unique(groups.take(end, axis=axis))] = True  # it goes on beyond the box
    loose = beside & ~held
    loose[0] = False
    return np.asarray(loose[groups])
