"""Which space is solid: the cut is the least one, and bare views of sound parts tell nothing."""

from __future__ import annotations

import itertools
from pathlib import Path

import manifold3d as m3
import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.sparse import coo_array
from scipy.sparse.csgraph import breadth_first_order, maximum_flow

from amrepair.deficit import compute_deficit
from amrepair.field.minimum_cut import UNIT_NATS, Facets, MinimumCut, facets_of
from amrepair.field.occupancy import find_occupancy
from amrepair.field.options import OccupancyOptions
from amrepair.field.space import Broken, VoxelGrid
from amrepair.frames import Transform
from amrepair.scans import Scan
from amrepair.template import MeshSdf
from tests import analytic
from tests.draws import draws
from tests.unit.loop_bench import solid_mesh

PLACED = Transform.identity("build", "template")


@settings(max_examples=60, deadline=None)
@given(shape=st.tuples(*[st.integers(1, 3)] * 2), seed=st.integers(0, 2**32 - 1))
def test_the_labelling_is_the_cheapest_of_all_and_of_those_has_the_most_solid(
    shape: tuple[int, int], seed: int
) -> None:
    rng = np.random.default_rng(seed)
    number = np.arange(int(np.prod(shape))).reshape(1, *shape)
    number[rng.random(number.shape) < 0.2] = -1  # known to be empty
    number[number >= 0] = np.arange((number >= 0).sum())
    count = int(number.max(initial=-1)) + 1
    f_mm = np.where(number < 0, 1.0, -1.0)
    facets = facets_of(VoxelGrid(np.zeros(3), 1.0, f_mm, number))
    nats = rng.integers(0, 4, (len(facets.one), 2)).astype(float)
    told = rng.integers(-5, 6, count).astype(float)

    def cost(empty: tuple[bool, ...]) -> float:
        solid = np.append(~np.array(empty, bool), False)
        one, other = solid[facets.one], solid[facets.other]
        surface = nats[one & ~other, 0].sum() + nats[other & ~one, 1].sum()
        return float(told[~solid[:-1]].sum() + surface)

    every = list(itertools.product([False, True], repeat=count))
    best = min(every, key=lambda empty: (cost(empty), sum(empty)))
    assert MinimumCut.of(facets, nats, told).empty.tolist() == list(best)


@settings(max_examples=30, deadline=None)
@given(shape=st.tuples(*[st.integers(2, 12)] * 3), seed=st.integers(0, 2**32 - 1))
def test_what_is_empty_is_what_scipys_largest_flow_leaves_reaching_empty(
    shape: tuple[int, int, int], seed: int
) -> None:
    rng = np.random.default_rng(seed)
    number = np.arange(int(np.prod(shape))).reshape(shape)
    facets = facets_of(VoxelGrid(np.zeros(3), 1.0, np.full(shape, -1.0), number))
    count, some = number.size, len(facets.one)
    nats = UNIT_NATS * np.where(rng.random((some, 2)) < 0.3, 0, rng.integers(0, 60, (some, 2)))
    # most is solid, a little; here and there something is empty for certain
    told = UNIT_NATS * np.where(
        rng.random(count) < 0.1, rng.integers(-400, 0, count), rng.integers(0, 30, count)
    )
    other = told + UNIT_NATS * np.where(rng.random(count) < 0.2, rng.integers(-300, 300, count), 0)
    more = nats + UNIT_NATS * rng.integers(0, 60, nats.shape)
    cut = MinimumCut.of(facets, nats, told)
    np.testing.assert_array_equal(cut.empty, by_scipy(facets, nats, told))
    dearer = cut.dearer(more, other)
    np.testing.assert_array_equal(dearer.empty, by_scipy(facets, more, other))


def by_scipy(facets: Facets, nats: np.ndarray, told: np.ndarray) -> np.ndarray:
    count = len(told)
    every = np.arange(count)
    rows = np.concatenate([facets.one, facets.other, np.full(count, count), every])
    columns = np.concatenate([facets.other, facets.one, every, np.full(count, count + 1)])
    prices = np.concatenate([*nats.T, np.maximum(told, 0.0), np.maximum(-told, 0.0)])
    fits = np.round(prices / UNIT_NATS).astype(np.int32)
    graph = coo_array((fits, (rows, columns)), shape=(count + 2, count + 2)).tocsr()
    left = graph - maximum_flow(graph, count, count + 1).flow
    left.eliminate_zeros()
    reaching = breadth_first_order(left.T.tocsr(), count + 1, return_predecessors=False)
    return np.isin(every, reaching)


