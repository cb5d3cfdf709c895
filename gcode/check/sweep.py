"""The tool head is a body: its envelope is swept along every move over what stands on the bed.

The envelope consists of slices, each of which reaches up to the next one, and the last to infinity.
Over a height field only its lower faces and cones can touch anything. What a move lays stands there
for the moves after it, as wide and as high as `surfaces.standing` says, which the planner uses too.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from gcode.check import sweep_kernels as kernels
from gcode.check.findings import Moves, Refusal, Text
from gcode.profiles import EnvelopeSlice, PrinterProfile
from gcode.surfaces import HeightField
from gcode.surfaces.heightfield import footprint_rows
from gcode.surfaces.standing import half_widths_mm

# A floor is rough, and a scan is noisy: the tip may press this deep into what it prints on.
TIP_SLACK_MM = 0.2
# The head's body must clear what stands there, up to the noise of the height field.
BODY_SLACK_MM = 0.1
MAX_SWEPT_CELLS = (
    4_000_000  # of a field: 100 MB with what is needed over it; beyond that cells are joined
)
# What is laid is looked at in cells of this size by slices that reach farther than this.
WIDE_SLICE_MM, WIDE_CELL_MM = 2.6, 0.2
WINDOW_EDGE_MM = 0.5  # of a window around moves
MOST_SAID = 20


def sweep(
    moves: Moves, text: Text, printer: PrinterProfile, as_built: HeightField
) -> tuple[list[Refusal], float]:
    """A refusal for every move on which the head touches, and the body's least clearance."""
    if not moves.count or not as_built.z_mm.size:
        return [], np.inf
    start, end, line = moves.start_mm, moves.end_mm, moves.line
    lowest_mm = float(min(start[:, 2].min(), end[:, 2].min()))
    tallest_mm = max(as_built.top_mm, float(end[:, 2].max()))
    # A slice that stays above everything when the tip is lowest cannot touch anything.
    slices = [p for p in printer.head if p.z_from_mm <= tallest_mm - lowest_mm]
    if not slices:
        return [], np.inf
    pushed = moves.pushed_mm3
    length = np.linalg.norm(end - start, axis=1)
    half_mm = half_widths_mm(pushed / np.maximum(length, 1e-9), printer.nozzle_diameter_mm)
    worst = np.full(len(start), -np.inf)
    which = np.zeros(len(start), dtype=np.int64)
    swept = _Swept(start, end, pushed, half_mm)
    near = [k for k, part in enumerate(slices) if part.reach_mm <= WIDE_SLICE_MM]
    far = [k for k, part in enumerate(slices) if part.reach_mm > WIDE_SLICE_MM]
    for own, found in (
        (near, swept.over(as_built, [slices[k] for k in near], grows=True)),
        (far, swept.over(as_built, [slices[k] for k in far], grows=False)),
        (far, swept.over_laid([slices[k] for k in far])),
    ):
        if found is None:
            continue
        depth, of_own = found
        deeper = depth > worst
        worst = np.where(deeper, depth, worst)
        which = np.where(deeper, np.array(own)[of_own], which)
    tip = np.array([part.is_tip for part in slices])
    refusals = []
    hits = np.flatnonzero(worst > 0)
    for k in hits[np.unique(line[hits], return_index=True)[1]][:MOST_SAID]:  # an arc is one line
        part = slices[int(which[k])]
        slack = _slack_mm(part)
        refusals.append(
            Refusal(
                int(line[k]),
                text.line(int(line[k])),
                f"the {part.part} ({part.z_from_mm:g} mm above the tip) hits what stands there",
                f"{worst[k] + slack:.2f} mm deep",
                f"{slack:g} mm",
            )
        )
    body = worst[np.isfinite(worst) & ~tip[which]]
    return refusals, float(-(body.max() + BODY_SLACK_MM)) if len(body) else np.inf


def deepest_along(
    places_mm: Float[np.ndarray, "n 3"], printer: PrinterProfile, as_built: HeightField
) -> Float[np.ndarray, " n"]:
    """(n,) how deep the head is in what stands there, with the tip at each place; ≤ 0: clear."""
    return deepest_of_moves(places_mm, places_mm, printer, as_built)[0]


def deepest_of_moves(
    start_mm: Float[np.ndarray, "n 3"],
    end_mm: Float[np.ndarray, "n 3"],
    printer: PrinterProfile,
    as_built: HeightField,
) -> tuple[Float[np.ndarray, " n"], tuple[EnvelopeSlice, ...]]:
    """(n,) how deep the head comes into what stands there on each move, and with which part.

    Depths are beyond what is allowed; ≤ 0 means clear. What the moves themselves lay is ignored.
    """
    tallest_mm = as_built.top_mm
    lowest_mm = float(min(start_mm[:, 2].min(), end_mm[:, 2].min()))
    slices = [p for p in printer.head if p.z_from_mm <= tallest_mm - lowest_mm]
    nothing = np.zeros(len(start_mm))
    found = _Swept(start_mm, end_mm, nothing, nothing).over(as_built, slices, grows=False)
    if found is None:
        return np.full(len(start_mm), -np.inf), (printer.head[0],) * len(start_mm)
    return found[0], tuple(slices[int(k)] for k in found[1])


