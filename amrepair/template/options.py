"""What templates are read and fitted by: each number once."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class MeshOptions:
    """Which meshes are a part, and what of them is mended.

    Attributes
    ----------
    sew_ratio
        Of the extent: narrower cracks are closed, 0.01 mm on a part of 100 mm.
    least_part_mm
        A printer that prints smaller ones lays no beads.
    most_lid_edges
        A larger hole has a shape that we do not know.
    most_open_ratio
        More open edges than this share of all is a bag of polygons, not a surface with a hole.
    """

    sew_ratio: float = 1e-4
    least_part_mm: float = 1.0
    most_lid_edges: int = 32
    most_open_ratio: float = 0.05


@dataclass(frozen=True, slots=True)
class FitOptions:
    """The fast recipe: a grid of exact distances, finer where it bends.

    Attributes
    ----------
    cells
        Along the longest side, at least.
    stocky_ratio
        Long and flat parts have flat boxes: as many nodes as a part that fills this share of the
        cube over its longest side, in smaller cells.
    most_divided
        Times as many cells along that side.
    margin_ratio
        Of the longest side, around the part.
    exact_cells
        Nearer nodes are measured against every triangle.
    fine
        A cell that bends is divided into so many along each edge.
    samples, band_cells
        Places where the grid is compared, so far around the surface.
    held_out
        Places that its bias is told from.
    least_residual_mm
        Cells where the grid is better are left as they are.
    most_blocks
        60 MB; the worst cells go first.
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
        Under the last layer: so deep a defect is looked for.
    margin_mm
        Around the beads.
    below_beads_mm
        Below its lowest beads nothing is planned: the bed is there, or what was looked at before.
    least_voxel_mm, most_voxel_mm, most_voxels
        Edge of a voxel, and how many there may be: else they are larger.
    """

    depth_mm: float = 4.0
    margin_mm: float = 3.0
    below_beads_mm: float = 1.5
    least_voxel_mm: float = 0.1
    most_voxel_mm: float = 0.25
    most_voxels: int = 60_000_000


USUAL_MESH, USUAL_FIT, USUAL_PLANNED = MeshOptions(), FitOptions(), PlannedOptions()
