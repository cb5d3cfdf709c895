"""The nozzle is a body: its envelope, swept along every move over what stands on the bed.

Slices of the envelope reach up to the next one, and the last to infinity; over a height field
only their lower faces can touch. What is laid on the way stands there for the moves after it.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int

from gcode.check import sweep_kernels as kernels
from gcode.check.rules import Moves, Refusal
from gcode.profiles import EnvelopeSlice, PrinterProfile
from gcode.surfaces import HeightField
from gcode.surfaces.heightfield import footprint_rows

# A floor is rough, and a scan is noisy: the tip may press this deep into what it prints on.
TIP_SLACK_MM = 0.2
# The head's body must clear what stands there, up to the noise of the height field.
BODY_SLACK_MM = 0.1
MAX_CELLS = 12_000_000  # of the field and all its slices: 96 MB; beyond that cells are joined
# Slices of the head that reach farther than this are swept over cells of this size.
WIDE_MM, WIDE_CELL_MM = 2.5, 0.2
MOST_SAID = 20


def sweep(
    moves: Moves, lines: list[str], printer: PrinterProfile, as_built: HeightField
) -> tuple[list[Refusal], float]:
    """Refusals for every move that touches, and the least clearance of the body."""
    if not moves.line or not as_built.z_mm.size:
        return [], np.inf
    start, end = np.array(moves.start), np.array(moves.end)
    lowest_mm = float(min(start[:, 2].min(), end[:, 2].min()))
    tallest_mm = max(as_built.top_mm, float(end[:, 2].max()))
    # what stays above everything when the tip is lowest cannot touch
    slices = [p for p in printer.envelope if p.z_from_mm <= tallest_mm - lowest_mm]
    if not slices:
        return [], np.inf
    pushed = np.array(moves.pushed_mm3)
    length = np.linalg.norm(end - start, axis=1)
    width = np.clip(pushed / np.maximum(length, 1e-9) / 0.2, 0.0, 2 * printer.nozzle_diameter_mm)
    worst = np.full(len(start), -np.inf)
    which = np.zeros(len(start), dtype=np.int64)
    reach = [float(np.abs(np.array(part.polygon_mm)).max()) for part in slices]
    # what is wide is swept over joined cells, each as high as its highest: never too low
    for wide in (False, True):
        own = [k for k, mm in enumerate(reach) if (mm > WIDE_MM) == wide]
        if not own:
            continue
        field = _coarse(
            as_built, max(1, MAX_CELLS // (len(own) + 1)), WIDE_CELL_MM if wide else 0.0
        )
        depth, of_own = _swept(field, [slices[k] for k in own], start, end, pushed, width)
        deeper = depth > worst
        worst = np.where(deeper, depth, worst)
        which = np.where(deeper, np.array(own)[of_own], which)
    tip = np.array([part.z_from_mm < 1e-9 for part in slices])
    refusals = []
    for k in np.flatnonzero(worst > 0)[:MOST_SAID]:
        part = slices[int(which[k])]
        slack = TIP_SLACK_MM if part.z_from_mm < 1e-9 else BODY_SLACK_MM
        refusals.append(
            Refusal(
                moves.line[k],
                lines[moves.line[k] - 1],
                f"the {part.part} ({part.z_from_mm:g} mm above the tip) hits what stands there",
                f"{worst[k] + slack:.2f} mm deep",
                f"{slack:g} mm",
            )
        )
    body = worst[np.isfinite(worst) & ~tip[which]]
    return refusals, float(-(body.max() + BODY_SLACK_MM)) if len(body) else np.inf


def _swept(
    field: HeightField,
    slices: list[EnvelopeSlice],
    start: Float[np.ndarray, "n 3"],
    end: Float[np.ndarray, "n 3"],
    pushed_mm3: Float[np.ndarray, " n"],
    width_mm: Float[np.ndarray, " n"],
) -> tuple[Float[np.ndarray, " n"], Int[np.ndarray, " n"]]:
    """Worst contact of every move with some slices, beyond what is allowed, and the slice."""
    tables = [footprint_rows(part.polygon_mm, field.cell_mm) for part in slices]
    rows = np.concatenate([np.stack(table, axis=1) for table in tables])
    row_at = np.concatenate([[0], np.cumsum([len(table[0]) for table in tables])])
    dilated = np.stack([field.max_within(part.polygon_mm) for part in slices])
    tip = np.array([part.z_from_mm < 1e-9 for part in slices])
    worst, which = kernels.sweep(
        start,
        end,
        (pushed_mm3 > 0).astype(np.int64),
        0.5 * width_mm,
        field.z_mm.astype(np.float64).copy(),
        field.origin_mm.astype(np.float64),
        field.cell_mm,
        np.array([part.z_from_mm for part in slices]),
        np.arange(len(slices)),
        dilated,
        rows,
        row_at,
        np.where(tip, TIP_SLACK_MM, BODY_SLACK_MM),
    )
    return np.asarray(worst), np.asarray(which)


def _coarse(field: HeightField, most: int, least_cell_mm: float) -> HeightField:
    """The field with cells joined, so that it is small enough and not finer than needed."""
    ny, nx = field.shape
    factor = max(
        int(np.ceil(np.sqrt(ny * nx / most))), int(np.ceil(least_cell_mm / field.cell_mm - 1e-6))
    )
    return field.coarsened(factor)
