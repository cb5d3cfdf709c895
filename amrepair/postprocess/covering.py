"""How much of what lies open after a layer the next one covers for ever: it cannot be seen again.

Sparse infill stays open for many layers and is closed by one: that is when a look is worth most.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from scipy import ndimage

from gcode.reader import Job
from gcode.surfaces.lines import near_lines

COVER_CELL_MM = 0.4  # about a bead
MOST_LAYER_CELLS = 1_000_000  # of a layer: a bed of 400 mm, some hundredths of a second


def covered_mm2(job: Job) -> Float[np.ndarray, " layers"]:
    """(layers,) area that each layer closes: open within the outline of the layer before, mm².

    Cells that a layer's beads cover and the layer's before did not, though its outline goes round
    them.
    """
    beads = job.beads
    low = np.minimum(beads.start_mm, beads.end_mm)[:, :2].min(axis=0) - COVER_CELL_MM
    high = np.maximum(beads.start_mm, beads.end_mm)[:, :2].max(axis=0) + COVER_CELL_MM
    wide_mm = high - low
    most = MOST_LAYER_CELLS  # a row of cells as well, where a job is one line that leads far away
    coarser_mm = max(np.sqrt(np.prod(wide_mm) / most), wide_mm.max() / most)
    cell_mm = max(COVER_CELL_MM, float(coarser_mm))
    nx, ny = (int(v) for v in np.ceil(wide_mm / cell_mm))
    bounds = np.searchsorted(beads.layer, np.arange(len(job.layers) + 1))
    areas, open_before = np.zeros(len(job.layers)), np.zeros((ny, nx), bool)
    for layer in range(len(job.layers)):
        part = slice(int(bounds[layer]), int(bounds[layer + 1]))
        laid = near_lines(
            beads.start_mm[part], beads.end_mm[part], 0.5 * beads.width_mm[part] + 0.25 * cell_mm,
            low_mm=low, cell_mm=cell_mm, shape=(ny, nx),
        )  # fmt: skip
        areas[layer] = float((laid & open_before).sum()) * cell_mm**2
        open_before = ndimage.binary_fill_holes(laid) & ~laid
    return areas
