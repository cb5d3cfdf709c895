"""Deficit: watertight solids of what is missing and what is too much, in the build frame.

The room turns regions that detection found into solids, and makes the height field of what stands
on the bed. It does not decide what to print. `compute.compute_deficit` is the whole algorithm:
`boxes` says where solids are made, `voxels` samples distances there, `solids` makes closed meshes;
`heights`, `walls` and `line_heights` say what stands.
"""

from amrepair.deficit.compute import AsBuilt, Deficit, Standing, compute_deficit, measured_regions
from amrepair.deficit.heights import (
    as_built_heights,
    heights_beside,
    with_others,
    with_what_stands_out,
)
from amrepair.deficit.line_heights import lines_beside, standing_in_job

__all__ = [
    "AsBuilt",
    "Deficit",
    "Standing",
    "as_built_heights",
    "compute_deficit",
    "heights_beside",
    "lines_beside",
    "measured_regions",
    "standing_in_job",
    "with_others",
    "with_what_stands_out",
]
