"""The passes of a patch, from the floor up: where beads are due, and how much is in them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float
from manifold3d import CrossSection, FillRule
from scipy import ndimage
from scipy.spatial import cKDTree
from skimage import measure

from gcode.moves import Role
from gcode.profiles import PrintSetup
from gcode.progress import Progress
from gcode.slicing.beads import Bead, divided, spacing_of
from gcode.slicing.infill import SOLID_ANGLES_RAD, ring_beads, solid_fill
from gcode.slicing.job import LEAST_NOZZLES, MOST_NOZZLES, Unprintable
from gcode.slicing.layers import LayerGrid
from gcode.slicing.medial import fill_thin
from gcode.slicing.patch_model import PatchModel
from gcode.slicing.reach import Reach
from gcode.slicing.regions import SIMPLIFY_MM, offset, peel, pieces

# Thinner than this no bead holds together; it is filled with the next pass, or is the tolerance.
LEAST_THICK_MM = 0.06
# The floor was measured, the deficit computed from it: they agree within this.
AGREE_MM = 0.04
# A gap of more than this share of the thickest bead is not filled from above: up to there a strand
# of one line width, round (π/4 d² = width × gap), still reaches its floor. On a steep slope the
# head keeps the tip this far off.
DEEP_RATIO = 1.6
HOLD_MM = 0.45  # a line's width: how far a bead may hang over a hole beside what holds it
STEP_MM = 0.4  # along a bead, between two samples of the gap
LEAST_RUN_MM = 0.4
LEAST_SECTION_MM2 = 0.004
# From a bead's centre, as far as plastic is pressed sideways under the nozzle's flat, which is
# 2.5 bores across (E3D V6): not to its very rim.
SPREAD_NOZZLES = 1.125
# What is pressed out under the flat beside a wall goes on to the wall, where that is this near to
# what it reaches: nowhere else has it to go.
TO_WALL_MM = 0.2
# Centre lines keep off the rim of where the tip may go: contours of cells are not exact.
DRAWN_IN_CELLS = 0.75
ROUNDED_CELLS = 4  # beyond a region, as far as rounding off its corners reaches
ROUNDING_MM = 2e-3  # more than the text's last digit
NOT_LISTED_MM3 = 0.02
# A flat top: as much area, as wide, within so little height.
FLAT_MM2, FLAT_WIDE_MM, FLAT_MM = 1.0, 0.6, 0.02
ON_FLAT_MM = 1.5 * FLAT_MM  # of its height: what belongs to it


@dataclass(frozen=True, slots=True)
class Chain:
    """A bead of a pass: (n, 2) points and (n-1,) cross-sections, mm²."""

    xy_mm: Float[np.ndarray, "n 2"]
    section_mm2: Float[np.ndarray, " m"]
    role: Role

    def reversed(self) -> Chain:
        """The same from its other end."""
        return Chain(
            np.ascontiguousarray(self.xy_mm[::-1]),
            np.ascontiguousarray(self.section_mm2[::-1]),
            self.role,
        )


@dataclass(frozen=True, slots=True)
class Pass:
    """Beads at one nozzle height."""

    z_mm: float
    height_mm: float
    index: int
    chains: tuple[Chain, ...]
    reach: Bool[np.ndarray, "ny nx"]


def plan_passes(
    model: PatchModel, grid: LayerGrid, setup: PrintSetup, progress: Progress
) -> list[Pass]:
    """Passes from the floor up."""
    low_mm, high_mm = float(model.box[2]), float(model.box[5])
    tops = grid.tops_to(high_mm)
    tops = tops[tops > low_mm + 1e-6]
    if len(tops) == 0 or tops[-1] < high_mm - 1e-6:
        tops = np.append(tops, high_mm)
    # the last pass ends with the deficit, not above it
    tops[-1] = min(tops[-1], high_mm)
    most_mm = min(model.most_mm, setup.process.max_gap_layers * grid.layer_height_mm)
    flats = _flats(model, tops)
    ends = np.full(model.shape, np.inf)  # where a flat top lies, off the job's layers
    for flat_mm in flats:
        ends[np.abs(model.top_mm - flat_mm) <= ON_FLAT_MM] = flat_mm
    heights = np.sort(np.concatenate([tops, flats]))
    passes: list[Pass] = []
    for k, z_mm in enumerate(heights):
        on_grid = not (np.abs(flats - z_mm) < ROUNDING_MM).any()
        later = tops[tops > z_mm + ROUNDING_MM]
        following = np.minimum(ends, float(later[0]) if len(later) else np.inf)
        here = ends > z_mm + ROUNDING_MM if on_grid else ends == z_mm
        one = _plan_pass(
            model, float(z_mm), here, following, most_mm, k, grid.layer_height_mm, setup
        )
        if one is not None:
            passes.append(one)
        progress("slice patch", float(k + 1), float(len(heights)))
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


def _plan_pass(
    model: PatchModel,
    z_mm: float,
    here: Bool[np.ndarray, "ny nx"],
    following_mm: Float[np.ndarray, "ny nx"],
    most_mm: float,
    index: int,
    layer_mm: float,
    setup: PrintSetup,
) -> Pass | None:
    """Fill what is due at this height, among the columns that are filled at it."""
    thick = _due(model, z_mm, here, following_mm, most_mm, layer_mm)
    if not thick.any():
        return None
    reach = model.reach.at(z_mm)
    centres = offset(
        _contour((thick > 0) & model.free_at(reach), model), -DRAWN_IN_CELLS * model.cell_mm
    )
    if centres.is_empty():
        return None
    wanted_region = _contour(thick > 0, model)
    height_mm = float(thick[thick > 0].mean())
    share_mm = spacing_of(max(setup.process.line_width_mm, 1.05 * height_mm), height_mm)
    # centres may go as far as the nozzle is free; the fill reaches half a line beyond them
    region = offset(centres, 0.5 * share_mm) ^ wanted_region
    beads, lost_mm2 = _fill(region, share_mm, index, setup)
    runs = [_begun_inside(run, model) for bead in beads for run in _free_runs(bead, reach, model)]
    if not runs:
        return None
    chains, laid = _weighed(runs, thick, _strips(thick, z_mm, model), model, setup)
    if not chains:
        return None
    lost_mm3 = lost_mm2 * height_mm
    if lost_mm3 > NOT_LISTED_MM3:
        model.lost.append(_thin(region, z_mm, height_mm, lost_mm3))
    # over a bridge the surface is the nozzle's height, whatever lies open below
    bridged = (laid > 0) & (z_mm - model.surface_mm > DEEP_RATIO * most_mm)
    model.surface_mm = np.where(bridged, z_mm, model.surface_mm + laid)
    model.laid_mm = model.laid_mm + laid
    return Pass(z_mm, height_mm, index, tuple(chains), reach)


def _due(
    model: PatchModel,
    z_mm: float,
    here: Bool[np.ndarray, "ny nx"],
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
    last = np.minimum(model.top_mm, following_mm) <= z_mm + ROUNDING_MM
    due = (following_mm - model.surface_mm > most_mm) | last
    active = here & due & (wanted > LEAST_THICK_MM / 2) & (thick >= LEAST_THICK_MM)
    # a slope is cut in mid-layer, as slicers do: what ends below stays a step of half a layer
    active &= model.top_mm > z_mm - 0.5 * layer_mm
    deep = active & (gap > DEEP_RATIO * most_mm)
    if deep.any():
        held = _beside((active & ~deep) | (gap < most_mm), deep, HOLD_MM, model.cell_mm)
        lidded = np.minimum(thick, layer_mm)
        model.sunk_mm = np.where(deep & held, model.sunk_mm + thick - lidded, model.sunk_mm)
        thick = np.where(deep & held, lidded, thick)
        active &= ~deep | held
    return np.where(active, thick, 0.0)


def _beside(
    what: Bool[np.ndarray, "ny nx"],
    asked: Bool[np.ndarray, "ny nx"],
    within_mm: float,
    cell_mm: float,
) -> Bool[np.ndarray, "ny nx"]:
    """Which columns, among those asked about, lie within a distance of others."""
    margin = int(np.ceil(within_mm / cell_mm)) + 1
    rows, columns = (
        slice(max(int(at.min()) - margin, 0), int(at.max()) + margin + 1) for at in asked.nonzero()
    )
    beside = np.zeros_like(what)
    apart = ndimage.distance_transform_edt(~what[rows, columns])
    beside[rows, columns] = apart * cell_mm <= within_mm + 1e-9
    return beside


def _free_runs(bead: Bead, reach: Bool[np.ndarray, "ny nx"], model: PatchModel) -> list[Bead]:
    """The stretches of a bead along which the nozzle may be."""
    xy = bead.xy_mm
    lengths = np.hypot(*np.diff(xy, axis=0).T)
    count = np.maximum(1, np.ceil(lengths / STEP_MM).astype(np.int64))
    points, owner = divided(xy, count)
    closer = 2 + int(np.ceil(3 * STEP_MM / model.reach.field.cell_mm))
    # closer than the checker's own steps of half a cell
    share = np.linspace(0.0, 1.0, closer)[:, None, None]
    between = points[:-1] + (points[1:] - points[:-1]) * share
    ok = surely_free(between.reshape(-1, 2), reach, model.reach).reshape(closer, -1).all(axis=0)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], ok, [False]]).astype(np.int8)))
    pieces_mm = (lengths / count)[owner]
    return [
        Bead(
            points[a : b + 1],
            np.ones(b - a),
            bead.role,
            closed=bool(bead.closed and b - a == len(owner)),
        )
        for a, b in zip(edges[::2], edges[1::2], strict=True)
        if pieces_mm[a:b].sum() >= LEAST_RUN_MM
    ]


def _begun_inside(run: Bead, model: PatchModel) -> Bead:
    """A loop whose seam has most old material around it, where it does not show."""
    if not run.closed:
        return run
    cells = np.floor((run.xy_mm[:-1] - model.origin_mm) / model.cell_mm).astype(np.int64)
    cells = np.clip(cells, 0, np.array(model.shape[::-1]) - 1)
    return run.started_at(int(np.argmax(model.beside_mm[cells[:, 1], cells[:, 0]])))


def surely_free(
    points_mm: Float[np.ndarray, "n 2"], free: Bool[np.ndarray, "_ry _rx"], reach: Reach
) -> Bool[np.ndarray, " n"]:
    """Whether the nozzle may be there, whichever way the text's last digit is rounded."""
    little = ROUNDING_MM * np.array([[-1, -1], [-1, 1], [1, -1], [1, 1]])
    near = (points_mm + little[:, None, :]).reshape(-1, 2)
    return np.asarray(reach.free_at_points(near, free).reshape(4, -1).all(axis=0))


