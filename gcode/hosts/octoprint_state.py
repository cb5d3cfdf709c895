"""What OctoPrint's news say of its printer and of the one print that is followed; no I/O."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from typing import Any

from gcode.hosts.unknown import UnknownCommands
from gcode.hosts.web import part_of

OCTOPRINT_ENDS = ("PrintDone", "PrintFailed", "PrintCancelled")
BUSY_STATES = ("printing", "paused", "pausing", "resuming", "cancelling", "finishing")


@dataclass(slots=True)
class ServerState:
    """State as told by the push socket, and by `/api/job` where news were missed.

    Attributes
    ----------
    outcome
        The event that ended the followed print; the server is at rest a little later.
    file_position
        Bytes of the followed file that the server has read, not what was carried out.
    moved
        It has changed since the follower last looked.
    terminal
        Lines of the server's terminal while somebody waits for an answer, else None.
    unknown
        Commands that the printer has not known since the print is followed.
    plugin, told
        Whose messages are taken, and the last one.
    """

    connected: bool = False
    text: str = ""
    error: str = ""
    flags: dict[str, bool] = field(default_factory=dict)
    file: str = ""
    file_position: int = 0
    moved: bool = False
    resends: int = 0
    outcome: str = ""
    unknown: UnknownCommands = field(default_factory=UnknownCommands)
    terminal: deque[str] | None = None
    plugin: str = ""
    told: dict[str, Any] = field(default_factory=dict)

    @property
    def failed(self) -> bool:
        """Whether the server has lost its printer, or it reported a fault."""
        return bool(self.flags.get("closedOrError") or self.flags.get("error"))

    @property
    def at_rest(self) -> bool:
        """Whether the server does nothing with a file."""
        return not any(self.flags.get(name) for name in BUSY_STATES)

    @property
    def ended(self) -> bool:
        """Whether the followed print is over."""
        return self.failed or (bool(self.outcome) and self.at_rest)

    @property
    def trouble(self) -> str:
        """The server's own words for where it stands."""
        return self.error or self.text or "it says nothing"

    def follow(self, file: str) -> None:
        """Follow the print of a file from now on."""
        self.file, self.file_position, self.outcome, self.error = file, 0, "", ""
        self.unknown = UnknownCommands()

    def take(self, message: object) -> None:
        """Take one message of the push socket; what is not understood is left alone."""
        if not isinstance(message, dict):
            return
        for kind in ("history", "current"):
            if isinstance(news := message.get(kind), dict):
                self._take_current(news, with_log=kind == "current")
                self.connected = True
        said = part_of(message, "plugin")
        if self.plugin and said.get("plugin") == self.plugin:
            self.told = part_of(said, "data")
        event = message.get("event")
        if isinstance(event, dict):
            self._take_event(str(event.get("type")), event.get("payload"))

    def _take_current(self, news: dict[str, Any], *, with_log: bool) -> None:
        state = news.get("state")
        if isinstance(state, dict):
            self.text, self.error = str(state.get("text", "")), str(state.get("error") or "")
            flags = state.get("flags")
            self.flags = {k: bool(v) for k, v in flags.items()} if isinstance(flags, dict) else {}
        resends = news.get("resends")
        if isinstance(resends, dict) and isinstance(resends.get("count"), int):
            self.resends = resends["count"]
        self._take_progress(news)
        logs = news.get("logs")
        for line in map(str, logs if with_log and isinstance(logs, list) else ()):
            self.unknown.hear(line.removeprefix("Recv: "))
            if self.terminal is not None:
                self.terminal.append(line)

    def _take_progress(self, news: dict[str, Any]) -> None:
        if _path(news) != self.file:
            return
        position = part_of(news, "progress").get("filepos")
        if isinstance(position, int):  # goes back to None once cancelled: the last one stays
            self.moved = self.moved or position != self.file_position
            self.file_position = position

    def _take_event(self, kind: str, payload: object) -> None:
        if kind == "Error" and isinstance(payload, dict):
            self.error = str(payload.get("error") or self.error)
        if not isinstance(payload, dict) or payload.get("path") != self.file:
            return
        if kind in OCTOPRINT_ENDS and not self.outcome:
            cancelled = payload.get("reason") == "cancelled"
            self.outcome = "PrintCancelled" if cancelled else kind
            # The flags lag behind by up to half a second; rest is what the next ones say.
            self.flags = {**self.flags, "finishing": True}

    def look(self, report: dict[str, Any], flags: dict[str, bool]) -> bool:
        """Take `/api/job` and the flags of `/api/printer`, empty where it is not operational.

        Returns
        -------
        False where the followed print is neither under way nor known to have ended.
        """
        self.text = str(report.get("state", ""))
        self.error = str(report.get("error") or self.error)
        self.flags = dict(flags) if flags else {"closedOrError": True}
        self._take_progress(report)
        if self.failed or self.outcome:
            return True
        if not self.at_rest:
            return _path(report) == self.file
        done = part_of(report, "progress").get("completion")
        if _path(report) == self.file and isinstance(done, int | float) and done >= 100.0:
            self.outcome = "PrintDone"
            return True
        return False


def _path(news: dict[str, Any]) -> str:
    return str(part_of(part_of(news, "job"), "file").get("path"))
