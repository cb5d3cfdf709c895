"""What stands on the bed when a job has been printed up to a line."""

from __future__ import annotations

import manifold3d
import numpy as np

from gcode.profiles import PrinterProfile
from gcode.reader.job import Beads
from gcode.stretches import in_turn
from gcode.surfaces import HeightField

STANDING_CELL_MM = 1.0
SPAN = 2_000_000  # samples at a time: 50 MB


def standing_field(beads: Beads, line: int, printer: PrinterProfile) -> HeightField:
    """The top surface of all beads laid by lines [0, line), on the whole reach of the nozzle."""
    bare = _bare(printer)
    (x0, y0), (ny, nx), z_mm = bare.origin_mm, bare.shape, bare.z_mm.reshape(-1)
    count = int(np.searchsorted(beads.line, line))
    start, end = beads.start_mm[:count], beads.end_mm[:count]
    half_mm = 0.5 * np.clip(beads.width_mm[:count], 0.3, 3.0)
    steps = np.maximum(np.ceil(np.linalg.norm(end - start, axis=1) / (0.5 * STANDING_CELL_MM)), 1.0)
    first = 0
    bounds = np.concatenate([[0], np.cumsum(steps + 1)])
    while first < count:
        last = max(first + 1, int(np.searchsorted(bounds, bounds[first] + SPAN)) - 1)
        pick = slice(first, last)
        owner, number = in_turn((steps[pick] + 1).astype(np.int64))
        share = number / steps[pick][owner]
        points = start[pick][owner] + share[:, None] * (end - start)[pick][owner]
        for dx, dy in ((0, 0), (1, 0), (-1, 0), (0, 1), (0, -1)):
            ix = np.floor((points[:, 0] + dx * half_mm[pick][owner] - x0) / STANDING_CELL_MM)
            iy = np.floor((points[:, 1] + dy * half_mm[pick][owner] - y0) / STANDING_CELL_MM)
            inside = (ix >= 0) & (iy >= 0) & (ix < nx) & (iy < ny)
            cell = (iy * nx + ix)[inside].astype(np.int64)
            np.maximum.at(z_mm, cell, points[inside, 2])
        first = last
    return bare


def _bare(printer: PrinterProfile) -> HeightField:
    """The bare bed, on the whole reach of the nozzle."""
    x0, y0, x1, y1 = printer.reach_box_mm
    return HeightField.flat((x1 - x0, y1 - y0), STANDING_CELL_MM, origin_mm=(x0, y0))


def with_solid(
    beads: Beads, line: int, printer: PrinterProfile, excess: manifold3d.Manifold
) -> HeightField:
    """What is laid by lines [0, line), and what stands out beside or above it."""
    laid = standing_field(beads, line, printer)
    if excess.is_empty():
        return laid
    return laid.raised_by(HeightField.from_manifold(excess, STANDING_CELL_MM))


def over_reach(field: HeightField, printer: PrinterProfile) -> HeightField:
    """What stands in a field, on the whole reach of the nozzle; bare bed beyond the field."""
    return _bare(printer).raised_by(field)
