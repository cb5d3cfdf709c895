"""A patch: beads that fill a deficit on top of a rough floor, and nothing else.

The deficit is divided into vertical columns on a fine grid (`patch_model`). Passes are laid from
the floor up, on the job's own layers (`patch_heights`), and after each of them the surface of the
columns is predicted anew (`patch_state`). A pass lays a bead wherever waiting for the next pass
would leave a gap too deep for one bead (`patch_due`); the bead is as thick as the gap between the
nozzle and the surface predicted there. Several ways to plan the passes are tried, and the best is
kept (`patch_plan`). What the nozzle cannot reach, and what is too thin for a bead, is listed with
its volume (`patch_left`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Bool

from gcode.errors import SliceError
from gcode.moves import Toolpath
from gcode.profiles import PrintSetup
from gcode.progress import Progress, silent
from gcode.slicing.job_lines import JobLines
from gcode.slicing.layer_plan import Unfilled
from gcode.slicing.layers import LayerGrid
from gcode.slicing.options import DEFAULT_PATCH, PatchOptions
from gcode.slicing.patch_laying import after_first, begin, emit, end, first_pass_words
from gcode.slicing.patch_left import (
    NOT_CLOSED,
    LeftCause,
    LeftColumns,
    PatchRegion,
    left_over,
    not_worth_it,
)
from gcode.slicing.patch_model import PatchModel
from gcode.slicing.patch_order import stages_of
from gcode.slicing.patch_plan import PatchPasses, best_plan
from gcode.surfaces import HeightField

__all__ = [
    "NOT_CLOSED",
    "LeftCause",
    "LeftColumns",
    "PatchPlan",
    "PatchRegion",
    "Unfilled",
    "slice_patch",
]


@dataclass(frozen=True, slots=True)
class PatchPlan:
    """A patch, and what it leaves out.

    Attributes
    ----------
    toolpath
        The moves; empty where nothing can be laid.
    beads_mm3
        Volume of plastic in the beads.
    spilt_mm3
        Volume that is laid where nothing is missing, without the bond's share of the plastic
        (`BeadOptions.bond_ratio`).
    reachable_mm3
        Volume of the deficit that the nozzle reaches.
    unreachable, unprintable
        Pieces that the nozzle cannot reach, and pieces into which no bead fits. Together with what
        is laid, less what is spilt, they make up the deficit, but for films thinner than a bead.
    regions
        For each connected piece of the deficit, how much of it is filled.
    first_pass
        How the first pass is laid onto cold plastic, in words.
    left
        The columns that stay open, by cause, each from which height to which.
    options
        The options that were used.
    """

    toolpath: Toolpath
    beads_mm3: float
    spilt_mm3: float
    reachable_mm3: float
    unreachable: tuple[Unfilled, ...]
    unprintable: tuple[Unfilled, ...]
    regions: tuple[PatchRegion, ...]
    first_pass: str
    left: tuple[LeftColumns, ...] = ()
    options: PatchOptions = DEFAULT_PATCH


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
    options: PatchOptions = DEFAULT_PATCH,
    progress: Progress = silent,
) -> PatchPlan:
    """Slice a deficit into beads that fill it.

    Parameters
    ----------
    deficit
        `manifold3d.Manifold` of what is missing, build frame, mm.
    as_built
        The heights of what stands there; unseen places must be as high as is safe.
    grid
        The job's layers.
    standalone
        True makes a whole program for a part on a machine whose Z is still true; X and Y are
        homed, Z never. False makes a patch in mid-job: the machine is hot and parked at `start_mm`
        with the filament pulled back by the profile's retraction, and is left in the same state.
        Nothing is primed then, since `as_built` does not show what else stands on the plate.
    start_mm
        Where the nozzle is parked in mid-job.
    hotend_c
        The job's nozzle temperature; None takes the material's. The first pass is hotter by the
        material's `repair_first_bead_delta_c`.
    lines
        The lines that the job laid there, where they are known. The patch follows them, in the same
        steps on slopes, with as much of each line's plastic as is missing.
    options
        How passes and beads are planned.

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
    model = PatchModel(deficit, setup, as_built, lines, options)
    best = best_plan(model, grid, setup, progress)
    dropped = np.zeros(model.shape, dtype=bool)
    if model.job is None:
        dropped = not_worth_it(best.state, model)
        best = _without(best, dropped, model)
    hotend_c = setup.material.hotend_c if hotend_c is None else hotend_c
    pen = begin(setup, as_built, start_mm, hotend_c)
    laid_mm3 = 0.0
    first = True
    for stage in stages_of(list(best.passes), best.state, model, setup, pen.position_mm[:2]):
        for one in stage.passes:
            laid_mm3 += emit(pen, one, stage.reach, model, setup, first=first)
            if first:
                after_first(pen, setup, hotend_c)
            first = False
    end(pen, setup, as_built, start_mm)
    left = left_over(best.state, model, dropped)
    return PatchPlan(
        toolpath=Toolpath(tuple(pen.moves) if laid_mm3 > 0 else ()),
        beads_mm3=laid_mm3,
        spilt_mm3=best.spilt_mm3(model),
        reachable_mm3=sum(r.volume_mm3 * r.reachable_ratio for r in left.regions),
        unreachable=left.unreachable,
        unprintable=left.unprintable,
        regions=left.regions,
        first_pass=first_pass_words(setup, hotend_c),
        left=left.columns,
        options=options,
    )


def _without(
    found: PatchPasses, dropped: Bool[np.ndarray, "ny nx"], model: PatchModel
) -> PatchPasses:
    """The same passes without the beads over some columns."""
    if not dropped.any():
        return found
    kept = []
    for one in found.passes:
        chains = tuple(c for c in one.chains if not model.at(dropped, c.middle_mm[None], False)[0])
        if chains:
            kept.append(replace(one, chains=chains))
    return PatchPasses(tuple(kept), found.state.without(model, dropped))
