"""Bridges of a patch: straight strands over air, each with both ends on what stands.

A strand begins and ends on a line's width that is as high as the layer under it, and no span is
longer than the material bears, or than the job spans itself. Over each hollow all strands go one
way: the one that spans most of it, and of those that span about as much the one with the shortest
strands (as PrusaSlicer's BridgeDetector chooses it).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, UInt8
from scipy import ndimage

from gcode.moves import Role
from gcode.slicing import bridges_kernels as kernels
from gcode.slicing.beads import Bead, spacing_of
from gcode.slicing.patch_beads import beside_runs
from gcode.slicing.patch_free import beside, free_between, free_runs
from gcode.slicing.patch_heights import Height
from gcode.slicing.patch_model import PatchModel
from gcode.slicing.patch_state import PatchState
from gcode.stretches import stretches_of

ANGLES_RAD = np.arange(36) * np.pi / 36.0  # PrusaSlicer's steps of 5 degrees
STRAIGHT = 0.98  # a line over air, from end to end over its length: it sets as if drawn taut
ASIDE_SPACINGS = (0.0, 0.15, -0.15, 0.3, -0.3)  # a strand moves so far for its hold


@dataclass(frozen=True, slots=True)
class Bridges:
    """Strands of one pass that hang between two holds.

    Attributes
    ----------
    strands
        From hold to hold, each straight.
    over, ends
        Columns that they hang over, and those that they end on.
    sag_mm
        How far they come to hang below the tip, by column.
    too_long_mm
        Where no span is short enough, the shortest; elsewhere 0.
    """

    strands: tuple[Bead, ...]
    over: Bool[np.ndarray, "ny nx"]
    ends: Bool[np.ndarray, "ny nx"]
    sag_mm: Float[np.ndarray, "ny nx"]
    too_long_mm: Float[np.ndarray, "ny nx"]

    @classmethod
    def none(cls, model: PatchModel) -> Bridges:
        """Of a pass that has none."""
        nothing, nowhere = np.zeros(model.shape), np.zeros(model.shape, dtype=bool)
        return cls((), nowhere, nowhere, nothing, nothing)

    def unlaid(self, model: PatchModel) -> Bridges:
        """Where the job's own lines are laid instead."""
        return replace(Bridges.none(model), too_long_mm=self.too_long_mm)


def bridges_at(
    model: PatchModel,
    at: Height,
    thick: Float[np.ndarray, "ny nx"],
    active: Bool[np.ndarray, "ny nx"],
    gap: Float[np.ndarray, "ny nx"],
    holds: Bool[np.ndarray, "ny nx"],
    alone: Bool[np.ndarray, "ny nx"],
) -> Bridges:
    """Strands over air wherever both ends find a hold.

    Parameters
    ----------
    thick, active
        What is wanted of each column at this height, and where something is.
    gap
        From what stands or was laid up to the tip.
    holds
        Where that is about as high as the layer under the strands.
    alone
        Where nothing beside holds a bead: hollows without such a place need no strands.
    """
    options = model.options.bridges
    found = Bridges.none(model)
    air = gap > at.deep_mm
    wanted = active & air & (thick >= options.least_layers * at.layer_mm)
    if not wanted.any():
        return found
    # a cell less: the checker looks at the text's rounded figures
    free = ndimage.binary_erosion(model.free_at(at.reach), np.ones((3, 3)))
    kind = np.zeros(model.shape, dtype=np.uint8)
    kind[holds] = kernels.HOLD_COLUMN
    kind[air] = kernels.AIR_COLUMN
    kind[wanted] = kernels.WANTED_COLUMN
    kind[~free] = kernels.NO_COLUMN
    label, count = ndimage.label(kind == kernels.WANTED_COLUMN, np.ones((3, 3)))
    for own, box in zip(range(1, count + 1), ndimage.find_objects(label), strict=True):
        if ((label[box] == own) & alone[box]).sum() * model.cell_mm**2 < options.least_mm2:
            continue
        hollow = np.zeros(model.shape, dtype=bool)
        hollow[box] = label[box] == own
        found = _over(model, at, found, kind, hollow)
    leaves_room = (kind == kernels.HOLD_COLUMN) & (thick >= model.options.beads.least_thick_mm)
    return replace(found, ends=found.ends & leaves_room)


