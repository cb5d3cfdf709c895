"""The serial protocol of printers as a state machine: bytes in, events out.

No I/O, no clock, no threads (h11 is the model). `hosts` gives it a port and a clock.
"""

from gcode.protocol.dialects import LINK_DIALECTS, LinkDialect
from gcode.protocol.ledger import HISTORY_LINES
from gcode.protocol.lines import WireLine, WireLines, checksum, command_in
from gcode.protocol.link import PLAIN_OK, Link
from gcode.protocol.timing import LinkTiming
from gcode.protocol.transitions import State

__all__ = [
    "HISTORY_LINES",
    "LINK_DIALECTS",
    "PLAIN_OK",
    "Link",
    "LinkDialect",
    "LinkTiming",
    "State",
    "WireLine",
    "WireLines",
    "checksum",
    "command_in",
]
