"""Speaks with one OctoPrint server: login, push socket, state, questions through its terminal.

It knows nothing of jobs; `octoprint` makes a `Printer` of it.
"""

from __future__ import annotations

import json
import re
import threading
from collections import deque
from collections.abc import Callable
from typing import Any

import httpx

from gcode.errors import LinkError
from gcode.hosts.octoprint_state import ServerState
from gcode.hosts.server import ServerReach, ServerSession
from gcode.hosts.web import json_object, number_or_none, part_of, sentence
from gcode.protocol import events as ev
from gcode.protocol.replies import parse_reply

_SENT_LINE = re.compile(r"Send: (?:N\d+ )?(.*?)(?:\*\d+)?")
OCTOPRINT_SUBSCRIPTION = {"state": {"logs": True, "messages": False}, "events": True}


class OctoPrintSession(ServerSession[ServerState]):
    """One login to a server and the socket that its news come over.

    Parameters
    ----------
    plugin
        Whose messages are listened to, besides; empty: nobody's.
    """

    def __init__(
        self,
        reach: ServerReach,
        *,
        plugin: str = "",
    ) -> None:
        super().__init__(reach, ServerState(plugin=plugin))
        self._asking = threading.Lock()

    def listen(self) -> None:
        """Open the push socket: a login for the session, then the subscription."""
        answer = self.web.request("POST", "/api/login", json={"passive": True})
        user = (json_object(answer) or {}) if answer.status_code == 200 else {}
        if not user.get("session"):
            raise LinkError(
                f"{self.address.name} grants no session to the API key ({sentence(answer)}); use "
                f"a user's or an application's key."
            )
        self._hang_up()
        self.state.connected = False
        socket = self._open_socket("/sockjs/websocket", {})
        socket.send({"auth": f"{user.get('name')}:{user['session']}"})
        plugins = [self.state.plugin] if self.state.plugin else False
        socket.send({"subscribe": {**OCTOPRINT_SUBSCRIPTION, "plugins": plugins}})
        with self.news:
            if not self.news.wait_for(lambda: self.state.connected, self._timing.request_s):
                raise LinkError(
                    f"The push socket of {self.address.name} stays silent; is there a proxy in "
                    f"between that does not pass websockets?"
                )

    def _logged(self, message: dict[str, Any]) -> str:
        return json.dumps(message.get("event", list(message)))

    def status(self) -> dict[str, Any]:
        """Return `/api/printer`.

        Raises
        ------
        LinkError
            If the server's printer is not operational.
        """
        answer = self.web.request("GET", "/api/printer", params={"exclude": "sd"})
        if answer.status_code != 200:
            job = self.web.get("/api/job")
            raise LinkError(
                f"The printer of {self.address.name} is not operational (it says "
                f"{str(job.get('state', 'nothing'))!r}); connect it there first."
            )
        body = json_object(answer) or {}
        self._flags(answer)
        return body

    def _flags(self, answer: httpx.Response) -> dict[str, bool]:
        """The flags of `/api/printer`; none where the printer is not operational."""
        if answer.status_code != 200:
            return {}
        state = (json_object(answer) or {}).get("state")
        flags = state.get("flags") if isinstance(state, dict) else None
        if not isinstance(flags, dict):
            raise LinkError(f"{self.address.name} does not answer as OctoPrint does; what is it?")
        return {str(name): bool(value) for name, value in flags.items()}

    def printing(self) -> tuple[str, float]:
        """Return what is printed there, and how far it is, per cent."""
        report = self.web.get("/api/job")
        done = part_of(report, "progress").get("completion")
        name = part_of(part_of(report, "job"), "file").get("name")
        return str(name), number_or_none(done) or 0.0

    def look(self) -> bool:
        """Ask for the state, listening anew where the socket has ended.

        Returns
        -------
        False where the followed print is neither under way nor known to have ended.
        """
        if not self.listening:
            self.listen()
        # The flags are asked first: a print that ends in between is then under way, not lost.
        answer = self.web.request("GET", "/api/printer", params={"exclude": "temperature,sd"})
        flags = self._flags(answer)
        report = self.web.get("/api/job")
        with self.news:
            return self.state.look(report, flags)

    def ask(self, *commands: str, wait_s: float | None = 0.0) -> list[object]:
        """Have commands sent; return what the printer says to the last one, up to its `ok`.

        The terminal shows lines in the order of the wire, and OctoPrint sends a line only when
        the one before is acknowledged.

        Parameters
        ----------
        wait_s
            For the `ok`: 0 the usual time, None as long as the printer is there.
        """
        limit_s = self._timing.answer_s if wait_s == 0.0 else wait_s
        with self._asking, self.news:
            terminal = self.state.terminal = deque()
            last = commands[-1]
            try:
                self.command(*commands)
                self._await(
                    lambda: _sent_at(terminal, last) is not None, last, self._timing.answer_s
                )
                self._await(lambda: _answer(terminal, last) is not None, last, limit_s)
            finally:
                self.state.terminal = None
            return _answer(terminal, last) or []

    def _await(self, ready: Callable[[], bool], what: str, limit_s: float | None) -> None:
        started_s = self._clock()
        while not self.news.wait_for(ready, self._timing.poll_s):
            waited_s = self._clock() - started_s
            if self.state.failed or not self.listening:
                raise LinkError(
                    f"{self.address.name} lost its printer or us while {what} was under way "
                    f"({self.state.trouble}); whether it was carried out is not known."
                )
            if limit_s is not None and waited_s > limit_s:
                raise LinkError(
                    f"The terminal of {self.address.name} shows no answer to {what} within "
                    f"{limit_s:g} s; is the printer busy, may the key's user see the terminal?"
                )

    def command(self, *commands: str) -> None:
        """Have commands sent, in turn with whatever else is sent; does not wait."""
        self.web.expect(
            204,
            f"send {', '.join(commands)}; is its printer connected?",
            "POST",
            "/api/printer/command",
            json={"commands": list(commands)},
        )


def _sent_at(terminal: deque[str], command: str) -> int | None:
    for index, line in enumerate(terminal):
        match = _SENT_LINE.fullmatch(line)
        if match is not None and match.group(1) == command:
            return index
    return None


def _answer(terminal: deque[str], command: str) -> list[object] | None:
    """What was received between a command and its `ok`; None while that is to come."""
    start = _sent_at(terminal, command)
    if start is None:
        return None
    heard: list[object] = []
    for line in list(terminal)[start + 1 :]:
        if line.startswith("Recv: "):
            reply = parse_reply(line.removeprefix("Recv: ").encode("latin-1", "replace"))
            if isinstance(reply, ev.Ok):
                return [*heard, *reply.more]
            heard.append(reply)
    return None
