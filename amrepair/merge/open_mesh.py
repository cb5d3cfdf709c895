"""Templates from meshes that bound no volume: scans with holes, exports that are not manifold.

What is inside is told by the generalized winding number (Jacobson, Kavan and Sorkine-Hornung,
SIGGRAPH 2013, by the fast sums of Barill et al., SIGGRAPH 2018): 1 within, 0 without, between in a
hole, whose middle surface is where it is a half. Small holes are closed so; what large ones hold is
unknown.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float
from scipy import ndimage
from scipy.spatial import cKDTree

from amrepair.arrays import Faces, Points, Vector, Vertices, Voxels
from amrepair.errors import TemplateError
from amrepair.field.groups import group_points
from amrepair.merge.fuse import solid_surface
from amrepair.merge.winding import Shell
from amrepair.template import GridSdf, MeshSdf, load_mesh
from amrepair.template.fit import fit_fast
from amrepair.template.fitting import made_from
from amrepair.template.grid import Coverage
from amrepair.template.mesh_file import OpenMeshError, file_sha256, read_mesh
from amrepair.template.nearest import TriangleTree
from amrepair.template.surface import count_for_spacing, sample_surface, triangle_areas_normals
from gcode.progress import Progress, silent
from gcode.stretches import places_to_ends

if TYPE_CHECKING:
    import trimesh

SAMPLES_ACROSS = 4  # of the surface, along the largest hole that is closed
BLOCK_NODES, BLOCKS_TOGETHER = 8, 2_000  # nodes along an edge; looked at together
LID_RATIO = 1e-3  # of the diagonal: a lid lies farther off the triangles
SURE_WINDING = 0.45  # from a half: so far within or without, that no triangle's side counts


@dataclass(frozen=True, slots=True)
class OpenMeshOptions:
    """How an open mesh is made a template.

    Attributes
    ----------
    cells
        Of the grid, along the longest side.
    small_hole_ratio
        Holes up to that share of the diagonal across are closed, larger ones are unknown.
    least_followed
        Share of the triangles' area that the surface must follow, or they bound nothing.
    patches_per_cell
        Pieces of surface along a cell's edge, as the winding number sums them.
    asked_first, doubt
        Places on the triangles that are asked before the grid is filled, whether an inside lies on
        one side of them and an outside on the other; by so much may the winding number err there.
    """

    cells: int = 256
    small_hole_ratio: float = 0.01
    least_followed: float = 0.9
    patches_per_cell: float = 1.5
    asked_first: int = 4_000
    doubt: float = 0.1


def fit_mesh(
    path: Path,
    *,
    seed: int = 0,
    options: OpenMeshOptions | None = None,
    progress: Progress = silent,
) -> GridSdf:
    """The template of a mesh's file, closed or not.

    Raises
    ------
    TemplateError
        If the file cannot be read, or its triangles bound nothing.
    """
    progress("read mesh", 0.0, 1.0)
    options = options or OpenMeshOptions()
    try:
        closed = load_mesh(path)
    except OpenMeshError:
        return _by_winding(path, options, seed, progress)
    progress("read mesh", 1.0, 1.0)
    metadata = made_from(closed, "fast", seed)
    coverage = None
    if closed.metadata["notes"]:  # a hole may have been closed that is no small one
        vertices, faces = _oriented(read_mesh(path))
        off_mm = LID_RATIO * float(np.linalg.norm(closed.extents))
        coverage, notes = _holes(closed, TriangleTree.of(vertices, faces), off_mm, options)
        metadata["notes"] = "; ".join([*closed.metadata["notes"], *notes])
    exact = MeshSdf.from_mesh(closed)
    made = fit_fast(exact, seed=seed, metadata=metadata, progress=progress)
    return replace(made, coverage=coverage)


def _by_winding(path: Path, options: OpenMeshOptions, seed: int, progress: Progress) -> GridSdf:
    mesh = read_mesh(path)
    made = _closed(mesh, path.name, options, progress)
    metadata = {
        **made_from(made.mesh, "fast", seed),
        "part_sha256": file_sha256(path),
        "notes": "; ".join(made.notes),
    }
    template = fit_fast(
        MeshSdf.from_mesh(made.mesh), seed=seed, metadata=metadata, progress=progress
    )
    return replace(
        template, bias_mm=float(np.hypot(template.bias_mm, made.off_mm)), coverage=made.coverage
    )


@dataclass(frozen=True, slots=True)
class _Made:
    """A closed mesh; how far the given triangles lie off it (99 %); what is unknown; sentences."""

    mesh: trimesh.Trimesh
    off_mm: float
    coverage: Coverage | None
    notes: tuple[str, ...]


def _closed(
    mesh: trimesh.Trimesh, name: str, options: OpenMeshOptions, progress: Progress
) -> _Made:
    """The surface where the winding number crosses a half, near the triangles on them."""
    vertices, faces = _oriented(mesh)
    edge = float(np.ptp(vertices, axis=0).max()) / options.cells
    areas, _ = triangle_areas_normals(vertices, faces)
    count = count_for_spacing(areas, edge / options.patches_per_cell)
    points, normals, _ = sample_surface(vertices, faces, count=count)
    # winding numbers have no unit: in cells, the tree's leaves hold a few pieces each
    shell = Shell.of(points / edge, normals * (float(areas.sum()) / count / edge**2))
    bounding = _bounding(shell, points, normals, edge, options)
    if bounding < options.least_followed:
        raise TemplateError(_no_part(name, bounding, options))
    tree = TriangleTree.of(vertices, faces)
    grid, low = _field(tree, shell, _rims(vertices, faces, edge), vertices, edge, progress)
    try:
        found = solid_surface(grid, low, edge)
    except TemplateError as error:
        raise TemplateError(
            f"the mesh {name} bounds nothing that could be closed: {error}"
        ) from error
    off_mm = MeshSdf.from_mesh(found).unsigned_distance(points)
    followed = float((off_mm < edge).mean())
    if followed < options.least_followed:
        raise TemplateError(_no_part(name, followed, options))
    coverage, notes = _holes(found, tree, edge, options)
    worst_mm = float(np.quantile(off_mm, 0.99))
    said = (
        "it is no closed manifold: its inside is told by the winding number, on cells of "
        f"{edge:.2g} mm, and its triangles lie within {worst_mm:.2g} mm (99 %)"
    )
    notes.insert(0, said)
    return _Made(found, worst_mm, coverage, tuple(notes))


def _bounding(
    shell: Shell, points: Points, normals: Points, edge: float, options: OpenMeshOptions
) -> float:
    """Share of the triangles' area that has an inside behind it and an outside before it.

    Across a triangle the winding number falls by one; it passes a half there only if what all
    others add to it lies between 0 and 1. A soup is told so in a second, not after its grid.
    """
    some = slice(None, None, max(1, len(points) // options.asked_first))
    behind, before = (
        shell.winding(points[some] / edge + side * normals[some]) for side in (-1.0, 1.0)
    )
    others = 0.5 * (behind + before)
    return float(((others > -options.doubt) & (others < 1.0 + options.doubt)).mean())


def _no_part(name: str, followed: float, options: OpenMeshOptions) -> str:
    return (
        f"the mesh {name} is a soup of polygons that bounds no part: of its area {followed:.0%} "
        f"lie on the surface that it encloses, {options.least_followed:.0%} are needed; export a "
        "closed solid"
    )


def _oriented(mesh: trimesh.Trimesh) -> tuple[Vertices, Faces]:
    """Welded triangles of some area, neighbours wound alike, most of the volume inside."""
    import trimesh

    welded = trimesh.Trimesh(mesh.vertices, mesh.faces, process=True)
    welded.update_faces(welded.nondegenerate_faces() & welded.unique_faces())
    if not len(welded.faces):
        raise TemplateError("the mesh has only triangles without area; export it again")
    trimesh.repair.fix_winding(welded)  # type: ignore[no-untyped-call]
    vertices, faces = np.asarray(welded.vertices), np.asarray(welded.faces)
    corners = vertices[faces] - vertices.mean(axis=0)
    volume = float(np.einsum("fi,fi->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])))
    return np.array(vertices), np.array(faces if volume >= 0 else faces[:, ::-1])


def _rims(vertices: Vertices, faces: Faces, edge: float) -> Float[np.ndarray, "k 3"]:
    """Points along the edges that belong to other than two faces, half a cell apart."""
    edges = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    pairs, count = np.unique(edges, axis=0, return_counts=True)
    start, end = vertices[pairs[count != 2]].transpose(1, 0, 2)
    return places_to_ends(start, end, 0.5 * edge)[0]


def _field(
    tree: TriangleTree,
    shell: Shell,
    rims: Float[np.ndarray, "k 3"],
    vertices: Vertices,
    edge: float,
    progress: Progress,
) -> tuple[Voxels, Vector]:
    """f at the nodes of a grid, right where it is near 0; and the first node.

    Near triangles it is the distance to them, of the side that they face; near open rims and in
    holes a half less the winding number, in cells.
    """
    low = vertices.min(axis=0) - 4.0 * edge
    blocks = (
        np.ceil((vertices.max(axis=0) + 4.0 * edge - low) / (BLOCK_NODES * edge)).astype(int) + 1
    )
    close = np.zeros(tuple(BLOCK_NODES * blocks), bool)
    close[tuple(np.rint(shell.place_mm - low / edge).astype(int).T)] = True
    close = ndimage.binary_dilation(close, iterations=2)
    every = np.argwhere(np.ones(tuple(blocks), bool))
    middle = 0.5 - shell.winding(low / edge + BLOCK_NODES * every + 0.5 * (BLOCK_NODES - 1))
    cut = close.reshape([n for b in blocks for n in (b, BLOCK_NODES)]).any(axis=(1, 3, 5)).ravel()
    cut |= np.abs(middle) < SURE_WINDING
    grid = middle.reshape(tuple(blocks)).astype(np.float32)
    for axis in range(3):
        grid = np.repeat(grid, BLOCK_NODES, axis)
    inner = np.argwhere(np.ones((BLOCK_NODES,) * 3, bool))
    for done, first in enumerate(range(0, len(every), BLOCKS_TOGETHER)):
        progress("winding number", float(done * BLOCKS_TOGETHER), float(len(every)))
        some = every[first : first + BLOCKS_TOGETHER][cut[first : first + BLOCKS_TOGETHER]]
        nodes = (BLOCK_NODES * some[:, None] + inner).reshape(-1, 3)
        grid[tuple(nodes.T)] = 0.5 - shell.winding(low / edge + nodes)
    near = np.argwhere(close)
    places = low + edge * near
    found = tree.nearest(places)
    said = grid[tuple(near.T)]
    side = np.where(found.side == 0, np.sign(said), found.side)
    at_rim = np.zeros(len(near), bool)
    if len(rims):
        at_rim = np.isfinite(cKDTree(rims).query(places, distance_upper_bound=2.0 * edge)[0])
    # near what is no rim, a side that the winding number denies is a neighbour's, or a fold's
    side = np.where(np.abs(said) > SURE_WINDING, np.sign(said), side)
    grid *= 2.0 * edge
    grid[tuple(near.T)] = np.where(at_rim, grid[tuple(near.T)], side * found.size_mm)
    return grid, low


def _holes(
    made: trimesh.Trimesh, tree: TriangleTree, off_mm: float, options: OpenMeshOptions
) -> tuple[Coverage | None, list[str]]:
    """What of a surface lies off all triangles: small holes, closed, and large ones, unknown."""
    vertices, faces = np.asarray(made.vertices), np.asarray(made.faces)
    diagonal = float(np.linalg.norm(made.extents))
    across_mm = options.small_hole_ratio * diagonal
    areas, _ = triangle_areas_normals(vertices, faces)
    spacing_mm = across_mm / SAMPLES_ACROSS
    points, normals, _ = sample_surface(vertices, faces, count=count_for_spacing(areas, spacing_mm))
    each_mm2 = float(areas.sum()) / len(points)
    off = tree.nearest(points).size_mm > off_mm
    bare = points[off]
    if not len(bare):
        return None, []
    which = group_points(bare, reach_mm=2.0 * spacing_mm)
    size = each_mm2 * np.bincount(which)
    limit_mm2 = 0.25 * np.pi * across_mm**2
    small, large = size[(size > 0) & (size <= limit_mm2)], size[size > limit_mm2]
    notes = []
    if len(small):
        notes.append(f"{len(small)} small holes closed, {small.sum():,.1f} mm² in all")
    if not len(large):
        return None, notes
    notes.append(
        f"{len(large)} large holes, {large.sum():,.0f} mm² in all, are closed by a guess: they are "
        "unknown, and nothing in them is called missing"
    )
    off[off] = size[which] > limit_mm2
    each = np.full(len(points), each_mm2)
    return Coverage.of(points, normals, each, off, 2.0 * spacing_mm), notes
