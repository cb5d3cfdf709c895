"""The child process of `EmulatedPrinterProcess`: one emulated printer, told by its parent."""

from __future__ import annotations

import json
import os
import socket
import sys
from collections.abc import Callable
from pathlib import Path

from gcode.firmware.core import FirmwareCore
from gcode.firmware.faults import parse_faults
from gcode.firmware.serve import FRAME, PtyServer
from gcode.profiles import PrinterProfile


def _recorder(path: str) -> Callable[[bytes], None]:
    """Append commands to a file at once: what is written survives a kill."""
    fd = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o644)

    def record(command: bytes) -> None:
        os.write(fd, command + b"\n")

    return record


def main() -> None:
    """Child of `EmulatedPrinterProcess`: options as JSON on standard input."""
    options = json.loads(sys.stdin.buffer.readline())
    control = socket.socket(fileno=options["control_fd"])
    record = _recorder(options["record"]) if options["record"] else None
    core = FirmwareCore(
        PrinterProfile.model_validate(options["printer"]),
        options["firmware"],
        faults=parse_faults(options["faults"]),
        accelerated=options["accelerated"],
        seed=options["seed"],
        record=record,
    )
    if options["advanced_ok"]:
        core.enable_advanced_ok()
    core.machine.dead_probe = options["dead_probe"]
    if options["standing"]:
        from gcode.surfaces import HeightField

        surface = HeightField.read(Path(options["standing"]))
        core.machine.stand(surface, seed=options["seed"])
        assert core.machine.contact is not None
        core.machine.contact.lost_mm = options["lost_mm"]
    server = PtyServer(core, Path(options["link"]), control=control)
    control.sendall(FRAME.pack(b"a", 2) + b"{}")
    try:
        server.serve()
    except KeyboardInterrupt:
        return
    finally:
        control.close()


if __name__ == "__main__":
    main()
