"""A patch: beads that fill a deficit on top of a rough floor, and nothing else.

Passes lie on the job's own layers, from the floor up. At every place a bead is as thick as the gap
between its nozzle and the surface predicted after the earlier passes (idea 8 of the design), and
a place is filled when waiting for the next layer would leave a gap too deep for one bead. What the
nozzle cannot reach, and what is too thin for it, is listed with its volume.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float
from manifold3d import CrossSection, FillRule
from scipy import ndimage
from scipy.spatial import cKDTree
from skimage import measure

from gcode.errors import SliceError
from gcode.moves import (
    Comment,
    FinishMoves,
    LayerChange,
    Prime,
    Role,
    Script,
    SetBed,
    SetFan,
    SetHotend,
    Toolpath,
)
from gcode.profiles import PrintSetup
from gcode.progress import Progress, silent
from gcode.slicing.beads import Bead, spacing_of, width_of
from gcode.slicing.infill import SOLID_ANGLES_RAD, ring_beads, solid_fill
from gcode.slicing.job import LEAST_NOZZLES, MOST_NOZZLES, Unprintable
from gcode.slicing.layers import LayerGrid, mesh_of
from gcode.slicing.medial import fill_thin
from gcode.slicing.pen import Pen
from gcode.slicing.reach import Reach
from gcode.slicing.regions import SIMPLIFY_MM, offset, peel, pieces
from gcode.surfaces import HeightField
from gcode.surfaces import raster_kernels as kernels

FINE_MM, COARSE_MM = 0.1, 0.2
FINE_CELLS = 250_000
MARGIN_MM = 3.0
# Thinner than this no bead holds together; it is filled with the next pass, or is the tolerance.
LEAST_THICK_MM = 0.06
# A bead thicker than this share of the bore no longer presses onto its floor.
MOST_THICK_NOZZLES = 0.8
# The floor was measured, the deficit computed from it: they agree within this.
AGREE_MM = 0.04
# A gap of more than this share of the thickest bead is not filled from above.
DEEP_RATIO = 1.3
HOLD_MM = 0.4  # how far a bead may hang over a hole beside what holds it
STEP_MM = 0.4  # along a bead, between two samples of the gap
LEAST_RUN_MM = 0.4
LEAST_SECTION_MM2 = 0.004
# From a bead's centre, as far as plastic is pressed sideways under the nozzle's flat, which is
# 2.5 bores across (E3D V6): not to its very rim.
SPREAD_NOZZLES = 1.125
# Centre lines keep off the rim of where the tip may go: contours of cells are not exact.
DRAWN_IN_CELLS = 0.75
ROUNDING_MM = 2e-3  # more than the text's last digit
NEAR_MM = 1.0  # a travel as short as this needs no lift
CLEAR_MM = 0.5  # of the tip over everything on a travel
STANDALONE_LIFT_MM = 5.0
NOT_LISTED_MM3 = 0.02
# A flat top: as much area, as wide, within so little height.
FLAT_MM2, FLAT_WIDE_MM, FLAT_MM = 1.0, 0.6, 0.02
COVERED = "covered by what stands above it"
TOO_SMALL = "too small for a bead, or with nothing below it to hold one"
Box = tuple[float, float, float, float, float, float]


@dataclass(frozen=True, slots=True)
class Unreachable:
    """A piece of the deficit that the nozzle cannot get to; the box is in the build frame."""

    volume_mm3: float
    box_mm: Box
    reason: str


@dataclass(frozen=True, slots=True)
class PatchRegion:
    """A connected piece of the deficit and the share of it that the beads fill."""

    volume_mm3: float
    box_mm: Box
    reachable_ratio: float


@dataclass(frozen=True, slots=True)
class PatchPlan:
    """A patch and what it leaves out.

    Attributes
    ----------
    beads_mm3
        Plastic laid as beads.
    reachable_mm3
        Volume of the deficit that the nozzle gets to.
    predicted
        The surface after the patch.
    """

    toolpath: Toolpath
    beads_mm3: float
    reachable_mm3: float
    unreachable: tuple[Unreachable, ...]
    unprintable: tuple[Unprintable, ...]
    regions: tuple[PatchRegion, ...]
    predicted: HeightField


def slice_patch(
    deficit: Any,
    setup: PrintSetup,
    *,
    as_built: HeightField,
    grid: LayerGrid,
    standalone: bool,
    start_mm: tuple[float, float, float] | None = None,
    progress: Progress = silent,
) -> PatchPlan:
    """Slice a deficit.

    Parameters
    ----------
    deficit
        `manifold3d.Manifold` of what is missing, build frame, mm.
    as_built
        What stands there, where unseen as high as is safe.
    grid
        Layers of the job.
    standalone
        True: a whole program for a part that stands on a machine whose Z is still true: X and Y
        are homed, Z never. False: in mid-job, hot, parked at `start_mm` with the filament pulled
        back by the profile's retraction; the patch ends there likewise.

    Raises
    ------
    SliceError
        If the deficit is empty, or `start_mm` is missing in mid-job.

    Examples
    --------
    >>> from pathlib import Path
    >>> import gcode
    >>> from gcode.slicing.layers import LayerGrid
    >>> setup = gcode.load_setup()
    >>> whole, broken = (gcode.read_solid(Path(f"{name}.stl")) for name in ("placed", "standing"))
    >>> patch = gcode.slice_patch(
    ...     whole - broken,
    ...     setup,
    ...     as_built=gcode.HeightField.from_manifold(broken, 0.2, margin_mm=30.0),
    ...     grid=LayerGrid.from_setup(setup),
    ...     standalone=True,
    ... )
    >>> 0.8 < patch.beads_mm3 / (whole - broken).volume() < 1.05
    True
    """
    if deficit.is_empty() or deficit.volume() <= 0:
        raise SliceError("The deficit is empty (0 mm³); there is nothing to print.")
    if not standalone and start_mm is None:
        raise SliceError("A patch in mid-job needs the place where the nozzle is parked.")
    model = _Model(deficit, setup, as_built)
    passes = _plan_passes(model, grid, setup, progress)
    pen = _begin(setup, model.field, start_mm)
    laid_mm3 = 0.0
    for one in passes:
        laid_mm3 += _emit(pen, one, model, setup)
    _end(pen, setup, model.field, start_mm)
    unreachable, regions = _left_over(model)
    return PatchPlan(
        toolpath=Toolpath(tuple(pen.moves) if laid_mm3 > 0 else ()),
        beads_mm3=laid_mm3,
        reachable_mm3=sum(r.volume_mm3 * r.reachable_ratio for r in regions),
        unreachable=unreachable,
        unprintable=tuple(model.lost),
        regions=regions,
        predicted=model.surface(),
    )


class _Model:
    """Columns over the deficit: what is wanted, what is there, what has been laid."""

    def __init__(self, deficit: Any, setup: PrintSetup, as_built: HeightField) -> None:
        self.deficit = deficit
        self.as_built = as_built
        self.box = deficit.bounding_box()
        x0, y0, x1, y1 = (
            self.box[0] - MARGIN_MM,
            self.box[1] - MARGIN_MM,
            self.box[3] + MARGIN_MM,
            self.box[4] + MARGIN_MM,
        )
        fine = (x1 - x0) * (y1 - y0) / FINE_MM**2 <= FINE_CELLS
        self.cell_mm = FINE_MM if fine else COARSE_MM
        nx = int(np.ceil((x1 - x0) / self.cell_mm))
        ny = int(np.ceil((y1 - y0) / self.cell_mm))
        self.shape = (ny, nx)
        self.origin_mm = np.array([x0, y0])
        vertices, faces = mesh_of(deficit)
        offsets, self._z, up = kernels.column_crossings(
            vertices, faces, x0, y0, self.cell_mm, nx, ny
        )
        self._sign = up.astype(np.float64)
        self._column = np.repeat(np.arange(nx * ny), np.diff(offsets))
        columns_mm3 = float(self.wanted_below(np.inf).sum()) * self.cell_mm**2
        # columns sample the solid; its own volume is exact
        self.weight = float(deficit.volume()) / columns_mm3 if columns_mm3 > 0 else 1.0
        self.top_mm = kernels.column_top(offsets, self._z, -np.inf).reshape(self.shape)
        self.points_mm = self._centres()
        floor_mm = as_built.sample(self.points_mm).reshape(self.shape)
        self.floor_mm = floor_mm
        self.surface_mm = floor_mm.copy()
        self.laid_mm = np.zeros(self.shape)
        self.sunk_mm = np.zeros(self.shape)  # given up under a bridge
        self.lost: list[Unprintable] = []
        self.most_mm = MOST_THICK_NOZZLES * setup.printer.nozzle_diameter_mm
        window = (x0 - NEAR_MM, y0 - NEAR_MM, x1 + NEAR_MM, y1 + NEAR_MM)
        # the lowest pass lies at most one thick bead above the deficit's floor
        self.reach = Reach(
            as_built,
            setup.printer,
            lowest_tip_mm=max(0.0, float(self.box[2])),
            window_mm=window,
        )
        self.field = as_built

    def _centres(self) -> Float[np.ndarray, "n 2"]:
        ny, nx = self.shape
        x = self.origin_mm[0] + (np.arange(nx) + 0.5) * self.cell_mm
        y = self.origin_mm[1] + (np.arange(ny) + 0.5) * self.cell_mm
        return np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)

    def wanted_below(self, z_mm: float) -> Float[np.ndarray, "ny nx"]:
        """Thickness of the deficit below a height, by column."""
        below = np.bincount(
            self._column,
            weights=self._sign * np.minimum(self._z, z_mm),
            minlength=self.shape[0] * self.shape[1],
        )
        return np.maximum(below.reshape(self.shape), 0.0)

    def free_at(self, reach: Bool[np.ndarray, "_ry _rx"]) -> Bool[np.ndarray, "ny nx"]:
        """Columns over which the nozzle may be, from an answer of `reach`."""
        return self.reach.free_at_points(self.points_mm, reach).reshape(self.shape)

    def surface(self) -> HeightField:
        """The as-built field with the patch on it."""
        cells = self.as_built.cells_of(self.points_mm)
        ny, nx = self.as_built.shape
        ok = ((cells >= 0) & (cells < (ny, nx))).all(axis=1) & (self.laid_mm.ravel() > 0)
        z_mm = self.as_built.z_mm.astype(np.float64).copy()
        np.maximum.at(z_mm, (cells[ok, 0], cells[ok, 1]), self.surface_mm.ravel()[ok])
        return self.as_built.raised(z_mm)


@dataclass(frozen=True, slots=True)
class _Chain:
    """A bead of a pass: (n, 2) points and (n-1,) cross-sections, mm²."""

    xy_mm: Float[np.ndarray, "n 2"]
    section_mm2: Float[np.ndarray, " m"]
    role: Role

    def reversed(self) -> _Chain:
        """The same from its other end."""
        return _Chain(
            np.ascontiguousarray(self.xy_mm[::-1]),
            np.ascontiguousarray(self.section_mm2[::-1]),
            self.role,
        )


@dataclass(frozen=True, slots=True)
class _Pass:
    """Beads at one nozzle height."""

    z_mm: float
    height_mm: float
    index: int
    chains: tuple[_Chain, ...]
    reach: Bool[np.ndarray, "ny nx"]


def _plan_passes(
    model: _Model, grid: LayerGrid, setup: PrintSetup, progress: Progress
) -> list[_Pass]:
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
        ends[np.abs(model.top_mm - flat_mm) <= 1.5 * FLAT_MM] = flat_mm
    heights = np.sort(np.concatenate([tops, flats]))
    passes: list[_Pass] = []
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


def _flats(model: _Model, tops_mm: Float[np.ndarray, " n"]) -> Float[np.ndarray, " m"]:
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
        flat = ndimage.binary_opening(np.abs(tops - z_mm) <= 1.5 * FLAT_MM, least)
        if flat.sum() * model.cell_mm**2 >= FLAT_MM2:
            found.append(float(np.median(tops[flat])))
    return np.array(found)


def _plan_pass(
    model: _Model,
    z_mm: float,
    here: Bool[np.ndarray, "ny nx"],
    following_mm: Float[np.ndarray, "ny nx"],
    most_mm: float,
    index: int,
    layer_mm: float,
    setup: PrintSetup,
) -> _Pass | None:
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
    runs = [run for bead in beads for run in _free_runs(bead, reach, model)]
    if not runs:
        return None
    chains, laid = _weighed(runs, thick, model, setup)
    if not chains:
        return None
    lost_mm3 = lost_mm2 * height_mm
    if lost_mm3 > NOT_LISTED_MM3:
        model.lost.append(_thin(region, z_mm, height_mm, lost_mm3))
    # over a bridge the surface is the nozzle's height, whatever lies open below
    bridged = (laid > 0) & (z_mm - model.surface_mm > DEEP_RATIO * most_mm)
    model.surface_mm = np.where(bridged, z_mm, model.surface_mm + laid)
    model.laid_mm = model.laid_mm + laid
    return _Pass(z_mm, height_mm, index, tuple(chains), reach)


def _due(
    model: _Model,
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
    last = model.top_mm <= z_mm + 1e-6
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


def _free_runs(bead: Bead, reach: Bool[np.ndarray, "ny nx"], model: _Model) -> list[Bead]:
    """The stretches of a bead along which the nozzle may be."""
    xy = bead.xy_mm
    lengths = np.hypot(*np.diff(xy, axis=0).T)
    count = np.maximum(1, np.ceil(lengths / STEP_MM).astype(np.int64))
    owner = np.repeat(np.arange(len(lengths)), count)
    step = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count)
    t = (step / count[owner])[:, None]
    points = np.concatenate([xy[owner] + (xy[owner + 1] - xy[owner]) * t, xy[-1:]])
    closer = 2 + int(np.ceil(3 * STEP_MM / model.reach.field.cell_mm))
    # closer than the checker's own steps of half a cell
    share = np.linspace(0.0, 1.0, closer)[:, None, None]
    between = points[:-1] + (points[1:] - points[:-1]) * share
    ok = _surely_free(between.reshape(-1, 2), reach, model).reshape(closer, -1).all(axis=0)
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


def _surely_free(
    points_mm: Float[np.ndarray, "n 2"], reach: Bool[np.ndarray, "_ry _rx"], model: _Model
) -> Bool[np.ndarray, " n"]:
    """Whether the nozzle may be there, whichever way the text's last digit is rounded."""
    little = ROUNDING_MM * np.array([[-1, -1], [-1, 1], [1, -1], [1, 1]])
    near = (points_mm + little[:, None, :]).reshape(-1, 2)
    return np.asarray(model.reach.free_at_points(near, reach).reshape(4, -1).all(axis=0))


