"""Beads of a patch: drawn into a region of columns, kept where the nozzle may be, and weighed."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int
from manifold3d import CrossSection, FillRule
from scipy import ndimage
from scipy.spatial import cKDTree
from skimage import measure

from gcode.moves import Role
from gcode.profiles import PrintSetup
from gcode.slicing.beads import ROUND_LOSS, Bead, spacing_of
from gcode.slicing.infill import ring_beads, solid_fill
from gcode.slicing.job_lines import JobPieces, gathered
from gcode.slicing.medial import fill_thin
from gcode.slicing.options import FillOptions, PatchOptions
from gcode.slicing.patch_middles import FreeBetween, in_the_middle, left_of, turn_rad
from gcode.slicing.patch_model import PatchModel
from gcode.slicing.reach import Reach
from gcode.slicing.regions import SIMPLIFY_MM, offset, peel, pieces
from gcode.stretches import stretches_of
from gcode.surfaces.lines import near_lines

CORNER_CELLS = 4  # beyond a region, as far as rounding off its corners reaches


@dataclass(frozen=True, slots=True)
class Chain:
    """A bead of a pass: (n, 2) points, (n,) heights of the tip, (n-1,) cross-sections, mm².

    `deep_mm` has (n-1,) how far what lies under it is below the tip; `cold` (n-1,) says where it
    lies on what has long been there, and not on beads of the patch; None where nobody asked.
    """

    xy_mm: Float[np.ndarray, "n 2"]
    z_mm: Float[np.ndarray, " n"]
    section_mm2: Float[np.ndarray, " m"]
    deep_mm: Float[np.ndarray, " m"]
    role: Role
    cold: Bool[np.ndarray, " m"] | None = None

    @property
    def volume_mm3(self) -> float:
        """Plastic in it."""
        return float(np.hypot(*np.diff(self.xy_mm, axis=0).T) @ self.section_mm2)

    @property
    def middle_mm(self) -> Float[np.ndarray, " 2"]:
        """A point of it, halfway among its points."""
        return self.xy_mm[len(self.xy_mm) // 2]

    def part(self, a: int, b: int) -> Chain:
        """From one of its points to another."""
        cold = None if self.cold is None else self.cold[a:b]
        to = slice(a, b + 1)
        return Chain(
            self.xy_mm[to], self.z_mm[to], self.section_mm2[a:b], self.deep_mm[a:b], self.role, cold
        )

    def reversed(self) -> Chain:
        """The same from its other end."""
        return replace(
            self,
            xy_mm=np.ascontiguousarray(self.xy_mm[::-1]),
            z_mm=np.ascontiguousarray(self.z_mm[::-1]),
            section_mm2=np.ascontiguousarray(self.section_mm2[::-1]),
            deep_mm=np.ascontiguousarray(self.deep_mm[::-1]),
            cold=None if self.cold is None else np.ascontiguousarray(self.cold[::-1]),
        )


def draw(
    thick_mm: Float[np.ndarray, "ny nx"],
    free: Bool[np.ndarray, "_ry _rx"],
    angle_rad: float,
    model: PatchModel,
    setup: PrintSetup,
    *,
    rings: int = 1,
) -> list[Bead]:
    """Centre lines for the columns to fill, over those where the nozzle may be.

    Within `rings` perimeters the lines go at an angle. `free` is an answer of the model's reach.
    """
    wanted = contour(thick_mm > 0, model)
    drawn_in = offset(_free_over(wanted, free, model.reach) ^ wanted, -model.options.beads.drawn_mm)
    if drawn_in.is_empty():
        return []
    height_mm = float(thick_mm[thick_mm > 0].mean())
    share_mm = spacing_of(max(setup.process.line_width_mm, 1.05 * height_mm), height_mm)
    # centres may go as far as the nozzle is free; the fill reaches half a line beyond them
    region = offset(drawn_in, 0.5 * share_mm) ^ wanted
    return fill(region, share_mm, angle_rad, setup, model.options.fill, rings=rings)


def begun_inside(run: Bead, model: PatchModel) -> Bead:
    """A loop whose seam has most old material around it, where it does not show."""
    if not run.closed:
        return run
    cells = np.floor((run.xy_mm[:-1] - model.origin_mm) / model.cell_mm).astype(np.int64)
    cells = np.clip(cells, 0, np.array(model.shape[::-1]) - 1)
    return run.started_at(int(np.argmax(model.beside_mm[cells[:, 1], cells[:, 0]])))


@dataclass(frozen=True, slots=True)
class _Shares:
    """Which columns go to which piece of some runs.

    Attributes
    ----------
    middle_mm, length_mm
        (m, 2) and (m,) of the pieces; `tree` finds the nearest.
    columns, piece, thick_mm
        (c,) the columns that beads get to, the piece that each goes to, what each wants.
    """

    middle_mm: Float[np.ndarray, "m 2"]
    length_mm: Float[np.ndarray, " m"]
    tree: cKDTree
    columns: Int[np.ndarray, " c"]
    piece: Int[np.ndarray, " c"]
    thick_mm: Float[np.ndarray, " c"]

    @classmethod
    def of(
        cls,
        runs: list[Bead],
        thick: Float[np.ndarray, "ny nx"],
        strips: Bool[np.ndarray, "ny nx"],
        model: PatchModel,
    ) -> _Shares:
        """To the nearest piece, as far as a bead spreads, and in `strips` on to the wall."""
        middle = np.concatenate([0.5 * (run.xy_mm[1:] + run.xy_mm[:-1]) for run in runs])
        length = np.concatenate([np.hypot(*np.diff(run.xy_mm, axis=0).T) for run in runs])
        filled = np.flatnonzero(thick.ravel() > 0)
        tree = cKDTree(middle)
        distance, nearest = tree.query(
            model.points_mm[filled],
            distance_upper_bound=model.spread_mm + model.options.beads.to_wall_mm,
        )
        near = np.isfinite(distance) & ((distance < model.spread_mm) | strips.ravel()[filled])
        columns = filled[near]
        return cls(middle, length, tree, columns, nearest[near], thick.ravel()[columns])

    def sums(self, of_column: Float[np.ndarray, " c"]) -> Float[np.ndarray, " m"]:
        """By piece; of nothing `bincount` makes integers."""
        return np.bincount(self.piece, of_column, minlength=self.tree.n).astype(np.float64)

    def off_mm(self, runs: list[Bead], model: PatchModel) -> Float[np.ndarray, " m"]:
        """How far to the left of each piece the middle of its columns lies.

        That is halfway across them. Where a line bends, more columns lie outside than inside it,
        and each counts by as much less as the line beside there is longer than the piece.
        """
        left = np.concatenate([left_of(run.xy_mm) for run in runs])
        turn = np.concatenate([turn_rad(run) for run in runs])
        away_mm = model.points_mm[self.columns] - self.middle_mm[self.piece]
        away_mm = (away_mm * left[self.piece]).sum(axis=1)
        beside_mm = self.length_mm[self.piece] - turn[self.piece] * away_mm
        each = 1.0 / np.maximum(beside_mm, 0.5 * model.cell_mm)
        return self.sums(each * away_mm) / np.maximum(self.sums(each), 1e-9)

    @property
    def deep_mm(self) -> Float[np.ndarray, " m"]:
        """What the columns of each piece want on average."""
        number = np.bincount(self.piece, minlength=self.tree.n)
        return self.sums(self.thick_mm) / np.maximum(number, 1)


def weighed(
    runs: list[Bead],
    tips_mm: list[Float[np.ndarray, " _n"]],
    thick: Float[np.ndarray, "ny nx"],
    strips: Bool[np.ndarray, "ny nx"],
    model: PatchModel,
    setup: PrintSetup,
    *,
    job: JobPieces | None = None,
    free: FreeBetween | None = None,
) -> tuple[list[Chain], Float[np.ndarray, "ny nx"]]:
    """Cross-sections such that every column's thickness goes to the nearest piece of a bead.

    So plastic is the volume that is missing, to the column. The tip is as high along each run as
    `tips_mm` says; where the runs are the job's own lines, `job` tells of their pieces. Where
    `free` says where the nozzle may go, beads lie in the middle of what they fill. Returns the
    chains, and the thickness that columns get: none beyond where a bead can spread (farther in
    `strips` along walls), less where a bead would be too wide.
    """
    options = model.options
    shares = _Shares.of(runs, thick, strips, model)
    volume = shares.sums(shares.thick_mm * model.cell_mm**2 * model.weight)
    depth = shares.deep_mm
    own, met = np.zeros(len(volume)), np.ones(len(volume))
    if job is not None:
        told_mm3 = _by_lines(volume, runs, shares, job, thick, model)
        volume, met_mm3 = gathered(
            told_mm3,
            depth,
            job,
            shares.length_mm,
            shares.middle_mm,
            setup.process.line_width_mm,
            options.lines,
        )
        own, met = job.section_mm2, met_mm3 / np.maximum(told_mm3, 1e-9)
    off_mm = shares.off_mm(runs, model) if free is not None else None
    chains: list[Chain] = []
    given = np.zeros(len(volume))  # share of what its columns want that a piece lays
    at = 0
    for run, tip_mm in zip(runs, tips_mm, strict=True):
        mine = slice(at, at + len(run.xy_mm) - 1)
        at = mine.stop
        section = options.beads.bond_ratio * _smooth(
            volume[mine], shares.length_mm[mine], closed=run.closed
        )
        deep = np.maximum(depth[mine], options.beads.least_thick_mm)
        most = _most_section(deep, options.beads.bond_ratio * own[mine], setup, model.options.fill)
        given[mine] = np.minimum(1.0, most / np.maximum(section, 1e-9)) * met[mine]
        section, xy_mm = np.minimum(section, most), run.xy_mm
        if free is not None and off_mm is not None and run.role is not Role.BRIDGE:
            xy_mm = in_the_middle(run, off_mm[mine], free)
            section = _as_much(section, run.xy_mm, xy_mm, setup)
        chains += _split(Chain(xy_mm, tip_mm, section, deep, run.role), options)
    laid = np.zeros(thick.size)
    laid[shares.columns] = shares.thick_mm * given[shares.piece]
    return chains, laid.reshape(thick.shape)


def _as_much(
    section_mm2: Float[np.ndarray, " n"],
    drawn_mm: Float[np.ndarray, "m 2"],
    xy_mm: Float[np.ndarray, "m 2"],
    setup: PrintSetup,
) -> Float[np.ndarray, " n"]:
    """Cross-sections with which moved pieces carry as much as they were to carry as drawn."""
    before_mm, length_mm = (np.hypot(*np.diff(xy, axis=0).T) for xy in (drawn_mm, xy_mm))
    section_mm2 = section_mm2 * before_mm / np.maximum(length_mm, 1e-9)
    return np.asarray(np.minimum(section_mm2, setup.printer.max_bead_section_mm2))


def _most_section(
    deep_mm: Float[np.ndarray, " n"],
    own_mm2: Float[np.ndarray, " n"],
    setup: PrintSetup,
    options: FillOptions,
) -> Float[np.ndarray, " n"]:
    """Greatest cross-sections: as wide as a bead may get, or the job's own, as the printer may."""
    _, wide_mm = options.widths_mm(setup.printer.nozzle_diameter_mm)
    most = np.maximum(deep_mm * (wide_mm - deep_mm * ROUND_LOSS), own_mm2)
    return np.asarray(np.minimum(most, setup.printer.max_bead_section_mm2))