@pytest.mark.parametrize("turned", [False, True])
def test_space_in_a_pit_is_empty_and_around_it_solid_whichever_way_its_planes_look(
    turned: bool,
) -> None:
    block = analytic.box((0, 0, 0), (24, 20, 10))
    pit = m3.Manifold.sphere(5, 96).translate((12, 10, 10))
    points, normals = analytic.noisy_scan_points(
        block.body - pit, spacing_mm=0.25, sigma_mm=0.03, seed=1
    )
    f_mm = block.distance(points)
    off = f_mm < -0.2
    planes = -normals[off] if turned else normals[off]
    broken = Broken(points[off], planes, *block.distance_and_gradient(points[off]))
    surface = block.surface_points(0.4)
    found = find_occupancy(
        block, broken, points[~off], surface, spacing_mm=0.25, options=OccupancyOptions()
    )
    ask = np.random.default_rng(0).uniform((5.0, 3.0, 4.0), (19.0, 17.0, 10.0), (4000, 3))
    from_centre_mm = np.linalg.norm(ask - (12, 10, 10), axis=1)
    clear = np.abs(from_centre_mm - 5.0) > found.voxel_mm
    truly = np.where(from_centre_mm < 5.0, -1.0, 1.0)
    told = found.at(ask)
    known = clear & (told != 0)
    assert known.mean() > 0.5
    assert (told[known] * truly[known] > 0).mean() > 0.998
    sure = f_mm[off] < -1.0
    right = found.open_side(broken)[sure] * (-1.0 if turned else 1.0)
    assert (right > 0).mean() > 0.99


def test_a_large_box_has_larger_voxels_and_the_same_answer() -> None:
    block = analytic.box((0, 0, 0), (24, 20, 10))
    cut = m3.Manifold.cube((10, 10, 8)).translate((14, 10, 5))
    points, normals = analytic.noisy_scan_points(
        block.body - cut, spacing_mm=0.25, sigma_mm=0.03, seed=2
    )
    f_mm = block.distance(points)
    off = f_mm < -0.2
    broken = Broken(points[off], normals[off], *block.distance_and_gradient(points[off]))
    few = OccupancyOptions(most_voxels=4000)
    found = find_occupancy(
        block, broken, points[~off], block.surface_points(0.4), spacing_mm=0.25, options=few
    )
    assert int(found.designed.sum()) <= few.most_voxels
    gone_mm3 = float((found.designed & ~found.solid).sum()) * found.voxel_mm**3
    assert gone_mm3 == pytest.approx(500.0, rel=0.15)


def seen_from(solid: m3.Manifold, way: tuple[float, float, float], seed: int) -> np.ndarray:
    """(n, 3) points of one bare view of a solid from far away, with a silhouette and shadows."""
    mesh = solid.to_mesh64()
    shape = trimesh.Trimesh(np.array(mesh.vert_properties)[:, :3], np.array(mesh.tri_verts))
    points, faces = trimesh.sample.sample_surface(shape, int(shape.area / 0.4**2), seed=seed)
    toward = np.array(way) / np.linalg.norm(way)
    across = np.linalg.svd(toward[None])[2][1:]
    pixel = np.floor(points @ across.T / 0.8).astype(np.int64)
    _, pixel = np.unique(pixel, axis=0, return_inverse=True)
    height = points @ toward
    topmost = np.full(pixel.max() + 1, -np.inf)
    np.maximum.at(topmost, pixel, height)
    facing = shape.face_normals[faces] @ toward
    seen = (facing > 0.15) & (height > topmost[pixel] - 0.6 / facing.clip(0.15))
    noise = np.random.default_rng(seed).normal(scale=0.04, size=points.shape)
    return np.asarray(points + noise)[seen]


PARTS = Path(__file__).parents[2] / "examples" / "parts"


def solid_of(name: str) -> tuple[trimesh.Trimesh, m3.Manifold]:
    """An example part as mesh and as solid."""
    mesh = trimesh.load_mesh(PARTS / name)
    vertices = np.array(mesh.vertices, np.float64)
    return mesh, m3.Manifold(m3.Mesh64(vertices, np.array(mesh.faces, dtype=np.uint64)))


VIEWS = ((0.4, 0.2, 0.9), (-0.7, 0.3, 0.6), (0.1, -0.8, 0.6))


