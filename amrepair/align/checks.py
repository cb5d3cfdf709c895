"""What no alignment can be made from, whatever the method."""

from __future__ import annotations

import numpy as np

from amrepair.errors import AlignmentError
from amrepair.scans import Scan

LOOK_AT = 5_000  # repeats of a few places show in a sample
ALONG = np.array([1.0, np.sqrt(2.0), np.sqrt(3.0)])  # places that differ along it differ


def refuse_repeated(scan: Scan, least: int) -> None:
    """Refuse a scan that says the same few places again and again.

    Raises
    ------
    AlignmentError
        If there are fewer different points than `least`.
    """
    step = max(1, len(scan) // LOOK_AT)
    if len(np.unique(scan.points_mm[::step] @ ALONG)) >= least:
        return
    different = len(np.unique(scan.points_mm, axis=0))
    if different < least:
        raise AlignmentError(
            f"the scan {scan.source} has only {different} different points among {len(scan)}; an "
            f"alignment needs {least}; check the export"
        )
