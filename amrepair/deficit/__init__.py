"""Deficit: watertight solids of what is missing and what is too much, in the build frame.

It turns a detected difference into geometry with a tolerance; it does not decide what to print.
"""

from amrepair.deficit.compute import AsBuilt, Deficit, Standing, compute_deficit, measured_regions
from amrepair.deficit.heights import as_built_heights, with_others, with_what_stands_out
from amrepair.deficit.line_heights import standing_in_job

__all__ = [
    "AsBuilt",
    "Deficit",
    "Standing",
    "as_built_heights",
    "compute_deficit",
    "measured_regions",
    "standing_in_job",
    "with_others",
    "with_what_stands_out",
]