@pytest.mark.parametrize(
    "view", [VIEWS[0], *(pytest.param(view, marks=pytest.mark.slow) for view in VIEWS[1:])]
)
def test_a_bare_view_of_a_sound_part_tells_nothing_missing(
    view: tuple[float, float, float],
) -> None:
    mesh, solid = solid_of("bracket.stl")
    scan = Scan(seen_from(solid, view, seed=0), 0.04, "template")
    deficit = compute_deficit(scan, MeshSdf.from_mesh(mesh), build_from_template=PLACED)
    assert deficit.missing_mm3 == 0.0


@pytest.mark.slow
def test_a_cut_in_a_bare_view_with_a_silhouette_is_measured() -> None:
    mesh, solid = solid_of("bracket.stl")
    corner = np.asarray(mesh.bounds)[1]
    cut = m3.Manifold.cube((10, 10, 6), True).translate(tuple(corner - (5, 5, 1)))
    gone = solid ^ cut
    assert gone.volume() > 20.0
    scan = Scan(seen_from(solid - cut, VIEWS[0], seed=0), 0.04, "template")
    deficit = compute_deficit(scan, MeshSdf.from_mesh(mesh), build_from_template=PLACED)
    assert deficit.missing_mm3 == pytest.approx(gone.volume(), rel=0.15)
    assert (deficit.missing ^ gone).volume() > 0.85 * gone.volume()


@pytest.mark.slow
def test_what_is_hidden_is_no_void_behind_a_few_strays() -> None:
    """Regression: a dozen stray points, and half a plate that nobody saw was 7,131 mm³ missing."""
    size = np.array([80.0, 60.0, 4.0])
    plate = MeshSdf.from_mesh(trimesh.creation.box(extents=size))
    rng = np.random.default_rng(0)
    top = np.column_stack([rng.uniform(-0.5, 0.5, (9_600, 2)) * size[:2], np.full(9_600, 2.0)])
    seen = top[top[:, 0] < 12.0]
    strays = np.column_stack([rng.uniform(24, 26, 12), rng.uniform(-1, 1, 12), np.zeros(12)])
    planes = np.tile([0.0, 0.0, 1.0], (12, 1))
    broken = Broken(strays, planes, *plate.distance_and_gradient(strays))
    emptied_mm3 = []
    for least_seen in (0.0, OccupancyOptions().least_seen):
        found = find_occupancy(
            plate,
            broken,
            seen,
            plate.surface_points(0.7),
            spacing_mm=0.7,
            options=OccupancyOptions(least_seen=least_seen),
        )
        emptied_mm3.append(float((found.designed & ~found.solid).sum()) * found.voxel_mm**3)
    assert emptied_mm3[0] > 1_000.0  # what the labels alone would say of what is in view
    assert emptied_mm3[1] == 0.0


@pytest.mark.parametrize("stood_mm", draws([-14.7, -16.5], -14.7))
def test_a_dent_at_the_rim_of_what_nobody_saw_does_not_take_it_along(stood_mm: float) -> None:
    """Regression: a ball seen down to where it stood, and a dent there of 100 mm³ was 2,293."""
    radius_mm, deep_mm, ball_mm = 21.0, 2.5, 7.5
    ball = MeshSdf.from_mesh(trimesh.creation.icosphere(4, radius=radius_mm))
    rng = np.random.default_rng(2)
    way = rng.normal(size=(14_000, 3))
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    off_mm = rng.normal(0.0, 0.05, (len(way), 1))
    points = (radius_mm + off_mm) * way
    turn = np.arccos(stood_mm / radius_mm) - 2.0 / radius_mm  # 2 mm above where it stood
    middle = (radius_mm + ball_mm - deep_mm) * np.array([np.sin(turn), 0.0, np.cos(turn)])
    within = np.linalg.norm(radius_mm * way - middle, axis=1) < ball_mm
    from_middle = points[within] - middle
    from_middle /= np.linalg.norm(from_middle, axis=1, keepdims=True)
    points[within] = middle + (ball_mm - off_mm[within]) * from_middle
    seen = radius_mm * way[:, 2] > stood_mm
    deficit = compute_deficit(
        Scan(points[seen], 0.05, "template"), ball, build_from_template=PLACED
    )
    gone = m3.Manifold.sphere(radius_mm, 128) ^ m3.Manifold.sphere(ball_mm, 96).translate(middle)
    assert 0.8 * gone.volume() < deficit.missing_mm3 < 1.3 * gone.volume()


