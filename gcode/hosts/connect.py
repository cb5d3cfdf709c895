"""From a port's name on the command line to the printer behind it."""

from __future__ import annotations

from pathlib import Path

from gcode.errors import InputError
from gcode.hosts.file import FilePrinter
from gcode.hosts.journal import Journal
from gcode.hosts.port import Printer
from gcode.hosts.serial import SerialPrinter


def connect(
    port: str,
    *,
    dialect: str = "marlin",
    baud: int = 115200,
    wire_log: Path | None = None,
    journal: Path | None = None,
) -> Printer:
    """Return the printer that `port` names, not connected yet.

    Parameters
    ----------
    port
        A device path, `octoprint+http://…`, `moonraker+http://…` or `file:PATH`.

    Raises
    ------
    InputError
        If the name is none of these.

    Examples
    --------
    >>> from pathlib import Path
    >>> import gcode
    >>> job = gcode.Program(Path("job.gcode").read_text(), "prusa")
    >>> printer = gcode.connect("file:copy.gcode")  # or "/dev/ttyACM0"
    >>> printer.connect()
    >>> printer.print(gcode.check_program(job, gcode.load_setup())).ok
    True
    >>> printer.close()
    """
    if port.startswith("file:"):
        return FilePrinter(Path(port.removeprefix("file:")))
    if port.startswith(("octoprint+", "moonraker+")):
        raise InputError(
            f"{port!r} needs the OctoPrint or Moonraker adapter, which this version does not have "
            f"yet; use the printer's device path or file:PATH."
        )
    if "://" in port:
        raise InputError(
            f"{port!r} names no kind of printer; write a device path, octoprint+http://…, "
            f"moonraker+http://… or file:PATH."
        )
    return SerialPrinter(
        port,
        baud=baud,
        dialect=dialect,
        wire_log=wire_log,
        journal=Journal(journal) if journal is not None else None,
    )
