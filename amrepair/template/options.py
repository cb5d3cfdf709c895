"""Options of reading and fitting templates: each number once."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class MeshOptions:
    """Which meshes are accepted as a part, and what of them is repaired.

    Attributes
    ----------
    sew_ratio
        Cracks narrower than this share of the part's extent are closed: 0.01 mm on 100 mm.
    least_part_mm
        A smaller part is refused: no printer lays beads so small.
    most_lid_edges
        A hole with more edges than this is not closed, since nobody knows its shape.
    most_open_ratio
        A mesh of which more than this share of all edges is open is a bag of polygons rather than a
        surface with a hole.
    """

    sew_ratio: float = 1e-4
    least_part_mm: float = 1.0
    most_lid_edges: int = 32
    most_open_ratio: float = 0.05


@dataclass(frozen=True, slots=True)
class FitOptions:
    """The fast recipe: a grid of exact distances, finer where the surface bends.

    Attributes
    ----------
    cells
        The least number of cells along the part's longest side.
    stocky_ratio, most_divided
        Long and flat parts have flat boxes, and get smaller cells: until the grid has as many nodes
        as that of a part which fills this share of the cube over its longest side, but at most
        `most_divided` times as many cells along that side.
    margin_ratio
        Margin around the part, as a share of its longest side.
    exact_cells
        Nodes nearer to the surface than this many cells get their exact distance to all triangles.
    fine
        A cell in which the surface bends is divided into this many along each edge.
    samples, band_cells
        At how many places the grid is compared with exact distances, and how far around the
        surface, in cells.
    held_out
        The number of further places from which its bias is estimated.
    least_residual_mm
        Cells in which the grid is off by less are not divided.
    most_blocks
        The largest number of divided cells (60 MB); the worst cells are divided first.
    """

    cells: int = 128
    stocky_ratio: float = 0.5
    most_divided: float = 4.0
    margin_ratio: float = 6.0 / 128.0
    exact_cells: float = 2.0
    fine: int = 4
    samples: int = 300_000
    band_cells: float = 1.0
    held_out: int = 40_000
    least_residual_mm: float = 0.008
    most_blocks: int = 120_000


@dataclass(frozen=True, slots=True)
class PlannedOptions:
    """A template of what a job has laid so far.

    Attributes
    ----------
    depth_mm
        How deep below the last layer beads are held, and so defects are looked for.
    margin_mm
        Margin around the beads.
    below_beads_mm
        How far the grid reaches below the lowest beads. Nothing is planned there: it is the bed, or
        was looked at before.
    least_voxel_mm, most_voxel_mm, most_voxels
        Limits of a voxel's edge, and the largest number of voxels; a larger grid is refused.
    """

    depth_mm: float = 4.0
    margin_mm: float = 3.0
    below_beads_mm: float = 1.5
    least_voxel_mm: float = 0.1
    most_voxel_mm: float = 0.25
    most_voxels: int = 60_000_000


DEFAULT_MESH, DEFAULT_FIT, DEFAULT_PLANNED = MeshOptions(), FitOptions(), PlannedOptions()
