"""A merged cloud without views: where one view errs, it holds two sheets of points, one sound."""

from __future__ import annotations

import numpy as np
import pytest

from amrepair.regions import Label, detect
from amrepair.scans import Scan
from amrepair.template import MeshSdf
from tests.analytic import box, sample_surface, to_trimesh

SIGMA_MM = 0.05
PLATE = box((0, 0, 0), (24, 20, 4))


def merged(pitches_mm: list[float], low_mm: list[float], sigma_mm: float = SIGMA_MM) -> Scan:
    """The plate from above, a raster of each pitch; so low each has a disc 6 mm wide."""
    rng = np.random.default_rng(5)
    views = []
    for pitch_mm, off_mm in zip(pitches_mm, low_mm, strict=True):
        x, y = np.meshgrid(*(np.arange(-40.0, 40.0, pitch_mm) + at for at in rng.uniform(size=2)))
        turn = rng.uniform(0, np.pi / 2)
        x, y = x * np.cos(turn) - y * np.sin(turn), x * np.sin(turn) + y * np.cos(turn)
        on = (x > 0) & (x < 24) & (y > 0) & (y < 20)
        low = np.hypot(x - 13, y - 9) < 3.0
        views.append(np.column_stack([x[on], y[on], np.where(low, 4.0 - off_mm, 4.0)[on]]))
    sides = sample_surface(PLATE.body, 0.12, seed=1)[0]
    views.append(sides[sides[:, 2] < 4 - 1e-6])
    points = np.concatenate(views)
    return Scan(points + rng.normal(0, sigma_mm, points.shape), sigma_mm, "template")


@pytest.mark.parametrize("low_mm", [0.6, -0.6])
def test_a_sparse_sheet_has_no_vote_beside_a_dense_one(low_mm: float) -> None:
    # regression: medians counted cells, and those of a view that errs as much as those of ten
    # times as many points on the surface
    scan = merged([0.2, 0.2, 0.2, 0.3], [0.0, 0.0, 0.0, low_mm])
    assert detect(scan, PLATE).regions == ()


@pytest.mark.parametrize("low_mm", [0.6, -0.6])
def test_of_two_sheets_along_the_surface_neither_is_certain(low_mm: float) -> None:
    # regression: the one that was off was certain, since its points agree with each other
    assert detect(merged([0.15, 0.15], [0.0, low_mm]), PLATE).regions == ()


@pytest.mark.parametrize("low_mm", [0.6, -0.6])
def test_what_all_views_see_off_is_off(low_mm: float) -> None:
    (found,) = detect(merged([0.2, 0.2, 0.3], [low_mm] * 3), PLATE).regions
    assert found.label == (Label.MISSING if low_mm > 0 else Label.EXCESS)
    assert (np.abs(found.box_mm[:, :2] - [(10, 6), (16, 12)]) < 0.3).all()


@pytest.mark.parametrize("sigma_mm", [0.02, 0.12])
def test_a_region_is_as_large_as_the_surface_that_it_lies_over(sigma_mm: float) -> None:
    # regression: area and volume counted cells, of which noise fills two, one above the other
    scan = merged([0.2, 0.2, 0.3], [0.6] * 3, sigma_mm)
    (found,) = detect(scan, MeshSdf.from_mesh(to_trimesh(PLATE.body))).regions
    disc_mm2 = np.pi * 3.0**2
    assert found.area_mm2 == pytest.approx(disc_mm2, rel=0.04)
    assert found.volume_mm3 == pytest.approx(0.6 * disc_mm2, rel=0.04)


@pytest.mark.parametrize("low_mm", [0.6, -0.6])
def test_what_was_seen_sparsely_is_judged_over_wider_windows(low_mm: float) -> None:
    # regression: of a top with a tenth of the sides' points nothing was found, nor said
    scan = merged([0.4], [low_mm])
    (found,) = detect(scan, PLATE).regions
    assert found.label == (Label.MISSING if low_mm > 0 else Label.EXCESS)
    assert (np.abs(found.box_mm[:, :2] - [(10, 6), (16, 12)]) < 0.5).all()
