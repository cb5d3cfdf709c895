"""The passes of a patch, from the floor up: where beads are due, and how much is in them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float
from scipy import ndimage

from gcode.profiles import PrintSetup
from gcode.progress import Progress
from gcode.slicing.infill import SOLID_ANGLES_RAD
from gcode.slicing.job import Unprintable
from gcode.slicing.job_lines import runs_of
from gcode.slicing.layers import LayerGrid
from gcode.slicing.patch_beads import (
    BOND_RATIO,
    LEAST_THICK_MM,
    ROUNDING_MM,
    TO_WALL_MM,
    Chain,
    begun_inside,
    beside_runs,
    draw,
    eased,
    free_between,
    free_runs,
    weighed,
)
from gcode.slicing.patch_model import PatchModel
from gcode.slicing.patch_skin import Skin, skin_of

# The floor was measured, the deficit computed from it: they agree within this.
AGREE_MM = 0.04
# A gap of more than this share of the thickest bead is not filled from above: up to there a strand
# of one line width, round (π/4 d² = width × gap), still reaches its floor. On a steep slope the
# head keeps the tip this far off.
DEEP_RATIO = 1.6
ROUNDED_OFF_MM = 0.02  # more than the mean of a scan's noise
HOLD_MM = 0.45  # a line's width: how far a bead may hang over a hole beside what holds it
SKIN_MM = 0.2  # about as thick as it gets
NOT_LISTED_MM3 = 0.02
LEAST_OF_GAP = 0.9  # where the gap is more than the deficit: both are right to about as much
FAR_MM = 0.3  # from a line: more than half of it
SERVED = 0.95  # share of what is due; where the job's own lines serve less, others may serve more
# Of columns over a hollow, as many as open to the head at one height are worth a pass there.
OPENING_MM2 = 1.0
# From a tip in the air, as far as its bead covers a rim; less of one is not worth a line.
HEM_MM, RIM_MM2 = 0.35, 1.0
# A flat top: as much area, as wide, within so little height.
FLAT_MM2, FLAT_WIDE_MM, FLAT_MM = 1.0, 0.6, 0.02
ON_FLAT_MM = 1.5 * FLAT_MM  # of its height: what belongs to it


@dataclass(frozen=True, slots=True)
class Pass:
    """Beads laid together, between all of which `reach` says where the tip may go directly.

    Attributes
    ----------
    z_mm
        Height of the tip, or its greatest.
    tip_mm
        The same wherever it may go: on the cells of `Reach` where it follows a surface.
    """

    z_mm: float
    height_mm: float
    index: int
    chains: tuple[Chain, ...]
    reach: Bool[np.ndarray, "ny nx"]
    tip_mm: float | Float[np.ndarray, "ny nx"]


def plan_passes(
    model: PatchModel,
    grid: LayerGrid,
    setup: PrintSetup,
    progress: Progress,
    *,
    hems: bool = True,
) -> list[Pass]:
    """Passes from the floor up; with `hems`, begun from the air too where that is the only way."""
    low_mm, high_mm = float(model.box[2]), float(model.box[5])
    tops = grid.tops_to(high_mm)
    tops = tops[tops > low_mm + 1e-6]
    if len(tops) == 0 or tops[-1] < high_mm - 1e-6:
        tops = np.append(tops, high_mm)
    # the last pass ends with the deficit, not above it, unless the job has a layer there
    if model.job is None or model.job.at(float(tops[-1])) is None:
        tops[-1] = min(tops[-1], high_mm)
    most_mm = min(model.most_mm, setup.process.max_gap_layers * grid.layer_height_mm)
    flats = _flats(model, tops) if model.job is None else np.zeros(0)
    ends = np.full(model.shape, np.inf)  # where a flat top lies, off the job's layers
    for flat_mm in flats:
        ends[np.abs(model.top_mm - flat_mm) <= ON_FLAT_MM] = flat_mm
    openings = _openings(model, np.concatenate([tops, flats]), most_mm)
    heights = np.sort(np.concatenate([tops, flats, openings]))
    skin = skin_of(model, ~np.isfinite(ends)) if setup.process.nonplanar_top else None
    skin = _skin_served(model, skin, setup)
    if skin is not None:
        model.planar_top_mm = skin.planar_top_mm(model, tops)
    passes: list[Pass] = []
    for k, z_mm in enumerate(heights):
        on_grid = not (np.abs(flats - z_mm) < ROUNDING_MM).any()
        later = tops[tops > z_mm + ROUNDING_MM]
        following = np.minimum(ends, float(later[0]) if len(later) else np.inf)
        here = ends > z_mm + ROUNDING_MM if on_grid else ends == z_mm
        if (np.abs(openings - z_mm) < ROUNDING_MM).any():
            here &= z_mm - model.surface_mm > DEEP_RATIO * most_mm
        one = _plan_pass(
            model, float(z_mm), here, following, most_mm, k, grid.layer_height_mm, setup, hems=hems
        )
        if one is not None:
            passes.append(one)
        progress("slice patch", float(k + 1), float(len(heights)))
    if skin is not None:
        one = _plan_skin(model, skin, most_mm, len(heights), setup)
        passes += [one] if one is not None else []
    return passes


def _flats(model: PatchModel, tops_mm: Float[np.ndarray, " n"]) -> Float[np.ndarray, " m"]:
    """Heights at which flat areas of the deficit end between the job's layers.

    They get a pass of their own there: the nozzle's flat makes the surface, at its own height.
    """
    tops = model.top_mm
    steps = np.round(tops[np.isfinite(tops)] / FLAT_MM).astype(np.int64)
    if not len(steps):
        return np.zeros(0)
    area_mm2 = np.bincount(steps - steps.min()) * model.cell_mm**2
    often = np.flatnonzero(ndimage.convolve1d(area_mm2, np.ones(3), mode="constant") >= FLAT_MM2)
    least = np.ones((round(FLAT_WIDE_MM / model.cell_mm),) * 2)
    found: list[float] = []
    for step in often[np.argsort(-area_mm2[often])] + steps.min():
        z_mm = float(step * FLAT_MM)
        if np.abs(np.array([*tops_mm, *found]) - z_mm).min() < LEAST_THICK_MM:
            continue
        # no rim or slope that passes through this height
        at = np.abs(tops - z_mm) <= ON_FLAT_MM
        (y0, y1), (x0, x1) = ((int(k.min()), int(k.max()) + 1) for k in at.nonzero())
        flat = np.zeros_like(at)
        flat[y0:y1, x0:x1] = ndimage.binary_opening(at[y0:y1, x0:x1], least)
        if flat.sum() * model.cell_mm**2 >= FLAT_MM2:
            found.append(float(np.median(tops[flat])))
    return np.array(found)


def _openings(
    model: PatchModel, tops_mm: Float[np.ndarray, " n"], most_mm: float
) -> Float[np.ndarray, " m"]:
    """Heights between other passes at which the head first gets in over much that is hollow.

    There beads grow out from what holds them by one more line before the next layer of the job:
    what lies under them is lost, and up to a layer less of it.
    """
    need_mm = model.need_mm
    hollow = need_mm - model.floor_mm > DEEP_RATIO * most_mm
    hollow &= np.isfinite(model.top_mm) & (need_mm < model.top_mm)
    steps = np.ceil(need_mm[hollow] / FLAT_MM).astype(np.int64)
    if not len(steps):
        return np.zeros(0)
    area_mm2 = np.bincount(steps - steps.min()) * model.cell_mm**2
    found: list[float] = []
    for step in np.flatnonzero(area_mm2 >= OPENING_MM2)[::-1] + steps.min():
        z_mm = float(step * FLAT_MM)
        if np.abs(np.array([*tops_mm, *found]) - z_mm).min() >= LEAST_THICK_MM:
            found.append(z_mm)
    return np.array(found)


def _plan_pass(
    model: PatchModel,
    z_mm: float,
    here: Bool[np.ndarray, "ny nx"],
    following_mm: Float[np.ndarray, "ny nx"],
    most_mm: float,
    index: int,
    layer_mm: float,
    setup: PrintSetup,
    *,
    hems: bool,
) -> Pass | None:
    """Fill what is due at this height, among the columns that are filled at it.

    Along the job's own lines where there are any and they serve; else along lines of our own.
    """
    planned = model.job.at(z_mm) if model.job is not None else None
    reach = model.reach.at(z_mm)
    if planned is None:
        thick = _due(model, z_mm, here, reach, following_mm, most_mm, layer_mm)
        if hems and model.job is None:
            thick = _hemmed(model, z_mm, thick, reach, most_mm, layer_mm)
    else:
        thick = _due_of_job(model, z_mm, planned, reach, following_mm, most_mm, layer_mm)
    if not thick.any():
        return None
    laying = _along_job(model, z_mm, planned, thick, reach, setup) if planned is not None else None
    if laying is None or laying.served < SERVED:
        own = _along_own(model, z_mm, thick, reach, SOLID_ANGLES_RAD[index % 2], setup)
        if laying is None or (own is not None and own.served > laying.served):
            laying = own
    if laying is None or not laying.chains:
        return None
    model.lost += laying.lost
    laid = laying.laid_mm
    # over a bridge the surface is the nozzle's height, whatever lies open below
    bridged = (laid > 0) & (z_mm - model.surface_mm > DEEP_RATIO * most_mm)
    model.surface_mm = np.where(bridged, z_mm, model.surface_mm + laid)
    model.laid_mm = model.laid_mm + laid
    if planned is not None:
        model.done_mm = np.where((laid > 0) & planned, z_mm, model.done_mm)
    return Pass(z_mm, laying.height_mm, index, tuple(laying.chains), reach, z_mm)


@dataclass(frozen=True, slots=True)
class _Laying:
    """Beads of one height, the thickness that columns get, and the share of it that they want."""

    chains: list[Chain]
    laid_mm: Float[np.ndarray, "ny nx"]
    served: float
    height_mm: float
    lost: list[Unprintable]


def _along_own(
    model: PatchModel,
    z_mm: float,
    thick: Float[np.ndarray, "ny nx"],
    reach: Bool[np.ndarray, "ry rx"],
    angle_rad: float,
    setup: PrintSetup,
) -> _Laying | None:
    """Along lines drawn into the columns."""
    drawn = draw(thick, reach, angle_rad, model, setup)
    if drawn is None:
        return None
    runs = [
        begun_inside(run, model)
        for bead in eased(drawn.beads, reach, model.reach)
        for run in free_runs(bead, lambda a, b: free_between(a, b, reach, model.reach))
    ]
    if not runs:
        return None
    tips_mm = [np.full(len(run.xy_mm), z_mm) for run in runs]
    chains, laid = weighed(runs, tips_mm, thick, _strips(thick, z_mm, model), model, setup)
    lost_mm3 = drawn.lost_mm2 * drawn.height_mm
    lost = []
    if lost_mm3 > NOT_LISTED_MM3:
        lost.append(_thin(drawn.region, z_mm, drawn.height_mm, lost_mm3))
    return _Laying(chains, laid, _served(chains, thick, model), drawn.height_mm, lost)


def _along_job(
    model: PatchModel,
    z_mm: float,
    planned: Bool[np.ndarray, "ny nx"],
    thick: Float[np.ndarray, "ny nx"],
    reach: Bool[np.ndarray, "ry rx"],
    setup: PrintSetup,
) -> _Laying | None:
    """Along what the job laid there, with as much of each line's plastic as is missing.

    Where walls keep the head off, so that lines end before them, none of them goes along the wall:
    less is served.
    """
    assert model.job is not None
    runs, job = runs_of(
        model.job.lines_at(z_mm),
        planned,
        lambda bead: free_runs(bead, lambda a, b: free_between(a, b, reach, model.reach)),
    )
    if not runs:
        return None
    tips_mm = [np.full(len(run.xy_mm), z_mm) for run in runs]
    strips = _strips(thick, z_mm, model)
    height_mm = float(thick[thick > 0].mean())
    wanted = model.left_below(z_mm)
    share = float(np.clip(wanted[model.job.near].sum() / thick.sum(), LEAST_OF_GAP, 1.0))
    chains, laid = weighed(runs, tips_mm, share * thick, strips, model, setup, job=job)
    served = float(thick[beside_runs(runs, FAR_MM, model)].sum()) / float(thick.sum())
    return _Laying(chains, laid, served, height_mm, [])


def _served(chains: list[Chain], thick: Float[np.ndarray, "ny nx"], model: PatchModel) -> float:
    """Share of what is due that beads lay."""
    beads_mm3 = sum(chain.volume_mm3 for chain in chains)
    due_mm3 = float(thick.sum()) * model.cell_mm**2 * model.weight
    return beads_mm3 / (BOND_RATIO * due_mm3)


def _plan_skin(
    model: PatchModel, skin: Skin, most_mm: float, index: int, setup: PrintSetup
) -> Pass | None:
    """The last pass, along the surface, where the planar ones left room for it."""
    wanted = model.left_below(np.inf)
    thick = np.minimum(model.top_mm - model.surface_mm, wanted + AGREE_MM)
    due = skin.columns & (thick >= LEAST_THICK_MM) & (thick <= DEEP_RATIO * most_mm)
    thick = np.where(due, thick, 0.0)
    chains, laid = _along_skin(model, skin, thick, setup)
    if not chains:
        return None
    model.surface_mm = model.surface_mm + laid
    model.laid_mm = model.laid_mm + laid
    nowhere = np.zeros(model.reach.shape, dtype=bool)  # the next bead is begun from above
    top_mm = float(max(chain.z_mm.max() for chain in chains))
    height_mm = float(thick[due].mean())
    return Pass(top_mm, height_mm, index, tuple(chains), nowhere, skin.tip.z_mm)


def _skin_served(model: PatchModel, skin: Skin | None, setup: PrintSetup) -> Skin | None:
    """A skin of the columns that its beads would get to."""
    if skin is None:
        return None
    thick = np.where(skin.columns, SKIN_MM, 0.0)
    _, laid = _along_skin(model, skin, thick, setup)
    return replace(skin, columns=laid > 0) if laid.any() else None


def _along_skin(
    model: PatchModel,
    skin: Skin,
    thick: Float[np.ndarray, "ny nx"],
    setup: PrintSetup,
) -> tuple[list[Chain], Float[np.ndarray, "ny nx"]]:
    """Beads across the slope from the lowest up: the flat then reaches over what is still open."""
    anywhere = np.ones(model.reach.shape, dtype=bool)  # among the skin's columns
    drawn = draw(thick, anywhere, skin.across_rad, model, setup, rings=0)
    beads = drawn.beads if drawn is not None else []
    runs = [run for bead in beads for run in free_runs(bead, skin.free_between)]
    if not runs:
        return [], np.zeros(model.shape)
    tips_mm = [skin.tip.sample(run.xy_mm, smooth=True) for run in runs]
    strips = _strips(thick, model.top_mm, model)
    chains, laid = weighed(runs, tips_mm, thick, strips, model, setup)
    upward = [c if c.z_mm[-1] >= c.z_mm[0] else c.reversed() for c in chains]
    return sorted(upward, key=lambda c: float(c.z_mm[0])), laid


def _due(
    model: PatchModel,
    z_mm: float,
    here: Bool[np.ndarray, "ny nx"],
    reach: Bool[np.ndarray, "ry rx"],
    following_mm: Float[np.ndarray, "ny nx"],
    most_mm: float,
    layer_mm: float,
) -> Float[np.ndarray, "ny nx"]:
    """Thickness to lay by column now: the gap, where waiting would make it too deep for a bead.

    Where it is too deep already (the nozzle could not get down there), a layer is drawn over it
    as far as a bead holds on to what stands beside it; what lies under it is lost, and said.
    """
    below = model.wanted_below(z_mm)
    wanted = below - model.laid_mm - model.sunk_mm
    # a hole that the nozzle could not get into ends below: nothing is laid over what is above it
    wanted = np.where(below - model.wanted_below(z_mm - most_mm) > ROUNDING_MM, wanted, 0.0)
    gap = z_mm - model.surface_mm
    thick = np.clip(np.minimum(gap, wanted + AGREE_MM), 0.0, None)
    last = np.minimum(model.planar_top_mm, following_mm) <= z_mm + ROUNDING_MM
    due = (following_mm - model.surface_mm > most_mm) | last
    active = here & due & (wanted > LEAST_THICK_MM / 2) & (thick >= LEAST_THICK_MM)
    # a slope is cut in mid-layer, as slicers do: what ends below stays a step of half a layer
    active &= model.planar_top_mm > z_mm - 0.5 * layer_mm
    deep = active & (gap > DEEP_RATIO * most_mm)
    return _lidded(model, thick, active, deep, reach, gap, most_mm, layer_mm)


def _due_of_job(
    model: PatchModel,
    z_mm: float,
    planned: Bool[np.ndarray, "ny nx"],
    reach: Bool[np.ndarray, "ry rx"],
    following_mm: Float[np.ndarray, "ny nx"],
    most_mm: float,
    layer_mm: float,
) -> Float[np.ndarray, "ny nx"]:
    """Thickness to lay now where the job laid something at this height: up to it, as the job did.

    On a slope the job's steps are what was there, not the smooth surface that the deficit has.
    """
    assert model.job is not None
    gap = z_mm - model.surface_mm
    wanted = model.left_below(z_mm)
    deep = gap > DEEP_RATIO * most_mm
    thick = np.where(deep, np.minimum(gap, np.maximum(wanted + AGREE_MM, layer_mm)), gap)
    thick = np.clip(thick, 0.0, None)
    after = np.unique(following_mm[np.isfinite(following_mm)])
    again = model.job.at(float(after[0])) if len(after) else None
    last = ~again if again is not None else np.ones_like(planned)
    due = last | (following_mm - model.surface_mm > most_mm)
    # the shallow rim of what a scan rounded off counts: line by line it makes up a bead; beside
    # it noise would
    least_mm = np.where(wanted > ROUNDING_MM, ROUNDED_OFF_MM, LEAST_THICK_MM)
    active = planned & due & (thick >= least_mm)
    active &= ~deep | (wanted > LEAST_THICK_MM / 2)  # beside the part all is deep
    return _lidded(model, thick, active, deep & active, reach, gap, most_mm, layer_mm)


def _hemmed(
    model: PatchModel,
    z_mm: float,
    thick: Float[np.ndarray, "ny nx"],
    reach: Bool[np.ndarray, "ry rx"],
    most_mm: float,
    layer_mm: float,
) -> Float[np.ndarray, "ny nx"]:
    """With half a line beside rims that the head gets to from outside alone.

    A wall keeps it off a gap in another one, but not off the air in front: there a line laid half
    upon the rim begins what the next ones grow from. Without it all above would stay open.
    """
    wanted, beside = thick > 0, ~np.isfinite(model.top_mm)
    air = beside & ((z_mm - model.surface_mm > DEEP_RATIO * most_mm) | model.hem)
    if not wanted.any() or not air.any():
        return thick
    free = model.free_at(reach)
    # a row of columns holds no line
    served = ndimage.binary_opening(wanted & free, np.ones((2, 2)))
    unserved = wanted & ~_beside(served, wanted, HEM_MM, model.cell_mm)
    if not unserved.any():
        return thick
    rim = unserved & _beside(air & free, unserved, HEM_MM, model.cell_mm)
    label, count = ndimage.label(rim, np.ones((3, 3)))
    area_mm2 = np.bincount(label.ravel(), minlength=count + 1) * model.cell_mm**2
    rim &= area_mm2[label] >= RIM_MM2
    if not rim.any():
        return thick
    hem = air & _beside(rim, rim, HEM_MM, model.cell_mm)
    model.hem |= hem
    return np.where(hem, layer_mm, thick)


def _lidded(
    model: PatchModel,
    thick: Float[np.ndarray, "ny nx"],
    active: Bool[np.ndarray, "ny nx"],
    deep: Bool[np.ndarray, "ny nx"],
    reach: Bool[np.ndarray, "ry rx"],
    gap: Float[np.ndarray, "ny nx"],
    most_mm: float,
    layer_mm: float,
) -> Float[np.ndarray, "ny nx"]:
    """Over what is too deep a layer is drawn, as far as a bead holds on to what stands beside.

    What the head cannot get over holds on from a little farther away: beads begin no nearer to it
    than the flat around the bore lets them.
    """
    if deep.any():
        # from the edge of what holds it, not from the middle of its last column
        hang_mm = HOLD_MM + 0.5 * model.cell_mm
        holds = (active & ~deep) | (gap < most_mm)
        held = _beside(holds, deep, hang_mm, model.cell_mm)
        blocked = ~model.free_at(reach)
        held |= _beside(holds & blocked, deep, hang_mm + TO_WALL_MM, model.cell_mm)
        lidded = np.minimum(thick, layer_mm)
        model.sunk_mm = np.where(deep & held, model.sunk_mm + thick - lidded, model.sunk_mm)
        thick = np.where(deep & held, lidded, thick)
        active = active & (~deep | held)
    return np.where(active, thick, 0.0)


def _beside(
    what: Bool[np.ndarray, "ny nx"],
    asked: Bool[np.ndarray, "ny nx"],
    within_mm: float,
    cell_mm: float,
) -> Bool[np.ndarray, "ny nx"]:
    """Which columns lie within a distance of others; found for those asked about at least."""
    beside = np.zeros_like(what)
    if not asked.any():
        return beside
    margin = int(np.ceil(within_mm / cell_mm)) + 1
    rows, columns = (
        slice(max(int(at.min()) - margin, 0), int(at.max()) + margin + 1) for at in asked.nonzero()
    )
    apart = ndimage.distance_transform_edt(~what[rows, columns])
    beside[rows, columns] = apart * cell_mm <= within_mm + 1e-9
    return beside


def _strips(
    thick: Float[np.ndarray, "ny nx"], z_mm: float | Float[np.ndarray, "ny nx"], model: PatchModel
) -> Bool[np.ndarray, "ny nx"]:
    """Columns to fill that lie along a wall: it stands up to the nozzle, or higher."""
    walls = (model.surface_mm > z_mm - AGREE_MM) & (thick <= 0)
    # what is drawn over a hollow hangs: nothing presses it aside
    asked = (thick > 0) & (z_mm - model.surface_mm <= DEEP_RATIO * model.most_mm)
    return _beside(walls, asked, TO_WALL_MM, model.cell_mm) & asked


def _thin(region: Any, z_mm: float, height_mm: float, volume_mm3: float) -> Unprintable:
    x0, y0, x1, y1 = region.bounds()
    return Unprintable(
        float(volume_mm3), (x0, y0, z_mm - height_mm, x1, y1, z_mm), "thinner than half a nozzle"
    )
