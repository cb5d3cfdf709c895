"""Points spread evenly over a triangle mesh, deterministically.

It samples; it does not know where the mesh came from.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float, Int

from amrepair.arrays import Faces, Vertices
from amrepair.template import surface_kernels as kernels
from gcode.compiled import read_only

if TYPE_CHECKING:
    import trimesh

# R2 low-discrepancy sequence (Roberts 2018): powers of the plastic number's inverse.
_PLASTIC = 1.32471795724474602596
_R2 = np.array([1.0 / _PLASTIC, 1.0 / _PLASTIC**2])


def triangle_areas_normals(
    vertices_mm: Vertices, faces: Faces
) -> tuple[Float[np.ndarray, " f"], Float[np.ndarray, "f 3"]]:
    """(f,) areas in mm² and (f, 3) unit normals (zero where a triangle has no area)."""
    return kernels.areas_normals(*_for_kernels(vertices_mm, faces))


def sample_surface(
    vertices_mm: Vertices, faces: Faces, *, count: int, offset: float = 0.5
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
    mesh = _for_kernels(vertices_mm, faces)
    areas, normals = kernels.areas_normals(*mesh)
    points, triangle = kernels.spread_over(*mesh, np.cumsum(areas), offset % 1.0, _R2, count)
    return points, normals[triangle], triangle


def _for_kernels(vertices_mm: Vertices, faces: Faces) -> tuple[Vertices, Faces]:
    """The same in one type, so that each kernel is compiled once."""
    return read_only(vertices_mm, np.float64), read_only(faces, np.int64)


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
