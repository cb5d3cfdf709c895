"""Regions: where a scan departs from its template by more than it may, told by a test.

It says what differs and how sure that is, not what to do about it.
"""

from amrepair.regions.anomaly import AnomalyMap, DefectType, Label, Region
from amrepair.regions.detection import detect

__all__ = ["AnomalyMap", "DefectType", "Label", "Region", "detect"]