def _strips(
    thick: Float[np.ndarray, "ny nx"], z_mm: float, model: PatchModel
) -> Bool[np.ndarray, "ny nx"]:
    """Columns to fill that lie along a wall: it stands up to the nozzle, or higher."""
    walls = (model.surface_mm > z_mm - AGREE_MM) & (thick <= 0)
    asked = thick > 0
    return _beside(walls, asked, TO_WALL_MM, model.cell_mm) & asked


def _weighed(
    runs: list[Bead],
    thick: Float[np.ndarray, "ny nx"],
    strips: Bool[np.ndarray, "ny nx"],
    model: PatchModel,
    setup: PrintSetup,
) -> tuple[list[Chain], Float[np.ndarray, "ny nx"]]:
    """Cross-sections such that every column's thickness goes to the nearest piece of a bead.

    So plastic is the volume that is missing, to the column. Returns the chains, and the thickness
    that columns get: none beyond where a bead can spread (farther in `strips` along walls), less
    where a bead would be too wide.
    """
    nozzle_mm = setup.printer.nozzle_diameter_mm
    middles = np.concatenate([0.5 * (run.xy_mm[1:] + run.xy_mm[:-1]) for run in runs])
    lengths = np.concatenate([np.hypot(*np.diff(run.xy_mm, axis=0).T) for run in runs])
    filled = np.flatnonzero(thick.ravel() > 0)
    spread_mm = SPREAD_NOZZLES * nozzle_mm
    distance, nearest = cKDTree(middles).query(
        model.points_mm[filled], distance_upper_bound=spread_mm + TO_WALL_MM
    )
    near = np.isfinite(distance) & ((distance < spread_mm) | strips.ravel()[filled])
    cell_mm3 = model.cell_mm**2 * model.weight
    volume = np.bincount(
        nearest[near], thick.ravel()[filled[near]] * cell_mm3, minlength=len(middles)
    )
    reach = np.bincount(nearest[near], thick.ravel()[filled[near]], minlength=len(middles))
    number = np.bincount(nearest[near], minlength=len(middles))
    depth = reach / np.maximum(number, 1)
    chains: list[Chain] = []
    given = np.zeros(len(middles))  # share of what its columns want that a piece lays
    at = 0
    for run in runs:
        n = len(run.xy_mm) - 1
        own = slice(at, at + n)
        at += n
        section = _smooth(volume[own] / np.maximum(lengths[own], 1e-9), closed=run.closed)
        most = np.maximum(depth[own], LEAST_THICK_MM) * MOST_NOZZLES * nozzle_mm
        most = np.minimum(most, setup.printer.max_bead_section_mm2)
        given[own] = np.minimum(1.0, most / np.maximum(section, 1e-9))
        section = np.minimum(section, most)
        chains += _split(Chain(run.xy_mm, section, run.role))
    laid = np.zeros(thick.size)
    laid[filled[near]] = thick.ravel()[filled[near]] * given[nearest[near]]
    return chains, laid.reshape(thick.shape)


