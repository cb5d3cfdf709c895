"""Placed scans to one surface: what most of them say, and how far they disagree.

Outliers go in two steps: points that other scans contradict (they see surface above or below, and
none here), then, at each node of the grid, scans that differ from the median of all. The surface
where nobody looked is closed by a Poisson surface (Kazhdan and Hoppe 2013), or by the given mesh.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import ndimage

from amrepair.arrays import Mask, Numbers, Points, Values, Vector, VoxelMask, Voxels
from amrepair.device import open3d
from amrepair.errors import TemplateError
from amrepair.frames import cells_of
from amrepair.merge import fuse_kernels as kernels
from amrepair.merge.cloud import SortedPoints
from amrepair.merge.options import DEFAULT_FUSE, FuseOptions
from amrepair.template.extract import zero_level
from amrepair.template.grid import Coverage, surface_elements
from amrepair.template.learned import Tolerance
from amrepair.template.mesh_sdf import MeshSdf
from gcode.meshes import mesh_of
from gcode.solids import as_manifold, is_valid

if TYPE_CHECKING:
    import trimesh

MAX_NODES = 60_000_000
BLOCK_NODES = 8  # nodes along its edge
MOST_EDGES = 400  # of the grid, along the longest side
SPREAD_CELLS = 5  # nodes along the edge of a cell of the stored spread


@dataclass(frozen=True, slots=True)
class Cloud:
    """Placed points of all scans, common frame.

    Attributes
    ----------
    normals
        (n, 3) outward.
    scan
        (n,) which scan each point is of.
    scans
        How many there are.
    spacing_mm, sparsest_mm
        Of all together, and of the sparsest of them.
    """

    points_mm: Points
    normals: Points
    scan: Numbers
    scans: int
    spacing_mm: float
    sigma_mm: float
    sparsest_mm: float


@dataclass(frozen=True, slots=True)
class Fused:
    """What placed scans say together.

    Attributes
    ----------
    mesh
        Closed.
    spread
        None where one scan alone was given.
    standard_error_mm
        99th percentile over the surface of the mean's own uncertainty.
    unseen_ratio, single_ratio
        Shares of the surface that no scan, or one alone, saw.
    rejected
        Points that other scans contradict.
    outvoted_mm2
        (scans,) the largest piece of surface on which each scan was outvoted by the others.
    outvoted_at_mm
        (scans, 3) where that is.
    coverage
        What no scan saw.
    """

    mesh: trimesh.Trimesh
    spread: Tolerance | None
    standard_error_mm: float
    unseen_ratio: float
    single_ratio: float
    rejected: int
    outvoted_mm2: Float[np.ndarray, " scans"]
    outvoted_at_mm: Float[np.ndarray, "scans 3"]
    coverage: Coverage


def fuse(cloud: Cloud, options: FuseOptions = DEFAULT_FUSE) -> Fused:
    """Fuse placed scans.

    Raises
    ------
    TemplateError
        If the points make no closed surface, or the grid would be too large.
    """
    against, lonely = _contradicted(cloud, options)
    keep = ~(against | lonely)
    points, normals, scan = cloud.points_mm[keep], cloud.normals[keep], cloud.scan[keep]
    radius_mm = reach_mm(cloud, options)
    edge = max(0.6 * radius_mm, float(np.ptp(points, axis=0).max()) / MOST_EDGES)
    low, shape, nodes, index = _band(points, edge, radius_mm)
    cells = SortedPoints.of(points, radius_mm)
    field, excess, heard, overruled = kernels.fused_nodes(
        nodes, np.ascontiguousarray(points[cells.order]),
        np.ascontiguousarray(normals[cells.order]), np.ascontiguousarray(scan[cells.order]),
        cloud.scans, cells.grid,
        kernels.Rules(
            radius_mm, max(cloud.sigma_mm, 1e-4 * cloud.spacing_mm), options.rounds,
            options.least_node_points, options.outlier_sigmas,
            options.outlier_spacings * cloud.spacing_mm,
        ),
    )  # fmt: skip
    # a plane fitted to points far below says little about a node high above them
    field[np.abs(field) > 1.01 * radius_mm] = np.nan
    grid = np.full(tuple(shape), np.nan, dtype=np.float32)
    grid[tuple(index.T)] = field
    seen = np.isfinite(grid)
    _fill(grid, seen, low, edge, (points, normals), options)
    mesh = solid_surface(grid, low, edge, options.dust_ratio)
    close = np.isfinite(field) & (np.abs(field) < edge)
    spread = None
    if cloud.scans > 1:
        spread = _spread(cloud, excess, close, index, (low, edge, shape), options)
    area_mm2, at_mm = _outvoted(cloud, against, nodes[close], overruled[close], radius_mm, options)
    coverage = coverage_of(mesh, points, normals, options.seen_spacings * cloud.sparsest_mm)
    return Fused(
        mesh=mesh,
        spread=spread,
        standard_error_mm=_standard_error(cloud, spread, radius_mm),
        unseen_ratio=coverage.unseen_mm2 / float(mesh.area),
        single_ratio=float((heard[close] == 1).mean()) if close.any() else 1.0,
        rejected=int((~keep).sum()),
        outvoted_mm2=area_mm2,
        outvoted_at_mm=at_mm,
        coverage=coverage,
    )


def _outvoted(
    cloud: Cloud,
    against: Mask,
    nodes_mm: Float[np.ndarray, "k 3"],
    overruled: Int[np.ndarray, " k"],
    radius_mm: float,
    options: FuseOptions,
) -> tuple[Float[np.ndarray, " scans"], Float[np.ndarray, "scans 3"]]:
    """The largest connected piece of surface on which each scan was outvoted, and its middle.

    By points that other scans contradict, and by nodes at which a scan was overruled; counted in
    cells of a fit's radius, each about its square.
    """
    area, at = np.zeros(cloud.scans), np.zeros((cloud.scans, 3))
    low = cloud.points_mm.min(axis=0)
    for s in range(cloud.scans):
        own = cloud.points_mm[against & (cloud.scan == s)]
        heard = nodes_mm[(overruled >> min(s, kernels.LAST_BIT)) & 1 == 1]
        places = np.concatenate([own, heard])
        cell, count = np.unique(cells_of(places, low, radius_mm), axis=0, return_counts=True)
        cell = cell[count >= options.outvoted_marks]
        if not len(cell):
            continue
        box = np.zeros(tuple(np.ptp(cell, axis=0) + 1), bool)
        box[tuple((cell - cell.min(axis=0)).T)] = True
        label, _ = ndimage.label(box, np.ones((3, 3, 3)))
        sizes = np.bincount(label.ravel())[1:]
        largest = np.argwhere(label == 1 + int(np.argmax(sizes))) + cell.min(axis=0)
        area[s] = sizes.max() * radius_mm**2
        at[s] = low + (largest.mean(axis=0) + 0.5) * radius_mm
    return area, at


def coverage_of(
    mesh: trimesh.Trimesh, points_mm: Points, normals: Points, reach_mm: float
) -> Coverage:
    """Which of the surface was not seen: what a disc on it, of that radius and without points,
    covers (the complement of an alpha shape, Edelsbrunner, Kirkpatrick and Seidel 1983).

    So the border of what was seen lies at its outermost points, and no point is unseen. Points on
    the other side of a thin wall say nothing of this one.
    """
    from scipy.spatial import cKDTree

    centre, area = np.asarray(mesh.triangles_center), np.asarray(mesh.area_faces)
    pieces = surface_elements(centre, np.asarray(mesh.face_normals), reach_mm)
    away, near = cKDTree(points_mm).query(centre, distance_upper_bound=reach_mm)
    found = np.isfinite(away)
    empty = ~found
    told = surface_elements(points_mm[near[found]], normals[near[found]], reach_mm)
    empty[found] = np.linalg.norm(pieces[found] - told, axis=1) > reach_mm
    some = np.flatnonzero(empty & found)
    if len(some):  # none of the nearest: of those around, each faces as the surface under it
        around = np.isfinite(
            cKDTree(centre[some]).query(points_mm, distance_upper_bound=reach_mm)[0]
        )
        under = cKDTree(centre).query(points_mm[around])[1]
        told = surface_elements(points_mm[around], np.asarray(mesh.face_normals)[under], reach_mm)
        empty[some] = np.isinf(cKDTree(told).query(pieces[some], distance_upper_bound=reach_mm)[0])
    covers = cKDTree(pieces[empty]).query(pieces, distance_upper_bound=reach_mm)[0]
    return Coverage.of(centre, np.asarray(mesh.face_normals), area, np.isfinite(covers), reach_mm)


def reach_mm(cloud: Cloud, options: FuseOptions) -> float:
    """Radius of a fit: enough points to bring the noise to a twentieth of the spacing.

    The kernel (1 − d²/r²)⁴ over a plane has 0.36 of its points' weight (Σw)²/Σw².
    """
    wanted_mm = options.wanted_spacings * cloud.spacing_mm
    least = max(24.0, 8.0 * cloud.scans)  # so that each scan alone has a word
    count = float(np.clip((cloud.sigma_mm / wanted_mm) ** 2 / 0.36, least, 120.0))
    return float(np.sqrt(count / np.pi)) * cloud.spacing_mm


def _contradicted(cloud: Cloud, options: FuseOptions) -> tuple[Mask, Mask]:
    """(n,) points that most other scans contradict; (n,) in cells that hold next to nothing."""
    cell_mm = 2.2 * cloud.spacing_mm * np.sqrt(cloud.scans)
    low = cloud.points_mm.min(axis=0) - 2 * cell_mm
    index = cells_of(cloud.points_mm, low, cell_mm)
    shape = tuple(index.max(axis=0) + 3)
    flat = np.ravel_multi_index(tuple(index.T), shape)
    key = cloud.scan * int(np.prod(shape)) + flat
    places, surfel = np.unique(key, return_inverse=True)
    count = np.bincount(surfel)

    def mean(values: Points) -> Float[np.ndarray, "s 3"]:
        sums = [np.bincount(surfel, weights=values[:, a]) / count for a in range(3)]
        return np.ascontiguousarray(np.stack(sums, axis=1))

    place, normal = mean(cloud.points_mm), mean(cloud.normals)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    table = np.full((cloud.scans, *shape), -1, dtype=np.int32)
    table.reshape(-1)[places] = np.arange(len(places))
    whose = places // int(np.prod(shape))
    near_mm = max(0.7 * reach_mm(cloud, options), 5.0 * cloud.sigma_mm)
    far_mm = max(options.far_spacings * cloud.spacing_mm, 6.0 * near_mm)
    support, conflict, _ = kernels.columns(
        place, normal, whose, table, low, cell_mm, near_mm, far_mm, options.facing
    )
    against = conflict > support + 1
    if cloud.scans == 2:  # one word against one: the first scan's stands
        against = (conflict > 0) & (support == 0) & (whose == 1)
    around = ndimage.uniform_filter(
        np.bincount(flat, minlength=int(np.prod(shape))).reshape(shape).astype(np.float32), 3
    ).reshape(-1)
    lonely = (27.0 * around[places % int(np.prod(shape))] < options.least_node_points) & (
        support == 0
    )
    return against[surfel], lonely[surfel]


def _band(
    points_mm: Points, edge: float, radius_mm: float
) -> tuple[Vector, Int[np.ndarray, " 3"], Float[np.ndarray, "k 3"], Int[np.ndarray, "k 3"]]:
    """Grid and its nodes near the points."""
    low, high = points_mm.min(axis=0), points_mm.max(axis=0)
    low = low - 4 * edge - radius_mm
    shape = np.ceil((high + 4 * edge + radius_mm - low) / edge).astype(np.int64) + 1
    if float(np.prod(shape.astype(np.float64))) > MAX_NODES:
        raise TemplateError(
            f"a grid of {edge:.3g} mm over these scans has {np.prod(shape):,} nodes, the limit is "
            f"{MAX_NODES:,}; remove far clutter from the scans"
        )
    occupied = np.zeros(tuple(shape), dtype=bool)
    occupied[tuple(np.rint((points_mm - low) / edge).astype(np.int64).T)] = True
    around = ndimage.generate_binary_structure(3, 1)
    near = ndimage.binary_dilation(occupied, around, iterations=2)
    index = np.argwhere(near)
    return low, shape, low + edge * index, index


def _fill(
    grid: Voxels,
    seen: VoxelMask,
    low: Vector,
    edge: float,
    oriented: tuple[Points, Points],
    options: FuseOptions,
) -> None:
    """Give the nodes without support a side: their neighbours', or that of a smooth closure."""
    parts, count = ndimage.label(~seen)
    positive = np.zeros(count + 1)
    touching = np.zeros(count + 1)
    for axis in range(3):
        for way in (0, 1):
            here = [slice(None)] * 3
            there = [slice(None)] * 3
            here[axis] = slice(0, -1) if way else slice(1, None)
            there[axis] = slice(1, None) if way else slice(0, -1)
            mask = ~seen[tuple(here)] & seen[tuple(there)]
            labels = parts[tuple(here)][mask]
            touching += np.bincount(labels, minlength=count + 1)
            sides = grid[tuple(there)][mask] > 0
            positive += np.bincount(labels, weights=sides, minlength=count + 1)
    share, sure = positive / np.maximum(touching, 1), options.side_agreement
    outer = parts[0, 0, 0]
    clear = (share >= sure) | (share <= 1 - sure) | (touching < 30)
    side = np.where(share > 0.5, edge, -edge).astype(np.float32)
    side[outer] = edge
    grid[~seen] = side[parts[~seen]]
    is_leaking = share[outer] < sure and touching[outer] > 0
    doubtful = [k for k in range(1, count + 1) if not clear[k] and k != outer]
    if is_leaking or doubtful:
        asked = np.isin(parts, [outer, *doubtful]) & ~seen
        _ask(grid, asked, _poisson(*oriented, options), low, edge)


