"""From a job and a height to a job that goes on from there.

It makes text and has it checked; it knows no printer's port and no journal (`hosts.resume` goes on
with a job whose printer is still there).
"""

from gcode.resumption.resume_at import Resumption, resume_at

__all__ = ["Resumption", "resume_at"]
