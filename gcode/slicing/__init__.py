"""Slicing: from a solid, and what already stands there, to beads.

It makes moves, not text, and judges what the nozzle can reach, but never whether a program is safe:
that is the task of `check`. There are two slicers. `job.slice_part` slices a whole part layer by
layer. `patch.slice_patch` fills a deficit on a rough floor; its modules are named `patch_*`.
"""
