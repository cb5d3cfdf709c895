"""Speaks JSON-RPC with one Moonraker server over its websocket; knows nothing of jobs."""

from __future__ import annotations

import itertools
import json
import re
from typing import Any

import gcode
from gcode.errors import LinkError, PortBusyError, PrinterError
from gcode.hosts.moonraker_state import MOONRAKER_SUBSCRIPTION, KlippyState, cause_of
from gcode.hosts.server import ServerReach, ServerSession
from gcode.hosts.web import json_object, refused_key, sentence

_MESSAGE = re.compile(r"""['"]message['"]:\s*(['"])(.*?)\1\s*[,}]""", re.DOTALL)


class MoonrakerSession(ServerSession[KlippyState]):
    """One websocket, its calls and its news.

    Parameters
    ----------
    agent
        Name of the agent as which this session serves the printer's macros; empty: it is none.
    methods
        What a macro may call by `action_call_remote_method`; an agent's only.
    """

    def __init__(
        self,
        reach: ServerReach,
        *,
        agent: str = "",
        methods: tuple[str, ...] = (),
    ) -> None:
        super().__init__(reach, KlippyState(methods=methods))
        self._numbers = itertools.count(1)
        self._agent, self._methods = agent, methods

    def listen(self) -> None:
        """Open the websocket and say who we are."""
        self.web.get("/server/info")  # tells an unreachable server from a refused key
        self._open_socket("/websocket", dict(self._key.headers))
        who = {"client_name": "gcode", "version": gcode.__version__, "type": "other", "url": "-"}
        if self._agent:
            who |= {"client_name": self._agent, "type": "agent"}
        if self._key.value:
            who["api_key"] = self._key.value
        try:
            self.call("server.connection.identify", who)
            for method in self._methods:
                self.call("connection.register_remote_method", {"method_name": method})
        except PrinterError as error:
            if "already registered" not in str(error):
                raise
            self._hang_up()
            raise PortBusyError(
                f"another agent named {self._agent!r} serves the printer behind "
                f"{self.address.name}; end that one first."
            ) from error

    @property
    def is_told(self) -> bool:
        """Not by a Klipper that came back: it is asked anew what it prints."""
        return self.listening and not self.state.stale

    def _logged(self, message: dict[str, Any]) -> str:
        return json.dumps({k: v for k, v in message.items() if k != "jsonrpc"})[:500]

    def call(
        self, method: str, params: dict[str, Any] | None = None, *, limit_s: float | None = 0.0
    ) -> Any:
        """Call a method and return its result.

        Parameters
        ----------
        limit_s
            0 the usual time; None as long as the socket lives: scripts take as long as their
            moves (Moonraker#437).

        Raises
        ------
        LinkError
            If no answer comes.
        PrinterError
            If Klipper refuses.
        """
        limit_s = self._timing.request_s if limit_s == 0.0 else limit_s
        number, socket = next(self._numbers), self._socket
        if socket is None or not socket.alive:
            raise LinkError(f"The websocket of {self.address.name} is closed.")
        if self._log is not None and method != "server.connection.identify":
            self._log.add(b">", f"{number} {method} {json.dumps(params or {})}"[:500])
        socket.send({"jsonrpc": "2.0", "method": method, "params": params or {}, "id": number})
        with self.news:
            answers = self.state.answers
            self.news.wait_for(lambda: number in answers or not socket.alive, limit_s)
            answer = answers.pop(number, None)
        if answer is None:
            why = "has closed the websocket" if not socket.alive else f"is silent for {limit_s:g} s"
            raise LinkError(
                f"{self.address.name} {why} while {method} was under way; whether it was carried "
                f"out is not known."
            )
        if "error" in answer:
            raise self._refusal(method, answer["error"])
        return answer.get("result")

    def _refusal(self, method: str, error: object) -> LinkError:
        code = error.get("code") if isinstance(error, dict) else None
        text = str(error.get("message", error) if isinstance(error, dict) else error)
        if code in {401, 403, -32602} and "nauthorized" in text:
            return refused_key(self.address, self._key)
        if match := _MESSAGE.search(text):  # Klipper's error object, printed
            text = match.group(2)
        text = cause_of(text)[:300]
        if code == 503:
            return LinkError(f"{self.address.name} has no Klipper behind it ({text}); start it.")
        return PrinterError(f"{self.address.name} refuses {method}: {text}.")

    def query(self, objects: dict[str, list[str] | None]) -> dict[str, dict[str, Any]]:
        """Return objects of Klipper; those that the printer lacks are left out."""
        found = self.call("printer.objects.query", {"objects": objects})
        status = found.get("status") if isinstance(found, dict) else None
        if not isinstance(status, dict):
            raise LinkError(f"{self.address.name} answers a query without a status.")
        return {name: value for name, value in status.items() if isinstance(value, dict)}

    def listed(self, path: str, **query: str) -> list[dict[str, Any]]:
        """Return the objects of an HTTP answer's result, one or many."""
        answer = self.web.request("GET", path, params=query)
        result = (json_object(answer) or {}).get("result") if answer.status_code == 200 else None
        if isinstance(result, dict):
            result = [result]
        if not isinstance(result, list):
            raise LinkError(f"{self.address.name} does not list its files ({sentence(answer)}).")
        return [row for row in result if isinstance(row, dict)]

    def look(self) -> None:
        """Ask for Klipper's state, listening and subscribing anew.

        Raises
        ------
        LinkError
            If there is no Klipper to be asked, or not yet.
        """
        if not self.listening:
            self.listen()
        info = self.call("server.info")
        klippy = str(info.get("klippy_state", "")) if isinstance(info, dict) else ""
        with self.news:
            self.state.klippy, self.state.stale = klippy, False
        if klippy in {"disconnected", "startup", ""}:
            raise LinkError(
                f"Klipper behind {self.address.name} is not ready (it is {klippy or 'silent'}); "
                f"start it, or see its log."
            )
        found = self.call("printer.objects.subscribe", {"objects": MOONRAKER_SUBSCRIPTION})
        with self.news:
            if isinstance(found, dict) and isinstance(found.get("status"), dict):
                self.state.take_status(found["status"])