def _over(
    model: PatchModel,
    at: Height,
    found: Bridges,
    kind: UInt8[np.ndarray, "ny nx"],
    hollow: Bool[np.ndarray, "ny nx"],
) -> Bridges:
    """Those found, and those over one more hollow."""
    angle_rad, least_mm, shortest_mm = _best_angle(model, kind, hollow)
    too_long = hollow & np.isfinite(shortest_mm) & (shortest_mm > model.longest_span_mm)
    found = replace(found, too_long_mm=np.where(too_long, shortest_mm, found.too_long_mm))
    spanned = hollow & (least_mm <= model.longest_span_mm)
    if not spanned.any():
        return found
    strands = _strands(model, at, kind, spanned, angle_rad)
    laid, sag_mm, passed = _under(model, strands, spanned)
    most_sag_mm = at.deep_mm - at.layer_mm  # what the next pass fills from above
    return replace(
        found,
        strands=(*found.strands, *strands.beads),
        over=found.over | laid,
        ends=found.ends | (passed & ~hollow),
        sag_mm=np.where(laid, np.minimum(sag_mm, most_sag_mm), found.sag_mm),
    )


class Holds:
    """What holds lines where the job laid some: where they would hang alone they are not laid."""

    def __init__(self, model: PatchModel, state: PatchState, at: Height, beside_mm: float) -> None:
        self._model, self._beside_mm = model, beside_mm
        gap = at.z_mm - state.surface_mm
        below, within_mm = gap <= at.deep_mm, beside_mm
        asked = model.near & ~below
        self._any = bool(asked.any())
        stands = below & ~state.hangs_at(at.z_mm)
        self._held = ~asked | beside(stands & ~state.loose, asked, within_mm, model.cell_mm)
        lies = (gap <= model.drop_mm) | beside(stands, asked, within_mm, model.cell_mm)
        self._air = ~self._held & ~lies
        # there a thin strand hangs over a floor that a thick one would lie on
        self._gap, self._over_floor = gap, model.near & below & (gap > at.most_mm)
        hangs = self._over_floor | asked  # what is deeper still holds no strand either
        self._firm = ~hangs
        if self._over_floor.any():
            under = (gap <= at.most_mm) & ~state.loose
            high = gap <= model.options.bridges.beside_layers * at.layer_mm
            for holds, near_mm in ((under, 0.5 * model.line_width_mm), (high, within_mm)):
                self._firm |= beside(holds, hangs, near_mm, model.cell_mm)

    def floored(
        self, runs: list[Bead], thick: Float[np.ndarray, "ny nx"]
    ) -> Float[np.ndarray, "ny nx"]:
        """Thickness to lay, down to the floor under what is not held at both its ends.

        From one end a thin strand droops onto a floor that it does not fill the gap to.
        """
        model = self._model
        if not (self._over_floor & (thick > 0)).any():
            return thick
        droops = []
        for run in runs:
            firm = self._at(run.xy_mm, self._firm)
            lengths_mm = np.hypot(*np.diff(run.xy_mm, axis=0).T)
            for a, b in stretches_of(~firm):
                held = firm.any() and (run.closed or (a > 0 and b < len(firm)))
                if not held and lengths_mm[a:b].sum() > model.options.due.hold_mm:
                    droops.append(run.xy_mm[a : b + 1])
        under = beside_runs(droops, 0.5 * model.line_width_mm, model)
        lies = under & self._over_floor & (thick > 0)
        return np.where(lies, np.maximum(thick, self._gap), thick)

    def _at(
        self, xy_mm: Float[np.ndarray, "n 2"], what: Bool[np.ndarray, "ny nx"]
    ) -> Bool[np.ndarray, " m"]:
        """Of columns, by the middles between points; true beyond the patch."""
        # a job's lines go on beyond the patch, where they lie
        return self._model.at(what, 0.5 * (xy_mm[1:] + xy_mm[:-1]), True)

    def stretches(self, xy_mm: Float[np.ndarray, "n 2"]) -> list[tuple[int, int]]:
        """From which point to which a line lies on something, or hangs between two holds."""
        whole = [(0, len(xy_mm) - 1)]
        if not self._any:
            return whole
        air, held = ~self._at(xy_mm, ~self._air), self._at(xy_mm, self._held)
        if not air.any():
            return whole
        lengths_mm = np.hypot(*np.diff(xy_mm, axis=0).T)
        keep = ~air
        most_mm = self._model.longest_span_mm - 2.0 * self._beside_mm
        for a, b in stretches_of(air):
            ends = a > 0 and b < len(air) and held[a - 1] and held[b]
            long_mm, chord_mm = lengths_mm[a:b].sum(), np.hypot(*(xy_mm[b] - xy_mm[a]))
            keep[a:b] = ends and long_mm <= most_mm and chord_mm >= STRAIGHT * long_mm
        return [(int(a), int(b)) for a, b in stretches_of(keep)]

    def held(self, run: Bead) -> list[Bead]:
        """What of a run is held."""
        found = self.stretches(run.xy_mm)
        if found == [(0, len(run.xy_mm) - 1)]:
            return [run]
        return [
            Bead(run.xy_mm[a : b + 1], run.share_mm[a:b], run.role, closed=False) for a, b in found
        ]


