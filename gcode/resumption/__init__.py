"""From a job and what stands on the bed to a job that goes on, or begins, on top of it.

It makes text and has it checked; it knows no printer's port and no journal (`hosts.resume` goes on
with a job whose printer is still there).
"""

from gcode.resumption.print_onto import Stacked, print_onto
from gcode.resumption.rest import Rest, rest_without, without_beads
from gcode.resumption.resume_at import Resumption, resume_at
from gcode.resumption.touch import Touching, TouchOptions, plan_touch

__all__ = [
    "Rest",
    "Resumption",
    "Stacked",
    "TouchOptions",
    "Touching",
    "plan_touch",
    "print_onto",
    "rest_without",
    "resume_at",
    "without_beads",
]
