"""A Moonraker in this process with a small Klipper behind it, for an agent to be served by."""

from __future__ import annotations

import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any
from urllib.parse import unquote

from small_klipper import CommandError, SmallKlipper
from web_harness import Answer, Asked, FakeServer

from amrepair.agent import MACROS, shipped
from gcode.resumption.klipper import TOUCH_MACRO

WATCHED = ("print_stats", "virtual_sdcard", "webhooks")


class AgentsMoonraker:
    """The calls that an agent makes, answered as Moonraker 0.11 does.

    Attributes
    ----------
    on_said
        Hears every line of the printer's console, in a thread of its own.
    scripts
        Scripts that were carried out, or refused, in order.
    """

    def __init__(self, gcodes: Path) -> None:
        self.klipper = SmallKlipper(
            gcodes, shipped(MACROS) + TOUCH_MACRO, respond=self._responded, call_remote=self._remote
        )
        self.server = FakeServer(self._handle, on_message=self._message)
        self.on_said: Callable[[str], None] = lambda text: None
        self.scripts: list[str] = []
        self.agent_there = False
        self.methods: set[str] = set()
        self.job_id = 0
        self._ended = threading.Event()

    def __enter__(self) -> AgentsMoonraker:
        self.server.__enter__()
        self._ticker = threading.Thread(target=self._tick, daemon=True)
        self._ticker.start()
        return self

    def __exit__(self, *why: Any) -> None:
        self._ended.set()
        self._ticker.join()
        self.server.__exit__(None, None, None)

    @property
    def url(self) -> str:
        return self.server.base

    def start(self, name: str) -> None:
        """Somebody begins a print at the printer's screen."""
        self.job_id += 1
        self.klipper.run_script(f"SDCARD_PRINT_FILE FILENAME={name}")

    def _tick(self) -> None:
        told: dict[str, Any] = {}
        while not self._ended.wait(0.005):
            now = {name: self.klipper.objects()[name] for name in WATCHED}
            if now != told:
                told = now
                self.server.push({"method": "notify_status_update", "params": [now, 0.0]})

    def _responded(self, text: str) -> None:
        self.server.push({"method": "notify_gcode_response", "params": [text]})
        threading.Thread(target=self.on_said, args=(text,), daemon=True).start()

    def _remote(self, method: str, params: dict[str, Any]) -> None:
        if method in self.methods:
            self.server.push({"jsonrpc": "2.0", "method": method, "params": params})

    def _handle(self, asked: Asked) -> Answer:
        if asked.path == "/server/info":
            return 200, {"result": {"klippy_state": "ready"}}
        path = self.klipper.gcodes / unquote(asked.path.removeprefix("/server/files/gcodes/"))
        return (200, path.read_bytes()) if path.is_file() else (404, None)

    def _message(self, message: dict[str, Any]) -> None:
        threading.Thread(target=self._answer, args=(message,), daemon=True).start()

    def _answer(self, message: dict[str, Any]) -> None:
        try:
            said: dict[str, Any] = {"result": self._call(message["method"], message["params"])}
        except CommandError as error:
            said = {"error": {"code": 400, "message": str(error)}}
        self.server.push({"jsonrpc": "2.0", "id": message["id"], **said})

    def _call(self, method: str, params: dict[str, Any]) -> Any:
        if method == "server.connection.identify":
            if self.agent_there:
                raise CommandError("Agent 'amrepair' already registered and connected'")
            assert params["type"] == "agent"
        elif method == "connection.register_remote_method":
            self.methods.add(params["method_name"])
        elif method == "server.info":
            return {"klippy_state": "shutdown" if self.klipper.shut_down else "ready"}
        elif method in {"printer.objects.query", "printer.objects.subscribe"}:
            objects = self.klipper.objects()
            return {
                "status": {name: objects[name] for name in params["objects"] if name in objects}
            }
        elif method == "server.history.list":
            busy = self.klipper.print_state in {"printing", "paused"}
            status = "in_progress" if busy else "completed"
            if self.klipper.shut_down:
                status = "klippy_shutdown"
            row = {"job_id": f"{self.job_id:06X}", "filename": self.klipper.file, "status": status}
            return {"jobs": [row]}
        elif method == "printer.print.resume":
            self.klipper.run_script("RESUME")
        elif method == "printer.print.pause":
            self.klipper.run_script("PAUSE")
        elif method == "printer.gcode.script":
            self.scripts.append(params["script"])
            self.klipper.run_script(params["script"])
        else:
            raise CommandError(f"{method} is not known here")
        return "ok"
