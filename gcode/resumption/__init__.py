"""From a job and what stands on the bed to a job that goes on, or begins, on top of it.

It makes text and has it checked; it knows no printer's port and no journal (`hosts.resume` goes on
with a job whose printer is still there).
"""

from gcode.resumption.print_onto import print_onto
from gcode.resumption.resume_at import Resumption, resume_at
from gcode.resumption.touch import Touching, plan_touch

__all__ = ["Resumption", "Touching", "plan_touch", "print_onto", "resume_at"]
