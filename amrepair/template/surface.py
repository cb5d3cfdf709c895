"""Points spread evenly over a triangle mesh, deterministically.

It samples; it does not know where the mesh came from.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float, Int

if TYPE_CHECKING:
    import trimesh

# R2 low-discrepancy sequence (Roberts 2018): powers of the plastic number's inverse.
_PLASTIC = 1.32471795724474602596
_R2 = np.array([1.0 / _PLASTIC, 1.0 / _PLASTIC**2])


def triangle_areas_normals(
    vertices_mm: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]
) -> tuple[Float[np.ndarray, " f"], Float[np.ndarray, "f 3"]]:
    """(f,) areas in mm² and (f, 3) unit normals (zero where a triangle has no area)."""
    corners = vertices_mm[faces]
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    norm = np.linalg.norm(cross, axis=1)
    return 0.5 * norm, cross / np.maximum(norm, 1e-300)[:, None]


def sample_surface(
    vertices_mm: Float[np.ndarray, "v 3"],
    faces: Int[np.ndarray, "f 3"],
    *,
    count: int,
    offset: float = 0.5,
) -> tuple[Float[np.ndarray, "m 3"], Float[np.ndarray, "m 3"], Int[np.ndarray, " m"]]:
    """Spread `count` points over a mesh, each standing for the same area.

    Parameters
    ----------
    offset
        Start of the low-discrepancy sequence; another value gives other points.

    Returns
    -------
    (m, 3) points in mm, (m, 3) unit normals of their triangles, (m,) triangle indices.
    """
    areas, normals = triangle_areas_normals(vertices_mm, faces)
    cumulative = np.cumsum(areas)
    shift = offset % 1.0
    targets = (np.arange(count) + shift) * (cumulative[-1] / count)
    triangle = np.minimum(np.searchsorted(cumulative, targets, side="right"), len(faces) - 1)
    uv = (shift + np.arange(1, count + 1)[:, None] * _R2) % 1.0
    root = np.sqrt(uv[:, :1])
    corners = vertices_mm[faces[triangle]]
    points = (
        (1.0 - root) * corners[:, 0]
        + root * (1.0 - uv[:, 1:]) * corners[:, 1]
        + root * uv[:, 1:] * corners[:, 2]
    )
    return points, normals[triangle], triangle.astype(np.int64)


def count_for_spacing(areas_mm2: Float[np.ndarray, " f"], spacing_mm: float) -> int:
    """How many points stand about `spacing_mm` apart on that area."""
    return max(1, int(np.ceil(float(areas_mm2.sum()) / spacing_mm**2)))


def mesh_points(
    mesh: trimesh.Trimesh, spacing_mm: float
) -> tuple[Float[np.ndarray, "m 3"], Float[np.ndarray, "m 3"]]:
    """(m, 3) points of a mesh, each for spacing² of its area, and (m, 3) face normals."""
    vertices, faces = np.asarray(mesh.vertices), np.asarray(mesh.faces)
    areas, _ = triangle_areas_normals(vertices, faces)
    points, normals, _ = sample_surface(vertices, faces, count=count_for_spacing(areas, spacing_mm))
    return points, normals