def _smooth(values: Float[np.ndarray, " n"], *, closed: bool) -> Float[np.ndarray, " n"]:
    """Means over three pieces: which of two pieces a column goes to is chance."""
    if len(values) < 3:
        return np.full(len(values), values.mean())
    return np.asarray(ndimage.uniform_filter1d(values, 3, mode="wrap" if closed else "nearest"))


def _split(chain: Chain) -> list[Chain]:
    """Drop the pieces where there is nothing to lay."""
    keep = np.concatenate([[False], chain.section_mm2 > LEAST_SECTION_MM2, [False]])
    edges = np.flatnonzero(np.diff(keep.astype(np.int8)))
    return [
        Chain(chain.xy_mm[a : b + 1], chain.section_mm2[a:b], chain.role)
        for a, b in zip(edges[::2], edges[1::2], strict=True)
    ]


def _contour(mask: Bool[np.ndarray, "ny nx"], model: PatchModel) -> Any:
    """A region of columns as polygons, corners of the grid rounded off."""
    if not mask.any():
        return CrossSection()
    (y0, y1), (x0, x1) = ((int(k.min()), int(k.max()) + 1) for k in mask.nonzero())
    around = np.pad(mask[y0:y1, x0:x1].astype(np.float64), ROUNDED_CELLS)
    smooth = ndimage.gaussian_filter(around, 0.8)
    corner = np.array([x0, y0]) + 0.5 - ROUNDED_CELLS
    polygons = []
    for line in measure.find_contours(smooth, 0.5):  # type: ignore[no-untyped-call]
        if len(line) < 4:
            continue
        polygons.append((line[:-1, ::-1] + corner) * model.cell_mm + model.origin_mm)
    if not polygons:
        return CrossSection()
    return CrossSection(polygons, FillRule.EvenOdd).simplify(SIMPLIFY_MM)