def _weighed(
    runs: list[Bead], thick: Float[np.ndarray, "ny nx"], model: _Model, setup: PrintSetup
) -> tuple[list[_Chain], Float[np.ndarray, "ny nx"]]:
    """Cross-sections such that every column's thickness goes to the nearest piece of a bead.

    So plastic is the volume that is missing, to the column. Returns the chains, and the thickness
    that columns get: none beyond where a bead can spread, less where a bead would be too wide.
    """
    nozzle_mm = setup.printer.nozzle_diameter_mm
    middles = np.concatenate([0.5 * (run.xy_mm[1:] + run.xy_mm[:-1]) for run in runs])
    lengths = np.concatenate([np.hypot(*np.diff(run.xy_mm, axis=0).T) for run in runs])
    filled = np.flatnonzero(thick.ravel() > 0)
    distance, nearest = cKDTree(middles).query(
        model.points_mm[filled], distance_upper_bound=SPREAD_NOZZLES * nozzle_mm
    )
    near = np.isfinite(distance)
    cell_mm3 = model.cell_mm**2 * model.weight
    volume = np.bincount(
        nearest[near], thick.ravel()[filled[near]] * cell_mm3, minlength=len(middles)
    )
    reach = np.bincount(nearest[near], thick.ravel()[filled[near]], minlength=len(middles))
    number = np.bincount(nearest[near], minlength=len(middles))
    depth = reach / np.maximum(number, 1)
    chains: list[_Chain] = []
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
        chains += _split(_Chain(run.xy_mm, section, run.role))
    laid = np.zeros(thick.size)
    laid[filled[near]] = thick.ravel()[filled[near]] * given[nearest[near]]
    return chains, laid.reshape(thick.shape)


