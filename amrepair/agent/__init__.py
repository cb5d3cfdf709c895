"""What an agent beside a print server says and is asked: macros, messages, questions, its unit.

It serves a print that the server's own printer has begun; the run itself is `loop`'s, and the
printer is a port of `gcode.hosts`. What is put into a job for it is `postprocess`'s; what sits in
OctoPrint itself is `octoprint`.
"""

from amrepair.agent.shipped import MACROS, shipped

__all__ = ["MACROS",
           "shipped"]  # fmt: skip
