"""What a patch leaves out, piece by piece: why, and how much for each cause."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from scipy import ndimage

from gcode.slicing.layer_plan import Unprintable
from gcode.slicing.patch_beads import LEAST_THICK_MM
from gcode.slicing.patch_due import AGREE_MM
from gcode.slicing.patch_model import PatchModel
from gcode.slicing.patch_passes import LEAST_LISTED_MM3
from gcode.slicing.patch_state import PatchState

COVERED = "covered by what stands above it"
# Less of a hollow than this share, so little, and over less of its opening: it closes nothing.
LEAST_SHARE, LEAST_WORTH_MM3, LEAST_CLOSED = 0.1, 30.0, 0.5
STAIRCASE_MM = 0.15  # of a job's staircase: half a layer, and what the scan gets wrong
NOT_CLOSED = "; the little in reach would not close it"
TOO_SMALL = "too small for a bead, or with nothing below it to hold one"
# Of what is left of a piece: a cause of less is told with the greatest.
LEAST_CAUSE = 0.05
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
class LeftOver:
    """What the head cannot get to, what no bead is laid for, and the pieces of the deficit."""

    unreachable: tuple[Unreachable, ...]
    unprintable: tuple[Unprintable, ...]
    regions: tuple[PatchRegion, ...]


def not_worth_it(state: PatchState, model: PatchModel) -> Bool[np.ndarray, "ny nx"]:
    """Columns of hollows that would stay open: no repair, but strands along a rim."""
    wanted = np.isfinite(model.top_mm)
    label, count = ndimage.label(wanted, np.ones((3, 3)))
    laid, due, cover, opening = (
        np.bincount(label.ravel(), each.ravel(), minlength=count + 1) * model.cell_mm**2
        for each in (state.laid_mm, model.wanted_below(np.inf), state.laid_mm > 0, wanted)
    )
    few = (laid < LEAST_SHARE * due) & (laid < LEAST_WORTH_MM3) & (cover < LEAST_CLOSED * opening)
    few[0] = False
    if not few.any():
        return np.zeros(model.shape, dtype=bool)
    nearest = ndimage.distance_transform_edt(~wanted, return_distances=False, return_indices=True)
    return np.asarray(few[label[tuple(nearest)]])


def left_over(
    state: PatchState, model: PatchModel, given_up: Bool[np.ndarray, "ny nx"]
) -> LeftOver:
    """By connected piece: what was filled, and why the rest was not."""
    cell_mm2 = model.cell_mm**2 * model.weight
    wanted = model.wanted_below(np.inf)
    left = np.clip(wanted - state.laid_mm, 0.0, None)
    # a film below the thinnest bead is the tolerance, not out of reach
    left = np.where(left > LEAST_THICK_MM + AGREE_MM, left, 0.0)
    # nor is what lies under a step of the job's staircase, or over it; what was given up under a
    # line that hangs is
    done = (state.surface_mm >= state.done_mm - AGREE_MM) & (
        state.done_mm > model.top_mm - STAIRCASE_MM
    )
    left = np.where(done, np.minimum(left, state.sunk_mm), left)
    unreachable: list[Unreachable] = []
    lost = list(state.lost)
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
        if stuck_mm3 <= LEAST_LISTED_MM3:
            continue
        ended = NOT_CLOSED if given_up[cells].any() else ""
        for reason, part in _causes(state, model, cells, left[cells], apart=not ended):
            cause_mm3 = volume_mm3 * (1.0 - share) * part
            if reason is None:
                lost.append(Unprintable(cause_mm3, box, TOO_SMALL))
            else:
                unreachable.append(Unreachable(cause_mm3, box, reason + ended))
    return LeftOver(tuple(unreachable), tuple(lost), tuple(regions))


def _cells_of(model: PatchModel, box: Box) -> tuple[slice, slice]:
    low = np.floor((np.array(box[:2]) - model.origin_mm) / model.cell_mm).astype(int)
    high = np.ceil((np.array(box[3:5]) - model.origin_mm) / model.cell_mm).astype(int)
    return slice(max(low[1], 0), high[1] + 1), slice(max(low[0], 0), high[0] + 1)


def _causes(
    state: PatchState,
    model: PatchModel,
    cells: tuple[slice, slice],
    stuck: Float[np.ndarray, "a b"],
    *,
    apart: bool,
) -> list[tuple[str | None, float]]:
    """Why columns are not filled, and the shares of what is left; None where nothing hinders.

    Of each cause the column with most left says how far the head would go in. Unless `apart`, the
    column with most left speaks for all.
    """
    floor, top = model.floor_mm[cells], model.top_mm[cells]
    # the tip over the first bead that is lacking: the lowest, where a bridge was laid over it
    lies = floor + np.where(state.sunk_mm[cells] > 0, 0.0, state.laid_mm[cells])
    tip = np.minimum(lies + model.most_mm, top)
    kind = np.where(model.need_mm[cells] > tip, 1, 0)
    kind = np.where(floor > top + LEAST_THICK_MM, 2, kind)
    total = float(stuck.sum())
    shares = np.bincount(kind.ravel(), stuck.ravel(), minlength=3) / total
    worst = int(kind.flat[int(np.argmax(stuck))])
    told = [k for k in range(3) if apart and shares[k] >= LEAST_CAUSE] or [worst]
    found = []
    for k in told:
        at = int(np.argmax(np.where(kind == k, stuck, -1.0)))
        iy, ix = np.unravel_index(at, stuck.shape)
        place = (int(iy) + cells[0].start, int(ix) + cells[1].start)
        reason = COVERED if k == 2 else None
        if k == 1:
            point = model.points_mm.reshape(*model.shape, 2)[place]
            reason = model.reach.reason_at(point, float(tip[iy, ix]))
        found.append((reason, float(shares[k])))
    rest = 1.0 - sum(share for _, share in found)
    most = max(range(len(found)), key=lambda n: found[n][1])
    found[most] = (found[most][0], found[most][1] + rest)
    return found
