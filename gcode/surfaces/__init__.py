"""Height fields of what already stands on the bed: readers and queries.

A height field answers "how high is the part here?" for the slicer (floor of a defect), the
checker (nozzle body against the part) and the writer (Z-hop). It does not know why it stands so.
"""

from gcode.surfaces.heightfield import HeightField

__all__ = ["HeightField"]