def _smooth(values: Float[np.ndarray, " n"], *, closed: bool) -> Float[np.ndarray, " n"]:
    """Means over three pieces: which of two pieces a column goes to is chance."""
    if len(values) < 3:
        return np.full(len(values), values.mean())
    return np.asarray(ndimage.uniform_filter1d(values, 3, mode="wrap" if closed else "nearest"))


def _split(chain: _Chain) -> list[_Chain]:
    """Drop the pieces where there is nothing to lay."""
    keep = np.concatenate([[False], chain.section_mm2 > LEAST_SECTION_MM2, [False]])
    edges = np.flatnonzero(np.diff(keep.astype(np.int8)))
    return [
        _Chain(chain.xy_mm[a : b + 1], chain.section_mm2[a:b], chain.role)
        for a, b in zip(edges[::2], edges[1::2], strict=True)
    ]


def _contour(mask: Bool[np.ndarray, "ny nx"], model: _Model) -> Any:
    """A region of columns as polygons, corners of the grid rounded off."""
    padded = np.pad(mask.astype(np.float64), 1)
    smooth = ndimage.gaussian_filter(padded, 0.8)
    polygons = []
    for line in measure.find_contours(smooth, 0.5):  # type: ignore[no-untyped-call]
        if len(line) < 4:
            continue
        xy = (line[:-1, ::-1] - 0.5) * model.cell_mm + model.origin_mm
        polygons.append(xy)
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


