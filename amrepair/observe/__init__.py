"""Observe: from a placed scan to deviations and rays, and what of them is the whole part's.

It says nothing about defects. It measures along rays and normals and tells background from part;
residual pose, scale, bow and offsets between views are fitted, told and taken out here. What is
left is for the rooms above to judge.
"""

from amrepair.observe.nuisance import Nuisance, fit_nuisance

__all__ = ["Nuisance", "fit_nuisance"]
