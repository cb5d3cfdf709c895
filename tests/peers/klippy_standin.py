"""A stand-in for Klipper's API socket, after Klipper's documentation (API_Server.md).

Not Klipper: it reads a virtual SD card's file line by line, keeps temperatures and a position, and
answers what Moonraker asks. Every line carried out is appended to a record, so that a test can tell
what was executed and how often. Run: `python klippy_standin.py SOCKET GCODES RECORD [LINES_PER_S]`.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import re
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

END = b"\x03"
OBJECTS = (
    "webhooks",
    "configfile",
    "print_stats",
    "virtual_sdcard",
    "pause_resume",
    "display_status",
    "gcode_move",
    "toolhead",
    "extruder",
    "heater_bed",
)
ENDPOINTS = (
    "info",
    "emergency_stop",
    "objects/list",
    "objects/query",
    "objects/subscribe",
    "gcode/help",
    "gcode/script",
    "gcode/restart",
    "gcode/firmware_restart",
    "gcode/subscribe_output",
    "pause_resume/pause",
    "pause_resume/resume",
    "pause_resume/cancel",
    "register_remote_method",
)


class CommandError(Exception):
    """What Klipper answers to a command that it refuses."""


class StandIn:
    has_macros = False

    def __init__(self, gcodes: Path, record: Path, lines_per_s: float) -> None:
        self.gcodes = gcodes
        self.record = record.open("a", buffering=1)
        self.pause_s = 1.0 / lines_per_s
        self.clients: list[Client] = []
        self.reset()

    def reset(self) -> None:
        self.state, self.message = "ready", "Printer is ready"
        self.target = {"extruder": 0.0, "heater_bed": 0.0}
        self.position = {"X": 0.0, "Y": 0.0, "Z": 0.0, "E": 0.0}
        self.absolute, self.absolute_e, self.homed = True, True, ""
        self.file, self.size, self.file_position = "", 0, 0
        self.print_state = "standby"
        self.printing: asyncio.Task[None] | None = None
        self.go_on = asyncio.Event()

    # ------------------------------------------------------------------ objects

    def objects(self) -> dict[str, dict[str, Any]]:
        place = [self.position[axis] for axis in "XYZE"]
        return {
            "webhooks": {"state": self.state, "state_message": self.message},
            "configfile": {
                "config": {"virtual_sdcard": {"path": str(self.gcodes)}},
                "settings": {"virtual_sdcard": {"path": str(self.gcodes)}},
                "save_config_pending": False,
                "warnings": [],
            },
            "print_stats": {
                "state": self.print_state,
                "filename": self.file,
                "message": "",
                "total_duration": 0.0,
                "print_duration": 0.0,
                "filament_used": 0.0,
                "info": {"total_layer": None, "current_layer": None},
            },
            "virtual_sdcard": {
                "file_path": str(self.gcodes / self.file) if self.file else None,
                "file_position": self.file_position,
                "file_size": self.size,
                "is_active": self.print_state == "printing",
                "progress": self.file_position / max(self.size, 1),
            },
            "pause_resume": {"is_paused": self.print_state == "paused"},
            "display_status": {"progress": 0.0, "message": None},
            "gcode_move": {"gcode_position": place, "position": place, "speed_factor": 1.0},
            "toolhead": {"homed_axes": self.homed, "position": place},
            "extruder": {"temperature": self.warm("extruder"), "target": self.target["extruder"]},
            "heater_bed": {
                "temperature": self.warm("heater_bed"),
                "target": self.target["heater_bed"],
            },
        }

    def warm(self, heater: str) -> float:
        return self.target[heater] or 21.0

    # ------------------------------------------------------------------ commands

    async def registered(self, client: Client, method: str, params: dict[str, Any]) -> None:
        """What a client wants to hear of; nothing here says any of it."""

    async def script(self, text: str) -> None:
        for line in text.split("\n"):
            await self.command(line)

    async def command(self, line: str) -> None:
        command = line.partition(";")[0].strip()
        if not command:
            return
        if self.state != "ready":
            raise CommandError(self.message)
        name = command.split()[0].upper()
        if name == "SDCARD_PRINT_FILE":
            self.start(re.findall(r'FILENAME="?([^"]+)"?', command)[0])
            return
        if name in {"RESTART", "FIRMWARE_RESTART"}:
            self.restart()
            return
        self.record.write(command + "\n")
        self.carry_out(name, command)

    def carry_out(self, name: str, command: str) -> None:
        words = {k: float(v) for k, v in re.findall(r"([XYZESF])(-?[\d.]+)", command[len(name) :])}
        if name in {"G0", "G1"}:
            self.move(words)
        elif name == "G28":
            self.homed = "xyz"
            self.position.update(X=0.0, Y=0.0, Z=0.0)
        elif name == "G92":
            self.position.update({k: v for k, v in words.items() if k in "XYZE"})
        elif name in {"G90", "G91"}:
            self.absolute = name == "G90"
        elif name in {"M82", "M83"}:
            self.absolute_e = name == "M82"
        elif name in {"M104", "M109"}:
            self.target["extruder"] = words["S"]
        elif name in {"M140", "M190"}:
            self.target["heater_bed"] = words["S"]
        elif name == "TURN_OFF_HEATERS":
            self.target = dict.fromkeys(self.target, 0.0)
        elif name not in {"M400", "M107", "M106", "G21", "G4", "M117"}:
            raise CommandError(f'Unknown command:"{name}"')

    def move(self, words: dict[str, float]) -> None:
        if not self.homed:
            raise CommandError("Must home axis first")
        for axis, value in words.items():
            if axis not in self.position:
                continue
            absolute = self.absolute and (axis != "E" or self.absolute_e)
            self.position[axis] = value if absolute else self.position[axis] + value

    # ------------------------------------------------------------------ printing

    def start(self, name: str) -> None:
        path = self.gcodes / name
        if self.print_state in {"printing", "paused"}:
            raise CommandError("SD busy")
        if not path.is_file():
            raise CommandError(f"Unable to open file {name}")
        self.file, self.size, self.file_position = name, path.stat().st_size, 0
        self.print_state = "printing"
        self.go_on.set()
        self.printing = asyncio.create_task(self.work(path.read_bytes()))

    async def work(self, data: bytes) -> None:
        for line in data.splitlines(keepends=True):
            await self.go_on.wait()
            try:
                await self.command(line.decode())
            except CommandError:
                self.print_state = "error"
                return
            self.file_position += len(line)
            await asyncio.sleep(self.pause_s)
        self.print_state = "complete"

    def pause(self) -> None:
        if self.print_state == "printing":
            self.go_on.clear()
            self.print_state = "paused"

    def resume(self) -> None:
        if self.print_state == "paused":
            self.print_state = "printing"
            self.go_on.set()

    def stop_printing(self) -> None:
        if self.printing is not None:
            self.printing.cancel()
            self.printing = None

    def cancel(self) -> None:
        self.stop_printing()
        if self.print_state in {"printing", "paused"}:
            self.print_state, self.file_position = "cancelled", 0

    def shut_down(self) -> None:
        self.stop_printing()
        self.target = dict.fromkeys(self.target, 0.0)
        if self.print_state in {"printing", "paused"}:
            self.print_state = "error"
        self.state, self.message = "shutdown", "Shutdown due to webhooks request"

    def restart(self) -> None:
        """As Klipper does: every connection is dropped, everything is forgotten."""
        self.stop_printing()
        self.reset()
        for client in list(self.clients):
            client.writer.close()


class Client:
    """One connection to the socket."""

    def __init__(self, klipper: StandIn, writer: asyncio.StreamWriter) -> None:
        self.klipper = klipper
        self.writer = writer
        self.subscribed: dict[str, list[str] | None] = {}
        self.template: dict[str, Any] = {}
        self.told: dict[str, dict[str, Any]] = {}

    def send(self, message: dict[str, Any]) -> None:
        if not self.writer.is_closing():
            self.writer.write(json.dumps(message).encode() + END)

    def picked(self, wanted: dict[str, list[str] | None]) -> dict[str, dict[str, Any]]:
        objects = self.klipper.objects()
        return {
            name: {k: v for k, v in objects.get(name, {}).items() if fields is None or k in fields}
            for name, fields in wanted.items()
        }

    def tell(self) -> None:
        """Push what changed since the last push, as Klipper does every 0.25 s."""
        now = self.picked(self.subscribed)
        news = {
            name: changed
            for name, fields in now.items()
            if (
                changed := {
                    k: v for k, v in fields.items() if self.told.get(name, {}).get(k, ...) != v
                }
            )
        }
        self.told = now
        if news:
            self.send({**self.template, "params": {"eventtime": 0.0, "status": news}})

    async def answer(self, request: dict[str, Any]) -> None:
        try:
            result = await self.call(request["method"], request.get("params", {}))
        except CommandError as error:
            message = {"error": "CommandError", "message": str(error)}
            self.send({"id": request.get("id"), "error": message})
            return
        if "id" in request:
            self.send({"id": request["id"], "result": result})

    async def call(self, method: str, params: dict[str, Any]) -> dict[str, Any]:
        klipper = self.klipper
        macros = {"pause": "PAUSE", "resume": "RESUME", "cancel": "CANCEL_PRINT"}
        if method.startswith("pause_resume/") and klipper.has_macros:
            await klipper.script(macros[method.partition("/")[2]])
            return {}
        simple: dict[str, Callable[[], None]] = {
            "emergency_stop": klipper.shut_down,
            "pause_resume/pause": klipper.pause,
            "pause_resume/resume": klipper.resume,
            "pause_resume/cancel": klipper.cancel,
            "gcode/restart": klipper.restart,
            "gcode/firmware_restart": klipper.restart,
        }
        if method in simple:
            simple[method]()
            return {}
        if method == "info":
            return {
                "state": klipper.state,
                "state_message": klipper.message,
                "hostname": "stand-in",
                "klipper_path": "/nowhere",
                "python_path": sys.executable,
                "process_id": os.getpid(),
                "user_id": os.getuid(),
                "group_id": os.getgid(),
                "log_file": "",
                "config_file": "/nowhere/printer.cfg",
                "software_version": "stand-in-1",
                "cpu_info": "none",
            }
        if method == "list_endpoints":
            return {"endpoints": list(ENDPOINTS)}
        if method == "objects/list":
            return {"objects": list(OBJECTS)}
        if method == "objects/query":
            return {"eventtime": 0.0, "status": self.picked(params["objects"])}
        if method == "objects/subscribe":
            self.subscribed = params["objects"]
            self.template = params.get("response_template", {})
            self.told = self.picked(self.subscribed)
            return {"eventtime": 0.0, "status": self.told}
        if method == "gcode/script":
            await klipper.script(params["script"])
            return {}
        if method in {"gcode/subscribe_output", "register_remote_method"}:
            await klipper.registered(self, method, params)
            return {}
        if method == "gcode/help":
            return {}
        raise CommandError(f"webhooks: No registered callback for path '{method}'")


async def serve(socket: Path, klipper: StandIn) -> None:
    async def connected(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        client = Client(klipper, writer)
        klipper.clients.append(client)
        answers: set[asyncio.Task[None]] = set()
        try:
            while True:
                data = await reader.readuntil(END)
                task = asyncio.create_task(client.answer(json.loads(data[:-1])))
                answers.add(task)
                task.add_done_callback(answers.discard)
        except (asyncio.IncompleteReadError, ConnectionError):
            return
        finally:
            klipper.clients.remove(client)
            writer.close()

    server = await asyncio.start_unix_server(connected, str(socket), limit=20_000_000)
    async with server:
        while True:
            await asyncio.sleep(0.1)
            for client in klipper.clients:
                client.tell()


def main() -> None:
    socket, gcodes, record = (Path(argument) for argument in sys.argv[1:4])
    lines_per_s = float(sys.argv[4]) if len(sys.argv) > 4 else 200.0
    socket.unlink(missing_ok=True)

    async def run() -> None:
        await serve(socket, StandIn(gcodes, record, lines_per_s))

    with contextlib.suppress(KeyboardInterrupt):
        asyncio.run(run())


if __name__ == "__main__":
    main()