def _begin(
    setup: PrintSetup, field: HeightField, start_mm: tuple[float, float, float] | None
) -> Pen:
    """From park (mid-job), or from a machine that stands still (standalone)."""
    if start_mm is not None:
        pen = Pen(setup, np.array(start_mm))
        pen.retracted = setup.printer.retraction_mm > 0
        pen.add(SetFan(setup.material.fan_ratio))
        return pen
    printer, material = setup.printer, setup.material
    safe_mm = min(field.top_mm + STANDALONE_LIFT_MM, printer.max_z_mm)
    pen = Pen(setup, np.array([*printer.prime_mm[:2], safe_mm]))
    pen.add(Comment("The part stands on the bed and Z is true: X and Y are homed, Z is not."))
    pen.add(SetBed(material.bed_c))
    pen.add(SetHotend(material.hotend_c))
    lift = f"{safe_mm:.3f}".rstrip("0").rstrip(".")
    pen.add(Script(("G21", "G91", "G1 Z2 F600", "G90", f"G1 Z{lift} F600", "G28 X Y"), "approach"))
    pen.position_mm = np.array([0.0, 0.0, safe_mm])
    pen.move_to(np.array([*printer.prime_mm[:2], safe_mm]))
    pen.add(SetBed(material.bed_c, wait=True))
    pen.add(SetHotend(material.hotend_c + material.repair_first_bead_delta_c, wait=True))
    pen.move_to(np.array(printer.prime_mm))
    if printer.prime_length_mm > 0:
        pen.add(Prime(printer.prime_length_mm, 3.0))
    pen.retract()
    wipe = np.array(printer.prime_mm) + np.array([4.0, 0.0, 0.0])
    pen.move_to(wipe)
    pen.move_to(np.array([*wipe[:2], safe_mm]))
    pen.add(SetFan(material.fan_ratio))
    return pen