def _ask(grid: Voxels, asked: VoxelMask, closing: MeshSdf, low: Vector, edge: float) -> None:
    """Distances to a surface at some nodes, in place: exact near it, of its side elsewhere.

    A block whose middle lies farther off than its half diagonal holds none of the surface.
    """
    where = np.argwhere(asked)
    shape = tuple(-(-n // BLOCK_NODES) for n in asked.shape)
    key = np.ravel_multi_index(tuple(where.T // BLOCK_NODES), shape)
    used = np.zeros(int(np.prod(shape)), bool)
    used[key] = True
    blocks, of_block = np.argwhere(used.reshape(shape)), (np.cumsum(used) - 1)[key]
    half_mm = 0.5 * np.sqrt(3.0) * BLOCK_NODES * edge
    far = closing.distance(low + edge * (BLOCK_NODES * blocks + 0.5 * (BLOCK_NODES - 1)))
    found = np.copysign(edge, far)[of_block].astype(np.float32)
    near = (np.abs(far) <= half_mm)[of_block]
    found[near] = closing.distance(low + edge * where[near])
    grid[asked] = found


def _poisson(points_mm: Points, normals: Points, options: FuseOptions = DEFAULT_FUSE) -> MeshSdf:
    """A closed surface through oriented points."""
    import trimesh

    o3d = open3d()
    step = max(1, len(points_mm) // options.poisson_points)
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points_mm[::step]))
    cloud.normals = o3d.utility.Vector3dVector(normals[::step])
    mesh = o3d.geometry.TriangleMesh.create_from_point_cloud_poisson(
        cloud, depth=options.poisson_depth, scale=1.2, linear_fit=False, n_threads=1
    )[0]
    made = trimesh.Trimesh(np.asarray(mesh.vertices), np.asarray(mesh.triangles), process=False)
    made.metadata["notes"] = ()  # only its distance is asked, and its sides by ray counts
    if len(made.faces) == 0:
        raise TemplateError("the scans leave the part too open to be closed; scan all sides of it")
    return MeshSdf.from_mesh(made)


def solid_surface(
    grid: Voxels, low: Vector, edge: float, dust_ratio: float = DEFAULT_FUSE.dust_ratio
) -> trimesh.Trimesh:
    """Marching cubes, without dust; a valid solid."""
    import manifold3d as m3
    import trimesh

    # the rim of the grid is outside: what reaches it is closed there
    for axis in range(3):
        for face in (0, -1):
            rim = [slice(None)] * 3
            rim[axis] = face  # type: ignore[call-overload]
            grid[tuple(rim)] = np.maximum(grid[tuple(rim)], edge)
    if not grid.min() < 0:
        raise TemplateError("the scans enclose nothing; scan all sides of the part")
    vertices, faces = zero_level(grid, edge)
    solid = as_manifold(vertices + low, faces)
    if not is_valid(solid):
        raise TemplateError("the fused surface is no valid solid; scan the part more evenly")
    if solid.volume() < 0:
        whole, turned = mesh_of(solid)
        solid = as_manifold(whole, turned[:, ::-1])
    pieces = solid.decompose()
    largest = max(abs(piece.volume()) for piece in pieces)
    kept = [piece for piece in pieces if abs(piece.volume()) >= dust_ratio * largest]
    solid = m3.Manifold.compose(kept) if len(kept) < len(pieces) else solid
    vertices, faces = mesh_of(solid)
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    mesh.metadata["notes"] = ()
    return mesh


def _spread(
    cloud: Cloud,
    excess: Float[np.ndarray, " k"],
    close: Bool[np.ndarray, " k"],
    index: Int[np.ndarray, "k 3"],
    box: tuple[Vector, float, Int[np.ndarray, " 3"]],
    options: FuseOptions,
) -> Tolerance:
    """Variance between scans pooled over coarse cells: chance averages out, disagreement stays."""
    low, edge, shape = box
    used = close & np.isfinite(excess)
    coarse = index[used] // SPREAD_CELLS
    size = shape // SPREAD_CELLS + 1
    key = (coarse[:, 0] * size[1] + coarse[:, 1]) * size[2] + coarse[:, 2]
    cells = int(np.prod(size))
    count = np.bincount(key, minlength=cells)
    pooled = np.bincount(key, weights=excess[used], minlength=cells) / np.maximum(count, 1)
    pooled[count < options.least_nodes] = 0.0
    found = np.sqrt(np.maximum(pooled, 0.0)).astype(np.float32)
    found[found < options.least_spread_noises * cloud.sigma_mm] = 0.0
    grown = ndimage.maximum_filter(found.reshape(tuple(size)), size=3)
    return Tolerance(low - 0.5 * edge, SPREAD_CELLS * edge, grown)


def widened(spread: Tolerance, cloud: Cloud, slack_mm: Values) -> Tolerance:
    """The spread between scans with what the scans' own poses leave open.

    Where several scans saw the surface, that of the middle one: the mean is theirs.

    Parameters
    ----------
    slack_mm
        (n,) of each point of the cloud: standard deviation of its scan's pose across it.
    """
    shape = spread.spread_mm.shape
    index = cells_of(cloud.points_mm, spread.origin_mm, spread.cell_mm)
    cell = np.ravel_multi_index(tuple(index.T), shape, mode="clip")
    pairs, which = np.unique(cell * cloud.scans + cloud.scan, return_inverse=True)
    each = np.bincount(which, weights=slack_mm) / np.bincount(which)
    place = pairs // cloud.scans
    order = np.lexsort((each, place))
    cells, first, count = np.unique(place[order], return_index=True, return_counts=True)
    open_mm = np.zeros(int(np.prod(shape)))
    open_mm[cells] = each[order][first + count // 2]
    grown = ndimage.maximum_filter(open_mm.reshape(shape), size=3)
    return replace(spread, spread_mm=np.hypot(spread.spread_mm, grown).astype(np.float32))


def _standard_error(cloud: Cloud, spread: Tolerance | None, radius_mm: float) -> float:
    """How well the surface is known at the 99th percentile: noise, and scans that differ."""
    near = 0.36 * np.pi * (radius_mm / cloud.spacing_mm) ** 2
    noise_mm = cloud.sigma_mm / np.sqrt(max(near, 1.0))
    if spread is None or not (spread.spread_mm > 0).any():
        return float(noise_mm)
    high = float(np.quantile(spread.spread_mm[spread.spread_mm > 0], 0.99))
    return float(np.hypot(noise_mm, high / np.sqrt(cloud.scans)))
