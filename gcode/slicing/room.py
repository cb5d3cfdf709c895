"""Where on the bed there is room to prime: beside what stands there, the whole head fitting."""

from __future__ import annotations

import numpy as np
from scipy import ndimage, spatial

from gcode.profiles import PrinterProfile
from gcode.profiles.round_beds import kept_on
from gcode.slicing.reach import Reach
from gcode.surfaces import HeightField

ROOM_CELL_MM = 1.0
INSET_MM = 5.0  # from the bed's edge
EVERY_MM = 10.0
BARE_RADIUS_MM = 6.0  # a strand that hangs from the nozzle falls into this circle


def over_bed(field: HeightField, printer: PrinterProfile) -> HeightField:
    """A field as high or higher on coarse cells all over the nozzle's reach; bare beside it."""
    x0, y0, x1, y1 = printer.reach_box_mm
    coarse = field.coarsened(max(1, int(ROOM_CELL_MM / field.cell_mm)))
    bare = HeightField.flat((x1 - x0, y1 - y0), ROOM_CELL_MM, origin_mm=(x0, y0))
    z_mm = bare.raised_by(coarse).z_mm
    # A cell reaches into the cells beside the one that holds its middle.
    z_mm = ndimage.maximum_filter(z_mm, 2 * int(np.ceil(0.5 * coarse.cell_mm / ROOM_CELL_MM)) + 1)
    return bare.raised(z_mm)


def room_for_line(
    field: HeightField, printer: PrinterProfile, length_mm: float
) -> tuple[float, float, float, float] | None:
    """Where a line can be drawn on the bed, the whole head fitting: (x, y) and its direction."""
    x, y = printer.prime_mm[:2]
    around = (
        x - ROOM_CELL_MM,
        y - ROOM_CELL_MM,
        x + length_mm + ROOM_CELL_MM,
        y + length_mm + ROOM_CELL_MM,
    )
    own = Reach(field, printer, window_mm=around)  # soon answered, and mostly it is enough
    place = _room_at([(x, y)], own, field, printer, length_mm)
    return place or _room_at(_starts(printer), Reach(field, printer), field, printer, length_mm)


def _room_at(
    starts: list[tuple[float, float]],
    reach: Reach,
    field: HeightField,
    printer: PrinterProfile,
    length_mm: float,
) -> tuple[float, float, float, float] | None:
    free = reach.at(printer.prime_mm[2])
    along = np.arange(0.0, length_mm + 0.25, 0.25)
    x_max, y_max = printer.reach_box_mm[2:]
    for x, y in starts:
        for dx, dy in ((1.0, 0.0), (0.0, 1.0)):
            points = np.array([x, y]) + along[:, None] * np.array([dx, dy])
            fits = points[-1, 0] <= x_max - 1.0 and points[-1, 1] <= y_max - 1.0
            if (
                fits
                and reach.free_at_points(points, free).all()
                and (field.sample(points) <= 0).all()  # drawn on the bed, not on a brim
            ):
                return x, y, dx, dy
    return None


def bare_place(field: HeightField, printer: PrinterProfile) -> tuple[float, float] | None:
    """A place at the bed's edge below which nothing stands, far from what does."""
    rows, columns = np.nonzero(field.z_mm > 0)
    if not len(rows):
        return printer.prime_mm[:2]
    xs, ys = field.centres_mm()
    standing = np.stack([xs[columns], ys[rows]], axis=1)
    places = _starts(printer)
    away_mm, _ = spatial.KDTree(standing).query(np.array(places))
    best = int(np.argmax(away_mm))
    return places[best] if away_mm[best] > BARE_RADIUS_MM else None


def _starts(printer: PrinterProfile) -> list[tuple[float, float]]:
    """The profile's own place, and places along the bed's edges."""
    x0, y0, x1, y1 = np.array(printer.bed_box_mm) + INSET_MM * np.array([1, 1, -1, -1])
    xs, ys = np.arange(x0, x1 + 1e-6, EVERY_MM), np.arange(y0, y1 + 1e-6, EVERY_MM)
    edges = [(float(x), float(y)) for y in (y0, y1) for x in xs]
    edges += [(float(x), float(y)) for x in (x0, x1) for y in ys]
    if printer.delta:
        bed = printer.bed_min_mm, printer.bed_size_mm, INSET_MM
        edges = [kept_on(at, *bed, to_edge=True) for at in edges]
    return [(printer.prime_mm[0], printer.prime_mm[1]), *edges]
