"""What lies under a slice of the head: against every cell that shapely says it touches."""

from __future__ import annotations

import numpy as np
import shapely
from hypothesis import given
from hypothesis import strategies as st
from shapely import affinity

from gcode.surfaces import HeightField

CELL_MM = 0.5
BARELY_MM = 1e-6  # what touches by less may count or not
side = st.integers(-12, 12).map(lambda n: 0.13 * n)
corner = st.tuples(side, side)


@given(
    st.one_of(
        st.tuples(corner, corner).map(
            lambda ab: shapely.box(
                min(ab[0][0], ab[1][0]),
                min(ab[0][1], ab[1][1]),
                max(ab[0][0], ab[1][0]) + 0.1,
                max(ab[0][1], ab[1][1]) + 0.1,
            )
        ),
        st.lists(corner, min_size=3, max_size=7).map(
            lambda corners: shapely.MultiPoint(corners).convex_hull
        ),
    ).filter(lambda outline: outline.area > 0.01),
    st.sampled_from([0.0, 0.045, 0.3]),
    st.integers(0, 1000),
)
def test_the_greatest_height_under_an_outline(
    outline: shapely.Polygon, aside_mm: float, seed: int
) -> None:
    field = HeightField(
        np.array([3.0, -2.0]),
        CELL_MM,
        np.random.default_rng(seed).uniform(0.0, 9.0, (9, 7)),
        np.ones((9, 7), dtype=bool),
    )
    around = shapely.box(-aside_mm, -aside_mm, aside_mm, aside_mm)
    wide = shapely.MultiPoint(
        [
            (x + dx, y + dy)
            for x, y in shapely.get_coordinates(outline)
            for dx, dy in shapely.get_coordinates(around)
        ]
    ).convex_hull
    polygon = [(float(x), float(y)) for x, y in outline.exterior.coords[:-1]]
    got = field.max_within(polygon, aside_mm=aside_mm)
    rows, columns = np.indices(field.shape)
    cells = shapely.box(columns - 0.5, rows - 0.5, columns + 0.5, rows + 0.5)
    cells = shapely.transform(cells, lambda at: at * CELL_MM)
    surely, maybe = wide.buffer(-BARELY_MM), wide.buffer(BARELY_MM)
    for iy in range(field.shape[0]):
        for ix in range(field.shape[1]):
            least, most = (
                np.asarray(field.z_mm)[
                    shapely.intersects(affinity.translate(w, ix * CELL_MM, iy * CELL_MM), cells)
                ].max(initial=-np.inf)
                for w in (surely, maybe)
            )
            assert least <= got[iy, ix] <= most


@given(
    st.floats(0.3, 2.6),
    st.floats(0.2, 3.0),
    st.sampled_from([0.0, 0.6, 0.95]),
    st.integers(0, 1000),
)
def test_what_stands_beside_a_cone_counts_for_less(
    widening_mm: float, height_mm: float, bare: float, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    z_mm = np.where(rng.random((9, 7)) < bare, 0.0, rng.uniform(0.0, 9.0, (9, 7)))
    field = HeightField(np.array([3.0, -2.0]), CELL_MM, z_mm, np.ones((9, 7), dtype=bool))
    point = [(0.01, 0.01), (-0.01, 0.01), (-0.01, -0.01), (0.01, -0.01)]
    got = field.max_within(point, widening_mm=widening_mm, height_mm=height_mm)
    # the head is wider above the cone: what stands there counts, too
    wider_mm = widening_mm + 4 * CELL_MM
    rows, columns = np.indices(field.shape)
    for iy in range(field.shape[0]):
        for ix in range(field.shape[1]):
            apart_mm = CELL_MM * np.hypot(rows - iy, columns - ix)
            above = z_mm[apart_mm <= wider_mm].max() - height_mm
            counted = z_mm - height_mm / widening_mm * apart_mm
            least, most = (
                counted[apart_mm <= widening_mm + cells * CELL_MM + 1e-9].max() for cells in (0, 2)
            )
            assert max(least, above) - 0.02 <= max(got[iy, ix], above) <= max(most, above) + 1e-9
