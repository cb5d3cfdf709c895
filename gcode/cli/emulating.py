"""The command `gcode emulate`."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Annotated

import typer

from gcode.cli import console
from gcode.cli.options import plain_text
from gcode.errors import InputError
from gcode.profiles import DEFAULT_PRINTER


@console.command(
    "emulate",
    "gcode emulate",
    "gcode emulate --firmware klipper --printer voron_2_4 --link /tmp/printer --accelerated",
    "gcode emulate --faults faults.txt --link /tmp/printer",
)
def emulate(
    firmware: Annotated[
        str | None,
        typer.Option(
            help="marlin, prusa, klipper or reprap. Left out: that of --printer; marlin without.",
        ),
    ] = None,
    printer: Annotated[
        str | None,
        typer.Option(
            help=f"Printer profile: an ID or a TOML file. Left out: {DEFAULT_PRINTER}.",
            autocompletion=console.profile_ids("printers"),
        ),
    ] = None,
    faults: Annotated[
        Path | None,
        typer.Option(help="Fault script, such as 'every 37 corrupt_in'; one fault a line."),
    ] = None,
    link: Annotated[Path | None, typer.Option(help="Name for the pseudo-terminal.")] = None,
    accelerated: Annotated[bool, typer.Option(help="Let the printer's clock jump.")] = False,
    motion: Annotated[
        Path | None,
        typer.Option(
            help="File that executed moves are appended to as they happen, nine float64 each: "
            "start and end, mm, filament, mm, speed, mm/s, the printer's clock, s; "
            "'amrepair loop --scanner simulated:FILE' looks at what they print."
        ),
    ] = None,
) -> None:
    """Emulate a printer: prints the pseudo-terminal's path and serves until interrupted."""
    from gcode.firmware import serve_forever
    from gcode.firmware.faults import parse_faults
    from gcode.firmware.variants import FIRMWARES
    from gcode.profiles import load_printer

    machine = load_printer(printer or DEFAULT_PRINTER)
    firmware = firmware or ("marlin" if printer is None else machine.dialect)
    if firmware not in FIRMWARES:
        raise InputError(f"--firmware is {firmware!r}; it is one of {', '.join(FIRMWARES)}.")
    script = parse_faults(plain_text(faults)) if faults is not None else None
    with tempfile.TemporaryDirectory(prefix="gcode-emulate-") as folder:
        serve_forever(
            machine,
            firmware=firmware,
            faults=script,
            link=link or Path(folder) / "ttyEMU0",
            accelerated=accelerated,
            motion=motion,
            on_port=typer.echo,
        )
