"""Plane regions and their peeling into rings: what every layer is made of.

Regions are `manifold3d.CrossSection` (Clipper2 underneath: 500 offsets of real sections take
30 ms). Peeling splits a region into rings one bead wide, what is too thin for a ring, and a core.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import accumulate
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from manifold3d import CrossSection, JoinType

MITER_LIMIT = 2.0
SIMPLIFY_MM = 0.008  # a fiftieth of a bead: below what a nozzle can show
_CRUMB_MM2 = 1e-3


def offset(region: Any, distance_mm: float) -> Any:
    """Grow (or shrink) keeping corners sharp."""
    return region.offset(distance_mm, JoinType.Miter, MITER_LIMIT)


def pieces(region: Any, *, least_mm2: float = _CRUMB_MM2) -> list[Any]:
    """Connected parts with their holes, crumbs left out."""
    if region.is_empty():
        return []
    return [part for part in region.decompose() if part.area() > least_mm2]


def flattened(region: Any) -> tuple[Float[np.ndarray, "n 2"], Int[np.ndarray, " m"]]:
    """Points of all contours, and where each contour starts (with the end)."""
    contours = region.to_polygons()
    if not contours:
        return np.zeros((0, 2)), np.zeros(1, np.int64)
    points = np.concatenate(contours, dtype=np.float64)
    return points, np.array([0, *accumulate(map(len, contours))], np.int64)


def union(regions: list[Any]) -> Any:
    """All regions as one."""
    if not regions:
        return CrossSection()
    from manifold3d import OpType

    return regions[0] if len(regions) == 1 else CrossSection.batch_boolean(regions, OpType.Add)


@dataclass(frozen=True, slots=True)
class Ring:
    """One peel: where the bead's centre runs, and the area that it stands for."""

    centre: Any
    area_mm2: float


@dataclass(frozen=True, slots=True)
class Peeled:
    """Rings from outside in, what was too thin at each, and the core that is left."""

    rings: tuple[Ring, ...]
    thin: tuple[Any, ...]
    core: Any


def peel(region: Any, spacing_mm: float, count: int) -> Peeled:
    """Take `count` rings of width `spacing_mm` off a region.

    What a ring cannot enter (narrower than two of them) is cut away as `thin`: it is what an
    opening by one spacing loses. Ring, thin and core add up to the region.
    """
    rings: list[Ring] = []
    thin: list[Any] = []
    least_mm2 = 0.1 * spacing_mm * spacing_mm
    for _ in range(count):
        if region.is_empty():
            break
        core = offset(region, -spacing_mm).simplify(1e-4)
        if core.area() <= _CRUMB_MM2:
            thin += pieces(region)
            region = CrossSection()
            break
        opened = offset(core, spacing_mm)
        area_mm2 = region.area()
        if area_mm2 - opened.area() > least_mm2:
            lost = region - opened
            thin += pieces(lost, least_mm2=least_mm2)
        centre = offset(core, 0.5 * spacing_mm).simplify(0.5 * SIMPLIFY_MM)
        rings.append(Ring(centre, opened.area() - core.area()))
        region = core
    return Peeled(tuple(rings), tuple(thin), region)
