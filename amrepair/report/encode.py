"""Arrays made small enough to live inside a page: thinning, quantising, base64.

Nothing here knows what an array means; every step is deterministic and says what it kept.
"""

from __future__ import annotations

import base64
from collections.abc import Sequence

import manifold3d
import numpy as np
import trimesh
from jaxtyping import Int
from scipy.spatial import cKDTree

from amrepair.align.thinning_kernels import morton_keys
from amrepair.arrays import Numbers, Points
from amrepair.field.groups import cell_numbers
from amrepair.frames import cells_of
from amrepair.report.data import SolidMesh
from amrepair.report.options import DEFAULT_PAGE

SHADE_LEVELS = 16
# Head-high light from where the first view looks, as drawings have it.
LIGHT = np.array([0.42, 0.54, 0.73])
# Where nobody knows which side is out, the side towards the light is drawn: as bright as a
# look with normals shows it from the first view.
UNORIENTED_SHADE = 0.5 * np.array([1.0, 0.42, 0.54, 0.73])
MORTON_BITS = 16

Encoded = dict[str, object]


def quantised(values: np.ndarray) -> Encoded:
    """An array of reals as unsigned integers of 16 bits with an offset and a scale per column.

    The error is at most half a step, extent / (2¹⁶ − 1) / 2: 1.9 µm over 250 mm.
    """
    columns = np.asarray(values, dtype=np.float64)
    columns = columns.reshape(len(columns), -1) if columns.size else columns.reshape(0, 1)
    low = columns.min(axis=0) if len(columns) else np.zeros(columns.shape[1])
    high = columns.max(axis=0) if len(columns) else np.zeros(columns.shape[1])
    step = np.where(high > low, (high - low) / (2**16 - 1), 1.0)
    whole = np.rint((columns - low) / step)
    return _packed(
        whole.astype("<u2"),
        offset=[float(f"{value:.9g}") for value in low],
        scale=[float(f"{value:.9g}") for value in step],
    )


def integers(values: np.ndarray) -> Encoded:
    """An array of non-negative integers in the narrowest type that holds them."""
    array = np.asarray(values)
    highest = int(array.max()) if array.size else 0
    kind = "|u1" if highest < 2**8 else "<u2" if highest < 2**16 else "<u4"
    return _packed(array.astype(kind))


