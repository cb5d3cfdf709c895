"""Breaks of walls a few beads thick: nothing deviates by more than half the wall there.

Regression: a chip off a ring 1 mm thick was found to 60 %; of 12 breaks of tubes three were not
found at all, and ten without sensors, one of them 20 mm² wide (four now). What a wall broke down to
lay as near to the places that were gone as surface that stands; depths of rays beyond it were taken
for noise, and its own cells for usual outliers.
"""

from __future__ import annotations

import itertools
from functools import cache

import manifold3d as m3
import numpy as np
import pytest
import trimesh

from amrepair.deficit import compute_deficit
from amrepair.frames import Transform
from amrepair.regions import Label, detect
from amrepair.scans import Scan
from amrepair.template import MeshSdf
from tests.analytic import box, difference, ray_scan, sample_surface, union
from tests.draws import draws
from tests.unit.loop_bench import solid_mesh

SIGMA_MM = 0.03
SENSORS_MM = np.array(
    [[10, 8, 300], [210, 8, 220], [-190, 38, 220], [10, 208, 220], [30, -192, 220]], dtype=float
)
IN_PLACE = Transform.identity("build", "template")


def tube(wall_mm: float) -> m3.Manifold:
    """A box of 20 × 16 × 12 mm, open at the top."""
    inside = m3.Manifold.cube((20 - 2 * wall_mm, 16 - 2 * wall_mm, 20))
    return m3.Manifold.cube((20, 16, 12)) - inside.translate((wall_mm, wall_mm, 1))


def pieces(wall_mm: float) -> dict[str, m3.Manifold]:
    """What breaks off: through a wall's rim, a corner of the rim, a bite of a corner, a window."""
    return {
        "notch": m3.Manifold.cube((5, 3 * wall_mm, 1.5)).translate((7, -wall_mm, 10.5)),
        "rim": m3.Manifold.cube((8, 8, 0.6)).translate((-1, -1, 11.4)),
        "bite": m3.Manifold.sphere(6, 64).translate((0, 0, 16.5)),
        "deep": m3.Manifold.cube((5, 3 * wall_mm, 4)).translate((7, -wall_mm, 8)),
    }


def seen(solid: m3.Manifold) -> Scan:
    """By five sensors, on a bed; a ray every 0.3 mm."""
    points, who = ray_scan(solid, SENSORS_MM, spacing_mm=0.3, sigma_mm=SIGMA_MM, seed=1)
    return Scan(points, SIGMA_MM, "template", sensors_mm=SENSORS_MM, sensor_index=who)


def bare(scan: Scan) -> Scan:
    """The same of a scanner that does not say where it stood."""
    return Scan(scan.points_mm, scan.sigma_mm, scan.frame)


@cache
def template_of(wall_mm: float) -> MeshSdf:
    return MeshSdf.from_mesh(solid_mesh(tube(wall_mm)))


def found_ratio(scan: Scan, wall_mm: float, gone: m3.Manifold) -> float:
    """What of the piece is found to be missing."""
    template = template_of(wall_mm)
    anomaly = detect(scan, template)
    deficit = compute_deficit(scan, template, anomaly, build_from_template=IN_PLACE)
    assert deficit.excess_mm3 < 0.05 * gone.volume()
    return (deficit.missing ^ gone).volume() / gone.volume()


@pytest.mark.parametrize(
    ("piece", "wall_mm"),
    draws(
        (
            (p, w)
            for p in ("notch", "rim", "bite", "deep")
            for w in (0.8, 1.2, 1.6)
            if (p, w) != ("rim", 0.8)
        ),
        *(("notch", 1.2), ("deep", 0.8)),
    ),  # 0.6 mm off 0.8 mm, at cells of 0.7 mm: the noise says whether
)
def test_what_a_thin_wall_lost_is_found_by_the_rays_that_passed(piece: str, wall_mm: float) -> None:
    gone = pieces(wall_mm)[piece] ^ tube(wall_mm)
    ratio = found_ratio(seen(tube(wall_mm) - gone), wall_mm, gone)
    assert ratio > 0.85