def _fill(region: Any, share_mm: float, index: int, setup: PrintSetup) -> tuple[list[Bead], float]:
    """One perimeter, then solid lines; along the medial axis where it is thin."""
    nozzle_mm = setup.printer.nozzle_diameter_mm
    least_mm, most_mm = LEAST_NOZZLES * nozzle_mm, MOST_NOZZLES * nozzle_mm
    beads: list[Bead] = []
    lost_mm2 = 0.0
    for island in pieces(region):
        peeled = peel(island, share_mm, 1)
        for ring in peeled.rings:
            beads += ring_beads(ring.centre, ring.area_mm2, share_mm, Role.PERIMETER)
        for part in peeled.thin:
            thin = fill_thin(part, least_mm=least_mm, most_mm=most_mm)
            beads += thin.beads
            lost_mm2 += thin.lost_mm2
        fills, left_mm2 = solid_fill(
            peeled.core,
            spacing_mm=share_mm,
            angle_rad=SOLID_ANGLES_RAD[index % 2],
            role=Role.SOLID_INFILL,
            least_mm=least_mm,
            most_mm=most_mm,
        )
        beads += fills
        lost_mm2 += left_mm2
    return beads, lost_mm2


def _thin(region: Any, z_mm: float, height_mm: float, volume_mm3: float) -> Unprintable:
    x0, y0, x1, y1 = region.bounds()
    return Unprintable(
        float(volume_mm3), (x0, y0, z_mm - height_mm, x1, y1, z_mm), "thinner than half a nozzle"
    )