def _by_lines(
    volume_mm3: Float[np.ndarray, " n"],
    runs: list[Bead],
    shares: _Shares,
    job: JobPieces,
    thick: Float[np.ndarray, "ny nx"],
    model: PatchModel,
) -> Float[np.ndarray, " n"]:
    """Volumes by how deep the floor lies under each piece on average, times its own width.

    One line has four columns across it, the next one five: that is no reason to lay less of it.
    The total stays what it is. What lies beside the lines is added to the nearest as it is.
    """
    lines_mm, within_mm = [run.xy_mm for run in runs], job.half_mm + model.options.beads.on_line_mm
    under = np.flatnonzero(job.over & beside_runs(lines_mm, within_mm, model))
    of_piece = shares.tree.query(model.points_mm[under])[1]
    number = np.bincount(of_piece, minlength=shares.tree.n)
    deep = np.bincount(of_piece, thick.ravel()[under], minlength=shares.tree.n)
    own = job.section_mm2 * shares.length_mm * deep / np.maximum(number, 1) / job.height_mm
    beside = ~np.isin(shares.columns, under)
    extra = shares.sums(np.where(beside, shares.thick_mm, 0.0)) * model.cell_mm**2 * model.weight
    whole_mm3 = float((own + extra).sum())
    return (own + extra) * (float(volume_mm3.sum()) / whole_mm3 if whole_mm3 > 0 else 1.0)


