"""Merge: scans of one part into one pose graph and one field, and what no scan saw of it.

It measures the scans' noise, places them on each other, fuses them, and hands the closed surface to
`template` to be fitted. It judges no scan for defects.
"""

from amrepair.merge.fit import ScanFit, fit_from_scans
from amrepair.merge.open_mesh import fit_mesh
from amrepair.merge.sound_scans import SoundFit, learn_from_scans

__all__ = ["ScanFit", "SoundFit", "fit_from_scans", "fit_mesh", "learn_from_scans"]
