"""What is due in a pass: how thick each column is to be filled, and where beads would hang."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float
from scipy import ndimage

from gcode.slicing.patch_bridges import Bridges, bridges_at
from gcode.slicing.patch_free import ROUNDING_MM, beside
from gcode.slicing.patch_heights import Height
from gcode.slicing.patch_model import PatchModel
from gcode.slicing.patch_state import PatchState


@dataclass(frozen=True, slots=True)
class Due:
    """What is due in a pass, column by column.

    Attributes
    ----------
    thick_mm
        The thickness to lay.
    sunk_mm
        The thickness that is given up below, where beads hang over it.
    hem
        Columns to be laid over air, beside a rim.
    hangs
        Columns where beads hang: once laid they are as high as the nozzle, with a gap below.
    loose
        Columns where beads fall onto the floor: they fill it, but hold no strand.
    bridges
        Strands over air, which sag.
    alone
        Columns over which no newly drawn line would be held, though one of the job's might be.
    """

    thick_mm: Float[np.ndarray, "ny nx"]
    sunk_mm: Float[np.ndarray, "ny nx"]
    hem: Bool[np.ndarray, "ny nx"]
    hangs: Bool[np.ndarray, "ny nx"]
    loose: Bool[np.ndarray, "ny nx"]
    bridges: Bridges
    alone: Bool[np.ndarray, "ny nx"]


def due_at(model: PatchModel, state: PatchState, at: Height) -> Due:
    """What is due where the job has no lines: each gap that the next pass would find too deep.

    A gap that is too deep already, since the nozzle could not get down into it, is covered by a
    layer: by strands from hold to hold, or as far as a bead holds on to what is beside it, or by
    beads that fall onto the floor. What stays open below is given up, and told.
    """
    options = model.options
    below = model.wanted_below(at.z_mm)
    wanted = below - state.laid_mm - state.sunk_mm
    # a hole that the nozzle could not get into ends below: nothing is laid over what is above it
    lower = model.wanted_below(at.z_mm - at.most_mm)
    wanted = np.where(below - lower > ROUNDING_MM, wanted, 0.0)
    gap = at.z_mm - state.surface_mm
    thick = np.clip(np.minimum(gap, wanted + options.due.agree_mm), 0.0, None)
    last = np.minimum(state.planar_top_mm, at.following_mm) <= at.z_mm + ROUNDING_MM
    due = (at.following_mm - state.surface_mm > at.most_mm) | last
    active = (
        at.here
        & due
        & (wanted > options.beads.least_thick_mm / 2)
        & (thick >= options.beads.least_thick_mm)
    )
    # a slope is cut in mid-layer, as slicers do: what ends below stays a step of half a layer
    active &= state.planar_top_mm > at.z_mm - 0.5 * at.layer_mm
    due = _lidded(model, state, at, thick, active, active & (gap > at.deep_mm), gap, at.layer_mm)
    holds = _ends_hold(model, state, at, gap)
    alone = active & ((due.thick_mm <= 0) | due.loose)
    bridges = bridges_at(model, at, thick, active, gap, holds, alone)
    return _bridged(due, bridges, np.minimum(gap, wanted), at)


def _ends_hold(
    model: PatchModel, state: PatchState, at: Height, over_mm: Float[np.ndarray, "ny nx"]
) -> Bool[np.ndarray, "ny nx"]:
    """Columns that hold a strand's end: about a layer below the tip, and not fallen there."""
    high = (over_mm <= at.most_mm) & (over_mm >= -model.options.due.agree_mm)
    return high & state.firm_at(at.z_mm)


def _bridged(due: Due, bridges: Bridges, thick: Float[np.ndarray, "ny nx"], at: Height) -> Due:
    """What is due, with strands over air in the place of beads that would hang or fall."""
    lidded = np.where(thick > at.most_mm, at.layer_mm, thick)
    return replace(
        due,
        thick_mm=np.where(bridges.over | bridges.ends, lidded, due.thick_mm),
        sunk_mm=np.where(bridges.over, thick - lidded, due.sunk_mm),
        loose=due.loose & ~bridges.over,
        bridges=bridges,
    )


