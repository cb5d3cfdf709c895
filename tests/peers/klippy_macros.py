"""A stand-in for Klipper with our macros, in front of an emulated printer that really moves.

Macros, variables, pauses and the card are `small_klipper`'s; every plain line goes to the emulated
firmware on its pseudo-terminal, which writes down what it executes. Where told, the nozzle is
clogged: the card's beads within a box come to nothing, and nobody knows.

Run, with `tests/unit` on the path: `python klippy_macros.py SOCKET GCODES MACROS PORT CLOG`, CLOG
being six numbers, mm: a box.
"""

from __future__ import annotations

import asyncio
import contextlib
import math
import re
import sys
from pathlib import Path
from typing import Any

import klippy_standin
import small_klipper
from klippy_standin import Client, StandIn, serve
from small_klipper import SmallKlipper

from gcode.errors import PrinterError
from gcode.hosts import connect
from gcode.hosts.serial import _TOUCHED, SerialPrinter

STEP_MM = 1.0  # a bead is cut into pieces so long, each laid or not
COUNTED = ("gcode_macro _AMREPAIR_STEP", "gcode_macro AMREPAIR_TOUCH")


class MacroKlipper(StandIn):
    """Klipper's socket, with a small Klipper behind it."""

    has_macros = True

    def __init__(
        self, gcodes: Path, macros: str, printer: SerialPrinter, clog_mm: list[float]
    ) -> None:
        self.gcodes, self.clients = gcodes, []
        self.printer, self.clog_mm = printer, clog_mm
        self.at = [0.0, 0.0, 0.0]
        self.state, self.message = "ready", "Printer is ready"
        self.loop = asyncio.get_running_loop()
        self.remote: dict[str, dict[Client, dict[str, Any]]] = {}
        self.output: dict[Client, dict[str, Any]] = {}
        self.small = SmallKlipper(
            gcodes, macros, carry_out=self.hand_on, respond=self.respond,
            call_remote=self.call_out, feel=self.feel,
        )  # fmt: skip

    def objects(self) -> dict[str, dict[str, Any]]:
        card = {"virtual_sdcard": {"path": str(self.gcodes)}}
        config = {"config": card, "settings": card, "save_config_pending": False, "warnings": []}
        return {**self.small.objects(), "configfile": config}

    async def script(self, text: str) -> None:
        try:
            await asyncio.to_thread(self.small.run_script, text)
        except small_klipper.CommandError as error:
            raise klippy_standin.CommandError(str(error)) from error

    def hand_on(self, line: str) -> None:
        """To the printer; what the card's beads would lay in the clogged box comes to nothing."""
        place = self.small.modes.position_mm
        start, end = self.at, [place.get(axis, 0.0) for axis in "XYZ"]
        self.at = end
        lays = re.search(r" E([\d.]+)", line) if line.startswith("G1 ") else None
        if not self.small.from_card or lays is None or start[:2] == end[:2]:
            self.printer.command(line)
            return
        self.printer.command(line.replace(lays.group(), "").split(" X")[0].split(" Y")[0])  # feed
        steps = max(1, round(math.dist(start[:2], end[:2]) / STEP_MM))
        low, high = self.clog_mm[:3], self.clog_mm[3:]
        for k in range(steps):
            at = [a + (b - a) * (k + 1) / steps for a, b in zip(start, end, strict=True)]
            words = f"G1 X{at[0]:.4f} Y{at[1]:.4f}"
            if not all(a <= b <= c for a, b, c in zip(low, at, high, strict=True)):
                words += f" E{float(lays.group(1)) / steps:.6f}"
            self.printer.command(words)

    def feel(self, depth_mm: float, speed_mm_s: float) -> float | None:
        """The emulated printer's own touch, of what it has laid itself."""
        self.printer.said.clear()
        with contextlib.suppress(PrinterError):
            self.printer.command(f"AMREPAIR_TOUCH DEPTH={depth_mm} SPEED={speed_mm_s}")
        met = [found for text in self.printer.said if (found := _TOUCHED.search(text))]
        if not met:
            return None
        return self.small.z_mm - float(met[-1].group(1))

    def respond(self, text: str) -> None:
        for client, template in list(self.output.items()):
            self.tell(client, {**template, "params": {"response": text}})

    def call_out(self, method: str, params: dict[str, Any]) -> None:
        for client, template in list(self.remote.get(method, {}).items()):
            self.tell(client, {**template, "params": params})

    def tell(self, client: Client, message: dict[str, Any]) -> None:
        self.loop.call_soon_threadsafe(client.send, message)

    async def registered(self, client: Client, method: str, params: dict[str, Any]) -> None:
        """What a client wants to hear of."""
        template = params.get("response_template", {})
        if method == "gcode/subscribe_output":
            self.output[client] = template
        else:
            self.remote.setdefault(params["remote_method"], {})[client] = template


def main() -> None:
    socket, gcodes, macros, port = sys.argv[1:5]
    printer = connect(port, dialect="klipper", baud=250000)
    assert isinstance(printer, SerialPrinter)
    printer.connect()
    klippy_standin.OBJECTS = (*klippy_standin.OBJECTS, *COUNTED)

    async def run() -> None:
        clog_mm = [float(number) for number in sys.argv[5:11]]
        klipper = MacroKlipper(Path(gcodes), Path(macros).read_text(), printer, clog_mm)
        await serve(Path(socket), klipper)

    asyncio.run(run())


if __name__ == "__main__":
    main()
