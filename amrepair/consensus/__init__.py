"""Consensus: one template from several normal scans, and how far they disagree about it.

It places scans on each other, fuses them, and hands the closed surface to `template` to be fitted.
It judges no scan for defects.
"""

from amrepair.consensus.fit import ScanFit, fit_from_scans

__all__ = ["ScanFit", "fit_from_scans"]
