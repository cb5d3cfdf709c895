"""From a port's name on the command line to the printer behind it."""

from __future__ import annotations

import sys
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
    window: int = 1,
    wire_log: Path | None = None,
    journal: Path | None = None,
) -> Printer:
    """Return the printer that `port` names, not connected yet.

    Parameters
    ----------
    port
        A device path, `octoprint+http://…`, `moonraker+http://…` or `file:PATH`. The servers'
        API keys come from the environment or the keys file (`secret`), never with the name.
    window
        Lines under way at once on a device; more than 1 only for firmware that buffers them and
        numbers its answers (ADVANCED_OK).

    Raises
    ------
    InputError
        If the name is none of these, or carries a secret.

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
        if journal is not None:
            raise InputError(
                f"A journal belongs to a serial port; {port.partition('+')[0]} keeps its own "
                f"state: leave --journal out."
            )
        return _web_printer(port, wire_log)
    if "://" in port:
        raise InputError(
            f"{port!r} names no kind of printer; write a device path, octoprint+http://…, "
            f"moonraker+http://… or file:PATH."
        )
    if sys.platform == "win32":
        raise InputError(
            f"{port!r} is a printer on a cable, which takes Linux or macOS (on Windows: WSL); "
            "print through octoprint+http://… or moonraker+http://…, or write file:PATH."
        )
    return SerialPrinter(
        port,
        baud=baud,
        window=window,
        dialect=dialect,
        wire_log=wire_log,
        journal=Journal(journal) if journal is not None else None,
    )


def _web_printer(port: str, wire_log: Path | None) -> Printer:
    # The web's libraries are loaded here, since a printer on a cable needs none of them.
    from gcode.hosts.secret import find_key
    from gcode.hosts.web import Address

    address = Address.parse(port)
    key = find_key(address.kind, address.spec)
    if address.kind == "octoprint":
        from gcode.hosts.octoprint import OctoPrintPrinter

        return OctoPrintPrinter(address, key, wire_log=wire_log)
    from gcode.hosts.moonraker import MoonrakerPrinter

    return MoonrakerPrinter(address, key, wire_log=wire_log)