@dataclass(frozen=True, slots=True)
class _Strands:
    """Strands over one hollow, and from where to where along each it hangs; their spacing."""

    beads: list[Bead]
    from_mm: list[float]
    to_mm: list[float]
    spacing_mm: float


@dataclass(frozen=True, slots=True)
class _Steps:
    """Steps of half a column along a line: how many a hold takes, and what is loose of a span."""

    step_mm: float
    hold: int
    loose: int

    @classmethod
    def of(cls, model: PatchModel) -> _Steps:
        """On a patch's columns."""
        step_mm, options = 0.5 * model.cell_mm, model.options.bridges
        return cls(step_mm, round(options.hold_mm / step_mm), round(options.loose_mm / step_mm))


def _best_angle(
    model: PatchModel, kind: UInt8[np.ndarray, "ny nx"], hollow: Bool[np.ndarray, "ny nx"]
) -> tuple[float, Float[np.ndarray, "ny nx"], Float[np.ndarray, "ny nx"]]:
    """The strands' angle, the spans at that angle, and the shortest at any; inf: none."""
    options = model.options.bridges
    rows, columns = hollow.nonzero()
    box = (int(rows.min()), int(columns.min()), int(rows.max()) + 1, int(columns.max()) + 1)
    margin = int(np.ceil((options.hold_mm + options.loose_mm) / model.cell_mm)) + 2
    low = np.maximum(np.array(box[:2]) - margin, 0)
    window = (slice(low[0], box[2] + margin), slice(low[1], box[3] + margin))
    near = np.ascontiguousarray(kind[window])
    inside = np.array([*(np.array(box[:2]) - low), *(np.array(box[2:]) - low)])
    steps = _Steps.of(model)
    most = model.longest_span_mm / steps.step_mm
    best: tuple[float, float, float, Float[np.ndarray, "_a _b"]] | None = None
    shortest = np.full(near.shape, np.inf)
    for angle_rad in ANGLES_RAD:
        least, within = kernels.spanned(near, angle_rad, inside, most, steps.hold, steps.loose)
        np.minimum(shortest, least, out=shortest)
        longest = float(np.max(least, initial=0.0, where=least <= most))
        # about as much is as much
        if (
            best is None
            or within > best[0] * (1.0 + options.alike)
            or (within > best[0] * (1.0 - options.alike) and longest < best[1])
        ):
            best = (float(within), longest, float(angle_rad), least)
    assert best is not None
    full = [np.full(model.shape, np.inf) for _ in range(2)]
    full[0][window], full[1][window] = best[3] * steps.step_mm, shortest * steps.step_mm
    return best[2], full[0], full[1]


