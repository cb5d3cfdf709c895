"""A patch: beads that fill a deficit on top of a rough floor, and nothing else.

Passes lie on the job's own layers, from the floor up. At every place a bead is as thick as the gap
between its nozzle and the surface predicted after the earlier passes (idea 8 of the design), and
a place is filled when waiting for the next layer would leave a gap too deep for one bead. What the
nozzle cannot reach, and what is too thin for it, is listed with its volume.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy import ndimage

from gcode.errors import SliceError
from gcode.moves import Toolpath
from gcode.profiles import PrintSetup
from gcode.progress import Progress, silent
from gcode.slicing.job import Unprintable
from gcode.slicing.job_lines import JobLines
from gcode.slicing.layers import LayerGrid
from gcode.slicing.patch_beads import LEAST_THICK_MM
from gcode.slicing.patch_laying import after_first, begin, emit, end
from gcode.slicing.patch_model import PatchModel
from gcode.slicing.patch_order import stages_of
from gcode.slicing.patch_passes import AGREE_MM, NOT_LISTED_MM3, Pass, plan_passes
from gcode.surfaces import HeightField

COVERED = "covered by what stands above it"
# Of the plastic, what may be laid in the air beside rims; about twice as much lies outside then.
MOST_HEM = 0.025
# Less of a hollow than this share, so little, and over less of its opening: it closes nothing.
LEAST_SHARE, LEAST_WORTH_MM3, LEAST_COVER = 0.1, 30.0, 0.5
STEP_MM = 0.15  # of a job's staircase: half a layer, and what the scan gets wrong
NOT_CLOSED = "; the little in reach would not close it"
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
    hotend_c: float | None = None,
    lines: JobLines | None = None,
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
        back by the profile's retraction; the patch ends there likewise. Nothing is primed then:
        what else stands on the plate, where that would be, is not in `as_built`.
    hotend_c
        What the job prints at; None: what the material is printed at. The first pass is hotter by
        the material's `repair_first_bead_delta_c`.
    lines
        What the job laid there, where that is known: the patch follows it, step by step of its
        staircase, with as much of each line's plastic as is missing.

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
    model = PatchModel(deficit, setup, as_built, lines)
    passes = plan_passes(model, grid, setup, progress)
    if model.hem_mm3 > MOST_HEM * sum(chain.volume_mm3 for one in passes for chain in one.chains):
        model = PatchModel(deficit, setup, as_built, lines)
        passes = plan_passes(model, grid, setup, progress, hems=False)
    if model.job is None:
        passes = _worth_it(passes, model)
    hotend_c = setup.material.hotend_c if hotend_c is None else hotend_c
    pen = begin(setup, as_built, start_mm, hotend_c)
    laid_mm3 = 0.0
    first = True
    for stage in stages_of(passes, model, setup, pen.position_mm[:2]):
        for one in stage.passes:
            laid_mm3 += emit(pen, one, stage.reach, model, setup, first=first)
            if first:
                after_first(pen, setup, hotend_c)
            first = False
    end(pen, setup, as_built, start_mm)
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


def _worth_it(passes: list[Pass], model: PatchModel) -> list[Pass]:
    """Without the beads over hollows that would stay open: no repair, but strands along a rim."""
    wanted = np.isfinite(model.top_mm)
    label, count = ndimage.label(wanted, np.ones((3, 3)))
    laid, due, cover, opening = (
        np.bincount(label.ravel(), each.ravel(), minlength=count + 1) * model.cell_mm**2
        for each in (model.laid_mm, model.wanted_below(np.inf), model.laid_mm > 0, wanted)
    )
    few = (laid < LEAST_SHARE * due) & (laid < LEAST_WORTH_MM3) & (cover < LEAST_COVER * opening)
    few[0] = False
    if not few.any():
        return passes
    nearest = ndimage.distance_transform_edt(~wanted, return_distances=False, return_indices=True)
    dropped = model.given_up = few[label[tuple(nearest)]]
    model.laid_mm[dropped] = 0.0
    model.sunk_mm[dropped] = 0.0
    model.surface_mm[dropped] = model.floor_mm[dropped]
    kept = []
    for one in passes:
        chains = tuple(c for c in one.chains if not dropped[model.cell_at(c.middle_mm)])
        if chains:
            kept.append(replace(one, chains=chains))
    return kept


def _left_over(model: PatchModel) -> tuple[tuple[Unreachable, ...], tuple[PatchRegion, ...]]:
    """By connected piece: what was filled, and why the rest was not."""
    cell_mm2 = model.cell_mm**2 * model.weight
    wanted = model.wanted_below(np.inf)
    left = np.clip(wanted - model.laid_mm, 0.0, None)
    # a film below the thinnest bead is the tolerance, not out of reach
    left = np.where(left > LEAST_THICK_MM + AGREE_MM, left, 0.0)
    # nor is what lies under a step of the job's staircase, or over it
    done = (model.surface_mm >= model.done_mm - AGREE_MM) & (model.done_mm > model.top_mm - STEP_MM)
    left = np.where(done, 0.0, left)
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
        if reason is not None and model.given_up[cells].any():
            reason += NOT_CLOSED
        if reason is None:
            model.lost.append(Unprintable(volume_mm3 * (1.0 - share), box, TOO_SMALL))
        else:
            unreachable.append(Unreachable(volume_mm3 * (1.0 - share), box, reason))
    return tuple(unreachable), tuple(regions)


def _cells_of(model: PatchModel, box: Box) -> tuple[slice, slice]:
    low = np.floor((np.array(box[:2]) - model.origin_mm) / model.cell_mm).astype(int)
    high = np.ceil((np.array(box[3:5]) - model.origin_mm) / model.cell_mm).astype(int)
    return slice(max(low[1], 0), high[1] + 1), slice(max(low[0], 0), high[0] + 1)


def _reason(
    model: PatchModel, cells: tuple[slice, slice], stuck: Float[np.ndarray, "a b"]
) -> str | None:
    """What keeps the nozzle from the column with most left; None if nothing does."""
    iy, ix = np.unravel_index(int(np.argmax(stuck)), stuck.shape)
    iy, ix = int(iy) + cells[0].start, int(ix) + cells[1].start
    point = model.points_mm.reshape(*model.shape, 2)[iy, ix]
    if model.floor_mm[iy, ix] > model.top_mm[iy, ix] + LEAST_THICK_MM:
        return COVERED
    # the tip over the first bead that is lacking: the lowest, where a bridge was laid over it
    under_bridge = model.sunk_mm[iy, ix] > 0
    lies_mm = model.floor_mm[iy, ix] + (0.0 if under_bridge else model.laid_mm[iy, ix])
    tip_mm = min(lies_mm + model.most_mm, model.top_mm[iy, ix])
    return model.reach.reason_at(point, float(tip_mm))
