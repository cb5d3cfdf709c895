"""Check: the judge. It reads final text with a parser of its own and knows profile and part alone.

It shares no code with slicing, writer and reader, so that their mistakes are not its own. What a
bead stands as it asks of `surfaces`, as the planner does: two guesses of one thing would differ.
Only `check` makes a `CheckedProgram`, and only that may be printed.
"""

from gcode.check.checker import check, find_refusals, judge, policy_of
from gcode.check.findings import Policy, Refusal, Touch
from gcode.check.hanging import JobBridges
from gcode.check.proof import CheckedProgram, CheckReport

__all__ = [
    "CheckReport",
    "CheckedProgram",
    "JobBridges",
    "Policy",
    "Refusal",
    "Touch",
    "check",
    "find_refusals",
    "judge",
    "policy_of",
]