def thinned(points_mm: Points, important: np.ndarray, *, budget: int) -> Int[np.ndarray, " k"]:
    """Indices of at most `budget` points: the important ones first, the rest evenly in space.

    Points are put in Morton order and every so-manieth is taken, which keeps the cloud's own
    relative density and needs no random numbers.
    """
    count = len(points_mm)
    if count <= budget:
        return np.arange(count)
    order = _morton_order(points_mm)
    first = order[important[order]]
    rest = order[~important[order]]
    room_for_first = min(len(first), max(budget // 2, budget - len(rest)))
    chosen = np.concatenate(
        [_every(first, room_for_first), _every(rest, min(len(rest), budget - room_for_first))]
    )
    return np.sort(chosen)


def shading(points_mm: Points, normals: Points | None, side: tuple[int, int] = (-1, -1)) -> Numbers:
    """(n,) brightness 0..15 of each point under a fixed light, so that a cloud shows its form.

    Parameters
    ----------
    side
        Signs of X and Y of the corner that the light stands at.
    """
    if len(points_mm) < DEFAULT_PAGE.shading_neighbours:
        return np.full(len(points_mm), SHADE_LEVELS - 1)
    if normals is None:
        neighbours = cKDTree(points_mm).query(points_mm, k=DEFAULT_PAGE.shading_neighbours)[1]
        around = points_mm[neighbours] - points_mm[neighbours].mean(axis=1, keepdims=True)
        axes = np.linalg.eigh(np.einsum("nki,nkj->nij", around, around))[1][:, :, 0]
        # which side is out is not known, so the two sides of a face must look the same
        brightness = UNORIENTED_SHADE[0] + np.abs(axes) @ UNORIENTED_SHADE[1:]
    else:
        light = LIGHT * (*side, 1) / np.linalg.norm(LIGHT)
        brightness = 0.5 + 0.5 * (normals @ light)
    return np.rint(np.clip(brightness, 0.0, 1.0) * (SHADE_LEVELS - 1)).astype(np.int64)


def simplified(mesh: SolidMesh, *, budget: int) -> SolidMesh:
    """A mesh of at most about `budget` faces; exact surfaces first, a grid as the last resort."""
    solid = manifold3d.Manifold(
        manifold3d.Mesh(
            vert_properties=np.ascontiguousarray(mesh.vertices_mm, dtype=np.float32),
            tri_verts=np.ascontiguousarray(mesh.faces, dtype=np.uint32),
        )
    )
    if solid.status() == manifold3d.Error.NoError and not solid.is_empty():
        tolerance_mm = DEFAULT_PAGE.simplify_mm
        for _ in range(DEFAULT_PAGE.simplify_steps):
            reduced = solid.simplify(tolerance_mm)
            if reduced.num_tri() <= budget and not reduced.is_empty():
                out = reduced.to_mesh()
                return SolidMesh(
                    np.asarray(out.vert_properties[:, :3], dtype=np.float64),
                    np.asarray(out.tri_verts, dtype=np.int64),
                )
            tolerance_mm *= 2
    return mesh if len(mesh.faces) <= budget else _clustered(mesh, budget)


def feature_edges(mesh: SolidMesh, *, budget: int) -> Int[np.ndarray, "e 2"]:
    """(e, 2) vertex pairs where two faces meet at an angle; none if they exceed `budget`."""
    drawn = trimesh.Trimesh(mesh.vertices_mm, mesh.faces, process=False)
    drawn.update_faces(drawn.area_faces > 0.0)
    angles_rad = np.asarray(drawn.face_adjacency_angles)
    sharp = np.asarray(drawn.face_adjacency_edges)[
        angles_rad > np.deg2rad(DEFAULT_PAGE.feature_deg)
    ]
    return sharp if len(sharp) <= budget else sharp[:0]


def _packed(array: np.ndarray, **extra: Sequence[float]) -> Encoded:
    return {
        "type": array.dtype.str[1:],
        "shape": list(array.shape),
        **extra,
        "data": base64.b64encode(np.ascontiguousarray(array).tobytes()).decode("ascii"),
    }


def _every(indices: np.ndarray, count: int) -> np.ndarray:
    """`count` of the indices, evenly spread, in order."""
    if count <= 0 or len(indices) == 0:
        return indices[:0]
    return indices[(np.arange(count) * len(indices)) // count]


def _morton_order(points_mm: np.ndarray) -> np.ndarray:
    """Order along the Z-curve: neighbours in space are near each other in the order."""
    low = points_mm.min(axis=0)
    extent_mm = max(float((points_mm.max(axis=0) - low).max()), 1e-9)
    edge_mm = extent_mm / (2**MORTON_BITS - 1)
    return np.argsort(morton_keys(points_mm, low, edge_mm, MORTON_BITS), kind="stable")


def _clustered(mesh: SolidMesh, budget: int) -> SolidMesh:
    """Vertices merged on a grid that grows until the faces fit; faces that collapse vanish."""
    low = mesh.vertices_mm.min(axis=0)
    extent_mm = float((mesh.vertices_mm.max(axis=0) - low).max())
    cell_mm = extent_mm / 512
    while True:
        group = cell_numbers(cells_of(mesh.vertices_mm, low, max(cell_mm, 1e-9)))
        faces = group[mesh.faces]
        alive = (
            (faces[:, 0] != faces[:, 1])
            & (faces[:, 1] != faces[:, 2])
            & (faces[:, 2] != faces[:, 0])
        )
        if alive.sum() <= budget:
            break
        cell_mm *= 1.25
    total = np.zeros((group.max() + 1, 3))
    np.add.at(total, group, mesh.vertices_mm)
    return SolidMesh(total / np.bincount(group)[:, None], faces[alive].astype(np.int64))
