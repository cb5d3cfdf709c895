"""Reader: what slicers write, as layers, beads and the machine's state after any line.

It understands Marlin-style text with arcs, relative and absolute modes, G92, inches, and the
comments of PrusaSlicer, SuperSlicer, OrcaSlicer, Bambu Studio, Cura and ideaMaker. It judges
nothing; `check` does, with a parser of its own.
"""

from gcode.reader.job import Beads, Job, Turn, job_for, read_job
from gcode.reader.objects import JobObjects, objects_of

__all__ = ["Beads", "Job", "JobObjects", "Turn", "job_for", "objects_of", "read_job"]
