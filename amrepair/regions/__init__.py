"""Regions: where a scan deviates from its template by more than it may, told by a test.

The room says what differs and how sure that is, not what to do about it. `detection.detect` is the
whole algorithm, and calls the other modules in this order:

- `observation` measures the scan against the template, `inspected` lists the places to test;
- `systematic` takes out what belongs to the whole part or to whole views;
- `significance` tests local means, with the scanner's errors as the scan itself or a calibration
  tells them (`error_calibration`);
- `labels` grows regions from what is significant, and `regions` measures them.
"""

from amrepair.regions.anomaly import AnomalyMap, DefectType, Label, Region
from amrepair.regions.detection import detect

__all__ = ["AnomalyMap", "DefectType", "Label", "Region", "detect"]