def beside_runs(
    runs_mm: list[Float[np.ndarray, "_n 2"]], within_mm: float, model: PatchModel
) -> Bool[np.ndarray, "ny nx"]:
    """Columns whose middles lie no farther from a run of points."""
    if not runs_mm:
        return np.zeros(model.shape, dtype=bool)
    start, end = (np.concatenate([xy[to] for xy in runs_mm]) for to in (slice(-1), slice(1, None)))
    return near_lines(
        start, end, within_mm, low_mm=model.origin_mm, cell_mm=model.cell_mm, shape=model.shape
    )


def _smooth(
    volume_mm3: Float[np.ndarray, " n"], length_mm: Float[np.ndarray, " n"], *, closed: bool
) -> Float[np.ndarray, " n"]:
    """Cross-sections, means over three pieces: which of two pieces a column goes to is chance.

    The volume stays what it is, however long the pieces are.
    """
    mode = "wrap" if closed else "nearest"
    volume, length = (
        ndimage.uniform_filter1d(v, min(3, len(v)), mode=mode) for v in (volume_mm3, length_mm)
    )
    section = volume / np.maximum(length, 1e-9)
    return np.asarray(section * volume_mm3.sum() / max(float(section @ length_mm), 1e-9))


def _split(chain: Chain, options: PatchOptions) -> list[Chain]:
    """Drop the pieces where there is nothing to lay."""
    keep = chain.section_mm2 > options.beads.least_section_mm2
    return [chain.part(a, b) for a, b in stretches_of(keep)]