def due_of_job(
    model: PatchModel, state: PatchState, at: Height, planned: Bool[np.ndarray, "ny nx"]
) -> Due:
    """What is due where the job laid lines at this height: up to it, as far as the job filled.

    On a slope the job's steps were there, and not the smooth surface that the deficit has. What the
    job left open stays open, as the cells of sparse infill: a line over them hangs, as it did.
    """
    options = model.options
    assert model.job is not None
    gap = model.job.laid_mm(state.surface_mm, at.z_mm)
    wanted = state.left_below(model, at.z_mm)
    deep = gap > at.deep_mm
    thick = np.where(
        deep, np.minimum(gap, np.maximum(wanted + options.due.agree_mm, at.layer_mm)), gap
    )
    thick = np.clip(thick, 0.0, None)
    after = np.unique(at.following_mm[np.isfinite(at.following_mm)])
    again = model.job.at(float(after[0])) if len(after) else None
    last = ~again if again is not None else np.ones_like(planned)
    due = last | (at.following_mm - state.surface_mm > at.most_mm)
    # the shallow rim of what a scan rounded off counts: line by line it makes up a bead; beside
    # it noise would
    least_mm = np.where(
        wanted > ROUNDING_MM, options.due.rounded_off_mm, options.beads.least_thick_mm
    )
    active = planned & due & (thick >= least_mm) & _gone_at(model, at)
    active &= ~deep | (wanted > options.beads.least_thick_mm / 2)  # beside the part all is deep
    # over what the job left open a strand has room to be round, and takes the place of lower ones
    open_below = at.z_mm - state.surface_mm > gap + options.due.agree_mm
    most_mm = np.where(open_below, at.most_mm, at.layer_mm)
    due = _lidded(model, state, at, thick, active, deep & active, gap, most_mm)
    due = replace(due, hangs=due.hangs | open_below)
    # where the job's lines find no hold, or span too much, strands of our own may
    over_mm = at.z_mm - state.surface_mm
    air = (due.thick_mm > 0) & (over_mm > at.deep_mm)
    if not air.any():
        return due
    below = (over_mm <= at.deep_mm) & state.firm_at(at.z_mm)
    alone = air & ~_held(model, below, air, model.free_at(at.reach))
    holds = _ends_hold(model, state, at, over_mm)
    bridges = bridges_at(model, at, due.thick_mm, due.thick_mm > 0, over_mm, holds, alone)
    return replace(due, bridges=bridges, alone=alone & ~bridges.over)


def _gone_at(model: PatchModel, at: Height) -> Bool[np.ndarray, "ny nx"]:
    """Columns where something of the layer that ends at a height is missing, and beside them.

    A deficit that goes on above, takes less than this layer, and begins no deeper than a bead of
    the next one gets, is that one's: a scanner's spot rounds off ridges one line wide, and their
    flanks lie lower.
    """
    options = model.options
    assert model.job is not None
    own = model.wanted_below(at.z_mm) - model.wanted_below(at.z_mm - at.layer_mm)
    goes_on = model.top_mm > at.z_mm + options.due.agree_mm
    least_mm = min(at.most_mm - at.layer_mm, at.layer_mm) - ROUNDING_MM
    gone = np.where(goes_on, own > least_mm, own > 0)
    return beside(gone, model.job.near, options.lines.rim_mm, model.cell_mm)


