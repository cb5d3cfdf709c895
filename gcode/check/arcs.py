"""Arcs as the short straight pieces that firmwares make of them."""

from __future__ import annotations

import math

Point = tuple[float, float, float]
LEAST_RADIUS_MM = 1e-3
CENTRE_MM, CENTRE_RATIO = 0.05, 0.002  # the ends' distances from the centre, which slicers round
PIECE_MM = 0.3  # at a radius of 1 mm


def centre_by_radius(
    start_mm: Point, end_mm: Point, radius_mm: float, *, clockwise: bool
) -> tuple[float, float] | None:
    """A centre relative to the start, as Marlin's G2_G3.cpp finds it; None where none fits.

    A radius below 0 is that of the longer arc.
    """
    dx, dy = end_mm[0] - start_mm[0], end_mm[1] - start_mm[1]
    along_mm = math.hypot(dx, dy)
    if along_mm < LEAST_RADIUS_MM or along_mm > 2 * abs(radius_mm):
        return None
    aside_mm = math.sqrt(radius_mm**2 - 0.25 * along_mm**2)
    side = -1.0 if clockwise != (radius_mm < 0) else 1.0
    return (
        0.5 * dx - side * aside_mm * dy / along_mm,
        0.5 * dy + side * aside_mm * dx / along_mm,
    )


def points_of_arc(
    start_mm: Point, end_mm: Point, centre_mm: tuple[float, float], *, clockwise: bool
) -> tuple[float, list[Point]]:
    """How far too far apart the circles of its two ends are, and points along it, as firmwares go.

    They keep the start's radius, and go straight on to the end. No points where there is no circle.
    `centre_mm` is relative to the start; ends that coincide make a whole turn.
    """
    (x0, y0, z0), (x1, y1, z1) = start_mm, end_mm
    cx, cy = x0 + centre_mm[0], y0 + centre_mm[1]
    r0, r1 = math.hypot(x0 - cx, y0 - cy), math.hypot(x1 - cx, y1 - cy)
    apart_mm = abs(r0 - r1) if abs(r0 - r1) > max(CENTRE_MM, CENTRE_RATIO * r0) else 0.0
    if r0 < LEAST_RADIUS_MM:
        return max(apart_mm, LEAST_RADIUS_MM), []
    a0 = math.atan2(y0 - cy, x0 - cx)
    sweep = math.atan2(y1 - cy, x1 - cx) - a0
    if clockwise:
        sweep -= 2 * math.pi if sweep >= -1e-9 else 0.0
    else:
        sweep += 2 * math.pi if sweep <= 1e-9 else 0.0
    n = max(2, math.ceil(abs(sweep) * math.sqrt(max(r0, 0.1)) / PIECE_MM))
    turns = ((k / n, a0 + sweep * k / n) for k in range(1, n + 1))
    return apart_mm, [
        (cx + r0 * math.cos(a), cy + r0 * math.sin(a), z0 + (z1 - z0) * t) for t, a in turns
    ]
