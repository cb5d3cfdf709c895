"""Views of a part without sensor positions: what nobody saw is not missing.

Regression: with all walls unseen, or one oblique view, a pocket made the whole part missing (1,043
of 13.75 mm³ from above, 59 of 13.75 and 73 of 50 mm³ aslant).
"""

from __future__ import annotations

import itertools

import manifold3d as m3
import numpy as np
import pytest

from amrepair.deficit import compute_deficit
from amrepair.frames import Transform
from amrepair.scans import Scan
from amrepair.template import MeshSdf
from tests.draws import draws
from tests.unit.loop_bench import scan_of, solid_mesh
from tests.unit.test_most_is_gone import points_on

BLOCK = m3.Manifold.cube((16.0, 12.0, 6.6))
TEMPLATE = MeshSdf.from_mesh(solid_mesh(BLOCK))
PLACED = Transform.identity("build", "template")
VIEWS = {"from above": ((0.0, 0.0, 1.0), 0.5), "aslant": ((0.3, 0.4, 0.85), 0.05)}
CUTS = {
    "pocket": ((5.0, 3.0, 6.05), (5.0, 5.0, 1.0)),
    "pocket beside a wall": ((1.0, 3.0, 5.6), (5.0, 5.0, 2.0)),
    "edge": ((-1.0, 3.0, 5.6), (4.0, 5.0, 2.0)),
    "corner": ((-1.0, -1.0, 5.1), (5.0, 5.0, 2.0)),
}


@pytest.mark.parametrize(
    ("cut", "view"),
    draws(
        itertools.product(CUTS, VIEWS),
        *(("pocket", "from above"), ("pocket beside a wall", "aslant")),
    ),
)
def test_only_what_is_broken_is_missing(cut: str, view: str) -> None:
    corner, size = CUTS[cut]
    gone = m3.Manifold.cube(size).translate(corner) ^ BLOCK
    cloud = scan_of(BLOCK - gone)
    assert cloud.normals is not None
    toward, least = VIEWS[view]
    seen = cloud.normals @ np.array(toward) > least
    normals = cloud.normals[seen] if view == "aslant" else None
    scan = Scan(cloud.points_mm[seen], cloud.sigma_mm, "template", normals)
    deficit = compute_deficit(scan, TEMPLATE, build_from_template=PLACED)
    # the walls of the cut are not all seen: a tenth may be given up
    assert deficit.missing_mm3 == pytest.approx(gone.volume(), rel=0.1)


def bare_view(gone: m3.Manifold, view: str) -> Scan:
    """A view of the block without what is gone, as points alone."""
    cloud = scan_of(BLOCK - gone)
    assert cloud.normals is not None
    toward, least = VIEWS[view]
    seen = cloud.normals @ np.array(toward) > least
    return Scan(cloud.points_mm[seen], cloud.sigma_mm, "template")


def test_a_slot_through_the_block_is_as_wide_as_it_was_seen() -> None:
    # regression: what stands beyond it, whose near wall no view sees, was missing, too (440 of
    # 222 mm³, then 175 of it on the wrong side of the wall that was seen)
    gone = m3.Manifold.cube((2.8, 12.0, 6.6)).translate((6.0, 0.0, 0.0))
    deficit = compute_deficit(bare_view(gone, "aslant"), TEMPLATE, build_from_template=PLACED)
    assert deficit.missing_mm3 == pytest.approx(gone.volume(), rel=0.1)
    assert (deficit.missing ^ gone).volume() > 0.85 * gone.volume()


@pytest.mark.parametrize("view", VIEWS)
def test_nothing_is_missing_below_a_deep_floor(view: str) -> None:
    # regression: from above alone, 20 mm³ lay below the floor, which was taken for a ceiling
    gone = m3.Manifold.cube((5.0, 5.0, 3.0)).translate((6.0, 4.0, 3.6))
    deficit = compute_deficit(bare_view(gone, view), TEMPLATE, build_from_template=PLACED)
    assert (deficit.missing - gone).volume() < 0.1 * gone.volume()
    assert deficit.missing_mm3 > 0.4 * gone.volume()  # of walls that nobody saw some stays unseen


def test_points_that_stray_to_where_surface_was_hold_nothing_there() -> None:
    # regression: each held a voxel, whose sides nobody saw: half the way to the broken faces was
    # taken for a guess (0.91 of what is missing was found)
    whole = m3.Manifold.cube((30.0, 14.0, 12.0))
    for x in np.arange(11):  # hidden sides of the part make it probable that others are hidden, too
        for y in np.arange(5):
            whole -= m3.Manifold.cube((1.6, 1.6, 10.0)).translate((1 + 2.6 * x, 0.8 + 2.6 * y, -5))
    gone = whole ^ m3.Manifold.cube((20.0, 20.0, 6.0)).translate((16.0, -1.0, 7.0))
    points = points_on(whole - gone, each_mm2=0.12)
    inner = (points[:, :2] > 0.5).all(axis=1) & (points[:, :2] < (29.5, 13.5)).all(axis=1)
    points = points[(points[:, 2] > 0.3) & ~(inner & (points[:, 2] < 5.2))]
    strays = np.array([[23.0, 7.0, 12.0], [26.0, 7.0, 12.02], [28.0, 3.0, 11.95]])
    scan = Scan(np.concatenate([points, strays]), 0.04, "template")
    deficit = compute_deficit(
        scan, MeshSdf.from_mesh(solid_mesh(whole)), build_from_template=PLACED
    )
    assert deficit.missing_mm3 == pytest.approx(gone.volume(), rel=0.01)


@pytest.mark.slow
def test_what_takes_most_of_a_top_along_is_gone_and_not_hidden() -> None:
    # regression: most surface that faces up was not seen, so what had been of it over the pit
    # counted as hidden; a patch of wall without points made a guess of all beside it (0.93 found)
    whole = m3.Manifold.cube((18.0, 14.0, 6.0))
    gone = whole ^ m3.Manifold.cube((15.4, 11.4, 9.0)).translate((1.3, 1.3, 3.0))
    points = points_on(whole - gone, each_mm2=0.12)
    bare = (np.abs(points - (1.3, 7.0, 5.0)) < (0.25, 2.5, 1.9)).all(axis=1)
    scan = Scan(points[(points[:, 2] > 0.3) & ~bare], 0.04, "template")
    deficit = compute_deficit(
        scan, MeshSdf.from_mesh(solid_mesh(whole)), build_from_template=PLACED
    )
    assert (deficit.missing ^ gone).volume() > 0.98 * gone.volume()


@pytest.mark.slow
def test_a_patch_without_points_hides_no_more_than_it_is_wide() -> None:
    # regression: all that lies nearer to it than to scanned surface was a guess (0.95 found)
    whole = m3.Manifold.cube((20.0, 14.0, 6.0))
    slope = m3.Manifold.cube((30.0, 30.0, 20.0)).translate((0.0, -5.0, 0.0))
    gone = whole ^ slope.rotate((0.0, 25.0, 0.0)).translate((6.5, 0.0, 6.0))
    points = points_on(whole - gone, each_mm2=0.12)
    bare = (points[:, 2] < 1.5) & (points[:, 0] > 11.0) & (np.abs(points[:, 1] - 7.0) < 1.5)
    scan = Scan(points[(points[:, 2] > 0.3) & ~bare], 0.04, "template")
    deficit = compute_deficit(
        scan, MeshSdf.from_mesh(solid_mesh(whole)), build_from_template=PLACED
    )
    assert (deficit.missing ^ gone).volume() > 0.97 * gone.volume()
