"""Scans: what a sensor measured, and the port through which it comes.

This room reads files and sensors into `Scan`; it does not align, clean or judge.
"""

from amrepair.scans.scan import Scan
from amrepair.scans.scanner import Scanner

__all__ = ["Scan", "Scanner"]
