"""Where on the bed a part is printed that nobody has placed: in the middle, foot down.

It moves and never turns: which way up a part prints well is its maker's to say.
"""

from __future__ import annotations

from typing import Any

from gcode.profiles import PrinterProfile

Xyz = tuple[float, float, float]


def in_the_middle(solid: Any, printer: PrinterProfile) -> tuple[Any, Xyz]:
    """A solid (`manifold3d.Manifold`) in the middle of the bed, its lowest point on it.

    Returns
    -------
    The solid, build frame, and by how much it was moved in X, Y, Z, mm.
    """
    x0, y0, z0, x1, y1, _ = solid.bounding_box()
    x, y = printer.bed_middle_mm
    by_mm = (x - 0.5 * (x0 + x1), y - 0.5 * (y0 + y1), -z0)
    return solid.translate(by_mm), by_mm
