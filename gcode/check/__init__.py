"""Check: the judge. It reads final text with a parser of its own and knows profile and part alone.

It shares no code with slicing, writer and reader, so that their mistakes are not its own. Only
`check` makes a `CheckedProgram`, and only that may be printed.
"""

from gcode.check.checker import check, find_refusals
from gcode.check.findings import Refusal
from gcode.check.proof import CheckedProgram, CheckReport

__all__ = ["CheckReport", "CheckedProgram", "Refusal", "check", "find_refusals"]
