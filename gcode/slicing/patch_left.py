"""What a patch leaves open, piece by piece, and how much of it for each cause."""

from __future__ import annotations

import enum
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import ndimage

from gcode.slicing.layer_plan import Unfilled
from gcode.slicing.patch_free import ROUNDING_MM
from gcode.slicing.patch_model import PatchModel
from gcode.slicing.patch_state import PatchState

COVERED = "covered by what stands above it"
NOT_CLOSED = "; the little in reach would not close it"
TOO_SMALL = "too small for a bead, or with nothing below it to hold one"
Box = tuple[float, float, float, float, float, float]


@dataclass(frozen=True, slots=True)
class PatchRegion:
    """A connected piece of the deficit and the share of it that the beads fill."""

    volume_mm3: float
    box_mm: Box
    reachable_ratio: float


class LeftCause(enum.IntEnum):
    """Why a column is not filled."""

    NO_BEAD = 0
    """It is too small for a bead, or nothing holds one."""
    OUT_OF_REACH = 1
    """The head would touch what stands beside it."""
    COVERED = 2
    """Something stands above it."""
    TOO_LONG = 3
    """Nothing is below it, and a bridge over it would be longer than the material bears."""


@dataclass(frozen=True, slots=True)
class LeftColumns:
    """Columns of a patch that stay open, for one cause.

    Attributes
    ----------
    middle_mm
        (n, 2) the columns' middles, build frame; `cell_mm` is their edge.
    low_mm, high_mm
        (n,) from which height to which a column stays open, build frame: above what is laid in it,
        or below a strand that hangs over it.
    """

    cause: LeftCause
    cell_mm: float
    middle_mm: Float[np.ndarray, "n 2"]
    low_mm: Float[np.ndarray, " n"]
    high_mm: Float[np.ndarray, " n"]

    @property
    def volume_mm3(self) -> float:
        """The open volume, as the columns sample it."""
        return float((self.high_mm - self.low_mm).sum()) * self.cell_mm**2


@dataclass(frozen=True, slots=True)
class LeftOver:
    """All that a patch leaves open.

    Attributes
    ----------
    unreachable, unprintable
        What the head cannot reach, and what no bead is laid for.
    regions
        The connected pieces of the deficit, with the share of each that is filled.
    columns
        Where it is, column by column.
    """

    unreachable: tuple[Unfilled, ...]
    unprintable: tuple[Unfilled, ...]
    regions: tuple[PatchRegion, ...]
    columns: tuple[LeftColumns, ...]


def not_worth_it(state: PatchState, model: PatchModel) -> Bool[np.ndarray, "ny nx"]:
    """Columns of hollows of which so little would be filled that it is no repair at all."""
    options = model.options.left
    wanted = np.isfinite(model.top_mm)
    label, count = ndimage.label(wanted, np.ones((3, 3)))
    laid, due, cover, opening = (
        np.bincount(label.ravel(), each.ravel(), minlength=count + 1) * model.cell_mm**2
        for each in (state.laid_mm, model.wanted_below(np.inf), state.laid_mm > 0, wanted)
    )
    few = (
        (laid < options.least_share * due)
        & (laid < options.least_worth_mm3)
        & (cover < options.least_closed * opening)
    )
    few[0] = False
    if not few.any():
        return np.zeros(model.shape, dtype=bool)
    nearest = ndimage.distance_transform_edt(~wanted, return_distances=False, return_indices=True)
    return np.asarray(few[label[tuple(nearest)]])


def left_over(
    state: PatchState, model: PatchModel, given_up: Bool[np.ndarray, "ny nx"]
) -> LeftOver:
    """Say for each connected piece how much was filled, and why the rest was not."""
    options = model.options
    cell_mm2 = model.cell_mm**2 * model.weight
    wanted = model.wanted_below(np.inf)
    left = np.clip(wanted - state.laid_mm, 0.0, None)
    # a film below the thinnest bead is the tolerance, not out of reach
    left = np.where(left > options.beads.least_thick_mm + options.due.agree_mm, left, 0.0)
    # the same holds for what lies under or over a step of the job's slopes; but what was given up
    # under a hanging line counts
    done = (state.surface_mm >= state.done_mm - options.due.agree_mm) & (
        state.done_mm > model.top_mm - options.left.staircase_mm
    )
    left = np.where(done, np.minimum(left, state.sunk_mm), left)
    under = model.wanted_below(model.floor_mm)
    covered = np.where(under > options.beads.least_thick_mm, np.minimum(left, under), 0.0)
    kinds = _kinds(state, model)
    unreachable: list[Unfilled] = []
    lost: list[Unfilled] = []
    regions: list[PatchRegion] = []
    for piece in model.deficit.decompose():
        x0, y0, z0, x1, y1, z1 = (float(v) for v in piece.bounding_box())
        box: Box = (x0, y0, z0, x1, y1, z1)
        cells, own, own_under = model.own_columns(piece)
        # of columns that pass through several pieces, each has its share
        over = _share(own - own_under, (wanted - under)[cells]) * (left - covered)[cells]
        stuck = _by_cause(kinds[cells], over, _share(own_under, under[cells]) * covered[cells])
        whole_mm3 = float(own.sum()) * cell_mm2
        stuck_mm3 = float(stuck.sum()) * cell_mm2
        share = 1.0 - stuck_mm3 / whole_mm3 if whole_mm3 > 0 else 1.0
        share = min(max(share, 0.0), 1.0)
        volume_mm3 = float(piece.volume())
        regions.append(PatchRegion(volume_mm3, box, share))
        if stuck_mm3 <= options.left.least_listed_mm3:
            continue
        ended = NOT_CLOSED if given_up[cells].any() else ""
        for cause, reason, part in _causes(state, model, cells, stuck, apart=not ended):
            cause_mm3 = volume_mm3 * (1.0 - share) * part
            if cause in (LeftCause.NO_BEAD, LeftCause.TOO_LONG):
                lost.append(Unfilled(cause_mm3, box, reason))
            else:
                unreachable.append(Unfilled(cause_mm3, box, reason + ended))
    columns = _columns(state, model, _by_cause(kinds, left - covered, covered))
    return LeftOver(tuple(unreachable), tuple(lost), tuple(regions), columns)


