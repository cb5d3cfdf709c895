"""Commands that a firmware says it does not know: told, and the job's end where they matter."""

from __future__ import annotations

import re

from gcode.errors import PrinterError
from gcode.protocol import events as ev
from gcode.protocol.replies import parse_reply

_NEEDED = re.compile(
    r'command: ?"?(G0*(?:[0-3]|20|28|9[0-2])|M(?:82|83|104|109))(?![\d.])[^*]*$', re.IGNORECASE
)
"""A command that moves, says how words are meant, or melts, as it stood in the program: what has a
checksum in it is a line that lost its number, and is sent again."""


def fault_of(text: str) -> PrinterError | None:
    """What is wrong with a job one of whose commands was answered so; None: nothing that shows."""
    needed = _NEEDED.search(text)
    if needed is None:
        return None
    return PrinterError(
        f"The printer's firmware does not know {needed.group(1)} ({text}): what follows it would "
        f"be printed wrong."
    )


class UnknownCommands:
    """What the printer behind a server has answered so while a print was followed.

    Attributes
    ----------
    told
        Each answer once, in order.
    fault
        Of the first that ends the job.
    """

    def __init__(self) -> None:
        self.told: dict[str, None] = {}
        self.fault: PrinterError | None = None

    def hear(self, line: str) -> None:
        """Take a line of the printer's."""
        reply = parse_reply(line.encode("latin-1", "replace"))
        if isinstance(reply, ev.UnknownCommand):
            self.told[reply.text] = None
            self.fault = self.fault or fault_of(reply.text)
