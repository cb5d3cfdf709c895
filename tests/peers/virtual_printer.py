"""OctoPrint's bundled virtual printer on a pseudo-terminal; runs in OctoPrint's environment.

Prints the port's path, then serves until its standard input closes. `N k` is recorded when the
printer sets its line number to k, `C …` when it carries a command out. Run:
`python virtual_printer.py RECORD FOLDER [LINE:COMMAND…]`; each `!!DEBUG:` COMMAND is given to the
printer just before it gets line LINE.
"""

from __future__ import annotations

import os
import re
import sys
import threading
import tty
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from octoprint.plugins.virtual_printer import VirtualPrinterPlugin, virtual
from serial import SerialTimeoutException

NUMBER = re.compile(rb"N(\d+)")


class Settings:
    """The plugin's default settings, as the printer asks for them."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.values = VirtualPrinterPlugin().get_settings_defaults()

    def get(self, path: Iterable[str], merged: bool = False) -> Any:
        found: Any = self.values
        for name in path:
            found = found.get(name) if isinstance(found, dict) else None
        return found

    def get_int(self, path: Iterable[str]) -> int:
        return int(self.get(path) or 0)

    def get_float(self, path: Iterable[str]) -> float:
        return float(self.get(path) or 0.0)

    def get_boolean(self, path: Iterable[str]) -> bool:
        return bool(self.get(path))

    def global_get_basefolder(self, name: str) -> str:
        return str(self.folder)


class NoPlugins:
    def get_hooks(self, name: str) -> dict[str, object]:
        return {}


class Recorder:
    """Stands in for the pattern that every command is matched with when it is carried out."""

    def __init__(self, pattern: re.Pattern[str], record: int) -> None:
        self.pattern = pattern
        self.record = record

    def match(self, text: str) -> re.Match[str] | None:
        os.write(self.record, f"C {text}\n".encode())
        return self.pattern.match(text)


def recorded_printer(record: int, folder: Path) -> virtual.VirtualPrinter:
    class Recorded(virtual.VirtualPrinter):
        @property
        def lastN(self) -> int:
            return self._last

        @lastN.setter
        def lastN(self, number: int) -> None:
            self._last = number
            os.write(record, f"N {number}\n".encode())

    virtual.plugin_manager = NoPlugins
    virtual.VirtualPrinter.command_regex = Recorder(virtual.VirtualPrinter.command_regex, record)
    return Recorded(Settings(folder), None, str(folder), read_timeout=0.1)


def feed(printer: virtual.VirtualPrinter, data: bytes) -> None:
    while data:
        data = data[printer.write(data) :]


def main() -> None:
    record = os.open(sys.argv[1], os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o644)
    faults = [argument.partition(":")[::2] for argument in sys.argv[3:]]
    pending = {int(line): f"!!DEBUG:{command}\n".encode() for line, command in faults}
    master, slave = os.openpty()
    tty.setraw(slave)
    printer = recorded_printer(record, Path(sys.argv[2]))

    def talk() -> None:
        while True:
            try:
                if line := printer.readline():
                    os.write(master, line.rstrip(b"\r\n") + b"\n")  # not every line has one
            except SerialTimeoutException:  # a dropped connection
                os._exit(0)

    def listen() -> None:
        rest = b""
        while True:
            *lines, rest = (rest + os.read(master, 4096)).split(b"\n")
            for line in lines:
                number = NUMBER.match(line)
                due = int(number.group(1)) if number else -1
                try:
                    if due in pending:
                        feed(printer, pending.pop(due))
                    feed(printer, line + b"\n")
                except SerialTimeoutException:
                    os._exit(0)

    for target in (talk, listen):
        threading.Thread(target=target, daemon=True).start()
    print(os.ttyname(slave), flush=True)
    sys.stdin.read()
    os._exit(0)


if __name__ == "__main__":
    main()