@dataclass(frozen=True, slots=True)
class _Swept:
    """Moves with (n, 3) start and end, (n,) volume of plastic, and half the width of their bead."""

    start_mm: Float[np.ndarray, "n 3"]
    end_mm: Float[np.ndarray, "n 3"]
    pushed_mm3: Float[np.ndarray, " n"]
    half_mm: Float[np.ndarray, " n"]

    @property
    def low_mm(self) -> Float[np.ndarray, " n"]:
        """The lower end of every move."""
        return np.minimum(self.start_mm[:, 2], self.end_mm[:, 2])

    def over(
        self, field: HeightField, slices: list[EnvelopeSlice], *, grows: bool
    ) -> tuple[Float[np.ndarray, " n"], Int[np.ndarray, " n"]] | None:
        """The deepest contact of every move, beyond what is allowed, and the slice that touches.

        With `grows`, what a move lays stands there for the moves after it.
        """
        if not slices:
            return None
        laid = self.pushed_mm3 > 0
        stands_mm = max(field.top_mm, float(self.end_mm[laid, 2].max()) if laid.any() else 0.0)
        box_mm = self._box_below(stands_mm - min(part.z_from_mm for part in slices))
        if box_mm is None:
            return None
        rows, columns = field.window(box_mm)
        cells = (rows.stop - rows.start) * (columns.stop - columns.start)
        factor = math.ceil(math.sqrt(cells / MAX_SWEPT_CELLS))
        field = field.coarsened(factor)
        window, near = field.window(box_mm), field.crop(box_mm)
        if not near.z_mm.size:
            return None
        need = np.full(near.shape, -np.inf)
        which = np.zeros(near.shape, dtype=np.int8)
        for k, part in enumerate(slices):
            under_mm = field.max_within(
                part.polygon_mm, window, widening_mm=part.widening_mm, height_mm=part.height_mm
            )
            own = under_mm - part.z_from_mm - _slack_mm(part)
            which[own > need] = k
            np.maximum(need, own, out=need)
        return self._run(near, slices, need, which, grows=grows)

    def over_laid(
        self, slices: list[EnvelopeSlice]
    ) -> tuple[Float[np.ndarray, " n"], Int[np.ndarray, " n"]] | None:
        """The same with what these moves laid themselves, in joined cells: never too low."""
        laid = self.pushed_mm3 > 0
        if not slices or not laid.any():
            return None
        # A bead is hit only by a part of the head that later comes far enough below its top.
        low_mm = self.low_mm
        later_mm = np.minimum.accumulate(low_mm[::-1])[::-1]
        drop_mm = float((self.end_mm[laid, 2] - later_mm[laid]).max())
        slices = [part for part in slices if part.z_from_mm < drop_mm]
        box_mm = self._box_below(float(self.end_mm[laid, 2].max()))
        if not slices or box_mm is None:
            return None
        size_mm = np.array(box_mm[2:]) - np.array(box_mm[:2])
        cell_mm = max(WIDE_CELL_MM, math.sqrt(float(np.prod(size_mm)) / MAX_SWEPT_CELLS))
        nx, ny = (int(v) for v in np.ceil(size_mm / cell_mm) + 1)
        nothing = np.full((ny, nx), -np.inf)
        bare = HeightField(np.array(box_mm[:2]), cell_mm, nothing.copy(), np.ones((ny, nx), bool))
        return self._run(bare, slices, nothing, np.zeros((ny, nx), np.int8), grows=True)

    def _box_below(self, z_mm: float) -> tuple[float, float, float, float] | None:
        """The box of the moves that come below a height."""
        low = self.low_mm <= z_mm
        if not low.any():
            return None
        both = np.concatenate([self.start_mm[low, :2], self.end_mm[low, :2]])
        (x0, y0), (x1, y1) = both.min(axis=0).tolist(), both.max(axis=0).tolist()
        return x0 - WINDOW_EDGE_MM, y0 - WINDOW_EDGE_MM, x1 + WINDOW_EDGE_MM, y1 + WINDOW_EDGE_MM

    def _run(
        self,
        field: HeightField,
        slices: list[EnvelopeSlice],
        need_mm: Float[np.ndarray, "_ny _nx"],
        which: Int[np.ndarray, "_ny _nx"],
        *,
        grows: bool,
    ) -> tuple[Float[np.ndarray, " n"], Int[np.ndarray, " n"]]:
        steps = [(step, k) for k, part in enumerate(slices) for step in part.steps]
        tables = [footprint_rows(step.polygon_mm, field.cell_mm) for step, _ in steps]
        worst, own = kernels.sweep(
            self.start_mm,
            self.end_mm,
            ((self.pushed_mm3 > 0) & grows).astype(np.int64),
            self.half_mm,
            field.z_mm.astype(np.float64),
            field.origin_mm.astype(np.float64),
            field.cell_mm,
            np.array([step.z_from_mm + _slack_mm(slices[k]) for step, k in steps]),
            np.array([k for _, k in steps]),
            need_mm,
            which,
            np.concatenate([np.stack(table, axis=1) for table in tables]),
            np.concatenate([[0], np.cumsum([len(table[0]) for table in tables])]),
        )
        return np.asarray(worst), np.asarray(own)


def _slack_mm(part: EnvelopeSlice) -> float:
    return TIP_SLACK_MM if part.is_tip else BODY_SLACK_MM