def _end(
    pen: Pen,
    setup: PrintSetup,
    field: HeightField,
    start_mm: tuple[float, float, float] | None,
) -> None:
    pen.retract()
    here = pen.position_mm
    if start_mm is not None:
        pen.move_to(np.array([*here[:2], max(start_mm[2], here[2])]))
        pen.move_to(np.array([*start_mm[:2], max(start_mm[2], here[2])]))
        pen.move_to(np.array(start_mm))
        pen.add(FinishMoves())
        return
    printer = setup.printer
    safe_mm = min(max(field.top_mm + STANDALONE_LIFT_MM, printer.park_mm[2]), printer.max_z_mm)
    pen.move_to(np.array([*here[:2], safe_mm]))
    pen.move_to(np.array([*printer.park_mm[:2], safe_mm]))
    pen.add(FinishMoves())
    pen.add(SetHotend(0.0))
    pen.add(SetBed(0.0))
    pen.add(SetFan(0.0))


def _emit(pen: Pen, one: _Pass, model: _Model, setup: PrintSetup) -> float:
    """Lay one pass; returns its plastic."""
    pen.add(LayerChange(one.index, one.z_mm, one.height_mm))
    over_mm = max(model.field.top_mm, one.z_mm) + CLEAR_MM
    over_mm = min(over_mm, setup.printer.max_z_mm)
    laid_mm3 = 0.0
    for chain in _ordered(one.chains, pen.position_mm[:2]):
        target = np.array([*chain.xy_mm[0], one.z_mm])
        gap = target - pen.position_mm
        near = abs(gap[2]) < 1e-6 and float(np.hypot(gap[0], gap[1])) < NEAR_MM
        samples = 2 + int(np.ceil(3 * NEAR_MM / model.reach.field.cell_mm))
        way = pen.position_mm[:2] + np.linspace(0.0, 1.0, samples)[:, None] * gap[:2]
        if near and _surely_free(way, one.reach, model).all():
            pen.move_to(target)
        else:
            pen.hop_to(target, over_mm=over_mm)
        lengths = np.hypot(*np.diff(chain.xy_mm, axis=0).T)
        width_mm = float(chain.section_mm2.mean()) / one.height_mm
        pen.extrude(
            np.column_stack([chain.xy_mm, np.full(len(chain.xy_mm), one.z_mm)]),
            chain.section_mm2,
            speed_mm_s=setup.process.repair_speed_mm_s,
            role=chain.role,
            width_mm=width_of(width_mm, one.height_mm),
            height_mm=one.height_mm,
        )
        laid_mm3 += float(lengths @ chain.section_mm2)
    return laid_mm3


