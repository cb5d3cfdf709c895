"""`Held` in OctoPrint: its hooks, events, addresses, tab and settings."""

from __future__ import annotations

import contextlib
import queue
import re
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import flask
import octoprint.plugin
from octoprint.access.permissions import Permissions
from octoprint.util import RepeatedTimer

import amrepair
from amrepair.agent.octoprint.held import HOLD_PATIENCE_S, Held, Refusal

TAG = "amrepair:"
TRIES, TRY_S = 50, 0.01
"""Of holding the job: OctoPrint's lock is taken for moments only."""
MOST_PROGRAM_BYTES = 256 * 1024 * 1024  # every line of a day's print
WILDCARDS = ("0.0.0.0", "::", "")
Blueprint = octoprint.plugin.BlueprintPlugin


class AmrepairPlugin(
    octoprint.plugin.StartupPlugin,
    octoprint.plugin.EventHandlerPlugin,
    octoprint.plugin.SettingsPlugin,
    octoprint.plugin.TemplatePlugin,
    octoprint.plugin.AssetPlugin,
    octoprint.plugin.BlueprintPlugin,
):
    """The plugin."""

    def initialize(self) -> None:
        """OctoPrint has put its parts into this object."""
        self._deeds: queue.SimpleQueue[Callable[[], None]] = queue.SimpleQueue()
        self._held = Held(
            self, self._deeds.put, time.monotonic,
            patience_s=lambda: float(self._settings.get_float(["patience_s"]) or HOLD_PATIENCE_S),
        )  # fmt: skip
        self._address = ("", "")
        self._note = Path(self.get_plugin_data_folder()) / "rests"
        threading.Thread(target=self._work, daemon=True, name="amrepair").start()

    def _work(self) -> None:
        while True:
            deed = self._deeds.get()
            try:
                deed()
            except Exception:
                self._logger.exception("amrepair")

    def on_after_startup(self) -> None:
        """Look now and then whether somebody has come."""
        self._ticks = RepeatedTimer(1.0, self._held.tick, daemon=True)
        self._ticks.start()

    # ------------------------------------------------------------------ what `Held` asks for

    def release(self) -> None:
        """Let the job go on."""
        self._note.unlink(missing_ok=True)
        with contextlib.suppress(RuntimeError):  # no printer any more
            self._printer.set_job_on_hold(False)

    def send(self, line: str, tag: str) -> None:
        """Have a line sent in its turn."""
        self._printer.commands([line], tags={f"{TAG}{tag}"} if tag else set())

    def heat(self) -> tuple[tuple[float, ...], float]:
        """What the hotend of each head, and the bed, are set to, °C."""
        found = self._printer.get_current_temperatures()
        tools = sorted(int(name[4:]) for name in found if re.fullmatch(r"tool\d+", name))
        names = [f"tool{k}" for k in tools] or ["tool0"]
        *hotends, bed = (found.get(name, {}).get("target") or 0.0 for name in (*names, "bed"))
        return tuple(float(c) for c in hotends), float(bed)

    def cancel(self) -> None:
        """Cancel the print."""
        self._printer.cancel_print()

    def tell(self, state: dict[str, Any]) -> None:
        """Push the state to tab and agent."""
        self._plugin_manager.send_plugin_message(self._identifier, state)

    # ------------------------------------------------------------------ OctoPrint's hooks

    def hooks(self) -> dict[str, Any]:
        """What OctoPrint calls."""
        return {
            "octoprint.comm.protocol.atcommand.queuing": self._at,
            "octoprint.comm.protocol.atcommand.sending": self._at_wire,
            "octoprint.comm.protocol.gcode.queuing": self._queuing,
            "octoprint.comm.protocol.gcode.sent": self._sent,
            "octoprint.comm.protocol.gcode.error": self._error,
            "octoprint.comm.protocol.gcode.received": self._received,
            "octoprint.server.http.bodysize": self._bodysize,
            "octoprint.server.http.routes": self._routes,
        }

    def _bodysize(self, *args: Any, **kwargs: Any) -> list[tuple[str, str, int]]:
        """Programs are larger than what OctoPrint takes by itself (100 kB)."""
        return [("POST", r"/(program|go_on)", MOST_PROGRAM_BYTES)]

    def _at(
        self, comm: Any, phase: str, command: str, parameters: str, tags: Any = None, **_: Any
    ) -> None:
        if command != "amrepair" or parameters.startswith("over "):
            return
        if not self._held.mark(parameters, _byte(tags)):
            return
        for _try in range(TRIES):
            if comm.set_job_on_hold(True, blocking=False):
                self._note.touch()
                return
            time.sleep(TRY_S)
        self._held.passed_by()

    def _at_wire(
        self, comm: Any, phase: str, command: str, parameters: str, tags: Any = None, **_: Any
    ) -> None:
        word, _space, send = parameters.partition(" ")
        if command == "amrepair" and word == "over":
            self._held.over(send.strip())

    def _queuing(self, comm: Any, phase: str, cmd: str, *args: Any, tags: Any = None,
                 **_: Any) -> Any:  # fmt: skip
        byte = _byte(tags)
        instead = None if byte is None else self._held.instead(byte)
        if instead is None:
            return None
        return [(command,) for command in instead] or (None,)

    def _sent(self, comm: Any, phase: str, cmd: str, *args: Any, tags: Any = None,
              **_: Any) -> None:  # fmt: skip
        for tag in tags or ():
            if tag.startswith(TAG):
                self._held.sent(tag[len(TAG) :])

    def _error(self, comm: Any, text: str, *args: Any, **_: Any) -> bool:
        """Whether OctoPrint is to pass over what its firmware calls an error."""
        return self._held.wrong(text)

    def _received(self, comm: Any, line: str, *args: Any, **_: Any) -> str:
        if "nknown command" in line:
            self._held.wrong(line.strip())
        return line

    def _routes(self, *args: Any, **kwargs: Any) -> list[Any]:
        from octoprint.server import app
        from octoprint.server.util.flask import permission_validator
        from octoprint.server.util.tornado import access_validation_factory

        from amrepair.agent.octoprint.page import LivePage

        allowed = access_validation_factory(app, permission_validator, Permissions.PRINT)
        return [(r"/live/?", LivePage, {"address": lambda: self._address, "allowed": allowed})]

    def on_event(self, event: str, payload: dict[str, Any]) -> None:
        """How OctoPrint's print goes."""
        if event == "PrintStarted" and payload.get("origin") == "local":
            self._held.began(str(payload["path"]))
        elif event == "PrintDone":
            self._held.ended("done")
        elif event in {"PrintCancelling", "PrintCancelled"}:
            self._held.ended("cancelled")
        elif event == "PrintFailed":
            self._held.ended(str(payload.get("reason") or "failed"))
        elif event in {"Disconnected", "Error"}:
            self._held.ended(str(payload.get("error") or "the printer is gone"))
        elif event == "Connected" and self._note.exists() and not self._held.rests:
            self._note.unlink()
            self._held.left_behind()

    # ------------------------------------------------------------------ addresses

    def is_blueprint_csrf_protected(self) -> bool:
        """No other page may press our buttons."""
        return True

    @Blueprint.route("/state", methods=["GET"])
    @Permissions.STATUS.require(403)
    def state(self) -> Any:
        """What the tab shows."""
        return flask.jsonify(self._held.state())

    @Blueprint.route("/press", methods=["POST"])
    @Permissions.PRINT.require(403)
    def press(self) -> Any:
        """A button of the tab."""
        return self._answered(self._held.press)

    @Blueprint.route("/<what>", methods=["POST"])
    @Permissions.PRINT.require(403)
    def from_agent(self, what: str) -> Any:
        """What the agent asks for."""
        return self._answered(lambda said: self._do(what, said))

    def _do(self, what: str, said: dict[str, Any]) -> None:
        held = self._held
        held.here(str(said.pop("agent")), self._page_of(said) if what == "here" else held.page)
        deeds: dict[str, Callable[..., None]] = {
            "program": held.program, "go_on": held.go_on, "pause": held.pause, "off": held.off,
            "leave": held.leave, "forget": held.forget,
        }  # fmt: skip
        if what in deeds:
            deeds[what](**said)
        elif what != "here":
            held.show(what, said)

    def _page_of(self, said: dict[str, Any]) -> str:
        """Where the agent's live page is, as seen from here."""
        host, _, port = str(said.get("page") or "").rpartition(":")
        if not port:
            self._address = ("", "")
            return ""
        if host in WILDCARDS:
            host = str(flask.request.remote_addr)
        self._address = (f"{host}:{port}", str(said.get("token") or ""))
        return self._address[0]

    def _answered(self, deed: Callable[[dict[str, Any]], None]) -> Any:
        said = flask.request.get_json(silent=True)
        try:
            if not isinstance(said, dict):
                raise Refusal("a JSON object is wanted", 400)
            deed(said)
        except Refusal as refusal:
            return flask.jsonify({"error": str(refusal)}), refusal.status
        except (KeyError, TypeError, ValueError) as error:
            return flask.jsonify({"error": f"not understood: {error}"}), 400
        return flask.jsonify(self._held.state())

    # ------------------------------------------------------------------ tab and settings

    def get_settings_defaults(self) -> dict[str, Any]:
        """What may be set."""
        return {"patience_s": HOLD_PATIENCE_S}

    def get_template_configs(self) -> list[dict[str, Any]]:
        """A tab, and a page of the settings."""
        return [
            {"type": "tab", "name": "amrepair", "custom_bindings": True},
            {"type": "settings", "name": "amrepair", "custom_bindings": False},
        ]

    def is_template_autoescaped(self) -> bool:
        """Nothing that we show is HTML."""
        return True

    def get_assets(self) -> dict[str, list[str]]:
        """The tab's script."""
        return {"js": ["amrepair.js"], "css": ["amrepair.css"]}


def _byte(tags: Any) -> int | None:
    """Where in its file a line of the job ends; None for other lines."""
    found = [tag for tag in tags or () if tag.startswith("filepos:")]
    return int(found[0][8:]) if found and "source:file" in tags else None


__plugin_version__ = amrepair.__version__