def _tips_mm(state: PatchState, model: PatchModel) -> Float[np.ndarray, "ny nx"]:
    """The tip over the first bead that is lacking: the lowest, where a bridge was laid over it."""
    lies = model.floor_mm + np.where(state.sunk_mm > 0, 0.0, state.laid_mm)
    return np.minimum(lies + model.most_mm, model.top_mm)


def _kinds(state: PatchState, model: PatchModel) -> Int[np.ndarray, "ny nx"]:
    """Of each column, why it would not be filled: a `LeftCause`."""
    kind = np.where(
        model.need_mm > _tips_mm(state, model), LeftCause.OUT_OF_REACH, LeftCause.NO_BEAD
    )
    kind = np.where(state.too_long_mm > 0, LeftCause.TOO_LONG, kind)
    covered = model.floor_mm > model.top_mm + model.options.beads.least_thick_mm
    return np.where(covered, LeftCause.COVERED, kind)


def _by_cause(
    kinds: Int[np.ndarray, "a b"],
    over: Float[np.ndarray, "a b"],
    covered: Float[np.ndarray, "a b"],
) -> Float[np.ndarray, "k a b"]:
    """The thickness that is left in each column, by cause: over what stands there, and below it."""
    found = np.stack([np.where(kinds == cause, over, 0.0) for cause in LeftCause])
    found[LeftCause.COVERED] += covered
    return found


def _share(
    part: Float[np.ndarray, "a b"], of: Float[np.ndarray, "a b"]
) -> Float[np.ndarray, "a b"]:
    return np.clip(part, 0.0, None) / np.maximum(np.maximum(of, part), ROUNDING_MM)


def _columns(
    state: PatchState, model: PatchModel, left: Float[np.ndarray, "k ny nx"]
) -> tuple[LeftColumns, ...]:
    """Where it is left, by cause."""
    found = []
    for cause in LeftCause:
        own = np.flatnonzero(left[cause] > 0)
        if len(own):
            if cause is LeftCause.COVERED:
                low = model.bottom_mm
            else:
                low = np.where(state.sunk_mm > 0, model.floor_mm, model.top_mm - left[cause])
            from_mm = low.ravel()[own]
            to_mm = from_mm + model.weight * left[cause].ravel()[own]
            places = model.points_mm[own]
            found.append(LeftColumns(cause, model.cell_mm, places, from_mm, to_mm))
    return tuple(found)


def _causes(
    state: PatchState,
    model: PatchModel,
    cells: tuple[slice, slice],
    stuck: Float[np.ndarray, "k a b"],
    *,
    apart: bool,
) -> list[tuple[LeftCause, str, float]]:
    """Why columns are not filled, in words too, and the shares of what is left.

    Of each cause the column with most left says how far the head would go in, or how long a bridge
    would be. Unless `apart`, the column with most left speaks for all.
    """
    options = model.options
    tip = _tips_mm(state, model)[cells]
    shares = stuck.sum(axis=(1, 2)) / float(stuck.sum())
    worst = LeftCause(int(np.argmax(stuck.max(axis=(1, 2)))))
    told = [k for k in LeftCause if apart and shares[k] >= options.left.least_cause] or [worst]
    found = []
    for k in told:
        iy, ix = np.unravel_index(int(np.argmax(stuck[k])), stuck[k].shape)
        place = (int(iy) + cells[0].start, int(ix) + cells[1].start)
        cause, reason = k, COVERED if k is LeftCause.COVERED else TOO_SMALL
        if k is LeftCause.TOO_LONG:
            long_mm, limit = float(state.too_long_mm[place]), f"{model.longest_span_mm:.3g}"
            reason = f"a bridge over it would be too long: {long_mm:.0f} mm, limit {limit} mm"
        if k is LeftCause.OUT_OF_REACH:
            point = model.points_mm.reshape(*model.shape, 2)[place]
            touches = model.reach.reason_at(point, float(tip[iy, ix]))
            cause, reason = (k, touches) if touches else (LeftCause.NO_BEAD, TOO_SMALL)
        found.append((cause, reason, float(shares[k])))
    rest = 1.0 - sum(share for _, _, share in found)
    most = max(range(len(found)), key=lambda n: found[n][2])
    found[most] = (*found[most][:2], found[most][2] + rest)
    return found