def hemmed(model: PatchModel, state: PatchState, at: Height, due: Due) -> Due:
    """With half a line beside rims that the head gets to from outside alone.

    A wall keeps it off a gap in another one, but not off the air in front: there a line laid half
    upon the rim begins what the next ones grow from. Without it all above would stay open.
    """
    options = model.options.due
    wanted, outside = due.thick_mm > 0, ~np.isfinite(model.top_mm)
    air = outside & ((at.z_mm - state.surface_mm > at.deep_mm) | state.hem)
    if not wanted.any() or not air.any():
        return due
    free = model.free_at(at.reach)
    # a row of columns holds no line
    served = ndimage.binary_opening(wanted & free, np.ones((2, 2)))
    unserved = wanted & ~beside(served, wanted, options.hem_mm, model.cell_mm)
    if not unserved.any():
        return due
    rim = unserved & beside(air & free, unserved, options.hem_mm, model.cell_mm)
    label, count = ndimage.label(rim, np.ones((3, 3)))
    area_mm2 = np.bincount(label.ravel(), minlength=count + 1) * model.cell_mm**2
    rim &= area_mm2[label] >= options.rim_mm2
    if not rim.any():
        return due
    hem = air & beside(rim, rim, options.hem_mm, model.cell_mm)
    return replace(due, thick_mm=np.where(hem, at.layer_mm, due.thick_mm), hem=hem)


def _lidded(
    model: PatchModel,
    state: PatchState,
    at: Height,
    thick: Float[np.ndarray, "ny nx"],
    active: Bool[np.ndarray, "ny nx"],
    deep: Bool[np.ndarray, "ny nx"],
    gap: Float[np.ndarray, "ny nx"],
    most_mm: float | Float[np.ndarray, "ny nx"],
) -> Due:
    """Over what is too deep up to `most_mm` is drawn, as far as a bead holds on to what is beside.

    What the head cannot get over holds on from a little farther away: beads begin no nearer to it
    than the flat around the bore lets them. A strand that nothing holds falls: where the floor is
    near enough it lies under the nozzle all the same. Counted is only what that holds, wherever
    it comes to lie, so that none of it is too much.
    """
    sunk = np.zeros(model.shape)
    loose = np.zeros(model.shape, dtype=bool)
    if deep.any():
        holds = ((active & ~deep) | (gap < at.most_mm)) & ~state.hangs_at(at.z_mm)
        free = model.free_at(at.reach)
        firm = _held(model, holds & ~state.loose, deep, free)
        held = firm | _held(model, holds & state.loose, deep, free)
        falls = deep & (gap <= model.drop_mm)
        held |= falls & beside(free, falls, model.spread_mm, model.cell_mm)
        loose = held & ~firm
        lidded = np.minimum(thick, most_mm)
        sunk = np.where(deep & held, thick - lidded, 0.0)
        thick = np.where(deep & held, lidded, thick)
        active = active & (~deep | held)
    nowhere = np.zeros(model.shape, dtype=bool)
    thick, none = np.where(active, thick, 0.0), Bridges.none(model)
    return Due(
        thick, sunk, nowhere, hangs=gap > at.deep_mm, loose=loose, bridges=none, alone=nowhere
    )


def _held(
    model: PatchModel,
    holds: Bool[np.ndarray, "ny nx"],
    asked: Bool[np.ndarray, "ny nx"],
    free: Bool[np.ndarray, "ny nx"],
) -> Bool[np.ndarray, "ny nx"]:
    """Of the columns asked about, those over which a bead holds on to what is beside."""
    options = model.options
    if not holds.any():
        return np.zeros_like(asked)
    # from the edge of what holds it, not from the middle of its last column
    hang_mm = options.due.hold_mm + 0.5 * model.cell_mm
    held = beside(holds, asked, hang_mm, model.cell_mm)
    held |= beside(holds & ~free, asked, hang_mm + options.beads.to_wall_mm, model.cell_mm)
    return held & asked


def strips_along_walls(
    thick: Float[np.ndarray, "ny nx"],
    z_mm: float | Float[np.ndarray, "ny nx"],
    model: PatchModel,
    state: PatchState,
) -> Bool[np.ndarray, "ny nx"]:
    """Columns to fill that lie along a wall: it stands up to the nozzle, or higher."""
    options = model.options
    walls = (state.surface_mm > z_mm - options.due.agree_mm) & (thick <= 0)
    # what is drawn over a hollow hangs: nothing presses it aside
    asked = (thick > 0) & (z_mm - state.surface_mm <= options.heights.deep_ratio * model.most_mm)
    return beside(walls, asked, options.beads.to_wall_mm, model.cell_mm) & asked
