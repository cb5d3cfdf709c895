"""Fitting the fast recipe: exact distances on a coarse grid, and on finer blocks where it bends.

Trilinear interpolation is exact on planes; what it misses lies at edges and curves, in few cells.
Those are found by asking the exact field around the surface, and divided. A hashed network in
their place was less accurate (57 µm at the 99th percentile on the bracket, blocks 19) and slower,
to fit and to ask.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable

import numpy as np
from jaxtyping import Float, Int
from scipy import ndimage

from amrepair.arrays import Points, Values, Vector, Voxels
from amrepair.frames import grid_points
from amrepair.template.grid import Grid, GridSdf
from amrepair.template.grid_kernels import NOBODY, carry, near_triangles, shared_nodes
from amrepair.template.mesh_sdf import MeshSdf
from amrepair.template.options import DEFAULT_FIT, FitOptions
from amrepair.template.signs import signed_grid, signs_in_blocks
from amrepair.template.surface import sample_surface
from gcode.progress import Progress, silent

FIT_VERSION = 4  # raised where the same file gives another template: cached ones are fitted again
AT_ONCE = 100_000  # distances: a second of a large mesh


def fit_fast(
    exact: MeshSdf,
    *,
    seed: int = 0,
    least_residual_mm: float = 0.0,
    metadata: dict[str, str] | None = None,
    options: FitOptions = DEFAULT_FIT,
    progress: Progress = silent,
) -> GridSdf:
    """Fit a template to an exact field.

    Parameters
    ----------
    exact
        The closed mesh's own field.
    seed
        Of the points where the grid is compared with it.
    least_residual_mm
        Cells where the grid is better than this, or than the options', are not divided: for
        meshes that are no truer than that themselves.
    """
    rng = np.random.default_rng(seed)
    low, high = exact.bounds_mm
    margin = options.margin_ratio * float((high - low).max())
    cell = _cell_mm(high - low, margin, options)
    origin = low - margin
    shape = np.ceil((high - low + 2 * margin) / cell).astype(int) + 1
    base = _base(exact, origin, cell, shape, options, progress)
    bare = Grid.bare(origin, cell, base)
    points = _samples(exact, options.samples, options.band_cells * cell, rng)
    residual = np.abs(
        _in_parts(exact.distance, points, "fit: compare", progress) - bare.distance(points)
    )
    least_mm = max(options.least_residual_mm, least_residual_mm)
    cells = _bent(bare, points, residual, least_mm, options)
    grid = Grid.refined(origin, cell, base, cells, _blocks(exact, bare, cells, options, progress))
    held = _on_surface(exact, options.held_out, rng)
    bias_mm = float(np.quantile(np.abs(grid.distance(held)), 0.99))
    return GridSdf(grid=grid, mesh=exact.mesh, bias_mm=bias_mm, metadata=metadata or {})


def _cell_mm(size_mm: Vector, margin_mm: float, options: FitOptions) -> float:
    """Edge of a cell: the longest side over its cells, or smaller where nodes are left."""
    largest = float(size_mm.max()) / options.cells
    nodes = options.stocky_ratio * options.cells**3
    as_stocky = float(np.cbrt(np.prod(size_mm + 2 * margin_mm) / nodes))
    return min(largest, max(as_stocky, largest / options.most_divided))


def _base(
    exact: MeshSdf,
    origin: Vector,
    cell: float,
    shape: np.ndarray,
    options: FitOptions,
    progress: Progress,
) -> Voxels:
    """(x, y, z) distances at the nodes, float32: exact near the surface.

    Far nodes look at many boxes of the tree before they know their triangle; their neighbours know
    one nearly as near (P.-E. Danielsson, Euclidean distance mapping, 1980, with triangles for
    points): 0.15 µm farther on average.
    """
    corners = np.asarray(exact.mesh.vertices, dtype=np.float64)[np.asarray(exact.mesh.faces)]
    a = np.ascontiguousarray(corners[:, 0])
    ab = np.ascontiguousarray(corners[:, 1] - a)
    ac = np.ascontiguousarray(corners[:, 2] - a)
    dots = np.stack([(u * v).sum(axis=1) for u, v in ((ab, ab), (ab, ac), (ac, ac))], axis=1)
    size = (int(shape[0]), int(shape[1]), int(shape[2]))
    squared, which = near_triangles(a, ab, ac, dots, origin, cell, size, options.exact_cells * cell)
    near = which != NOBODY
    sweeps = list(itertools.product((1, -1), repeat=3))
    for done, way in enumerate(sweeps, 1):
        progress("fit: grid", float(done), float(len(sweeps)))
        carry(squared, which, near, a, ab, ac, dots, origin, cell, *way)
    base = np.sqrt(squared).astype(np.float32)
    return signed_grid(base, origin, cell, exact.inside).astype(np.float32)


def _in_parts(
    ask: Callable[[Float[np.ndarray, "k 3"]], Float[np.ndarray, " k"]],
    points_mm: Points,
    what: str,
    progress: Progress,
) -> Values:
    """(n,) answers at points, some at a time."""
    found = np.empty(len(points_mm))
    for first in range(0, len(points_mm), AT_ONCE):
        last = min(first + AT_ONCE, len(points_mm))
        found[first:last] = ask(points_mm[first:last])
        progress(what, float(last), float(len(points_mm)))
    return found


def _on_surface(exact: MeshSdf, count: int, rng: np.random.Generator) -> Points:
    vertices, faces = np.asarray(exact.mesh.vertices), np.asarray(exact.mesh.faces)
    points, _, _ = sample_surface(vertices, faces, count=count, offset=float(rng.random()))
    return points


def _samples(exact: MeshSdf, count: int, band_mm: float, rng: np.random.Generator) -> Points:
    """Points around the surface, half of them close to it."""
    points = _on_surface(exact, count, rng)
    spread = np.where(rng.random(len(points)) < 0.5, 0.25, 1.0) * band_mm
    return points + rng.normal(size=points.shape) * (spread / np.sqrt(3.0))[:, None]


def _bent(
    bare: Grid, points: Points, residual: Values, least_mm: float, options: FitOptions
) -> Int[np.ndarray, "b 3"]:
    """(b, 3) cells where the coarse grid is not good enough, and their neighbours."""
    worst = np.zeros(bare.block_of.shape)
    np.maximum.at(worst, tuple(bare.cell_of(points).T), residual)
    wrong = ndimage.binary_dilation(worst > least_mm)
    cells = np.argwhere(wrong)
    if len(cells) > options.most_blocks:
        around = ndimage.maximum_filter(worst, 3)[tuple(cells.T)]
        cells = cells[np.sort(np.argsort(-around, kind="stable")[: options.most_blocks])]
    return cells


def _blocks(
    exact: MeshSdf,
    bare: Grid,
    cells: Int[np.ndarray, "b 3"],
    options: FitOptions,
    progress: Progress,
) -> Float[np.ndarray, "b r r r"]:
    """(b, r+1, r+1, r+1) exact distances; nodes that blocks share are asked once."""
    fine = options.fine
    inner = grid_points(*[np.arange(fine + 1)] * 3)
    block_of = np.full(bare.block_of.shape, -1, np.int64)
    block_of[tuple(cells.T)] = np.arange(len(cells))
    back, first = shared_nodes(cells, block_of, fine)
    block, own = np.divmod(first, len(inner))
    where = bare.origin_mm + (cells[block] * fine + inner[own]) * (bare.cell_mm / fine)
    size = _in_parts(exact.unsigned_distance, where, "fit: details", progress).astype(np.float32)
    blocks = size[back].reshape(len(cells), *[fine + 1] * 3)
    ends = np.stack(np.meshgrid(*[[0, 1]] * 3, indexing="ij"), -1)
    corners = np.moveaxis(cells[:, None, None, None, :] + ends, -1, 0)
    corner_sign = np.sign(bare.base[tuple(corners)]).astype(np.int8)
    sign = signs_in_blocks(blocks, corner_sign, bare.cell_mm / fine)
    back = back.reshape(sign.shape)
    asked = np.unique(back[sign == 0])
    side = np.zeros(len(first), dtype=np.int8)
    side[asked] = np.where(exact.inside(where[asked]), -1, 1)
    return blocks * np.where(sign == 0, side[back], sign)
