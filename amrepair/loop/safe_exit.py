"""A run's way out: heaters are told to switch off whatever ended it, and what came of it is said.

It knows ports only. What cannot be reached is said loudly: nobody may take a hot printer for cold.
"""

from __future__ import annotations

import logging

from gcode.errors import GcodeError
from gcode.hosts.file import FilePrinter
from gcode.hosts.port import MakesSafe, Printer

_log = logging.getLogger(__name__)


def leave_safe(printer: Printer) -> None:
    """Heaters off, and on a cable the nozzle up, whatever is under way; never raises of it."""
    try:
        if isinstance(printer, MakesSafe):
            printer.make_safe()  # it waits for no heater that is under way, and says what came
        else:
            printer.heaters_off()
            _tell_heaters(printer)
    except (GcodeError, OSError) as error:
        _log.warning("printer: HEATERS COULD NOT BE REACHED (%s): switch the printer off", error)


def cool(printer: Printer) -> None:
    """Heaters off at rest, acknowledged; where that fails, by any means left."""
    try:
        printer.heaters_off()
        _tell_heaters(printer)
    except (GcodeError, OSError):
        leave_safe(printer)


def _tell_heaters(printer: Printer) -> None:
    """What the printer says of heaters that were told to switch off; some are meant to stay on."""
    if isinstance(printer, FilePrinter):
        return
    if set_c := printer.temperatures().set_c:
        on = " and ".join(f"{c:g} °C" for c in set_c)
        _log.warning("printer: heaters are NOT off: the printer says that they are set to %s", on)
    else:
        _log.warning("printer: heaters off (the printer reports targets of 0)")