def _ordered(chains: tuple[_Chain, ...], start_mm: Float[np.ndarray, " 2"]) -> list[_Chain]:
    """Greedy: the chain whose end is nearest comes next."""
    heads = np.array([chain.xy_mm[0] for chain in chains])
    tails = np.array([chain.xy_mm[-1] for chain in chains])
    alive = np.ones(len(chains), dtype=bool)
    here = np.asarray(start_mm, dtype=np.float64)
    out = []
    for _ in chains:
        to_head = np.where(alive, ((heads - here) ** 2).sum(axis=1), np.inf)
        to_tail = np.where(alive, ((tails - here) ** 2).sum(axis=1), np.inf)
        k = int(np.argmin(np.minimum(to_head, to_tail)))
        alive[k] = False
        chain = chains[k] if to_head[k] <= to_tail[k] else chains[k].reversed()
        out.append(chain)
        here = chain.xy_mm[-1]
    return out


def _left_over(model: _Model) -> tuple[tuple[Unreachable, ...], tuple[PatchRegion, ...]]:
    """By connected piece: what was filled, and why the rest was not."""
    cell_mm2 = model.cell_mm**2 * model.weight
    wanted = model.wanted_below(np.inf)
    left = np.clip(wanted - model.laid_mm, 0.0, None)
    # a film below the thinnest bead is the tolerance, not out of reach
    left = np.where(left > LEAST_THICK_MM + AGREE_MM, left, 0.0)
    unreachable: list[Unreachable] = []
    regions: list[PatchRegion] = []
    for piece in model.deficit.decompose():
        x0, y0, z0, x1, y1, z1 = (float(v) for v in piece.bounding_box())
        box: Box = (x0, y0, z0, x1, y1, z1)
        cells = _cells_of(model, box)
        whole_mm3 = float(wanted[cells].sum()) * cell_mm2
        stuck_mm3 = float(left[cells].sum()) * cell_mm2
        share = 1.0 - stuck_mm3 / whole_mm3 if whole_mm3 > 0 else 1.0
        share = min(max(share, 0.0), 1.0)
        volume_mm3 = float(piece.volume())
        regions.append(PatchRegion(volume_mm3, box, share))
        if stuck_mm3 <= NOT_LISTED_MM3:
            continue
        reason = _reason(model, cells, left[cells])
        if reason is None:
            model.lost.append(Unprintable(volume_mm3 * (1.0 - share), box, TOO_SMALL))
        else:
            unreachable.append(Unreachable(volume_mm3 * (1.0 - share), box, reason))
    return tuple(unreachable), tuple(regions)


def _cells_of(model: _Model, box: Box) -> tuple[slice, slice]:
    low = np.floor((np.array(box[:2]) - model.origin_mm) / model.cell_mm).astype(int)
    high = np.ceil((np.array(box[3:5]) - model.origin_mm) / model.cell_mm).astype(int)
    return slice(max(low[1], 0), high[1] + 1), slice(max(low[0], 0), high[0] + 1)


def _reason(
    model: _Model, cells: tuple[slice, slice], stuck: Float[np.ndarray, "a b"]
) -> str | None:
    """What keeps the nozzle from the column with most left; None if nothing does."""
    iy, ix = np.unravel_index(int(np.argmax(stuck)), stuck.shape)
    iy, ix = int(iy) + cells[0].start, int(ix) + cells[1].start
    point = model.points_mm.reshape(*model.shape, 2)[iy, ix]
    field = model.reach.field
    row, column = (int(v) for v in field.cells_of(point[None])[0])
    ny, nx = field.shape
    if model.floor_mm[iy, ix] > model.top_mm[iy, ix] + LEAST_THICK_MM:
        return COVERED
    if not (0 <= row < ny and 0 <= column < nx):
        return COVERED
    # the tip over the first bead that is lacking: the lowest, where a bridge was laid over it
    under_bridge = model.sunk_mm[iy, ix] > 0
    lies_mm = model.floor_mm[iy, ix] + (0.0 if under_bridge else model.laid_mm[iy, ix])
    tip_mm = min(lies_mm + model.most_mm, model.top_mm[iy, ix])
    return model.reach.reason_at(row, column, float(tip_mm))
