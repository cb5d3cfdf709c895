"""Detect: scores, thresholds, labels and regions. It says what differs, not what to do about it."""

from amrepair.detect.anomaly import AnomalyMap, DefectType, Label, Region
from amrepair.detect.detection import detect

__all__ = ["AnomalyMap", "DefectType", "Label", "Region", "detect"]
