"""Beads in what is too thin for rings lie in it: none runs across what it runs around."""

from __future__ import annotations

import manifold3d
import numpy as np
import pytest
import shapely
from hypothesis import given
from hypothesis import strategies as st
from jaxtyping import Float

from gcode.slicing.medial import fill_thin
from gcode.slicing.options import FillOptions

BORE_MM = 0.4
OPTIONS = FillOptions()


def arc(radius_mm: float, turn_rad: float) -> shapely.LineString:
    angles = np.linspace(0.0, turn_rad, 2 + int(turn_rad * 30))
    return shapely.LineString(radius_mm * np.column_stack([np.cos(angles), np.sin(angles)]))


def section_of(shape: shapely.Polygon) -> manifold3d.CrossSection:
    rings = [np.asarray(ring.coords)[:-1] for ring in (shape.exterior, *shape.interiors)]
    return manifold3d.CrossSection(rings, manifold3d.FillRule.EvenOdd)


def outside_mm(shape: shapely.Polygon) -> tuple[float, float]:
    """How far beads lie outside, and the volume they hold against that of the region, per mm."""
    filled = fill_thin(section_of(shape), BORE_MM, OPTIONS)
    farthest = held_mm2 = 0.0
    for bead in filled.beads:
        line = np.asarray(bead.xy_mm, np.float64)
        if bead.closed:
            line = np.concatenate([line, line[:1]])
        between: Float[np.ndarray, "k 2"] = shapely.get_coordinates(
            shapely.segmentize(shapely.LineString(line), 0.1)
        )
        farthest = max(farthest, float(shapely.distance(shape, shapely.points(between)).max()))
        held_mm2 += bead.area_mm2
    assert held_mm2 + filled.lost_mm2 == pytest.approx(shape.area, rel=0.3, abs=0.05)
    return farthest, held_mm2


@pytest.mark.parametrize("width_mm", [0.03, 0.1, 0.15])
def test_a_ring_thinner_than_a_bead_is_not_bridged(width_mm: float) -> None:
    """Regression: one straight bead across a bore of 16 mm, from side to side of its wall."""
    filled = fill_thin(section_of(arc(8.0, 2 * np.pi).buffer(width_mm / 2)), BORE_MM, OPTIONS)
    assert filled.beads == ()
    assert filled.lost_mm2 == pytest.approx(16 * np.pi * width_mm, rel=0.02)


@pytest.mark.parametrize("width_mm", [0.19, 0.2, 0.21])
def test_a_wall_of_just_a_beads_thickness_is_no_row_of_dashes(width_mm: float) -> None:
    """Regression: 190 beads of 0.2 mm each, one at every corner of the contour."""
    filled = fill_thin(section_of(arc(8.0, 2 * np.pi).buffer(width_mm / 2)), BORE_MM, OPTIONS)
    assert len(filled.beads) <= 3


def test_a_dot_is_filled_with_one_stroke() -> None:
    dot = shapely.Point(1.0, 2.0).buffer(0.2)
    farthest, held_mm2 = outside_mm(dot)
    assert farthest < 0.02
    assert held_mm2 == pytest.approx(dot.area, rel=0.3)


@given(
    radius_mm=st.floats(0.6, 12.0),
    turn_rad=st.floats(0.4, 2 * np.pi),
    width_mm=st.floats(0.02, 0.8),
)
def test_beads_lie_in_their_region(radius_mm: float, turn_rad: float, width_mm: float) -> None:
    thin = arc(radius_mm, turn_rad).buffer(width_mm / 2, cap_style="flat")
    farthest, _ = outside_mm(thin)
    assert farthest < 0.1
