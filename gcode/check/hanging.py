"""What a patch lays over air: every strand there ends, both ways, on something that holds it.

A bead is held where something stands beside it or under it, or lies where the floor is near below.
Where neither is, it hangs: a bridge, straight from one hold to the next, no longer than its
material bears. What was laid in the same pass holds nothing, so each strand is judged as if it were
alone; what fell onto a floor holds no strand's end.
"""

from __future__ import annotations

import math

import numpy as np

from gcode.check import hanging_kernels as kernels
from gcode.check.findings import Moves, Refusal, Text
from gcode.profiles import PrintSetup
from gcode.surfaces import HeightField
from gcode.surfaces.standing import half_widths_mm

# From its middle: its own half, two lines' widths (each line is pressed against the one before, and
# the first against what stands), and as far as the flat presses plastic aside.
BESIDE_MM = 1.2
# In bores: so deep below the tip something still holds a bead; a round strand of a bore's width
# with as much room again under it hangs.
DEEP_NOZZLES = 1.4
# In bores: so near a floor a strand lies under the nozzle as what is purged in the air does.
DROP_NOZZLES = 6.0
SPAN_SLACK_MM = 0.5  # of a span: rims are known to some cells
LEAST_STRAIGHT = 0.9  # of a stretch's length, from end to end: a strand is straight while it sets
STEP_MM = 0.2
MOST_SAID = 20
MOST_CELLS = 4_000_000


def hanging(moves: Moves, text: Text, setup: PrintSetup, as_built: HeightField) -> list[Refusal]:
    """Refusals for strands over air that are not held at both ends, or span too much."""
    laid = moves.pushed_mm3 > 0
    if not laid.any() or not as_built.z_mm.size:
        return []
    start, end, line = moves.start_mm, moves.end_mm, moves.line
    both = np.concatenate([start[laid, :2], end[laid, :2]])
    low, high = both.min(axis=0) - BESIDE_MM, both.max(axis=0) + BESIDE_MM
    near = as_built.crop((float(low[0]), float(low[1]), float(high[0]), float(high[1])))
    near = near.coarsened(max(1, math.ceil(math.sqrt(near.z_mm.size / MOST_CELLS))))
    bore_mm, limit_mm = setup.printer.nozzle_diameter_mm, setup.material.max_bridge_mm
    long = np.linalg.norm(end - start, axis=1)
    wrong, length_mm = kernels.follow(
        start,
        end,
        laid,
        # over air nothing but the flat presses it aside
        np.maximum(half_widths_mm(moves.pushed_mm3 / np.maximum(long, 1e-9), bore_mm), bore_mm),
        near.z_mm.astype(np.float64),
        near.origin_mm.astype(np.float64),
        near.cell_mm,
        _beside(near.cell_mm),
        (
            DEEP_NOZZLES * bore_mm,
            DROP_NOZZLES * bore_mm,
            max(limit_mm + SPAN_SLACK_MM - 2 * BESIDE_MM, 0.0),
            LEAST_STRAIGHT,
            BESIDE_MM,
            bore_mm,  # hardly more than a drop
            STEP_MM,
        ),
    )
    found = []
    for k in np.flatnonzero(wrong)[:MOST_SAID]:
        number = int(line[k])
        what, value = "strand over air that ends on nothing", f"{length_mm[k]:.1f} mm out"
        limit = f"a hold within {BESIDE_MM:g} mm of both ends"
        if wrong[k] == kernels.TOO_LONG:
            what, value = (
                "bridge too long, or not straight",
                f"{length_mm[k] + 2 * BESIDE_MM:.1f} mm",
            )
            limit = f"{limit_mm:g} mm"
        found.append(Refusal(number, text.line(number), what, value, limit))
    return found


def _beside(cell_mm: float) -> np.ndarray:
    """(c, 2) rows and columns of all cells beside one, itself first."""
    reach = int(BESIDE_MM / cell_mm + 0.5)
    rows, columns = np.mgrid[-reach : reach + 1, -reach : reach + 1].reshape(2, -1)
    apart_mm = np.hypot(rows, columns) * cell_mm
    keep = np.flatnonzero(apart_mm <= BESIDE_MM + 0.5 * cell_mm)
    keep = keep[np.argsort(apart_mm[keep], kind="stable")]
    return np.ascontiguousarray(np.stack([rows[keep], columns[keep]], axis=1))