def contour(mask: Bool[np.ndarray, "ny nx"], model: PatchModel) -> Any:
    """A region of columns as polygons, corners of the grid rounded off."""
    return _outline(mask, model.origin_mm, model.cell_mm)


def _free_over(wanted: Any, free: Bool[np.ndarray, "ry rx"], reach: Reach) -> Any:
    """Where the tip may be, over a region and a little around it."""
    if wanted.is_empty():
        return wanted
    box = np.array(wanted.bounds()).reshape(2, 2)
    low, high = (box - reach.field.origin_mm) / reach.cell_mm
    first = np.floor(low).astype(np.int64) - CORNER_CELLS
    last = np.ceil(high).astype(np.int64) + CORNER_CELLS
    a, b = np.maximum(first, 0), np.minimum(last, free.shape[::-1])
    near = np.ones((last - first)[::-1], dtype=bool)  # outside the field nothing stands
    if (a < b).all():
        (x0, y0), (x1, y1) = a - first, b - first
        near[y0:y1, x0:x1] = free[a[1] : b[1], a[0] : b[0]]
    if near.all():
        return wanted
    return _outline(near, reach.field.origin_mm + first * reach.cell_mm, reach.cell_mm)


def _outline(
    mask: Bool[np.ndarray, "ay ax"], origin_mm: Float[np.ndarray, " 2"], cell_mm: float
) -> Any:
    if not mask.any():
        return CrossSection()
    (y0, y1), (x0, x1) = ((int(k.min()), int(k.max()) + 1) for k in mask.nonzero())
    around = np.pad(mask[y0:y1, x0:x1].astype(np.float64), CORNER_CELLS)
    smooth = ndimage.gaussian_filter(around, 0.8)
    corner = np.array([x0, y0]) + 0.5 - CORNER_CELLS
    polygons = []
    for line in measure.find_contours(smooth, 0.5):  # type: ignore[no-untyped-call]
        if len(line) < 4:
            continue
        polygons.append((line[:-1, ::-1] + corner) * cell_mm + origin_mm)
    if not polygons:
        return CrossSection()
    return CrossSection(polygons, FillRule.EvenOdd).simplify(SIMPLIFY_MM)


def fill(
    region: Any,
    share_mm: float,
    angle_rad: float,
    setup: PrintSetup,
    options: FillOptions,
    *,
    rings: int,
) -> list[Bead]:
    """Perimeters, then solid lines; along the medial axis where it is thin."""
    bore_mm = setup.printer.nozzle_diameter_mm
    beads: list[Bead] = []
    for island in pieces(region):
        peeled = peel(island, share_mm, rings)
        for ring in peeled.rings:
            beads += ring_beads(ring.centre, ring.area_mm2, share_mm, Role.PERIMETER, options)
        for part in peeled.thin:
            beads += fill_thin(part, bore_mm, options).beads
        fills, _ = solid_fill(
            peeled.core,
            spacing_mm=share_mm,
            angle_rad=angle_rad,
            role=Role.SOLID_INFILL,
            bore_mm=bore_mm,
            options=options,
        )
        beads += fills
    return beads
