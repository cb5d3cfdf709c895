"""What stands on the bed when a job has been printed up to a line, and where there is room."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float

from gcode.profiles import PrinterProfile
from gcode.reader.job import Beads
from gcode.slicing.reach import Reach
from gcode.surfaces import HeightField

CELL_MM = 1.0
SPAN = 2_000_000  # samples at a time: 50 MB
INSET_MM = 5.0  # from the bed's edge
EVERY_MM = 10.0
BARE_RADIUS_MM = 6.0  # a strand that hangs from the nozzle falls into this circle


def standing_field(beads: Beads, line: int, printer: PrinterProfile) -> HeightField:
    """The top surface of all beads laid by lines [0, line), on the whole reach of the nozzle."""
    x0, y0, x1, y1 = printer.reach_box_mm
    nx, ny = int(np.ceil((x1 - x0) / CELL_MM)), int(np.ceil((y1 - y0) / CELL_MM))
    z_mm = np.zeros(ny * nx)
    count = int(np.searchsorted(beads.line, line))
    start, end = beads.start_mm[:count], beads.end_mm[:count]
    half_mm = 0.5 * np.clip(beads.width_mm[:count], 0.3, 3.0)
    steps = np.maximum(np.ceil(np.linalg.norm(end - start, axis=1) / (0.5 * CELL_MM)), 1.0)
    first = 0
    bounds = np.concatenate([[0], np.cumsum(steps + 1)])
    while first < count:
        last = max(first + 1, int(np.searchsorted(bounds, bounds[first] + SPAN)) - 1)
        pick = slice(first, last)
        n = (steps[pick] + 1).astype(np.int64)
        owner = np.repeat(np.arange(len(n)), n)
        share = (np.arange(len(owner)) - np.repeat(np.cumsum(n) - n, n)) / steps[pick][owner]
        points = start[pick][owner] + share[:, None] * (end - start)[pick][owner]
        for dx, dy in ((0, 0), (1, 0), (-1, 0), (0, 1), (0, -1)):
            ix = np.floor((points[:, 0] + dx * half_mm[pick][owner] - x0) / CELL_MM)
            iy = np.floor((points[:, 1] + dy * half_mm[pick][owner] - y0) / CELL_MM)
            inside = (ix >= 0) & (iy >= 0) & (ix < nx) & (iy < ny)
            cell = (iy * nx + ix)[inside].astype(np.int64)
            np.maximum.at(z_mm, cell, points[inside, 2])
        first = last
    return HeightField(
        np.array([x0, y0]), CELL_MM, z_mm.reshape(ny, nx), np.ones((ny, nx), dtype=bool)
    )


def room_for_line(
    field: HeightField, printer: PrinterProfile, length_mm: float
) -> tuple[float, float, float, float] | None:
    """Where a line can be drawn on the bed, the whole head fitting: (x, y) and its direction."""
    reach = Reach(field, printer)
    free = reach.at(printer.prime_mm[2])
    along = np.arange(0.0, length_mm + 0.25, 0.25)
    x_max, y_max = printer.reach_box_mm[2:]
    for x, y in _starts(printer):
        for dx, dy in ((1.0, 0.0), (0.0, 1.0)):
            points = np.array([x, y]) + along[:, None] * np.array([dx, dy])
            fits = points[-1, 0] <= x_max - 1.0 and points[-1, 1] <= y_max - 1.0
            if fits and reach.free_at_points(points, free).all() and _bare(field, points).all():
                return x, y, dx, dy
    return None


def bare_place(field: HeightField, printer: PrinterProfile) -> tuple[float, float] | None:
    """A place at the bed's edge below which nothing stands, far from what does."""
    best, far_mm = None, 0.0
    rows, columns = np.nonzero(field.z_mm > 0)
    if not len(rows):
        return printer.prime_mm[:2]
    xs, ys = field.centres_mm()
    standing = np.stack([xs[columns], ys[rows]], axis=1)
    for place in _starts(printer):
        away_mm = float(np.sqrt(((standing - np.array(place)) ** 2).sum(axis=1).min()))
        if away_mm > max(far_mm, BARE_RADIUS_MM):
            best, far_mm = place, away_mm
    return best


def _starts(printer: PrinterProfile) -> list[tuple[float, float]]:
    """The profile's own place first, then places along the bed's edges."""
    width, depth = printer.bed_size_mm
    xs = np.arange(INSET_MM, width - INSET_MM + 1e-6, EVERY_MM)
    ys = np.arange(INSET_MM, depth - INSET_MM + 1e-6, EVERY_MM)
    edges = [(float(x), y) for y in (INSET_MM, depth - INSET_MM) for x in xs]
    edges += [(x, float(y)) for x in (INSET_MM, width - INSET_MM) for y in ys]
    return [(printer.prime_mm[0], printer.prime_mm[1]), *edges]


def _bare(field: HeightField, points_mm: Float[np.ndarray, "n 2"]) -> Bool[np.ndarray, " n"]:
    """Whether nothing stands below the points: a line is drawn on the bed, not on a brim."""
    index = field.cells_of(points_mm)
    ny, nx = field.shape
    inside = np.asarray(((index >= 0) & (index < (ny, nx))).all(axis=1))
    index = np.where(inside[:, None], index, 0)
    height_mm = np.asarray(field.z_mm)[index[:, 0], index[:, 1]]
    return np.asarray(~inside | (height_mm <= 0))
