"""The heights of a patch's passes: the job's layers, flat tops, and openings of hollows.

An opening is a height between layers at which the head first gets down into a hollow.
"""

from __future__ import annotations

import enum
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from scipy import ndimage

from gcode.profiles import PrintSetup
from gcode.slicing.layers import LayerGrid
from gcode.slicing.patch_free import ROUNDING_MM
from gcode.slicing.patch_model import PatchModel
from gcode.slicing.patch_state import PatchState


class Openings(enum.Enum):
    """How openings are used: at which heights between the job's layers an extra pass is laid."""

    EACH = enum.auto()
    """From the lowest up, layer by layer, for as long as the head gets into more columns."""
    ALONE = enum.auto()
    """The same, and hollows get no pass at the job's layers until the last of these."""


@dataclass(frozen=True, slots=True)
class Height:
    """One height, at which a pass is laid.

    Attributes
    ----------
    z_mm, index
        The height of the tip, and its number, counted from below.
    here
        Columns that may be filled in this pass.
    following_mm
        The height of each column's next pass.
    most_mm, deep_mm
        The thickest bead, and the deepest gap that is filled from above.
    layer_mm
        The height of the job's layers.
    reach
        Where the tip may be at this height, on the cells of `Reach`.
    """

    z_mm: float
    index: int
    here: Bool[np.ndarray, "ny nx"]
    following_mm: Float[np.ndarray, "ny nx"]
    most_mm: float
    deep_mm: float
    layer_mm: float
    reach: Bool[np.ndarray, "_ry _rx"]


@dataclass(frozen=True, slots=True)
class Heights:
    """All heights of a patch's passes.

    Attributes
    ----------
    tops_mm, flats_mm, openings_mm
        Heights of the job's layers, of flat tops between them, and of openings.
    alone
        Columns that get passes at openings only, up to the last of these.
    ends_mm
        Where a flat top off the job's layers ends a column; infinite elsewhere.
    most_mm, layer_mm
        The thickest bead, and the height of the job's layers.
    """

    tops_mm: Float[np.ndarray, " n"]
    flats_mm: Float[np.ndarray, " m"]
    openings_mm: Float[np.ndarray, " k"]
    alone: Bool[np.ndarray, "ny nx"]
    ends_mm: Float[np.ndarray, "ny nx"]
    most_mm: float
    layer_mm: float

    @classmethod
    def of(
        cls, model: PatchModel, grid: LayerGrid, setup: PrintSetup, *, openings: Openings
    ) -> Heights:
        """Find the heights for a patch."""
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
            ends[np.abs(model.top_mm - flat_mm) <= model.options.heights.on_flat_mm] = flat_mm
        others = np.sort(np.concatenate([tops, flats]))
        alone = np.zeros(model.shape, dtype=bool)
        keep = openings is Openings.ALONE
        opened = _openings(model, others, most_mm, grid.layer_height_mm, alone=keep)
        if keep and len(opened):
            alone = _hollow(model, others, most_mm)
        return cls(tops, flats, opened, alone, ends, most_mm, grid.layer_height_mm)

    @property
    def all_mm(self) -> Float[np.ndarray, " n"]:
        """All heights, from the floor up."""
        return np.sort(np.concatenate([self.tops_mm, self.flats_mm, self.openings_mm]))

    def at(self, index: int, state: PatchState, model: PatchModel) -> Height:
        """One of the heights, with the columns that may be filled in a given state."""
        options = model.options.heights
        z_mm = float(self.all_mm[index])
        on_grid = not (np.abs(self.flats_mm - z_mm) < ROUNDING_MM).any()
        later = self.tops_mm[self.tops_mm > z_mm + ROUNDING_MM]
        following = np.minimum(self.ends_mm, float(later[0]) if len(later) else np.inf)
        here = self.ends_mm > z_mm + ROUNDING_MM if on_grid else self.ends_mm == z_mm
        deep_mm = options.deep_ratio * self.most_mm
        opens = bool((np.abs(self.openings_mm - z_mm) < ROUNDING_MM).any())
        if self.alone.any() and z_mm < self.openings_mm[-1] + options.apart_layers * self.layer_mm:
            apart_mm = self.openings_mm[-1] + options.apart_layers * self.layer_mm
            more = np.concatenate([self.openings_mm, self.tops_mm[self.tops_mm >= apart_mm]])
            more = more[more > z_mm + ROUNDING_MM]
            ends = state.planar_top_mm <= z_mm + ROUNDING_MM
            here &= (self.alone == opens) | (self.alone & ends)
            if len(more):
                following = np.where(self.alone, np.minimum(self.ends_mm, more[0]), following)
        elif opens:
            here &= following - state.surface_mm > deep_mm
        reach = model.reach.at(z_mm)
        return Height(z_mm, index, here, following, self.most_mm, deep_mm, self.layer_mm, reach)


