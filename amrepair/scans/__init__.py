"""Scans: what a sensor measured, and the port through which it comes.

This room reads files and sensors into `Scan`; it does not align, clean or judge.
"""

from amrepair.scans.files import WatchedFolderScanner
from amrepair.scans.ply import write_ply
from amrepair.scans.range_grid import EDGE, FLYING, RangeGrid
from amrepair.scans.readers import read_scan
from amrepair.scans.scan import Scan
from amrepair.scans.scanner import PROBE, Scanner, ScanRequest

__all__ = [
    "EDGE",
    "FLYING",
    "PROBE",
    "RangeGrid",
    "Scan",
    "ScanRequest",
    "Scanner",
    "WatchedFolderScanner",
    "read_scan",
    "write_ply",
]
