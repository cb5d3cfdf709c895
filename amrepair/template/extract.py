"""Level sets of a template as closed meshes, evaluating only the cells that the surface crosses.

A distance field changes by at most its argument's step (Lipschitz 1), so a block whose centre
lies farther from the level than its half diagonal holds none of it and is never looked into.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import trimesh
from jaxtyping import Float

from amrepair.arrays import Faces, Vector, Vertices
from amrepair.errors import TemplateError
from amrepair.frames import grid_points
from gcode.solids import as_manifold, is_valid

if TYPE_CHECKING:
    from amrepair.template.port import Template

# Fine cells along the edge of a coarse block: few empty blocks, few half-empty ones.
BLOCK_CELLS = 8
BLOCKS_AT_ONCE = 1_000  # what fits into a processor's cache
# Learned fields are Lipschitz 1 only nearly; the band is wider by this factor.
BAND_SAFETY = 1.25
MAX_EXTRACTED_CELLS = 400_000_000
LEAST_VOXELS = 1e-3  # far below what the field is good to


def extract_mesh(template: Template, voxel_mm: float, *, level_mm: float = 0.0) -> trimesh.Trimesh:
    """The surface f = level as a closed triangle mesh, template frame.

    Parameters
    ----------
    voxel_mm
        Edge of a grid cell.
    level_mm
        Offset of the surface; positive is outside the part.

    Raises
    ------
    TemplateError
        If the voxel is not positive, the grid would be too large, the level set is empty, or not
        a closed solid.

    References
    ----------
    Lorensen and Cline, *Marching Cubes*, SIGGRAPH 1987 (scikit-image's `marching_cubes`).
    """
    field, low_mm = band_field(template, voxel_mm, level_mm=level_mm)
    if not (field.min() < 0.0 < field.max()):
        raise TemplateError(
            f"the template has no surface at level {level_mm} mm; choose a level nearer to 0"
        )
    vertices, faces = zero_level(field, voxel_mm)
    vertices = vertices + low_mm
    if not is_valid(as_manifold(vertices, faces)):
        raise TemplateError(
            f"the surface at level {level_mm} mm with a voxel of {voxel_mm} mm is no closed solid; "
            "choose another voxel"
        )
    return trimesh.Trimesh(vertices, faces, process=False)


def zero_level(field: Float[np.ndarray, "nx ny nz"], voxel_mm: float) -> tuple[Vertices, Faces]:
    """Vertices about the first node, mm, and faces of f = 0, closed within the field.

    Where a node lies on the surface the triangles around it shrink to nothing and are lost, and
    the surface is open; so nodes nearer than `LEAST_VOXELS` are moved off it, in place.
    """
    from skimage.measure import marching_cubes

    least = np.float32(LEAST_VOXELS * voxel_mm)
    flat = field.reshape(-1)
    on = np.flatnonzero(np.abs(flat) < least)
    flat[on] = np.where(flat[on] < 0, -least, least)
    vertices, faces, _, _ = marching_cubes(  # type: ignore[no-untyped-call]
        field, 0.0, spacing=(voxel_mm,) * 3
    )
    return np.asarray(vertices, dtype=np.float64), np.asarray(faces, dtype=np.int64)


def band_field(
    template: Template, voxel_mm: float, *, level_mm: float
) -> tuple[Float[np.ndarray, "nx ny nz"], Vector]:
    """(nx, ny, nz) float32 of f − level, exact in the band, of the right sign elsewhere.

    The outermost nodes are outside, whatever the template says.
    """
    if not 0 < voxel_mm < np.inf:
        raise TemplateError(f"the voxel is {voxel_mm} mm; it must be above 0")
    if not np.isfinite(level_mm):
        raise TemplateError(f"the level is {level_mm} mm; it must be a number")
    margin_mm = max(level_mm, 0.0) + 2.0 * voxel_mm
    bounds_mm = template.bounds_mm
    low_mm = bounds_mm[0] - margin_mm
    blocks = np.ceil((bounds_mm[1] + margin_mm - low_mm) / (BLOCK_CELLS * voxel_mm)).astype(int)
    shape = tuple(int(n) for n in blocks * BLOCK_CELLS)
    if np.prod([float(n) for n in shape]) > MAX_EXTRACTED_CELLS:
        raise TemplateError(
            f"a voxel of {voxel_mm} mm needs {shape[0]}×{shape[1]}×{shape[2]} cells, the limit is "
            f"{MAX_EXTRACTED_CELLS:,}; choose a larger voxel"
        )
    edge_mm = BLOCK_CELLS * voxel_mm
    block_index = grid_points(*map(np.arange, blocks))
    centre = template.distance(low_mm + (block_index + 0.5) * edge_mm - 0.5 * voxel_mm) - level_mm
    far = np.copysign(np.float32(edge_mm), centre).astype(np.float32).reshape(blocks)
    field = np.empty(shape, dtype=np.float32)
    # The cells of block (i, j, k) are at [i, :, j, :, k, :].
    cells = field.reshape([n for count in blocks for n in (int(count), BLOCK_CELLS)])
    cells[:] = far[:, None, :, None, :, None]
    near = block_index[np.abs(centre) <= BAND_SAFETY * 0.5 * np.sqrt(3.0) * edge_mm]
    inner = grid_points(*[np.arange(BLOCK_CELLS)] * 3)
    inner_mm = low_mm + inner * voxel_mm
    for first in range(0, len(near), BLOCKS_AT_ONCE):
        some = near[first : first + BLOCKS_AT_ONCE]
        nodes_mm = (some * edge_mm)[:, None, :] + inner_mm
        values = template.distance(nodes_mm.reshape(-1, 3)) - level_mm
        i, j, k = some.T
        cells[i, :, j, :, k, :] = values.reshape(-1, *[BLOCK_CELLS] * 3)
    for face in (field[0], field[-1], field[:, 0], field[:, -1], field[:, :, 0], field[:, :, -1]):
        # An undertrained network can have its zero level beyond the part's box.
        np.maximum(face, np.float32(voxel_mm), out=face)
    return field, low_mm