def _flats(model: PatchModel, tops_mm: Float[np.ndarray, " n"]) -> Float[np.ndarray, " m"]:
    """Heights at which flat areas of the deficit end between the job's layers.

    They get a pass of their own there: the nozzle's flat makes the surface, at its own height.
    """
    options = model.options
    tops = model.top_mm
    steps = np.round(tops[np.isfinite(tops)] / options.heights.flat_mm).astype(np.int64)
    if not len(steps):
        return np.zeros(0)
    area_mm2 = np.bincount(steps - steps.min()) * model.cell_mm**2
    often = np.flatnonzero(
        ndimage.convolve1d(area_mm2, np.ones(3), mode="constant") >= options.heights.flat_mm2
    )
    least = np.ones((round(options.heights.flat_wide_mm / model.cell_mm),) * 2)
    found: list[float] = []
    for step in often[np.argsort(-area_mm2[often])] + steps.min():
        z_mm = float(step * options.heights.flat_mm)
        if np.abs(np.array([*tops_mm, *found]) - z_mm).min() < options.beads.least_thick_mm:
            continue
        # no rim or slope that passes through this height
        at = np.abs(tops - z_mm) <= options.heights.on_flat_mm
        (y0, y1), (x0, x1) = ((int(k.min()), int(k.max()) + 1) for k in at.nonzero())
        flat = np.zeros_like(at)
        flat[y0:y1, x0:x1] = ndimage.binary_opening(at[y0:y1, x0:x1], least)
        if flat.sum() * model.cell_mm**2 >= options.heights.flat_mm2:
            found.append(float(np.median(tops[flat])))
    return np.array(found)


def _openings(
    model: PatchModel,
    tops_mm: Float[np.ndarray, " n"],
    most_mm: float,
    layer_mm: float,
    *,
    alone: bool,
) -> Float[np.ndarray, " m"]:
    """Heights from the lowest at which the head gets into hollows, at least a layer apart.

    There beads grow out from what holds them by one more line before the next layer of the job:
    what lies under them is lost, and up to a layer less of it. A layer hangs under each, so that
    nothing between two of them is lost. Unless hollows keep to them `alone`, a pass of the job's a
    little higher takes the place of one, and so does one a little lower where the head is in: its
    beads lie there already.
    """
    options = model.options
    at_mm, area_mm2 = _opening(model, tops_mm, most_mm)
    if not len(at_mm):
        return np.zeros(0)
    others = np.zeros(0) if alone else tops_mm[tops_mm >= at_mm[0] - ROUNDING_MM]
    found: list[float] = []
    last_mm, open_mm2 = -np.inf, 0.0
    for z_mm, more_mm2 in zip(at_mm.tolist(), area_mm2.tolist(), strict=True):
        open_mm2 += more_mm2
        if open_mm2 < options.heights.opening_mm2 or z_mm < last_mm + layer_mm - ROUNDING_MM:
            continue
        near = others[np.abs(others - z_mm) < options.beads.least_thick_mm]
        if len(near):
            last_mm = float(near[-1])
        else:
            last_mm = z_mm
            found.append(z_mm)
        open_mm2 = 0.0
    return np.array(found)


def _hollow(
    model: PatchModel, tops_mm: Float[np.ndarray, " n"], most_mm: float
) -> Bool[np.ndarray, "ny nx"]:
    """Columns too deep for a bead where passes at some heights first get in."""
    later = np.searchsorted(tops_mm, model.need_mm - ROUNDING_MM)
    first_mm = np.append(tops_mm, np.inf)[later]
    deep = first_mm - model.floor_mm > model.options.heights.deep_ratio * most_mm
    return np.asarray(deep & np.isfinite(model.top_mm))


def _opening(
    model: PatchModel, tops_mm: Float[np.ndarray, " n"], most_mm: float
) -> tuple[Float[np.ndarray, " s"], Float[np.ndarray, " s"]]:
    """Ascending heights, and over how much that is hollow the head first gets in at each."""
    options = model.options.heights
    need_mm = model.need_mm
    hollow = _hollow(model, tops_mm, most_mm) & (need_mm < model.top_mm - options.opens_below_mm)
    hollow &= np.isfinite(need_mm)  # elsewhere nothing stands: the head was never out
    steps = np.ceil(need_mm[hollow] / options.flat_mm).astype(np.int64)
    if not len(steps):
        return np.zeros(0), np.zeros(0)
    area_mm2 = np.bincount(steps - steps.min()) * model.cell_mm**2
    return (np.arange(len(area_mm2)) + steps.min()) * options.flat_mm, area_mm2
