"""The nozzle is a body: its envelope, swept along every move over what stands on the bed.

Slices of the envelope reach up to the next one, and the last to infinity; over a height field
only their lower faces can touch. What is laid on the way stands there for the moves after it.
"""

from __future__ import annotations

import numpy as np

from gcode.check import sweep_kernels as kernels
from gcode.check.rules import Moves, Refusal
from gcode.profiles import PrinterProfile
from gcode.surfaces import HeightField
from gcode.surfaces.heightfield import footprint_rows

# A floor is rough, and a scan is noisy: the tip may press this deep into what it prints on.
TIP_SLACK_MM = 0.2
# The head's body must clear what stands there, up to the noise of the height field.
BODY_SLACK_MM = 0.1
MAX_CELLS = 12_000_000  # of the field and all its slices: 96 MB; beyond that cells are joined
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
    field = _coarse(as_built, max(1, MAX_CELLS // (len(slices) + 1)))
    tables = [footprint_rows(part.polygon_mm, field.cell_mm) for part in slices]
    rows = np.concatenate([np.stack(table, axis=1) for table in tables])
    row_at = np.concatenate([[0], np.cumsum([len(table[0]) for table in tables])])
    dilated = np.stack([field.max_within(part.polygon_mm) for part in slices])
    pushed = np.array(moves.pushed_mm3)
    length = np.linalg.norm(end - start, axis=1)
    width = np.clip(pushed / np.maximum(length, 1e-9) / 0.2, 0.0, 2 * printer.nozzle_diameter_mm)
    tip = np.array([part.z_from_mm < 1e-9 for part in slices])
    worst, which = kernels.sweep(
        start,
        end,
        (pushed > 0).astype(np.int64),
        0.5 * width,
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


def _coarse(field: HeightField, most: int) -> HeightField:
    """The field with cells joined, each as high as its highest, so that it is small enough."""
    ny, nx = field.shape
    factor = int(np.ceil(np.sqrt(ny * nx / most)))
    if factor <= 1:
        return field
    padded = np.full((-(-ny // factor) * factor, -(-nx // factor) * factor), -np.inf)
    padded[:ny, :nx] = field.z_mm
    blocks = padded.reshape(padded.shape[0] // factor, factor, padded.shape[1] // factor, factor)
    z_mm = blocks.max(axis=(1, 3))
    return HeightField(
        field.origin_mm, field.cell_mm * factor, z_mm, np.ones(z_mm.shape, dtype=bool)
    )
