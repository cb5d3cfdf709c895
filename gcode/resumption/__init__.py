"""From a job and a height to a job that goes on from there.

It makes text and has it checked; it knows no printer's port and no journal (`hosts.resume` goes on
with a job whose printer is still there).
"""

from gcode.resumption.resume_at import Resumption, resume_at
from gcode.resumption.touch import Touching, TouchOptions, plan_touch

__all__ = ["Resumption", "TouchOptions", "Touching", "plan_touch", "resume_at"]