@pytest.mark.parametrize(
    ("piece", "wall_mm"),
    draws(itertools.product(("notch", "deep"), (0.45, 0.8, 1.2, 1.6)), ("notch", 0.45)),
)
def test_without_sensors_it_is_found_by_the_end_across_the_wall(piece: str, wall_mm: float) -> None:
    """Regression: of walls of 0.45 and 0.8 mm all that had broken off was said to be there."""
    gone = pieces(wall_mm)[piece] ^ tube(wall_mm)
    assert found_ratio(bare(seen(tube(wall_mm) - gone)), wall_mm, gone) > 0.85


@pytest.mark.slow
def test_an_end_is_no_neighbour_of_the_cells_beside_it() -> None:
    """A bite of 8.5 mm³ was lost where the two were one window: they differ by more than noise."""
    gone = pieces(1.6)["bite"] ^ tube(1.6)
    assert found_ratio(bare(seen(tube(1.6) - gone)), 1.6, gone) > 0.7


@pytest.mark.slow
@pytest.mark.parametrize("seed", [2, 0, 3])
def test_of_a_cup_of_one_bead_s_wall_the_upper_half_is_found_all_around(seed: int) -> None:
    """Where chance left a gap in the scanned end a wedge was left standing over it (0.91 found,
    seed 2), in the way of the whole repair; ends were compared with sound places that face as they
    do, so that a scanner seemed to err by half a millimetre (nothing found, seeds 0 and 3).
    """

    def cone(radius_mm: float) -> m3.Manifold:
        return m3.Manifold.cylinder(20, radius_mm, radius_mm + 3, 96)

    whole = cone(12.0) - cone(11.55).translate((0, 0, 1.2))
    rest, gone = (whole.trim_by_plane((0, 0, way), way * 10) for way in (-1, 1))
    mesh = solid_mesh(rest)
    rng = np.random.default_rng(seed)
    points, _ = trimesh.sample.sample_surface(mesh, int(mesh.area / 0.06), seed=seed)
    scan = Scan(points + rng.normal(0.0, 0.04, points.shape), 0.04, "template")
    template = MeshSdf.from_mesh(solid_mesh(whole))
    deficit = compute_deficit(scan, template, detect(scan, template), build_from_template=IN_PLACE)
    assert (deficit.missing ^ gone).volume() > 0.94 * gone.volume()


def test_points_that_stray_into_a_sound_wall_are_no_ends_of_it() -> None:
    """In patches of 1.5 mm every second point lies anywhere within the wall.

    Where both faces went on, 3 of 60 sound scans with a real scanner's residuals had told 5 gaps.
    """
    points = seen(tube(1.2)).points_mm.copy()
    rng = np.random.default_rng(0)
    front = np.flatnonzero((points[:, 1] < 0.3) & (points[:, 2] > 2.0) & (points[:, 2] < 10.0))
    for spot in rng.choice(front, 12):
        near = front[np.linalg.norm(points[front] - points[spot], axis=1) < 1.5]
        points[near[::2], 1] = rng.uniform(0.0, 1.2, len(near[::2]))
    regions = detect(Scan(points, SIGMA_MM, "template"), template_of(1.2)).regions
    assert [r for r in regions if r.label is Label.MISSING] == []


@pytest.mark.parametrize("seed", [0, 1])
def test_the_cells_of_a_broken_wall_are_no_scanner_s_errors(seed: int) -> None:
    """Some 1 % of a coarse scan's cells lay on the break; all to one side, they were taken for it.

    Of 28 cuts of real parts, a point every 0.5 mm, one was found to 63 %.
    """
    whole = union(box((0, 0, 0), (40, 24, 3)), box((4, 10, 3), (36, 12.6, 14)))
    broken = difference(whole, box((18, 5, 7), (40, 15, 20)))
    points, _ = sample_surface(broken.body, 0.5, seed=seed)
    points = points + np.random.default_rng(seed).normal(0, 0.06, points.shape)
    regions = detect(Scan(points, 0.06, "template"), whole).regions
    assert [region.label for region in regions] == [Label.MISSING]
    (low, high) = regions[0].box_mm
    assert low[0] < 20.0
    assert high[0] > 34.0


@pytest.mark.parametrize("wall_mm", [0.8, 1.6])
def test_a_sound_tube_is_sound(wall_mm: float) -> None:
    assert detect(seen(tube(wall_mm)), template_of(wall_mm)).regions == ()