def test_a_dent_beside_a_bump_that_nobody_saw_does_not_take_it_along() -> None:
    """Regression: surface like the bump's was seen, and 1.66 of the dent was told."""
    high_mm, wide_mm = 1.5, 5.5
    radius_mm = (wide_mm**2 + high_mm**2) / (2 * high_mm)
    bump = m3.Manifold.sphere(radius_mm, 160).translate((25, 12, 10 + high_mm - radius_mm))
    part = (m3.Manifold.cube((40, 24, 10)) + bump) ^ m3.Manifold.cube((40, 24, 30))
    cut = m3.Manifold.sphere(7.5, 96).translate((15.5, 12, 15))
    points, _ = analytic.noisy_scan_points(part - cut, spacing_mm=0.6, sigma_mm=0.05, seed=2)
    bare = (np.linalg.norm(points[:, :2] - (25, 12), axis=1) < wide_mm) & (points[:, 2] > 9.9)
    scan = Scan(points[~bare], 0.05, "template")
    template = MeshSdf.from_mesh(solid_mesh(part))
    deficit = compute_deficit(scan, template, build_from_template=PLACED)
    assert deficit.missing_mm3 == pytest.approx((part ^ cut).volume(), rel=0.1)


@pytest.mark.parametrize("seen_mm", draws([20.0, 26.0], 20.0))
def test_a_notch_at_the_end_of_the_view_does_not_take_the_rest_along(seen_mm: float) -> None:
    # regression: where the view ended within a notch, all that it had not seen was told missing,
    # 27 times what was; of the head's way past it, too, nothing stood there
    block = analytic.box((0, 0, 0), (40, 12, 10))
    cut = m3.Manifold.cube((12, 14, 10)).translate((16, -1, 6))
    points, _ = analytic.noisy_scan_points(block.body - cut, spacing_mm=0.3, sigma_mm=0.05, seed=3)
    seen = points[(points[:, 0] < seen_mm) & (points[:, 2] > 0.4)]
    deficit = compute_deficit(Scan(seen, 0.05, "template"), block, build_from_template=PLACED)
    unseen_mm3 = (deficit.missing - m3.Manifold.cube((seen_mm, 12, 10))).volume()
    gone_mm3 = 12.0 * 4.0 * (seen_mm - 16.0)
    assert deficit.missing_mm3 - unseen_mm3 == pytest.approx(gone_mm3, rel=0.15)
    assert unseen_mm3 < 0.6 * gone_mm3  # it was 7.3 and 3.0 of it


@pytest.mark.parametrize(
    ("size", "at"),
    draws([((9, 9, 12), (33, 17, -1)), ((8, 8, 12), (16, 8, -1))], ((8, 8, 12), (16, 8, -1))),
    ids=["corner", "hole"],
)
def test_what_is_gone_down_to_an_unseen_underside_is_measured(
    size: tuple[float, float, float], at: tuple[float, float, float]
) -> None:
    """Regression: of the underside beside it as much was taken along, 1.5 of it in all."""
    cut = m3.Manifold.cube(size).translate(at)
    block = analytic.box((0, 0, 0), (40, 24, 10))
    points, _ = analytic.noisy_scan_points(block.body - cut, spacing_mm=0.5, sigma_mm=0.05, seed=3)
    above = points[points[:, 2] > 0.4]
    deficit = compute_deficit(Scan(above, 0.05, "template"), block, build_from_template=PLACED)
    assert deficit.missing_mm3 == pytest.approx((block.body ^ cut).volume(), rel=0.1)


@pytest.mark.slow
@pytest.mark.xfail(
    strict=True,
    reason="0.26 of it is found: broken surface counts by how much of it a mouth lets be seen, and "
    "this mouth, of 1.5 mm, lets nothing be seen that the points show",
)
def test_a_hollow_under_a_film_is_open_though_its_mouth_is_narrow() -> None:
    """Regression: surface with material on both sides cost nothing, and 0.09 of it was found."""
    block = analytic.box((0, 0, 0), (24, 16, 9))
    hollow = m3.Manifold.cube((14, 10, 7.55)).translate((5, 3, 1.3))  # 0.15 mm below the top
    hollow += m3.Manifold.cube((1.5, 5, 1.5)).translate((11, -1, 4))
    points, _ = analytic.noisy_scan_points(
        block.body - hollow, spacing_mm=0.25, sigma_mm=0.03, seed=4
    )
    deficit = compute_deficit(Scan(points, 0.03, "template"), block, build_from_template=PLACED)
    assert deficit.missing_mm3 == pytest.approx((block.body ^ hollow).volume(), rel=0.05)