def _strands(
    model: PatchModel,
    at: Height,
    kind: UInt8[np.ndarray, "ny nx"],
    spanned: Bool[np.ndarray, "ny nx"],
    angle_rad: float,
) -> _Strands:
    """Strands side by side over what is spanned, evenly from edge to edge."""
    options = model.options.bridges
    along = np.array([np.cos(angle_rad), np.sin(angle_rad)])
    across = np.array([-along[1], along[0]])
    points = model.points_mm[spanned.ravel()]
    v_mm, u_mm = points @ across, points @ along
    cell_mm = model.cell_mm
    bins = np.floor(v_mm / cell_mm).astype(np.int64)
    lines = np.unique(bins)
    parts = np.split(lines, np.flatnonzero(np.diff(lines) > 1) + 1)
    width_mm = spacing_of(model.line_width_mm, at.layer_mm)
    reach_mm = options.hold_mm + options.loose_mm + cell_mm
    from_mm, to_mm = float(u_mm.min()) - reach_mm, float(u_mm.max()) + reach_mm
    found = _Strands([], [], [], width_mm)
    for part in parts:
        low_mm, high_mm = part[0] * cell_mm, (part[-1] + 1) * cell_mm
        number = max(1, round((high_mm - low_mm) / width_mm))
        for k in range(number):
            v = low_mm + (k + 0.5) * (high_mm - low_mm) / number
            for aside in ASIDE_SPACINGS:
                line = (v + aside * width_mm) * across
                if _held_on(model, at, kind, line + from_mm * along, line + to_mm * along, found):
                    break
    return found


def _held_on(
    model: PatchModel,
    at: Height,
    kind: UInt8[np.ndarray, "ny nx"],
    start_mm: Float[np.ndarray, " 2"],
    end_mm: Float[np.ndarray, " 2"],
    found: _Strands,
) -> bool:
    """Add the strands that a line has; whether there is any."""
    steps = _Steps.of(model)
    step_mm, hold = steps.step_mm, steps.hold
    length_mm = float(np.hypot(*(end_mm - start_mm)))
    along = (end_mm - start_mm) / length_mm
    x, y = (start_mm - model.origin_mm) / model.cell_mm
    stretches = np.empty((64, 2), np.int64)
    number = kernels.spans_on_line(
        kind, x, y, 0.5 * along[0], 0.5 * along[1], int(length_mm / step_mm) + 1, hold,
        steps.loose, stretches,
    )  # fmt: skip
    any_held = False
    for first, last in stretches[:number].tolist():
        if (last - first + 1) * step_mm > model.longest_span_mm:
            continue
        xy = start_mm + np.array([[first - hold], [last + hold]]) * step_mm * along
        bead = Bead(xy, np.ones(1), Role.BRIDGE, closed=False)
        runs = free_runs(bead, lambda a, b: free_between(a, b, at.reach, model.reach))
        if len(runs) == 1 and runs[0].length_mm > bead.length_mm - 1e-6:
            found.beads.append(runs[0])
            found.from_mm.append((hold - 0.5) * step_mm)
            found.to_mm.append((last - first + hold + 0.5) * step_mm)
            any_held = True
    return any_held


def _under(
    model: PatchModel, strands: _Strands, spanned: Bool[np.ndarray, "ny nx"]
) -> tuple[Bool[np.ndarray, "ny nx"], Float[np.ndarray, "ny nx"], Bool[np.ndarray, "ny nx"]]:
    """Columns that strands cover where they hang, how far those sag, and all that they pass."""
    laid, passed = np.zeros(model.shape, bool).ravel(), np.zeros(model.shape, bool).ravel()
    sag_mm = np.zeros(laid.shape)
    within_mm = 0.5 * strands.spacing_mm * (1.0 + 2.0 * max(ASIDE_SPACINGS)) + model.cell_mm
    for bead, from_mm, to_mm in zip(strands.beads, strands.from_mm, strands.to_mm, strict=True):
        start_mm = bead.xy_mm[0]
        along = (bead.xy_mm[-1] - start_mm) / bead.length_mm
        off = model.points_mm - start_mm
        u_mm, v_mm = off @ along, off @ np.array([-along[1], along[0]])
        on = (np.abs(v_mm) <= within_mm) & (u_mm >= 0.0) & (u_mm <= bead.length_mm)
        passed |= on & (np.abs(v_mm) <= 0.5 * strands.spacing_mm + 0.5 * model.cell_mm)
        laid |= on & spanned.ravel()
        drop_mm = 4.0 * model.material.bridge_sag_per_mm * (u_mm - from_mm) * (to_mm - u_mm)
        sag_mm = np.where(on, np.maximum(sag_mm, drop_mm), sag_mm)
    shape = model.shape
    return laid.reshape(shape), sag_mm.reshape(shape), passed.reshape(shape)
