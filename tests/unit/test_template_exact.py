"""The exact field: double precision, in slivers and beside folds, too; few rays for many nodes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh
from jaxtyping import Float

from amrepair.errors import TemplateError
from amrepair.template import MeshSdf, load_mesh
from amrepair.template.fit import fit_fast
from amrepair.template.nearest import TriangleTree
from amrepair.template.options import FitOptions
from amrepair.template.signs import signed_grid, signs_in_blocks

BRACKET = Path(__file__).parents[2] / "examples" / "parts" / "bracket.stl"
# On the bottom face, on a wall, on the top of the base: Embree's distances were 0.06 to 0.02 mm.
ON_FACES_MM = np.array(
    [[55.625, 3.75, 0.0], [47.5, 1.09375, 0.0], [54.53125, 45.0, 36.25], [20.0, 14.375, 0.0]]
)


@pytest.fixture(scope="module")
def bracket() -> MeshSdf:
    return MeshSdf.from_mesh(load_mesh(BRACKET))


def around(mesh: trimesh.Trimesh, count: int, spread_mm: float) -> Float[np.ndarray, "n 3"]:
    points = np.asarray(trimesh.sample.sample_surface(mesh, count, seed=3)[0])
    return points + np.random.default_rng(3).normal(0, spread_mm, points.shape)


def winding(mesh: trimesh.Trimesh, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
    """Solid angles of all triangles (van Oosterom and Strackee 1983)."""
    a, b, c = np.moveaxis(np.asarray(mesh.triangles)[None] - points[:, None, None], 2, 0)
    la, lb, lc = (np.linalg.norm(v, axis=2) for v in (a, b, c))
    above = np.einsum("nfi,nfi->nf", a, np.cross(b, c))
    below = la * lb * lc + (a * b).sum(2) * lc + (b * c).sum(2) * la + (c * a).sum(2) * lb
    return np.arctan2(above, below).sum(axis=1) / (2.0 * np.pi)


def test_points_on_faces_of_slivers_are_on_the_surface(bracket: MeshSdf) -> None:
    # regression: single precision found other triangles nearest, in slivers up to 0.09 mm away
    assert np.abs(bracket.distance(ON_FACES_MM)).max() < 1e-9


def test_distances_are_those_of_all_triangles(bracket: MeshSdf) -> None:
    points = around(bracket.mesh, 100, 2.0)
    triangles = np.asarray(bracket.mesh.triangles)
    brute = [
        np.linalg.norm(
            trimesh.triangles.closest_point(triangles, np.tile(p, (len(triangles), 1))) - p, axis=1
        ).min()
        for p in points
    ]
    distance, gradient = bracket.distance_and_gradient(points)
    assert np.abs(distance) == pytest.approx(np.array(brute), abs=1e-9)
    assert np.array_equal(distance < 0, winding(bracket.mesh, points) > 0.5)
    at = points - distance[:, None] * gradient
    assert np.abs(bracket.distance(at)).max() < 1e-8


def test_many_points_are_answered_in_their_own_order(bracket: MeshSdf) -> None:
    points = around(bracket.mesh, 25_000, 1.0)
    some = np.random.default_rng(0).permutation(len(points))[:50]
    assert np.array_equal(bracket.distance(points)[some], bracket.distance(points[some]))


def test_a_fold_of_no_thickness_does_not_turn_the_part_inside_out() -> None:
    box = trimesh.creation.box(bounds=((0, 0, 0), (30, 20, 10)))
    # the top, with a triangle under two others of it, as exports in single precision leave them
    inner = np.array([[5, 5, 10], [25, 5, 10], [25, 15, 10], [5, 15, 10], [15, 7, 10.0]])
    top = [k for k, n in enumerate(box.face_normals) if n[2] > 0.5]
    ring = [[0, 0, 10], [30, 0, 10], [30, 20, 10], [0, 20, 10]]
    places = {tuple(np.round(v).astype(int)): k for k, v in enumerate(box.vertices)}
    a, b, c, d = (places[tuple(p)] for p in ring)
    e, f, g, h, tip = range(8, 13)
    faces = [[a, b, f], [a, f, tip], [a, tip, e], [b, c, g], [b, g, f], [c, d, h], [c, h, g]]
    faces += [[d, a, e], [d, e, h], [e, f, g], [e, g, h], [e, tip, f]]
    mesh = trimesh.Trimesh(
        np.concatenate([box.vertices, inner]),
        np.concatenate([np.delete(box.faces, top, axis=0), faces]),
        process=False,
    )
    tree = TriangleTree.of(np.asarray(mesh.vertices), np.asarray(mesh.faces))
    assert not tree.sure.all()
    rng = np.random.default_rng(0)
    points = rng.uniform((2, 2, 9), (28, 18, 11), (4_000, 3))
    found = tree.nearest(points)
    sided = found.side != 0
    assert sided.mean() > 0.5
    assert np.array_equal(found.side[sided] < 0, points[sided, 2] < 10.0)
    assert np.array_equal(tree.inside(points), points[:, 2] < 10.0)


def test_triangles_without_area_are_no_trouble() -> None:
    # regression: a corner that stands twice in a triangle divided by zero
    corners = np.array([[0, 0, 0], [10, 0, 0], [0, 10, 0], [5, 0, 0], [20, 0, 0], [20, 5, 0.0]])
    faces = np.array([[0, 1, 2], [0, 1, 1], [0, 3, 1], [2, 2, 2], [0, 0, 1], [4, 5, 4]])
    tree = TriangleTree.of(corners, faces)
    assert (tree.nearest(corners).size_mm < 1e-12).all()
    points = np.random.default_rng(0).uniform(0, 10, (500, 3))
    above = points[points[:, 0] + points[:, 1] < 10]
    assert tree.nearest(above).size_mm == pytest.approx(above[:, 2], abs=1e-12)


def test_signs_from_few_rays_are_those_of_all(bracket: MeshSdf) -> None:
    low = bracket.bounds_mm[0] - 3.1
    cell_mm, shape = 2.3, (38, 25, 23)
    nodes = low + cell_mm * np.argwhere(np.ones(shape, dtype=bool))
    exact = bracket.distance(nodes).reshape(shape)
    asked: list[int] = []

    def inside(points: Float[np.ndarray, "n 3"]) -> np.ndarray:
        asked.append(len(points))
        return bracket.inside(points)

    grid = signed_grid(np.abs(exact), low, cell_mm, inside)
    assert np.array_equal(grid, exact)
    assert sum(asked) < 0.35 * grid.size
    blocks = np.stack([exact[k : k + 5, 3:8, 4:9] for k in range(0, 33, 3)])
    known = signs_in_blocks(np.abs(blocks), np.sign(blocks[:, ::4, ::4, ::4]).astype(np.int8), 2.3)
    assert (known != 0).mean() > 0.5
    assert np.array_equal(known[known != 0], np.sign(blocks[known != 0]))


def test_long_parts_get_smaller_cells() -> None:
    few = FitOptions(cells=32, samples=20_000)
    stocky, long = (
        fit_fast(MeshSdf.from_mesh(trimesh.creation.box(size)), options=few)
        for size in ((40.0, 30.0, 25.0), (200.0, 12.0, 12.0))
    )
    assert stocky.grid.cell_mm == pytest.approx(40.0 / few.cells, rel=0.1)
    assert long.grid.cell_mm < 0.5 * 200.0 / few.cells
    assert long.grid.base.size < 1.5 * stocky.grid.base.size


def test_a_mesh_in_metres_is_refused(tmp_path: Path) -> None:
    # regression: a template 0.08 mm across was fitted, "good to 0.000 mm"
    path = tmp_path / "metres.stl"
    trimesh.creation.box((0.08, 0.04, 0.02)).export(path)
    with pytest.raises(TemplateError, match=r"0\.0917 mm across.*metres"):
        load_mesh(path)
